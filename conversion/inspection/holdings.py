"""What a recording holds: its topics, scans and poses, whether of messages or of arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from conversion.inspection.findings import (
    Pictures,
    PoseReport,
    SampleScan,
    ScanReport,
    TopicReport,
    TransformReport,
)
from conversion.inspection.observation import Key, Observation, observe
from conversion.inspection.pose_sources import PoseSource, PoseSources, longest_gap_s
from conversion.inspection.scan_probe import ScanProbe
from conversion.inspection.timelines import Timeline
from conversion.messages.lidars import place_lidar
from conversion.messages.parts import choose_stamps
from conversion.messages.poses import AUTO, pose_topics
from conversion.messages.recordings import Recording, Topic
from conversion.messages.scans import Beams
from conversion.options import Options
from conversion.plan import Arrays, SequencePlan
from semantic2d_dataset.errors import RecordingError

Rates = tuple[NDArray[np.float64], NDArray[np.float64]]

_DRAWN = 4000  # poses of a sequence that are kept to be drawn
_MOST_DRAWN = 16  # sequences, likewise
_SYNTHETIC = "synthetic"


@dataclass
class Holdings:
    """What was found, as `conversion.inspection.findings.Inspection` has it.

    Parameters
    ----------
    unreadable
        Topics whose messages cannot be decoded, and why.
    """

    topics: list[TopicReport] = field(default_factory=list)
    scans: list[ScanReport] = field(default_factory=list)
    transforms: list[TransformReport] = field(default_factory=list)
    poses: list[PoseReport] = field(default_factory=list)
    pictures: Pictures = field(default_factory=Pictures)
    problems: list[str] = field(default_factory=list)
    notices: tuple[str, ...] = ()
    unreadable: dict[Key, str] = field(default_factory=dict)
    first_ns: int | None = None
    last_ns: int = 0

    def add(self, look: _Look) -> None:
        """Add what a sequence of arrays holds; times count from the first that came."""
        self.scans.append(look.scan_report())
        line, first, last = look.line, look.line.first_ns, look.line.last_ns
        if first is not None and last is not None:
            self.first_ns = first if self.first_ns is None else min(first, self.first_ns)
            self.last_ns = max(last, self.last_ns)
            topic = Topic(look.plan.header.sequence_id, look.plan.topic, len(line))
            self.topics.append(_topic_report(topic, "scans", line, first))
        if look.plan.scans_with_pose:
            self.poses.append(look.pose_report())


def of_messages(recording: Recording, options: Options) -> Holdings:
    """Read a recording of messages once."""
    seen = observe(recording, options)
    probes = {name: probe for name, probe in seen.probes.items() if probe.beams is not None}
    sources = PoseSources(
        seen.survey,
        seen.times,
        seen.timelines,
        _stamps(recording, seen, options),
        seen.first_ns or 0,
        options,
        frozenset(topic.name for topic in pose_topics(recording, AUTO)),
    )
    poses, ways = sources.compare(recording.pose_topics)
    return Holdings(
        topics=_topic_reports(recording, seen),
        scans=[_scan_report(seen, probe, options) for probe in probes.values()],
        transforms=list(seen.times.reports()),
        poses=list(poses),
        pictures=_pictures(probes, ways, _all_rates(seen), seen.first_ns),
        problems=[] if seen.damage is None else [seen.damage],
        notices=recording.notices,
        unreadable=seen.unreadable,
        first_ns=seen.first_ns,
        last_ns=seen.last_ns,
    )


def of_arrays(plans: Sequence[SequencePlan]) -> Holdings:
    """Read the arrays of sequences that were planned."""
    held, drawn = Holdings(), dict[str, _Look]()
    for plan in plans:
        look, name = _Look(plan), plan.header.sequence_id
        try:
            look.read()
        except RecordingError as err:
            held.problems.append(f"{name}: {err.message}")
        held.add(look)
        if len(drawn) < _MOST_DRAWN:
            drawn[name] = look
    first = held.first_ns or 0
    held.pictures = _pictures(
        {name: look.probe for name, look in drawn.items()},
        {name: look.way for name, look in drawn.items() if look.plan.scans_with_pose},
        {name: _rates(look.line, first) for name, look in drawn.items() if len(look.line)},
        held.first_ns,
    )
    return held


def _stamps(recording: Recording, seen: Observation, options: Options) -> str:
    """Choose the stamps that a conversion would compare; it reports why there are none."""
    try:
        return choose_stamps(recording.path, seen.survey, options.stamps)[0]
    except RecordingError:
        return "record"


def _topic_reports(recording: Recording, seen: Observation) -> list[TopicReport]:
    roles = {
        "scans": recording.scan_topics,
        "poses": recording.pose_topics,
        "transforms": recording.transform_topics,
        "velocity": recording.velocity_topics,
    }
    reports = []
    for topic in recording.topics:
        role = next((role for role, topics in roles.items() if topic in topics), "other")
        line = seen.timelines.get((topic.name, topic.type), Timeline())
        reports.append(_topic_report(topic, role, line, seen.first_ns or 0))
    return reports


def _topic_report(topic: Topic, role: str, line: Timeline, first: int) -> TopicReport:
    gap = line.longest
    return TopicReport(
        name=topic.name,
        type=topic.type,
        role=role,
        messages=len(line),
        rate_hz=line.rate_hz,
        period_s=line.period_s,
        regularity=line.regularity,
        longest_gap_s=longest_gap_s(line),
        longest_gap_at_s=None if gap is None else (gap.start_ns - first) / 1e9,
        start_s=None if line.first_ns is None else (line.first_ns - first) / 1e9,
        stop_s=None if line.last_ns is None else (line.last_ns - first) / 1e9,
    )


def _scan_report(seen: Observation, probe: ScanProbe, options: Options) -> ScanReport:
    beams = probe.log.runs[0].beams
    base = options.base_frame or seen.transforms.base_of(beams.frame)
    in_tf = None if base is None else seen.transforms.mount(base.strip("/"), beams.frame)
    if probe.lidar is not None:
        lidar, found = place_lidar(probe.lidar, options.mount, in_tf)
        return probe.report(beams, (lidar.base_T_lidar, found))
    return probe.report(beams, (options.mount or in_tf, "as given" if options.mount else "tf"))


def _all_rates(seen: Observation) -> dict[str, Rates]:
    first = seen.first_ns or 0
    return {name: _rates(line, first) for (name, _), line in sorted(seen.timelines.items())}


def _rates(line: Timeline, first_ns: int) -> Rates:
    edges, rates = line.rates()
    return edges - first_ns / 1e9, rates


def _pictures(
    probes: dict[str, ScanProbe],
    ways: dict[str, NDArray[np.float64]],
    rates: dict[str, Rates],
    first_ns: int | None,
) -> Pictures:
    found = {name: probe.by_beam for name, probe in probes.items()}
    return Pictures(
        rates=rates,
        trajectories=ways,
        by_beam={name: by_beam for name, by_beam in found.items() if by_beam is not None},
        ranges={name: probe.statistics.histogram for name, probe in probes.items()},
        samples={name: _since(probe.samples, first_ns) for name, probe in probes.items()},
    )


def _since(samples: Sequence[SampleScan], first_ns: int | None) -> tuple[SampleScan, ...]:
    first = (first_ns or 0) / 1e9
    return tuple(replace(sample, at_s=sample.at_s - first) for sample in samples)


class _Look:
    """The arrays of one sequence, read once."""

    def __init__(self, plan: SequencePlan) -> None:
        lidar = plan.header.lidar
        topic = Topic(plan.header.sequence_id, plan.topic, plan.scans_out)
        limits = (lidar.range_min, lidar.range_max)
        self.plan = plan
        self.line = Timeline()
        self.beams = Beams(
            plan.frame, lidar.beams, lidar.angle_min, lidar.angle_increment, *limits, reversed=False
        )
        self.probe = ScanProbe(topic, lambda _: (lidar, "as planned"))
        self.probe.begin(self.beams)
        self._ways: list[NDArray[np.float64]] = []
        self._rows = 0

    @property
    def way(self) -> NDArray[np.float64]:
        """Some of the poses, (M, 3) x y yaw."""
        return np.concatenate((np.zeros((0, 3)), *self._ways))

    def read(self) -> None:
        """Read it to its end."""
        for arrays in self.plan.blocks():
            if "scans/ranges" in arrays:
                self._add(arrays)

    def _add(self, arrays: Arrays) -> None:
        ranges, stamps = arrays["scans/ranges"], arrays["scans/stamps_ns"]
        self.probe.add_arrays(ranges, arrays.get("scans/intensities"))
        if self.plan.header.stamps_source != _SYNTHETIC:
            self.line.extend(stamps)
        if "scans/labels" in arrays:
            self.probe.add_labels(arrays["scans/labels"])
        if "poses/initial" in arrays:
            step = self.plan.scans_out // _DRAWN + 1
            self._ways.append(arrays["poses/initial"][-self._rows % step :: step].copy())
        for row, stamp in enumerate(stamps.tolist()):
            if self.probe.wants_sample(self._rows + row):
                self.probe.keep_sample(stamp, self.beams, ranges[row])
        self._rows += len(ranges)

    def scan_report(self) -> ScanReport:
        """Say what the scans hold."""
        return self.probe.report(self.beams, (self.plan.header.lidar.base_T_lidar, "as planned"))

    def pose_report(self) -> PoseReport:
        """Say where the poses come from."""
        plan, covered = self.plan, self.plan.scans_with_pose
        return PoseSource(
            name=plan.pose_source,
            kind="layout",
            frame="map",
            samples=covered,
            line=self.line,
            longest_gap_s=longest_gap_s(self.line),
            coverage={plan.header.sequence_id: covered / max(1, plan.scans_in)},
            max_gap_s=plan.pose_max_gap_s,
            way=self.way,
            automatic=True,
            option="",
            notes=(),
        ).report(self.line.first_ns or 0)
