"""The lidars of the release, and any other from a YAML file."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.documents import read_yaml


@dataclass(frozen=True)
class LidarSpec:
    """Geometry, limits and mount of one 2D lidar.

    Parameters
    ----------
    name
        Short id used in sequence ids and on the command line, such as ``hokuyo-utm-30lx-ew``.
    model
        The maker's name of the sensor.
    beams
        Number of beams B in one scan.
    angle_min
        Bearing of beam 0, rad, in the lidar's frame; beams run counter-clockwise.
    angle_increment
        Bearing step between beams, rad, positive.
    range_min, range_max
        Limits of a valid return, m: ``range_min <= r < range_max``.
    base_T_lidar
        Mount x, y, z (m), roll, pitch, yaw (rad): ``p_base = R p_lidar + t``.

    Raises
    ------
    InvalidInputError
        If a field is not finite or out of its domain.
    """

    name: str
    model: str
    beams: int
    angle_min: float
    angle_increment: float
    range_min: float
    range_max: float
    base_T_lidar: tuple[float, float, float, float, float, float] = (0.0,) * 6

    def __post_init__(self) -> None:
        numbers = (self.angle_min, self.angle_increment, self.range_min, self.range_max)
        if not all(math.isfinite(value) for value in (*numbers, *self.base_T_lidar)):
            raise InvalidInputError(f"lidar {self.name!r}: every number must be finite")
        if not 2 <= self.beams <= 100_000:
            raise InvalidInputError(
                f"lidar {self.name!r}: expected 2 to 100000 beams, found {self.beams}"
            )
        if not 0 < self.angle_increment * (self.beams - 1) <= 2 * math.pi + 1e-3:
            raise InvalidInputError(
                f"lidar {self.name!r}: beams must run counter-clockwise over at most 2 pi rad, "
                f"found {self.beams} beams {self.angle_increment} rad apart"
            )
        if not 0 <= self.range_min < self.range_max:
            raise InvalidInputError(
                f"lidar {self.name!r}: expected 0 <= range_min < range_max, "
                f"found {self.range_min} and {self.range_max}"
            )
        object.__setattr__(self, "base_T_lidar", tuple(self.base_T_lidar))
        if len(self.base_T_lidar) != 6:
            raise InvalidInputError(
                f"lidar {self.name!r}: base_T_lidar takes x y z roll pitch yaw, "
                f"found {len(self.base_T_lidar)} numbers"
            )

    @property
    def bearings(self) -> NDArray[np.float64]:
        """Bearing of every beam, (B,) f8, rad, lidar frame."""
        steps: NDArray[np.float64] = np.arange(self.beams, dtype=np.float64)
        return self.angle_min + self.angle_increment * steps

    def has_return(self, ranges: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Tell which ranges (..., B) in m are returns: above 0, finite and within the limits."""
        near: NDArray[np.bool_] = (ranges > 0) & (ranges >= self.range_min)
        return near & (ranges < self.range_max)


_HALF_FIELD = 2.356194496154785  # rad, of the Hokuyo and the WLR-716
_HALF_TURN = 3.1415927410125732  # rad, of the RPLIDAR

# Beams, angles, limits and mounts as recorded in the release's bags (paper, table of sensors).
HOKUYO_UTM_30LX_EW = LidarSpec(
    name="hokuyo-utm-30lx-ew",
    model="Hokuyo UTM-30LX-EW",
    beams=1081,
    angle_min=-_HALF_FIELD,
    angle_increment=2 * _HALF_FIELD / 1080,
    range_min=0.1,
    range_max=60.0,
    base_T_lidar=(-0.12, 0.0, 0.0, 0.0, 0.0, 0.0),
)
WLR_716 = LidarSpec(
    name="wlr-716",
    model="WLR-716",
    beams=811,
    angle_min=-_HALF_FIELD,
    angle_increment=2 * _HALF_FIELD / 810,
    range_min=0.15,
    range_max=25.0,
    base_T_lidar=(0.065, 0.0, 0.182, 3.1415926, 0.0, 0.0),
)
RPLIDAR_S2 = LidarSpec(
    name="rplidar-s2",
    model="RPLIDAR-S2",
    beams=1972,
    angle_min=-_HALF_TURN,
    angle_increment=2 * _HALF_TURN / 1971,
    range_min=0.2,
    range_max=30.0,
    base_T_lidar=(0.065, 0.0, 0.11, 0.0, 0.0, 3.1415926),
)

LIDARS = {spec.name: spec for spec in (HOKUYO_UTM_30LX_EW, WLR_716, RPLIDAR_S2)}
_ALIASES = {"hokuyo": HOKUYO_UTM_30LX_EW, "wlr716": WLR_716, "rplidar": RPLIDAR_S2}


def find_lidar(name: str) -> LidarSpec:
    """Look a lidar of the release up by its id or short name, whatever the case.

    Parameters
    ----------
    name
        ``hokuyo-utm-30lx-ew`` or ``hokuyo``, ``wlr-716`` or ``wlr716``, ``rplidar-s2`` or
        ``rplidar``.

    Raises
    ------
    InvalidInputError
        If no lidar has that name.
    """
    known = LIDARS | _ALIASES
    spec = known.get(name.strip().lower().replace("_", "-"))
    if spec is None:
        raise InvalidInputError(f"unknown lidar {name!r}; known are {', '.join(sorted(known))}")
    return spec


def full_name(name: str) -> str:
    """Return the id of a lidar of the release for its short name; any other name as it is."""
    try:
        return find_lidar(name).name
    except InvalidInputError:
        return name


def read_lidar(path: Path) -> LidarSpec:
    """Read a lidar from a YAML file whose keys are the fields of `LidarSpec`.

    Raises
    ------
    InvalidInputError
        If the file is not such a mapping, or a value is out of its domain.
    """
    found = read_yaml(path)
    names = {field.name for field in fields(LidarSpec)}
    if not isinstance(found, dict) or not set(found) <= names:
        raise InvalidInputError(f"{path}: expected a mapping with the keys {sorted(names)}")
    try:
        mount = tuple(float(value) for value in found.pop("base_T_lidar", (0.0,) * 6))
        numbers = {
            key: int(value) if key == "beams" else float(value)
            for key, value in found.items()
            if key not in ("name", "model")
        }
        names_of = {key: str(found.get(key, "")) for key in ("name", "model")}
        return LidarSpec(**names_of, **numbers, base_T_lidar=mount)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError) as err:
        raise InvalidInputError(f"{path}: {err}") from err


def describe(spec: LidarSpec) -> dict[str, object]:
    """Return the fields of a lidar as plain values for JSON or YAML."""
    return asdict(spec)
