"""One look at everything that a recording of messages holds, in bounded memory."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

from conversion.inspection.pose_sources import TransformTimes
from conversion.inspection.scan_probe import ScanProbe
from conversion.inspection.timelines import Timeline
from conversion.messages.lidars import choose_lidar
from conversion.messages.poses import PoseLog
from conversion.messages.recordings import Message, Recording
from conversion.messages.survey import Survey, with_progress
from conversion.messages.transforms import Transforms
from conversion.messages.velocities import VelocityLog
from conversion.options import Options
from semantic2d_dataset.errors import RecordingError

Key = tuple[str, str]
"""Name and type of a topic."""


@dataclass
class Observation:
    """What was seen.

    Parameters
    ----------
    timelines
        When messages of each topic were recorded.
    probes
        The scans of each scan topic, by its name.
    transforms, times, poses
        Where the robot was.
    unreadable
        Topics whose messages could not be decoded, and why; they count all the same.
    damage
        Why the recording could not be read to its end; what came before was seen.
    first_ns, last_ns
        Record times of the first and of the last message.
    """

    timelines: defaultdict[Key, Timeline] = field(default_factory=lambda: defaultdict(Timeline))
    probes: dict[str, ScanProbe] = field(default_factory=dict)
    transforms: Transforms = field(default_factory=Transforms)
    times: TransformTimes = field(default_factory=TransformTimes)
    poses: PoseLog = field(default_factory=PoseLog)
    unreadable: dict[Key, str] = field(default_factory=dict)
    damage: str | None = None
    first_ns: int | None = None
    last_ns: int = 0

    @property
    def survey(self) -> Survey:
        """The same as a conversion sees it."""
        logs = tuple(probe.log for probe in self.probes.values() if len(probe.log))
        return Survey(logs, self.transforms, self.poses, VelocityLog(None))


def observe(recording: Recording, options: Options) -> Observation:
    """Read a recording once: time all messages; decode scans, poses and transforms.

    What cannot be read is said in the result, and is no error.
    """
    seen = Observation()
    readers = _readers(recording, options, seen)
    try:
        for message in with_progress(recording, recording.topics, "inspect"):
            key = (message.topic, message.type)
            if seen.first_ns is None:
                seen.first_ns = message.record_ns
            seen.last_ns = message.record_ns
            seen.timelines[key].add(message.record_ns)
            if key in readers:
                try:
                    readers[key](message)
                except RecordingError as err:
                    seen.unreadable[key] = err.message
                    del readers[key]
    except RecordingError as err:
        seen.damage = err.message
    for probe in seen.probes.values():
        probe.flush()
    return seen


def _readers(
    recording: Recording, options: Options, seen: Observation
) -> dict[Key, Callable[[Message], None]]:
    def read_scan(message: Message) -> None:
        probe = seen.probes[message.topic]
        probe.add(recording.scan(message), message.record_ns)
        probe.time(recording, message)

    def read_pose(message: Message) -> None:
        seen.poses.add(message.topic, recording.pose(message), message.record_ns)

    def read_transforms(message: Message) -> None:
        for sample in recording.transforms(message):
            seen.transforms.add(sample, message.record_ns)
            seen.times.add(sample, message.record_ns)

    for topic in recording.scan_topics:
        seen.probes[topic.name] = ScanProbe(
            topic, partial(choose_lidar, recording.path, topic, named=options.lidar)
        )
    readers: dict[Key, Callable[[Message], None]] = {}
    for group, reader in (
        (recording.scan_topics, read_scan),
        (recording.pose_topics, read_pose),
        (recording.transform_topics, read_transforms),
    ):
        readers |= {(topic.name, topic.type): reader for topic in group}
    return readers
