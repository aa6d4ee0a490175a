"""The sources of poses in a recording, side by side: what each covers, and what chooses it."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from conversion.inspection.findings import PoseReport, TransformReport
from conversion.inspection.timelines import Timeline
from conversion.messages.pose_files import LIDAR, read_pose_file
from conversion.messages.poses import AUTO, NONE, TF
from conversion.messages.recordings import Topic, TransformSample
from conversion.messages.survey import ScanLog, Survey
from conversion.messages.tracks import Track, default_gap_s
from conversion.options import Options
from semantic2d_dataset.errors import RecordingError

_DRAWN = 4000  # poses of a source that are kept to be drawn
_TIMED = 400  # transforms that are timed: markers and the like may bring thousands of frames

Poses = NDArray[np.float64]


@dataclass
class TransformTimes:
    """When each transform of tf was recorded."""

    timelines: dict[tuple[str, str], Timeline] = field(default_factory=dict)
    static: set[tuple[str, str]] = field(default_factory=set)

    def add(self, sample: TransformSample, record_ns: int) -> None:
        """Add a transform that was recorded at a time."""
        key = (sample.parent, sample.child)
        if key not in self.timelines:
            if len(self.timelines) >= _TIMED:
                return
            self.timelines[key] = Timeline()
        if sample.static:
            self.static.add(key)
        self.timelines[key].add(record_ns)

    def reports(self) -> tuple[TransformReport, ...]:
        """Return what there is, parents before their children."""
        keys = sorted(self.timelines, key=lambda key: (*self.ancestors(key[1]), key[1]))
        return tuple(self._report(key) for key in keys)

    def ancestors(self, frame: str) -> tuple[str, ...]:
        """Return the frames above one, the root first."""
        parents = {child: parent for parent, child in self.timelines}
        found: list[str] = []
        while frame in parents and parents[frame] not in found:
            frame = parents[frame]
            found.append(frame)
        return tuple(reversed(found))

    def moving(self, chain: Sequence[str]) -> list[Timeline]:
        """Return the transforms of a chain that are not static, the least often sent first."""
        keys = [key for a, b in pairwise(chain) for key in ((a, b), (b, a))]
        moving = [self.timelines[k] for k in keys if k in self.timelines and k not in self.static]
        return sorted(moving, key=len)

    def _report(self, key: tuple[str, str]) -> TransformReport:
        line = self.timelines[key]
        static, gap = key in self.static, longest_gap_s(line)
        return TransformReport(*key, static, len(line), line.rate_hz, gap)


class PoseSource(NamedTuple):
    """A source of poses: when it was recorded, what it covers, and the way that it tells."""

    name: str
    kind: str
    frame: str
    samples: int
    line: Timeline
    longest_gap_s: float | None
    coverage: dict[str, float]
    max_gap_s: float | None
    way: Poses
    automatic: bool
    option: str
    notes: tuple[str, ...]

    def report(self, first_ns: int) -> PoseReport:
        """Say what it is, with times from a first message on."""
        line, known = self.line, self.way[np.isfinite(self.way).all(axis=1)]
        start, stop = line.first_ns, line.last_ns
        width, height = np.ptp(known[:, :2], axis=0).tolist() if len(known) else (0.0, 0.0)
        steps = np.linalg.norm(np.diff(known[:, :2], axis=0), axis=1)
        return PoseReport(
            name=self.name,
            kind=self.kind,
            frame=self.frame,
            samples=self.samples,
            rate_hz=line.rate_hz,
            longest_gap_s=self.longest_gap_s,
            start_s=None if start is None else (start - first_ns) / 1e9,
            stop_s=None if stop is None else (stop - first_ns) / 1e9,
            max_gap_s=self.max_gap_s,
            coverage=self.coverage,
            length_m=float(steps.sum()),
            width_m=width,
            height_m=height,
            automatic=self.automatic,
            option=self.option,
            notes=self.notes,
        )


@dataclass(frozen=True)
class PoseSources:
    """What is needed to compare sources of poses.

    Parameters
    ----------
    found
        All scans, transforms and poses of the recording.
    times, timelines
        When transforms, and when the messages of topics were recorded.
    stamps
        ``header`` or ``record``: which stamps are compared.
    first_ns
        Record time of the first message.
    options
        As for a conversion.
    automatic
        Topics that a conversion considers unless told otherwise.
    """

    found: Survey
    times: TransformTimes
    timelines: Mapping[tuple[str, str], Timeline]
    stamps: str
    first_ns: int
    options: Options
    automatic: frozenset[str]

    def compare(self, topics: Sequence[Topic]) -> tuple[tuple[PoseReport, ...], dict[str, Poses]]:
        """Return all sources, the most useful first, and the way that each tells, x y yaw."""
        chains = [self._of_chain(chain) for chain in self._chains()]
        tracks = self.found.poses.tracks
        found = [*self._of_file(), *chains]
        found += [self._of_topic(topic) for topic in topics if topic.name in tracks]
        found.sort(key=lambda each: (not each.automatic, -max(each.coverage.values(), default=0)))
        ways = {each.name: each.way for each in found if np.isfinite(each.way).any()}
        return tuple(each.report(self.first_ns) for each in found), ways

    @property
    def _map_frame(self) -> str:
        return self.options.map_frame.strip("/")

    @property
    def _scans(self) -> list[ScanLog]:
        return [log for log in self.found.scans if len(log)]

    def _stamps_of(self, log: ScanLog) -> NDArray[np.int64]:
        return log.header_ns if self.stamps == "header" else log.record_ns

    def _chains(self) -> list[tuple[str, ...]]:
        """Return the chains to the robot from every frame above it, whatever lidar it carries."""
        transforms = self.found.transforms
        chains: dict[tuple[str, ...], None] = {}
        for log in self._scans:
            frame = log.runs[0].beams.frame
            base = (self.options.base_frame or transforms.base_of(frame) or frame).strip("/")
            for above in self.times.ancestors(base):
                chain = transforms.chain(above, base)
                fixed = above != self._map_frame and transforms.mount(above, base) is not None
                if chain is not None and not fixed and self.times.moving(chain):
                    chains[chain] = None
        return list(chains)

    def _of_chain(self, chain: tuple[str, ...]) -> PoseSource:
        transforms, root = self.found.transforms, chain[0]
        coverage, way, gap = {}, np.zeros((0, 3)), 0.0
        for log in self._scans:
            poses, gap, _ = transforms.poses(
                chain, self._stamps_of(log), self.stamps, self.options.max_gap_s
            )
            coverage[log.topic.name] = _share_known(poses)
            way = poses if len(poses) > len(way) else way
        moving = self.times.moving(chain)
        gaps = [line.longest for line in moving if line.longest is not None]
        is_map, is_level = root == self._map_frame, transforms.is_level(chain)
        way = _thin(way)
        return PoseSource(
            name=f"tf {' -> '.join(chain)}",
            kind="tf",
            frame=root,
            samples=len(moving[0]),
            line=moving[0],
            longest_gap_s=max((gap.seconds for gap in gaps), default=None),
            coverage=coverage,
            max_gap_s=gap,
            way=way,
            automatic=is_map and is_level,
            option=shlex.join(("--poses", "tf", *(() if is_map else ("--map-frame", root)))),
            notes=(*self._elsewhere(root), *(() if is_level else ("leaves the plane",))),
        )

    def _of_topic(self, topic: Topic) -> PoseSource:
        log, frame = self.found.poses.tracks[topic.name], self.found.poses.frames[topic.name]
        track = log.track(self.stamps)
        gap = default_gap_s(track) if self.options.max_gap_s is None else self.options.max_gap_s
        line = self.timelines[topic.name, topic.type]
        lacking = len(line) - len(log)
        return PoseSource(
            name=topic.name,
            kind=topic.type.rsplit("/", 1)[-1],
            frame=frame,
            samples=len(log),
            line=line,
            longest_gap_s=longest_gap_s(line),
            coverage={each.topic.name: self._covered(each, track, gap) for each in self._scans},
            max_gap_s=gap,
            way=track.sample(self._drawn_at(), gap),
            automatic=topic.name in self.automatic and not self._elsewhere(frame),
            option=shlex.join(("--poses", topic.name)),
            notes=(
                *self._elsewhere(frame),
                *((f"{lacking} messages hold no pose",) if lacking > 0 else ()),
            ),
        )

    def _of_file(self) -> Iterator[PoseSource]:
        """Take the pose file of the options; that it cannot be read is said by the plans."""
        options, path = self.options, Path(self.options.poses)
        if options.poses in (AUTO, TF, NONE) or not path.is_file():
            return
        try:
            file = read_pose_file(path)
        except RecordingError:
            return
        track = file.track.shifted(round(options.clock_offset_s * 1e9))
        gap = default_gap_s(track) if options.max_gap_s is None else options.max_gap_s
        line = Timeline()
        line.extend(track.stamps_ns)
        of_lidar = (options.poses_of or file.of) == LIDAR
        yield PoseSource(
            name=path.name,
            kind=file.kind,
            frame=self._map_frame,
            samples=len(line),
            line=line,
            longest_gap_s=longest_gap_s(line),
            coverage={each.topic.name: self._covered(each, track, gap) for each in self._scans},
            max_gap_s=gap,
            way=track.sample(self._drawn_at(), gap),
            automatic=True,
            option="",
            notes=(*(("of the lidar",) if of_lidar else ()), *file.notices),
        )

    def _drawn_at(self) -> NDArray[np.int64]:
        """Stamps of the topic with the most scans, thinned out."""
        longest = max(self._scans, key=len, default=None)
        return np.zeros(0, np.int64) if longest is None else _thin(self._stamps_of(longest))

    def _covered(self, log: ScanLog, track: Track, gap: float) -> float:
        return _share_known(track.sample(self._stamps_of(log), gap))

    def _elsewhere(self, frame: str) -> tuple[str, ...]:
        wanted = self._map_frame
        return () if frame in ("", wanted) else (f"in {frame!r}, not in {wanted!r}",)


def longest_gap_s(line: Timeline) -> float | None:
    """Return the longest gap, s; None of fewer than two stamps."""
    return None if line.longest is None else line.longest.seconds


def _share_known(poses: Poses) -> float:
    return float(np.isfinite(poses).all(axis=1).mean()) if len(poses) else 0.0


def _thin(rows: NDArray[Any]) -> NDArray[Any]:
    return rows[:: len(rows) // _DRAWN + 1].copy()
