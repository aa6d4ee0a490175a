"""Trajectories in files of their own: TUM, and the ground truth of MIT Stata Center."""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from conversion.messages.poses import FoundPoses
from conversion.messages.tracks import Track, default_gap_s
from conversion.messages.transforms import Mount
from conversion.wording import seconds
from semantic2d_dataset.errors import InvalidInputError, RecordingError
from semantic2d_dataset.scene.geometry import compose, invert, mount_in_plane

BASE, LIDAR = "base", "lidar"

_MAX_LINE_CHARS = 4096
_MAX_STAMP_NS = 2**62  # the year 2116; leaves room for an offset
_MAX_OFFSET_S = 4e9
_MAX_DISTANCE_M = 1e8
_UNIT_WITHIN = 0.1  # how far the length of a quaternion may be from 1
_LEVEL = 0.9  # cosine of the tilt up to which a pose is one of the plane
_SHOWN = 60


@dataclass(frozen=True)
class PoseFile:
    """A trajectory of a file.

    Parameters
    ----------
    path
        The file.
    kind
        What it is, for people.
    track
        Its poses in the plane, by their stamps.
    of
        Whether its kind gives poses of the ``base`` or of the ``lidar``.
    notices
        What was repaired or guessed, for the user.
    """

    path: Path
    kind: str
    track: Track
    of: str
    notices: tuple[str, ...] = ()


class _Kind(NamedTuple):
    """One layout of lines: how many words, what the first counts, how the others give a pose."""

    name: str
    words: int
    units_per_s: int
    of: str
    pose: Callable[[list[float]], tuple[float, float, float]]


def read_pose_file(path: Path) -> PoseFile:
    """Read a trajectory; which kind it is its first line tells.

    A TUM trajectory has lines ``stamp tx ty tz qx qy qz qw`` in s and m, of the base unless the
    user says otherwise. The ground truth of MIT Stata Center has lines ``t_us,x,y,yaw`` in us, m
    and rad, of the laser. Lines that begin with ``#`` and one line of column names are skipped.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    RecordingError
        If it is no such file, or a line holds no pose: with its number.
    """
    path = Path(path)
    stamps, poses = array("q"), array("d")
    kind: _Kind | None = None
    for number, words in _rows(path):
        if kind is None:
            kind = _kind_of(path, number, words)
        try:
            stamp_ns, pose = _read(kind, words)
        except ValueError as err:
            raise RecordingError(path, f"line {number} is no pose of a {kind.name}: {err}") from err
        stamps.append(stamp_ns)
        poses.extend(pose)
    if kind is None:
        raise RecordingError(path, f"expected poses, found none; {_EXPECTED}")
    known = np.array(stamps, np.int64)
    track = _ordered(known, np.array(poses).reshape(-1, 3))
    return PoseFile(path, kind.name, track, kind.of, _oddities(known, len(track.stamps_ns)))


def poses_at_scans(
    file: PoseFile,
    at_ns: NDArray[np.int64],
    mount: Mount,
    *,
    of: str | None = None,
    clock_offset_s: float = 0.0,
    max_gap_s: float | None = None,
) -> FoundPoses:
    """Interpolate the poses of the base at the stamps of scans.

    Parameters
    ----------
    file
        The trajectory.
    at_ns
        (N,) i8 stamps of the scans, non-decreasing.
    mount
        The lidar on its base; poses of the lidar are moved to the base by it.
    of
        Whether the file gives poses of the ``base`` or of the ``lidar``; None takes what its
        kind usually does.
    clock_offset_s
        Added to the stamps of the file, s.
    max_gap_s
        Longest time to interpolate over, s; None takes twice the median period of the file, at
        least 0.5 s.

    Raises
    ------
    InvalidInputError
        If the offset is beyond all clocks.
    RecordingError
        If no scan was taken while the file has poses: with both times, and the offset that would
        make them start together.
    """
    if not abs(clock_offset_s) < _MAX_OFFSET_S:
        raise InvalidInputError(f"clock offset: expected seconds, found {clock_offset_s}")
    track = file.track.shifted(round(clock_offset_s * 1e9))
    first, last = int(track.stamps_ns[0]), int(track.stamps_ns[-1])
    if not ((at_ns >= first) & (at_ns <= last)).any():
        raise RecordingError(file.path, _why_apart(track, at_ns, clock_offset_s))
    gap = default_gap_s(track) if max_gap_s is None else max_gap_s
    poses = track.sample(at_ns, gap)
    if (of or file.of) == LIDAR:
        rotation, (x, y) = mount_in_plane(mount)
        poses = compose(poses, invert((x, y, np.arctan2(rotation[1, 0], rotation[0, 0]))))
    found = FoundPoses(f"{file.kind} {file.path.name}", poses, gap)
    notices = (_coverage(found, track, clock_offset_s), *file.notices)
    return FoundPoses(found.source, found.poses, gap, notices)


def nanoseconds(text: str, units_per_s: int) -> int:
    """Read a time to the nanosecond, which floating-point numbers cannot hold.

    Parameters
    ----------
    text
        A decimal number.
    units_per_s
        What it counts: 1 for s, 1_000 for ms, and so on.

    Raises
    ------
    ValueError
        If it is no time.
    """
    try:
        stamp_ns = int((Decimal(text) * (10**9 // units_per_s)).to_integral_value())
    except (InvalidOperation, OverflowError, ValueError):
        raise ValueError(f"{text!r} is no time") from None
    if abs(stamp_ns) > _MAX_STAMP_NS:
        raise ValueError(f"{text!r} is no time: it is beyond the year 2116")
    return stamp_ns


def _of_tum(values: list[float]) -> tuple[float, float, float]:
    x, y, _, qx, qy, qz, qw = values
    if not abs(math.hypot(qx, qy, qz, qw) - 1) < _UNIT_WITHIN:
        raise ValueError("its last four numbers are no unit quaternion qx qy qz qw")
    if 1 - 2 * (qx * qx + qy * qy) < _LEVEL:
        raise ValueError("it leaves the plane: z does not point upward")
    return x, y, math.atan2(2 * (qw * qz + qx * qy), qw * qw + qx * qx - qy * qy - qz * qz)


def _of_stata(values: list[float]) -> tuple[float, float, float]:
    x, y, yaw = values
    return x, y, yaw


_TUM = _Kind("TUM trajectory", 8, 1, BASE, _of_tum)
_STATA = _Kind("MIT Stata ground truth", 4, 10**6, LIDAR, _of_stata)
_EXPECTED = (
    "lines are either 'stamp tx ty tz qx qy qz qw' (TUM, in s) or 't_us,x,y,yaw' (MIT Stata "
    "Center, in us)"
)


def _rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield the words of each line, without comments and the one line of column names."""
    number = named = 0
    begun = False
    with path.open(encoding="utf-8", errors="replace") as stream:
        while line := stream.readline(_MAX_LINE_CHARS):
            number += 1
            words = line.replace(",", " ").split()
            if not words or words[0].startswith(("#", "%")):
                continue
            begun = begun or _is_number(words[0])
            named += not begun
            if named > 1 or len(line) == _MAX_LINE_CHARS:
                raise RecordingError(
                    path, f"line {number} ({line[:_SHOWN].strip()}) is no pose; {_EXPECTED}"
                )
            if begun:
                yield number, words


def _kind_of(path: Path, number: int, words: list[str]) -> _Kind:
    for kind in (_TUM, _STATA):
        if len(words) == kind.words:
            return kind
    raise RecordingError(
        path, f"line {number}: expected 8 or 4 numbers, found {len(words)}; {_EXPECTED}"
    )


def _read(kind: _Kind, words: list[str]) -> tuple[int, tuple[float, float, float]]:
    if len(words) != kind.words:
        raise ValueError(f"expected {kind.words} numbers, found {len(words)}")
    values = [float(word) for word in words[1:]]
    if not all(map(math.isfinite, values)):
        raise ValueError("a number is not finite; remove the line")
    if math.hypot(*values[:2]) > _MAX_DISTANCE_M:
        raise ValueError("it is on no place on this planet")
    return nanoseconds(words[0], kind.units_per_s), kind.pose(values)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _ordered(stamps_ns: NDArray[np.int64], poses: NDArray[np.float64]) -> Track:
    """Sort by stamps; of equal ones the last counts."""
    distinct, first = np.unique(stamps_ns[::-1], return_index=True)
    return Track(distinct, poses[::-1][first])


def _oddities(stamps_ns: NDArray[np.int64], distinct: int) -> tuple[str, ...]:
    notices = []
    backward = int((np.diff(stamps_ns) < 0).sum())
    if backward:
        notices.append(f"stamps of the pose file go backward {backward} times: sorted")
    repeated = len(stamps_ns) - distinct
    if repeated:
        notices.append(f"{repeated} stamps of the pose file are repeated: the last of each counts")
    return tuple(notices)


def _coverage(found: FoundPoses, track: Track, clock_offset_s: float) -> str:
    shift = f" with {clock_offset_s:+.3f} s" if clock_offset_s else ""
    return (
        f"the pose file{shift} covers {int(found.known.sum())} of {len(found.poses)} scans, from "
        f"{seconds(int(track.stamps_ns[0]))} to {seconds(int(track.stamps_ns[-1]))}; if the clocks "
        "differ pass --clock-offset"
    )


def _why_apart(track: Track, at_ns: NDArray[np.int64], clock_offset_s: float) -> str:
    first, last = int(track.stamps_ns[0]), int(track.stamps_ns[-1])
    offset = clock_offset_s + (int(at_ns[0]) - first) / 1e9
    return (
        f"has poses from {seconds(first)} to {seconds(last)}, but the scans are from "
        f"{seconds(int(at_ns[0]))} to {seconds(int(at_ns[-1]))}: none has a pose; --clock-offset "
        f"{offset:.3f} would make both start together"
    )
