"""The scans before a scan, as they were measured or as the robot sees them from where it is now."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numba
import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.access.bearings import level_mount
from semantic2d_dataset.access.features import share_rows
from semantic2d_dataset.access.scan_source import ScanSource
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.geometry import arctan_quadrant, compose, invert
from semantic2d_dataset.scene.lidars import LidarSpec
from semantic2d_dataset.scene.taxonomy import UNLABELLED

_FILL = {"ranges": np.nan, "intensities": 0.0, "labels": UNLABELLED, "poses": np.nan}

Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class History:
    """Which past scans come with each scan; never those of another sequence.

    Parameters
    ----------
    scans
        How many, k.
    stride
        Take every so manieth scan of the past; 2 at 20 Hz are 0.1 s.
    max_gap_s
        Nothing before a gap is taken: where two scans that follow each other in a recording lie
        farther apart in time than this, s.
    across_splits
        Take past scans of any split and of the gaps between them, too. They are inputs without
        labels, but a network that is tested behind a border has then seen these inputs in
        training: by default there is no such scan in an item.
    compensate
        ``ranges`` brings past scans to the beams of the current one by the motion between the
        two poses, ``points`` gives their points in the current lidar frame besides; None leaves
        them as they were measured. A past scan without a known pose counts as absent then.
    labels
        Give the labels of past scans, too; of the same split alone.

    Raises
    ------
    InvalidInputError
        If a value is out of its domain.
    """

    scans: int
    stride: int = 1
    max_gap_s: float = 1.0
    across_splits: bool = False
    compensate: Literal["ranges", "points"] | None = None
    labels: bool = False

    def __post_init__(self) -> None:
        if self.scans < 1 or self.stride < 1 or not self.max_gap_s > 0:
            raise InvalidInputError(
                f"history: expected scans, stride and max_gap_s above 0, found {self}"
            )
        if self.compensate not in (None, "ranges", "points"):
            raise InvalidInputError(
                f"history: compensate must be 'ranges', 'points' or None, found {self.compensate!r}"
            )
        if self.labels and self.across_splits:
            raise InvalidInputError(
                "history: labels of other splits are not for training: give either labels or "
                "across_splits"
            )


class PastScans:
    """Finds and reads the past scans of scans of a split.

    Parameters
    ----------
    source
        The scans that have a past.
    history
        Which past scans are wanted.

    Raises
    ------
    InvalidInputError
        If motion is to be compensated for a lidar that is not mounted level.
    """

    def __init__(self, source: ScanSource, history: History) -> None:
        self.source, self.history = source, history
        self._pool = source.of_split(None) if history.across_splits else source
        stamps = source.read_stamps()
        self._starts = np.cumsum([0, *map(len, stamps)])
        self._stamps = np.concatenate(stamps)
        self._segments = _segments_of(stamps, history.max_gap_s)
        if history.compensate:
            level_mount(source.lidar)

    def fetch(self, wanted: NDArray[np.int64]) -> Arrays:
        """Return the past of n scans, the oldest first.

        Returns
        -------
        ``ranges`` (n, k, B) f4 m, NaN where there is no such scan; ``intensities`` (n, k, B) f4
        where the lidar gives them; ``labels`` (n, k, B) u1 where they are wanted; ``points``
        (n, k, B, 2) f4 m, NaN where there is no return, where they are wanted; ``poses``
        (n, k, 3) f4 m, m, rad: the past base in the current base's frame, NaN where unknown;
        ``valid`` (n, k) bool: there is such a scan; ``dt_s`` (n, k) f4: how old it is, NaN
        where there is none.
        """
        numbers, dt_s = self._find(wanted)
        arrays = self._read(numbers)
        now, rows = self.source.fetch(wanted, {"poses"})
        motion = compose(invert(now["poses"][rows])[:, None], arrays["poses"])
        valid = numbers >= 0
        if self.history.compensate:
            valid &= np.isfinite(motion).all(axis=-1)
            arrays = self._compensate(arrays, motion, valid)
        return arrays | {
            "poses": motion.astype(np.float32),
            "valid": valid,
            "dt_s": np.where(valid, dt_s, np.nan).astype(np.float32),
        }

    def _find(self, wanted: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return numbers of past scans in the pool (n, k), -1 where none, and their ages, s."""
        sequences, rows = self.source.places_of(wanted)
        steps = self.history.stride * np.arange(self.history.scans, 0, -1)
        past = rows[:, None] - steps
        now = (self._starts[sequences] + rows)[:, None]
        then = np.maximum(now - steps, self._starts[sequences][:, None])
        known = (past >= 0) & (self._segments[then] == self._segments[now])
        numbers = self._pool.numbers_at(sequences[:, None], past)
        return np.where(known, numbers, -1), (self._stamps[now] - self._stamps[then]) / 1e9

    def _read(self, numbers: NDArray[np.int64]) -> Arrays:
        """Read scans by number, each once."""
        names = {"ranges", "poses", "intensities"} | ({"labels"} if self.history.labels else set())
        there = numbers >= 0
        unique, inverse = np.unique(numbers[there], return_inverse=True)
        fields, rows = self._pool.fetch(unique, names)
        arrays = {}
        for name in names & set(fields):
            values = fields[name]
            arrays[name] = np.full((*numbers.shape, *values.shape[1:]), _FILL[name], values.dtype)
            arrays[name][there] = values[rows[inverse]]
        return arrays

    def _compensate(
        self, arrays: Arrays, motion: NDArray[np.float64], valid: NDArray[np.bool_]
    ) -> Arrays:
        lidar = self.source.lidar
        turn, shift = _lidar_motion(lidar, np.where(valid[..., None], motion, 0.0))
        ranges = np.where(valid[..., None], arrays["ranges"], np.float32(np.nan))
        if self.history.compensate == "points":
            returns = np.where(lidar.has_return(ranges), ranges, np.float32(np.nan))
            ends = returns[..., None] * _directions(lidar)  # (n, k, B, 2)
            points = ends @ np.swapaxes(turn, -1, -2) + shift[..., None, :]
            return arrays | {"ranges": ranges, "points": points.astype(np.float32)}
        seen, beams = see_again(ranges, lidar, turn, shift)
        found = arrays | {"ranges": np.where(valid[..., None], seen, np.float32(np.nan))}
        for name in {"intensities", "labels"} & set(arrays):
            found[name] = np.full_like(arrays[name], _FILL[name])
            values, picked = (each.reshape(-1, lidar.beams) for each in (arrays[name], found[name]))
            _pick(values, beams.reshape(-1, lidar.beams), picked)
        return found


def see_again(
    ranges: NDArray[np.float32],
    lidar: LidarSpec,
    turn: NDArray[np.float64],
    shift: NDArray[np.float64],
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Tell what a lidar would measure elsewhere of the endpoints that it measured here.

    Each endpoint goes to the beam nearest in bearing, and the nearest of those that fall on one
    beam is seen. What was hidden stays hidden: a beam that meets no endpoint has no return.

    Parameters
    ----------
    ranges
        (..., B) f4, m.
    lidar
        The sensor.
    turn, shift
        (..., 2, 2) and (..., 2) f8: ``p_there = turn @ p_here + shift``, lidar frames.

    Returns
    -------
    ranges, beams
        (..., B) f4 in m, +inf without return, and (..., B) i8: which beam measured it, -1 for
        none.
    """
    shape = ranges.shape
    seen = np.full(shape, np.inf, np.float32)
    beams = np.full(shape, -1, np.int64)
    rows = np.ascontiguousarray(ranges).reshape(-1, lidar.beams)
    turns = np.ascontiguousarray(turn).reshape(-1, 2, 2)
    shifts = np.ascontiguousarray(shift).reshape(-1, 2)
    outs = seen.reshape(rows.shape), beams.reshape(rows.shape)
    limits, angles = (lidar.range_min, lidar.range_max), (lidar.angle_min, lidar.angle_increment)
    directions = _directions(lidar)

    def work(part: slice) -> None:
        a, b = outs[0][part], outs[1][part]
        _see_again(rows[part], turns[part], shifts[part], a, b, directions, limits, angles)

    share_rows(work, len(rows))
    return seen, beams


def _segments_of(stamps: list[NDArray[np.int64]], max_gap_s: float) -> NDArray[np.int64]:
    """Give each stretch without a gap a number, (N,) i8; sequences share none."""
    parts, first = [], 0
    for each in stamps:
        gaps = np.diff(each, prepend=each[:1]) > max_gap_s * 1e9
        parts.append(first + np.cumsum(gaps))
        first = int(parts[-1][-1]) + 1 if len(each) else first
    return np.concatenate(parts)


def _directions(lidar: LidarSpec) -> NDArray[np.float64]:
    return np.stack((np.cos(lidar.bearings), np.sin(lidar.bearings)), axis=-1)


def _lidar_motion(
    lidar: LidarSpec, motion: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Turn base motions (..., 3) into turn (..., 2, 2) and shift (..., 2) of the lidar's points."""
    mount, offset = level_mount(lidar)
    c, s = np.cos(motion[..., 2]), np.sin(motion[..., 2])
    rotation = np.stack((np.stack((c, -s), -1), np.stack((s, c), -1)), -2)
    unmount = np.linalg.inv(mount)
    turn = unmount @ rotation @ mount
    shift = (rotation @ offset + motion[..., :2] - offset) @ unmount.T
    return turn, shift


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _see_again(
    ranges: NDArray[np.float32],
    turn: NDArray[np.float64],
    shift: NDArray[np.float64],
    seen: NDArray[np.float32],
    beams: NDArray[np.int64],
    directions: NDArray[np.float64],
    limits: tuple[float, float],
    angles: tuple[float, float],
) -> None:
    count, circle = ranges.shape[1], 2 * np.pi / angles[1]
    for n in range(len(ranges)):
        a, t = turn[n], shift[n]
        for k in range(count):
            r = ranges[n, k]
            if not (r > 0 and r >= limits[0] and r < limits[1]):
                continue
            x, y = r * directions[k, 0], r * directions[k, 1]
            u = a[0, 0] * x + a[0, 1] * y + t[0]
            v = a[1, 0] * x + a[1, 1] * y + t[1]
            distance = np.float32(np.sqrt(u * u + v * v))
            if not (distance > 0 and distance >= limits[0] and distance < limits[1]):
                continue
            bearing = float(arctan_quadrant(np.float32(abs(v)), np.float32(abs(u))))
            bearing = np.pi - bearing if u < 0 else bearing
            position = ((-bearing if v < 0 else bearing) - angles[0]) / angles[1]
            position -= np.floor((position + 0.5) / circle) * circle
            beam = int(position + 0.5)
            while beam < count:
                if distance < seen[n, beam]:
                    seen[n, beam], beams[n, beam] = distance, k
                beam += int(np.rint(circle))  # the last beam may look where the first one does


@numba.njit(cache=True, nogil=True)
def _pick(values: NDArray[Any], beams: NDArray[np.int64], out: NDArray[Any]) -> None:
    for n in range(len(values)):
        for k in range(values.shape[1]):
            if beams[n, k] >= 0:
                out[n, k] = values[n, beams[n, k]]
