"""One scan, and a batch of scans of one lidar."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import DTypeLike, NDArray

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.lidars import LidarSpec


def check_array(
    name: str, array: object, dtype: DTypeLike, shape: tuple[int | None, ...], where: str = ""
) -> None:
    """Check kind, dtype and shape of an array; None in `shape` admits any length.

    Raises
    ------
    InvalidInputError
        With the name, what was expected and what was found.
    """
    prefix = f"{where}: " if where else ""
    wanted = f"({', '.join('any' if n is None else str(n) for n in shape)})"
    if not isinstance(array, np.ndarray):
        raise InvalidInputError(
            f"{prefix}{name}: expected an array of {np.dtype(dtype)} {wanted}, "
            f"found {type(array).__name__}"
        )
    same_shape = array.ndim == len(shape) and all(
        want is None or want == found for want, found in zip(shape, array.shape, strict=True)
    )
    if array.dtype != np.dtype(dtype) or not same_shape:
        raise InvalidInputError(
            f"{prefix}{name}: expected {np.dtype(dtype)} {wanted}, "
            f"found {array.dtype} {array.shape}"
        )


@dataclass(frozen=True)
class Scan:
    """One row of beams.

    Parameters
    ----------
    lidar
        The sensor that measured it, B beams.
    ranges
        (B,) f4, m, as measured: +inf no return, -inf too close, NaN invalid (REP 117).
    intensities
        (B,) f4, sensor units, or None.
    labels
        (B,) u1 class ids, 255 not labelled, or None.
    pose
        (3,) f8 x y yaw of the base in the map, NaN where unknown.
    stamp_ns
        Nanoseconds since the Unix epoch.
    """

    lidar: LidarSpec
    ranges: NDArray[np.float32]
    intensities: NDArray[np.float32] | None
    labels: NDArray[np.uint8] | None
    pose: NDArray[np.float64]
    stamp_ns: int

    def __post_init__(self) -> None:
        check_array("ranges", self.ranges, np.float32, (self.lidar.beams,))
        check_array("pose", self.pose, np.float64, (3,))
        if self.intensities is not None:
            check_array("intensities", self.intensities, np.float32, (self.lidar.beams,))
        if self.labels is not None:
            check_array("labels", self.labels, np.uint8, (self.lidar.beams,))

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Which beams have a return, (B,) bool."""
        return self.lidar.has_return(self.ranges)


@dataclass(frozen=True)
class ScanBatch:
    """N scans of one lidar, every array with leading N.

    Parameters
    ----------
    lidar
        The sensor that measured them, B beams.
    ranges
        (N, B) f4, m, as measured: +inf no return, -inf too close, NaN invalid (REP 117).
    intensities
        (N, B) f4, sensor units, or None.
    labels
        (N, B) u1 class ids, 255 not labelled, or None.
    poses
        (N, 3) f8 x y yaw of the base in the map, NaN where unknown.
    stamps_ns
        (N,) i8 nanoseconds since the Unix epoch.
    """

    lidar: LidarSpec
    ranges: NDArray[np.float32]
    intensities: NDArray[np.float32] | None
    labels: NDArray[np.uint8] | None
    poses: NDArray[np.float64]
    stamps_ns: NDArray[np.int64]

    def __post_init__(self) -> None:
        check_array("ranges", self.ranges, np.float32, (None, self.lidar.beams))
        rows = self.ranges.shape
        check_array("poses", self.poses, np.float64, (rows[0], 3))
        check_array("stamps_ns", self.stamps_ns, np.int64, (rows[0],))
        if self.intensities is not None:
            check_array("intensities", self.intensities, np.float32, rows)
        if self.labels is not None:
            check_array("labels", self.labels, np.uint8, rows)

    def __len__(self) -> int:
        return len(self.ranges)

    def __getitem__(self, index: int) -> Scan:
        return Scan(
            self.lidar,
            self.ranges[index],
            None if self.intensities is None else self.intensities[index],
            None if self.labels is None else self.labels[index],
            self.poses[index],
            int(self.stamps_ns[index]),
        )

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Which beams have a return, (N, B) bool."""
        return self.lidar.has_return(self.ranges)
