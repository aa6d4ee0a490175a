"""Poses over time: how a source recorded them, and what they are between its samples."""

from __future__ import annotations

import math
from array import array
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semantic2d_dataset.scene.geometry import interpolate_poses

Values = tuple[float, float, float, float, float, float, float]

_MIN_GAP_S = 0.5
_PERIODS_PER_GAP = 2.0
_MAX_DISTANCE_M = 1e8
_UNIT_WITHIN = 0.1


@dataclass(frozen=True)
class Track:
    """Poses in the plane over time.

    Parameters
    ----------
    stamps_ns
        (M,) i8, strictly increasing.
    poses
        (M, 3) f8 x y yaw.
    """

    stamps_ns: NDArray[np.int64]
    poses: NDArray[np.float64]

    @property
    def period_s(self) -> float:
        """Median time between two samples, s; 0 where there are fewer than two."""
        return float(np.median(np.diff(self.stamps_ns))) / 1e9 if len(self.stamps_ns) > 1 else 0.0

    def shifted(self, by_ns: int) -> Track:
        """Return the track with its stamps moved."""
        return Track(self.stamps_ns + by_ns, self.poses)

    def sample(
        self, at_ns: ArrayLike, max_gap_s: float, *, held: bool = False
    ) -> NDArray[np.float64]:
        """Interpolate the poses at other stamps.

        Parameters
        ----------
        at_ns
            (N,) i8.
        max_gap_s
            Longest time between two samples to interpolate over, s.
        held
            Whether the first and the last pose also hold for `max_gap_s` before and after.

        Returns
        -------
        (N, 3) f8; NaN where the samples are too far apart or too far away.
        """
        at, known = np.asarray(at_ns, np.int64), self.stamps_ns
        if not known.size:
            return np.full((at.size, 3), np.nan)
        inside = np.clip(at, known[0], known[-1])
        found = interpolate_poses(known, self.poses, inside)
        before = known[np.searchsorted(known, inside, side="right") - 1]
        after = known[np.searchsorted(known, inside, side="left")]
        reach_s = max_gap_s if held else 0.0
        near = (after - before <= max_gap_s * 1e9) & (np.abs(at - inside) <= reach_s * 1e9)
        return np.where(near[:, None], found, np.nan)


def default_gap_s(*tracks: Track) -> float:
    """Return twice the median period of the slowest track, at least 0.5 s."""
    return max((_MIN_GAP_S, *(_PERIODS_PER_GAP * track.period_s for track in tracks)))


class TrackLog:
    """Collect the samples of one source in 72 bytes each: position and quaternion, two stamps."""

    def __init__(self) -> None:
        self._header_ns = array("q")
        self._record_ns = array("q")
        self._values = array("d")

    def __len__(self) -> int:
        return len(self._header_ns)

    def add(self, stamp: Any, record_ns: int, values: Values) -> None:
        """Add a sample with the stamp of a ROS message."""
        self._header_ns.append(stamp.sec * 10**9 + stamp.nanosec)
        self._record_ns.append(record_ns)
        self._values.extend(values)

    @property
    def values(self) -> NDArray[np.float64]:
        """Position and quaternion of every sample, (M, 7) f8 x y z qx qy qz qw."""
        return np.array(self._values).reshape(-1, 7)

    @property
    def lead_ns(self) -> int:
        """How far header stamps lie ahead of record times, median."""
        header, record = np.array(self._header_ns), np.array(self._record_ns)
        return int(np.median(header - record)) if header.size else 0

    def track(self, stamps: str) -> Track:
        """Return the samples in the order of their `header` or `record` stamps.

        Of samples with one stamp the last recorded counts.
        """
        log = self._header_ns if stamps == "header" else self._record_ns
        known = np.array(log, np.int64)[::-1]
        distinct, first = np.unique(known, return_index=True)
        return Track(distinct, planar(self.values[::-1][first]))


def values_of(position: Any, rotation: Any) -> Values | None:
    """Return x y z qx qy qz qw of the parts of a ROS message, None where they are no pose.

    A pose is finite and on this planet, and its quaternion has a length of about one.
    """
    place = (position.x, position.y, position.z)
    turn = (rotation.x, rotation.y, rotation.z, rotation.w)
    usable = math.hypot(*place) < _MAX_DISTANCE_M and abs(math.hypot(*turn) - 1) < _UNIT_WITHIN
    return (*place, *turn) if usable else None


def planar(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Reduce positions and quaternions (M, 7) to x y yaw (M, 3)."""
    x, y, z, w = values[:, 3:].T
    yaw = np.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)
    return np.column_stack((values[:, 0], values[:, 1], yaw))
