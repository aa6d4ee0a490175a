"""Poses over time: how a source recorded them, and what they are between its samples."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from conversion.messages.spill import Spill
from semantic2d_dataset.scene.geometry import interpolate_poses

Values = tuple[float, float, float, float, float, float, float]

_MIN_GAP_S = 0.5
_PERIODS_PER_GAP = 2.0
_MAX_DISTANCE_M = 1e8
_SHORTEST_TURN, _LONGEST_TURN = 0.9**2, 1.1**2  # squares of lengths of quaternions
_BLOCK = 256  # samples that are kept aside together
_SAMPLED = 1 << 16  # stamps at which poses are asked for at once
_LOOKED_AT = 64  # blocks that stand for all of a long recording in a median
_ROW = np.dtype([("header", "<i8"), ("record", "<i8"), ("pose", "<f8", 3)])

Samples = tuple[NDArray[np.int64], NDArray[np.float64]]
"""Stamps (M,) i8 and poses (M, 3) f8 x y yaw."""


class Track:
    """Poses in the plane over time.

    Of samples with one stamp the last counts. Of a track in blocks only those are loaded that
    are needed, so that a long one takes no more memory than a short one.

    Parameters
    ----------
    stamps_ns
        (M,) i8, in any order.
    poses
        (M, 3) f8 x y yaw.
    """

    def __init__(self, stamps_ns: NDArray[np.int64], poses: NDArray[np.float64]) -> None:
        known = bool(stamps_ns.size)
        spans = [[stamps_ns.min(), stamps_ns.max()]] if known else np.empty((0, 2))
        self._spans = np.array(spans, np.int64)
        self._load: Callable[[Sequence[int]], Samples] = lambda _: (stamps_ns, poses)
        self._shift_ns = 0

    @classmethod
    def in_blocks(
        cls,
        spans: NDArray[np.int64],
        load: Callable[[Sequence[int]], Samples],
        shift_ns: int = 0,
    ) -> Self:
        """Return a track of which `load` gives the samples of some blocks.

        Parameters
        ----------
        spans
            (K, 2) i8, the first and the last stamp in each block.
        load
            Takes numbers of blocks, and returns their samples in the order of recording.
        shift_ns
            Added to all of these stamps.
        """
        track = cls(np.empty(0, np.int64), np.empty((0, 3)))
        track._spans, track._load, track._shift_ns = spans + shift_ns, load, shift_ns
        return track

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """Every stamp once, (M,) i8, strictly increasing."""
        return self._sorted(range(len(self._spans)))[0]

    @property
    def poses(self) -> NDArray[np.float64]:
        """The poses at `stamps_ns`, (M, 3) f8."""
        return self._sorted(range(len(self._spans)))[1]

    @property
    def period_s(self) -> float:
        """Median time between two samples, s; 0 where there are fewer than two.

        Of a long track it is the median of blocks spread over it.
        """
        blocks = _spread(len(self._spans))
        whole = len(blocks) == len(self._spans)
        groups = [blocks] if whole else [[block] for block in blocks]
        steps = np.concatenate([np.diff(self._sorted(group)[0]) for group in groups])
        return float(np.median(steps)) / 1e9 if steps.size else 0.0

    def shifted(self, by_ns: int) -> Track:
        """Return the track with its stamps moved."""
        return Track.in_blocks(self._spans - self._shift_ns, self._load, self._shift_ns + by_ns)

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
        at = np.asarray(at_ns, np.int64)
        found = np.full((at.size, 3), np.nan)
        if not len(self._spans):
            return found
        for start in range(0, at.size, _SAMPLED):
            part = at[start : start + _SAMPLED]
            samples = self._sorted(self._around(int(part.min()), int(part.max())))
            reach_s = max_gap_s if held else 0.0
            found[start : start + _SAMPLED] = _interpolate(*samples, part, max_gap_s, reach_s)
        return found

    def _around(self, first_ns: int, last_ns: int) -> list[int]:
        """Blocks that hold what lies between two stamps, and the samples next to both."""
        starts, stops = self._spans.T
        before, after = stops[stops < first_ns], starts[starts > last_ns]
        first_ns = before.max() if before.size else first_ns
        last_ns = after.min() if after.size else last_ns
        near: list[int] = np.flatnonzero((stops >= first_ns) & (starts <= last_ns)).tolist()
        return near

    def _sorted(self, blocks: Sequence[int]) -> Samples:
        stamps, poses = self._load(blocks)
        if not (np.diff(stamps) > 0).all():
            stamps, last = np.unique(stamps[::-1], return_index=True)
            poses = poses[::-1][last]
        return stamps + self._shift_ns, poses


def default_gap_s(*tracks: Track) -> float:
    """Return twice the median period of the slowest track, at least 0.5 s."""
    return max((_MIN_GAP_S, *(_PERIODS_PER_GAP * track.period_s for track in tracks)))


class TrackLog:
    """Collect the samples of one source: all of them, in memory that does not grow with them.

    Parameters
    ----------
    spill
        Takes 40 bytes of each sample; None makes one of its own.
    """

    def __init__(self, spill: Spill | None = None) -> None:
        self._spill = spill
        self._stamps = array("q")  # header and record, by turns
        self._values = array("d")
        self._blocks = array("q")  # place, number of rows, spans of header and record
        self._count = 0
        self._first: NDArray[np.float64] | None = None
        self._last = np.empty(7)
        self._low, self._high = np.full(7, np.inf), np.full(7, -np.inf)
        self._upright = 1.0

    def __len__(self) -> int:
        return self._count + len(self._stamps) // 2

    def add(self, stamp_ns: int, record_ns: int, values: Values) -> None:
        """Add a sample with its own stamp and the time of its recording."""
        self._stamps.append(stamp_ns)
        self._stamps.append(record_ns)
        self._values.extend(values)
        if len(self._stamps) >= 2 * _BLOCK:
            self._settle()

    @property
    def first(self) -> NDArray[np.float64]:
        """Position and quaternion of the first sample, (7,) f8 x y z qx qy qz qw."""
        self._settle()
        return np.full(7, np.nan) if self._first is None else self._first

    @property
    def last(self) -> NDArray[np.float64]:
        """Position and quaternion of the last sample, (7,) f8."""
        self._settle()
        return self._last

    @property
    def extent(self) -> NDArray[np.float64]:
        """How far each of the seven numbers moves, (7,) f8; q and -q are one rotation."""
        self._settle()
        extent: NDArray[np.float64] = self._high - self._low
        return extent

    @property
    def upright(self) -> float:
        """Cosine of the largest tilt of the z axis in any sample."""
        self._settle()
        return self._upright

    @property
    def lead_ns(self) -> int:
        """How far header stamps lie ahead of record times, median; of a long log an estimate."""
        self._settle()
        blocks = _spread(len(self._blocks) // 6)
        rows = self._rows(blocks)
        return int(np.median(rows["header"] - rows["record"])) if rows.size else 0

    def track(self, stamps: str) -> Track:
        """Return the samples in the order of their `header` or `record` stamps.

        Of samples with one stamp the last recorded counts.
        """
        self._settle()
        column = 2 if stamps == "header" else 4
        spans = np.array(self._blocks, np.int64).reshape(-1, 6)[:, column : column + 2]
        return Track.in_blocks(spans, partial(self._load, stamps))

    def _settle(self) -> None:
        """Keep what was added aside, and what matters of it here."""
        if not self._stamps:
            return
        values = np.array(self._values).reshape(-1, 7)
        rows = np.empty(len(values), _ROW)
        stamps = np.array(self._stamps).reshape(-1, 2)
        rows["header"], rows["record"], rows["pose"] = *stamps.T, planar(values)
        self._spill = self._spill or Spill()
        spans = (stamps.min(axis=0), stamps.max(axis=0))
        at = self._spill.append(rows.tobytes())
        self._blocks.extend((at, len(rows), *(int(span[k]) for k in (0, 1) for span in spans)))
        self._count += len(rows)
        self._note(values)
        del self._stamps[:], self._values[:]

    def _note(self, values: NDArray[np.float64]) -> None:
        if self._first is None:
            self._first = values[0].copy()
        self._last = values[-1].copy()
        x, y, z, w = values[:, 3:].T
        self._upright = min(self._upright, float((w * w - x * x - y * y + z * z).min()))
        values[values[:, 3:] @ self._first[3:] < 0, 3:] *= -1
        self._low = np.minimum(self._low, values.min(axis=0))
        self._high = np.maximum(self._high, values.max(axis=0))

    def _load(self, stamps: str, blocks: Sequence[int]) -> Samples:
        rows = self._rows(blocks)
        return rows[stamps].astype(np.int64), rows["pose"].astype(np.float64)

    def _rows(self, blocks: Sequence[int]) -> NDArray[Any]:
        if self._spill is None:
            return np.empty(0, _ROW)
        found = bytearray()
        for block in blocks:
            at, count = self._blocks[6 * block : 6 * block + 2]
            found += self._spill.read(at, count * _ROW.itemsize)
        return np.frombuffer(found, _ROW)


def values_of(position: Any, rotation: Any) -> Values | None:
    """Return x y z qx qy qz qw of the parts of a ROS message, None where they are no pose."""
    place = (position.x, position.y, position.z)
    return usable((*place, rotation.x, rotation.y, rotation.z, rotation.w))


def usable(values: Values) -> Values | None:
    """Return a pose, x y z qx qy qz qw; None where the numbers are none.

    A pose is finite and on this planet, and its quaternion has a length of about one.
    """
    x, y, z, qx, qy, qz, qw = values
    near = x * x + y * y + z * z < _MAX_DISTANCE_M**2
    turn = qx * qx + qy * qy + qz * qz + qw * qw
    return values if near and _SHORTEST_TURN < turn < _LONGEST_TURN else None


def planar(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Reduce positions and quaternions (M, 7) to x y yaw (M, 3)."""
    x, y, z, w = values[:, 3:].T
    yaw = np.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)
    return np.column_stack((values[:, 0], values[:, 1], yaw))


def _spread(count: int) -> list[int]:
    """Numbers below a count, all of them or so many that are spread over them evenly."""
    if count <= _LOOKED_AT:
        return list(range(count))
    return [round(k * (count - 1) / (_LOOKED_AT - 1)) for k in range(_LOOKED_AT)]


def _interpolate(
    known: NDArray[np.int64],
    poses: NDArray[np.float64],
    at: NDArray[np.int64],
    max_gap_s: float,
    reach_s: float,
) -> NDArray[np.float64]:
    inside = np.clip(at, known[0], known[-1])
    found = interpolate_poses(known, poses, inside)
    before = known[np.searchsorted(known, inside, side="right") - 1]
    after = known[np.searchsorted(known, inside, side="left")]
    near = (after - before <= max_gap_s * 1e9) & (np.abs(at - inside) <= reach_s * 1e9)
    return np.where(near[:, None], found, np.nan)
