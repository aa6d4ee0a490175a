"""How much of a split a model has as good as seen in training: the audit of split schemes.

Two questions are asked of every scan of a split: how long before or after it was the nearest
train scan of the same recording taken, by any of its lidars; and how near to its pose lies that of
a train scan in the same environment, at any time. Poses are compared as points x, y, w cos(yaw),
w sin(yaw): their distance is that of the positions, to which a turn adds the chord it draws on a
circle of radius w, chosen so that 15 degrees count like 0.25 m.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from tqdm import tqdm

from semantic2d_dataset.format.manifest import Manifest, check_sequence, find_file
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.format.splits import NONE, TRAIN, SplitScheme, is_next_to, split_id

NEAR_S = 1.0
NEAR_M, NEAR_RAD = 0.25, math.radians(15)
"""A train scan as near as this in position and heading sees nearly the same."""

COLUMNS = 600
"""Points in time at which a timeline is sampled."""

_RADIUS_M = NEAR_M / (2 * math.sin(NEAR_RAD / 2))


@dataclass(frozen=True)
class Track:
    """When and where the scans of a sequence were taken.

    Parameters
    ----------
    sequence_id
        ``<environment>--<recording>--<lidar>``.
    stamps_ns
        (N,) i8, not decreasing.
    poses
        (N, 3) f8 x, y (m), yaw (rad) in the map of the environment, NaN where unknown.
    """

    sequence_id: str
    stamps_ns: NDArray[np.int64]
    poses: NDArray[np.float64]

    @property
    def environment(self) -> str:
        """First part of the id."""
        return self.sequence_id.split("--", 1)[0]

    @property
    def recording(self) -> str:
        """The id without the lidar."""
        return self.sequence_id.rsplit("--", 1)[0]

    @property
    def lidar(self) -> str:
        """Last part of the id."""
        return self.sequence_id.rsplit("--", 1)[-1]


@dataclass(frozen=True)
class Nearness:
    """The nearest train scan of each of n scans.

    Parameters
    ----------
    next_to_train
        (n,) bool: the scan before or after it in its own sequence is a train scan.
    trained_on
        (n,) bool: its own sequence has train scans.
    time_s
        (n,) f4: to the nearest train scan of its recording; inf where there is none.
    pose_m
        (n,) f4: distance of its pose to the nearest one of a train scan in its environment, by the
        measure of this module; inf where there is none, NaN where the scan has no pose.
    position_m, turn_rad
        (n,) f4: what parts the two in position and in heading.
    """

    next_to_train: NDArray[np.bool_]
    trained_on: NDArray[np.bool_]
    time_s: NDArray[np.float32]
    pose_m: NDArray[np.float32]
    position_m: NDArray[np.float32]
    turn_rad: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.time_s)

    @classmethod
    def concatenate(cls, parts: Sequence[Nearness]) -> Nearness:
        """Put scans one after the other."""
        flags, numbers = np.zeros(0, np.bool_), np.zeros(0, np.float32)
        whole = [cls(flags, flags, numbers, numbers, numbers, numbers), *parts]
        names = (each.name for each in fields(cls))
        return cls(*(np.concatenate([getattr(p, name) for p in whole]) for name in names))

    def summarise(self) -> dict[str, Any]:
        """Return counts, shares and medians as plain values; None where there is no number.

        Shares of poses are shares of the scans that have one.
        """
        posed = ~np.isnan(self.pose_m)
        near = (self.position_m <= NEAR_M) & (self.turn_rad <= NEAR_RAD)
        return {
            "scans": len(self),
            "next_to_train": _share(self.next_to_train),
            "within_1_s": _share(self.time_s < NEAR_S),
            "same_sequence": _share(self.trained_on),
            "same_recording": _share(np.isfinite(self.time_s)),
            "nearest_s": _number(np.min, self.time_s),
            "median_s": _number(np.median, self.time_s),
            "scans_with_pose": int(posed.sum()),
            "within_25_cm_15_deg": _share(near[posed]),
            "same_environment": _share(np.isfinite(self.pose_m[posed])),
            "median_pose_m": _number(np.median, self.pose_m[posed]),
        }


@dataclass(frozen=True)
class Audit:
    """What was measured of one scheme.

    Parameters
    ----------
    scheme
        The scheme.
    nearness
        By split, then by lidar of its scans.
    timelines
        (`COLUMNS`,) u1 by sequence id: the split of the scan that is nearest to each of so many
        points in time, evenly spaced over the recording.
    """

    scheme: SplitScheme
    nearness: Mapping[str, Mapping[str, Nearness]]
    timelines: Mapping[str, NDArray[np.uint8]]

    def of(self, split: str) -> Nearness:
        """Return the scans of a split by all lidars."""
        return Nearness.concatenate([*self.nearness[split].values()])


def read_tracks(folder: Path, manifest: Manifest) -> Iterator[Track]:
    """Read when and where the scans of a data set were taken, sequence by sequence, by id.

    Raises
    ------
    DatasetNotFoundError
        If a file is missing.
    ChecksumError
        If it was changed since the manifest was written.
    CorruptFileError, UnsafeFileError, FormatVersionError
        If it cannot be read.
    """
    entries = sorted(manifest.sequences, key=lambda entry: entry.id)
    for entry in tqdm(entries, desc="auditing", unit="file", disable=None, leave=False):
        with SequenceReader(find_file(folder, entry)) as reader:
            check_sequence(reader, entry)
            yield Track(entry.id, reader.read("scans/stamps_ns"), reader.read_poses())


def audit_schemes(
    schemes: Sequence[SplitScheme], tracks: Iterable[Track], *, lidar: str | None = None
) -> list[Audit]:
    """Measure how near the test and val scans of schemes lie to their train scans.

    The tracks of one environment are held at a time, and 18 bytes for each scan of a split.

    Parameters
    ----------
    schemes
        Sequences that a scheme does not cover belong to no split of it.
    tracks
        In an order that keeps environments together, such as that of their ids.
    lidar
        Name of the lidar whose test and val scans are looked at; None for all. A train scan
        counts whichever lidar took it.
    """
    drafts = [_Draft(scheme) for scheme in schemes]
    for _, group in itertools.groupby(tracks, key=lambda track: track.environment):
        environment = list(group)
        for draft in drafts:
            draft.add(environment, lidar)
    return [draft.finish() for draft in drafts]


@dataclass
class _Draft:
    """The audit of a scheme while environments come in."""

    scheme: SplitScheme
    parts: dict[tuple[str, str], list[Nearness]] = field(default_factory=dict)
    timelines: dict[str, NDArray[np.uint8]] = field(default_factory=dict)

    def add(self, environment: Sequence[Track], lidar: str | None) -> None:
        """Measure all tracks of an environment."""
        members = [self._members(track) for track in environment]
        places = _Places(environment, members)
        pairs = zip(environment, members, strict=True)
        for _, group in itertools.groupby(pairs, key=lambda pair: pair[0].recording):
            recording = list(group)
            times = np.sort(np.concatenate([t.stamps_ns[ids == TRAIN] for t, ids in recording]))
            for track, ids in recording:
                if lidar not in (None, track.lidar):
                    continue
                self.timelines[track.sequence_id] = _sample(track, ids, recording)
                for split in ("test", "val"):
                    found = _measure(track, ids, split_id(split), times, places)
                    self.parts.setdefault((split, track.lidar), []).append(found)

    def finish(self) -> Audit:
        """Return what was measured; lidars without a scan in a split are left out."""
        nearness: dict[str, dict[str, Nearness]] = {"test": {}, "val": {}}
        for (split, lidar), parts in sorted(self.parts.items()):
            whole = Nearness.concatenate(parts)
            if len(whole):
                nearness[split][lidar] = whole
        return Audit(self.scheme, nearness, self.timelines)

    def _members(self, track: Track) -> NDArray[np.uint8]:
        none = np.full(len(track.stamps_ns), NONE, np.uint8)
        return self.scheme.membership.get(track.sequence_id, none)


class _Places:
    """Where the train scans of an environment were taken."""

    def __init__(self, tracks: Sequence[Track], members: Sequence[NDArray[np.uint8]]) -> None:
        poses = np.concatenate([t.poses[m == TRAIN] for t, m in zip(tracks, members, strict=True)])
        # a robot that stands still gives equal poses, among which a tree would find no order
        self._poses = np.unique(poses[np.isfinite(poses).all(axis=1)], axis=0)
        self._tree = KDTree(_points_of(self._poses)) if len(self._poses) else None

    def nearest(self, poses: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return (3, n) f4: distance by the measure, m in position, and rad in heading."""
        found = np.full((3, len(poses)), np.nan, np.float32)
        posed = np.isfinite(poses).all(axis=1)
        found[:, posed] = np.inf
        if self._tree is None or not posed.any():
            return found
        wanted = poses[posed]
        distance, index = self._tree.query(_points_of(wanted), workers=-1)
        apart = wanted - self._poses[index]
        turn = np.abs(np.remainder(apart[:, 2] + np.pi, 2 * np.pi) - np.pi)
        found[:, posed] = (distance, np.hypot(apart[:, 0], apart[:, 1]), turn)
        return found


def _points_of(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return poses (n, 3) as points (n, 4), m, whose distances are those of this module."""
    x, y, yaw = poses.T
    return np.column_stack((x, y, _RADIUS_M * np.cos(yaw), _RADIUS_M * np.sin(yaw)))


def _measure(
    track: Track,
    ids: NDArray[np.uint8],
    wanted: int,
    train_ns: NDArray[np.int64],
    places: _Places,
) -> Nearness:
    chosen = ids == wanted
    next_to = is_next_to(ids == TRAIN)[chosen]
    trained_on = np.full(len(next_to), (ids == TRAIN).any())
    time_s = _nearest_s(track.stamps_ns[chosen], train_ns)
    return Nearness(next_to, trained_on, time_s, *places.nearest(track.poses[chosen]))


def _nearest_s(stamps_ns: NDArray[np.int64], train_ns: NDArray[np.int64]) -> NDArray[np.float32]:
    """Return the time (n,) s between each stamp and the nearest of ascending others."""
    nearest = np.full(len(stamps_ns), np.inf)
    if not len(train_ns):
        return nearest.astype(np.float32)
    after = np.searchsorted(train_ns, stamps_ns)
    for index in (np.maximum(after - 1, 0), np.minimum(after, len(train_ns) - 1)):
        other = train_ns[index]
        later, earlier = np.maximum(stamps_ns, other), np.minimum(stamps_ns, other)
        apart = later.astype(np.uint64) - earlier.astype(np.uint64)  # may be beyond int64
        nearest = np.minimum(nearest, apart / 1e9)
    return nearest.astype(np.float32)


def _sample(
    track: Track, ids: NDArray[np.uint8], recording: Sequence[tuple[Track, Any]]
) -> NDArray[np.uint8]:
    stamps = [t.stamps_ns for t, _ in recording if len(t.stamps_ns)]
    if not len(track.stamps_ns):
        return np.full(COLUMNS, NONE, np.uint8)
    first = float(min(each[0] for each in stamps))
    last = float(max(each[-1] for each in stamps))
    times = np.linspace(first, last, COLUMNS)
    after = np.searchsorted(track.stamps_ns[1:] / 2 + track.stamps_ns[:-1] / 2, times)
    return ids[after]


def _share(these: NDArray[np.bool_]) -> float | None:
    return float(these.mean()) if these.size else None


def _number(reduce: Any, values: NDArray[np.float32]) -> float | None:
    found = float(reduce(values)) if values.size else math.inf
    return found if math.isfinite(found) else None
