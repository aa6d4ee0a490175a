"""The YAML that describes a recording in arrays or columns: what it may say, and what it means."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jsonschema
import yaml

from conversion.tables.rows import Selector
from semantic2d_dataset.errors import InvalidInputError, RecordingError
from semantic2d_dataset.format.sequence import slug
from semantic2d_dataset.scene.lidars import LidarSpec, find_lidar, read_lidar
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, UNLABELLED

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
PER_SECOND = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}
RADIANS = {"rad": 1.0, "deg": math.pi / 180}

_MAX_BYTES = 1 << 20
_SELECTED = ("ranges", "intensities", "labels", "stamps", "poses", "velocities")
_EXAMPLE = """\
# What the arrays of a recording mean. Leave out what there is not; only data, ranges and lidar
# are needed. Save it as layout.yaml and run: semantic2d convert layout.yaml --out sequences/

data: run.npz              # a .npz, a .csv, or a folder of .npy; relative to this file
ranges: ranges             # (N, B); in a .csv first and last column: r0..r359, or 3..362
range_unit: m              # m, cm or mm
no_return: [0.0, 65.533]   # m, what the driver writes where there is no return
clockwise: false           # whether beams run clockwise: they are reversed then
intensities: intensities   # (N, B)
labels: labels             # (N, B)
classes: {0: Other, 3: Wall, 12: Person, 255: 255}  # class by the ids in labels; 255: unlabelled
stamps: t                  # (N,)
stamp_unit: s              # s, ms, us or ns
poses: poses               # (N, 3) x y yaw of the base in the map; or [x, y, yaw], one by one
yaw_unit: rad              # rad or deg
velocities: [vx, wz]       # (N, 2) m/s and rad/s
lidar:                     # a lidar of the release (hokuyo, wlr716, rplidar), a LIDAR.yaml, or
  name: my-lidar
  angle_min: -135          # of the first beam when they run counter-clockwise
  angle_max: 135           # of the last beam; or angle_increment
  angle_unit: deg          # rad or deg
  range_min: 0.1           # m
  range_max: 30.0
  mount: [0.1, 0, 0.2, 0, 0, 0]  # on the base: x y z in m, roll pitch yaw in rad
environment: lobby         # parts of the sequence's name
recording: run-1
license: CC-BY-4.0
"""

_TEXT = {"type": "string", "minLength": 1}
_NUMBER = {"type": "number"}
_ONE = {"type": ["string", "integer"], "minLength": 1, "minimum": 0}
_SELECTOR = {"anyOf": [_ONE, {"type": "array", "items": _ONE, "minItems": 1}]}
_LIDAR = {
    "type": "object",
    "additionalProperties": False,
    "required": ["angle_min", "range_min", "range_max"],
    "oneOf": [{"required": ["angle_max"]}, {"required": ["angle_increment"]}],
    "properties": {
        "name": _TEXT,
        "model": _TEXT,
        "angle_min": _NUMBER,
        "angle_max": _NUMBER,
        "angle_increment": _NUMBER,
        "angle_unit": {"enum": list(RADIANS)},
        "range_min": _NUMBER,
        "range_max": _NUMBER,
        "mount": {"type": "array", "items": _NUMBER, "minItems": 6, "maxItems": 6},
    },
}
_SCHEMA: dict[str, Any] = {
    "type": "object",
    "additionalProperties": False,
    "required": ["data", "ranges"],
    "properties": {
        "data": _TEXT,
        "ranges": _SELECTOR,
        "intensities": _SELECTOR,
        "labels": _SELECTOR,
        "stamps": _ONE,
        "poses": _SELECTOR,
        "velocities": _SELECTOR,
        "range_unit": {"enum": list(METRES)},
        "stamp_unit": {"enum": list(PER_SECOND)},
        "yaw_unit": {"enum": list(RADIANS)},
        "no_return": {"type": "array", "items": _NUMBER},
        "clockwise": {"type": "boolean"},
        "classes": {"type": "object"},
        "lidar": {"anyOf": [_TEXT, _LIDAR]},
        "environment": _TEXT,
        "recording": _TEXT,
        "license": _TEXT,
    },
}


@dataclass(frozen=True)
class TableLayout:
    """What a description says, in the units of the format.

    Parameters
    ----------
    path
        The description.
    data
        The file or folder that it describes.
    ranges, intensities, labels, stamps, poses, velocities
        Where they are; None where there are none.
    metres, per_second, radians
        Length of a unit of the ranges, units of the stamps in a second, size of a unit of yaw.
    no_return
        Ranges that stand for no return, m.
    clockwise
        Whether beams run clockwise.
    classes
        Class ids by the ids in the labels; empty where these are ours.
    lidar
        As described, or its name or file; None where nothing is said of it.
    environment, recording, license
        As described.
    """

    path: Path
    data: Path
    ranges: Selector
    intensities: Selector | None = None
    labels: Selector | None = None
    stamps: Selector | None = None
    poses: Selector | None = None
    velocities: Selector | None = None
    metres: float = 1.0
    per_second: int = 1
    radians: float = 1.0
    no_return: tuple[float, ...] = ()
    clockwise: bool = False
    classes: Mapping[int, int] = field(default_factory=dict)
    lidar: str | Mapping[str, Any] | None = None
    environment: str | None = None
    recording: str | None = None
    license: str | None = None

    def lidar_of(self, beams: int, named: str | None) -> LidarSpec:
        """Return the lidar of scans of so many beams: the one named, else the one described.

        Raises
        ------
        RecordingError
            If there is none, or it has another number of beams.
        InvalidInputError
            If nothing has that name.
        """
        said = self.lidar if named is None else named
        if said is None:
            raise RecordingError(
                self.path,
                f"expected lidar: name it or describe its angles, for scans of {beams} beams; an "
                f"example:\n\n{example_description()}",
            )
        spec = self._described(said, beams) if isinstance(said, Mapping) else self._named(said)
        if spec.beams != beams:
            raise RecordingError(
                self.path, f"lidar: {spec.name} has {spec.beams} beams, but the ranges {beams}"
            )
        return spec

    def _named(self, name: str) -> LidarSpec:
        if not name.lower().endswith((".yaml", ".yml")):
            return find_lidar(name)
        here = self.path.parent / name
        return read_lidar(here if here.is_file() else Path(name))

    def _described(self, said: Mapping[str, Any], beams: int) -> LidarSpec:
        unit = RADIANS[said.get("angle_unit", "rad")]
        first = float(said["angle_min"]) * unit
        if "angle_max" in said:
            step = (float(said["angle_max"]) * unit - first) / max(beams - 1, 1)
        else:
            step = float(said["angle_increment"]) * unit
        name = slug(str(said.get("name", f"lidar-{beams}")))
        x, y, z, roll, pitch, yaw = (float(value) for value in said.get("mount", (0.0,) * 6))
        try:
            return LidarSpec(
                name=name,
                model=str(said.get("model", name)),
                beams=beams,
                angle_min=first,
                angle_increment=step,
                range_min=float(said["range_min"]),
                range_max=float(said["range_max"]),
                base_T_lidar=(x, y, z, roll, pitch, yaw),
            )
        except InvalidInputError as err:
            raise RecordingError(self.path, f"lidar: {err}") from err


def example_description() -> str:
    """Return a description that names every key, to start from."""
    return _EXAMPLE


def read_layout(path: Path) -> TableLayout:
    """Read and check a description.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    RecordingError
        If it is none, or says what cannot be: with the key, and what may be there.
    """
    path = Path(path)
    if path.stat().st_size > _MAX_BYTES:
        raise RecordingError(path, f"is longer than {_MAX_BYTES} bytes: no description")
    try:
        said = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, ValueError, RecursionError) as err:
        raise RecordingError(path, f"not a YAML file: {err}") from err
    if not isinstance(said, dict) or not said:
        raise RecordingError(
            path, f"expected a description of arrays, such as:\n\n{example_description()}"
        )
    if {"image", "resolution"} <= said.keys():
        raise RecordingError(
            path, "is a map, not a recording; maps go to: semantic2d salsa label SEQUENCE --map MAP"
        )
    _check(path, said)
    selectors = {name: _selector(said[name]) for name in _SELECTED if name in said}
    return TableLayout(
        path=path,
        data=path.parent / said["data"],
        **selectors,
        metres=METRES[said.get("range_unit", "m")],
        per_second=PER_SECOND[said.get("stamp_unit", "s")],
        radians=RADIANS[said.get("yaw_unit", "rad")],
        no_return=tuple(float(value) for value in said.get("no_return", ())),
        clockwise=said.get("clockwise", False),
        classes=_classes(path, said.get("classes", {})),
        lidar=said.get("lidar"),
        environment=said.get("environment"),
        recording=said.get("recording"),
        license=said.get("license"),
    )


def _selector(said: Any) -> Selector:
    return tuple(map(str, said)) if isinstance(said, list) else str(said)


def _check(path: Path, said: dict[Any, Any]) -> None:
    _check_keys(path, "", said, _SCHEMA)
    if isinstance(said.get("lidar"), dict):
        _check_keys(path, "lidar: ", said["lidar"], _LIDAR)
    problem = jsonschema.exceptions.best_match(
        jsonschema.Draft202012Validator(_SCHEMA).iter_errors(said)
    )
    if problem is not None:
        where = problem.json_path.removeprefix("$.").removeprefix("$")
        raise RecordingError(path, f"{where + ': ' if where else ''}{problem.message}")


def _check_keys(path: Path, where: str, said: dict[Any, Any], schema: Mapping[str, Any]) -> None:
    known = schema["properties"]
    unknown = [str(key) for key in said if key not in known]
    if unknown:
        raise RecordingError(
            path,
            f"{where}unknown key {', '.join(map(repr, unknown))}; known are {', '.join(known)}",
        )
    missing = [key for key in schema["required"] if key not in said]
    if missing:
        raise RecordingError(
            path,
            f"{where}expected {', '.join(missing)} too; an example:\n\n{example_description()}",
        )


def _classes(path: Path, said: Mapping[Any, Any]) -> dict[int, int]:
    found = {}
    for key, value in said.items():
        if isinstance(key, bool) or not isinstance(key, int):
            raise RecordingError(path, f"classes: expected ids as keys, found {key!r}")
        found[key] = _class_id(path, value)
    return found


def _class_id(path: Path, value: Any) -> int:
    if isinstance(value, str):
        try:
            return SEMANTIC2D.id_of(value)
        except InvalidInputError as err:
            raise RecordingError(path, f"classes: {err}") from err
    if isinstance(value, int) and value in (*range(len(SEMANTIC2D)), UNLABELLED):
        return int(value)
    raise RecordingError(
        path,
        f"classes: expected a class by name ({', '.join(SEMANTIC2D.names)}) or id (0 to "
        f"{len(SEMANTIC2D) - 1}, {UNLABELLED} for unlabelled), found {value!r}",
    )
