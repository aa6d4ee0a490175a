"""The first pass over a recording: stamps, beams, transforms and poses; no ranges are kept."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from conversion.messages.poses import PoseLog
from conversion.messages.recordings import Message, Recording, Topic
from conversion.messages.scans import Beams, Scan
from conversion.messages.transforms import Transforms
from conversion.messages.velocities import VelocityLog
from semantic2d_dataset.errors import RecordingError

_MIN_BEAMS = 2


@dataclass
class Run:
    """Consecutive scans of one topic with the same beams.

    Parameters
    ----------
    beams
        What they share.
    first
        Index of the first of them among the scans of the topic.
    change
        How they differ from those before; empty for the first run.
    intensity_counts
        How many of them carry so many intensities.
    """

    beams: Beams
    first: int
    change: str = ""
    intensity_counts: dict[int, int] = field(default_factory=dict)

    @property
    def has_intensities(self) -> bool:
        """Whether any of the scans carries one intensity for each beam."""
        return self.beams.count in self.intensity_counts


class ScanLog:
    """Collect the stamps and the beams of the scans of one topic, 16 bytes each.

    Scans of fewer than two beams, which some drivers send when they start, are left out.
    """

    def __init__(self, topic: Topic) -> None:
        self.topic = topic
        self.runs: list[Run] = []
        self.empty = 0
        self._header_ns = array("q")
        self._record_ns = array("q")

    def __len__(self) -> int:
        return len(self._header_ns)

    @property
    def header_ns(self) -> NDArray[np.int64]:
        """Stamps of the scans as their headers have them, (N,) i8."""
        return np.array(self._header_ns, np.int64)

    @property
    def record_ns(self) -> NDArray[np.int64]:
        """Times at which the scans were recorded, (N,) i8, never going backward."""
        return np.array(self._record_ns, np.int64)

    @property
    def lead_ns(self) -> int:
        """How far header stamps lie ahead of record times, median."""
        return int(np.median(self.header_ns - self.record_ns)) if len(self) else 0

    def add(self, scan: Scan, record_ns: int) -> None:
        """Add a scan that was recorded at a time."""
        if not is_scan(scan):
            self.empty += 1
            return
        change = self.runs[-1].beams.difference(scan) if self.runs else ""
        if change is not None:
            self.runs.append(Run(Beams.of(scan), len(self), change))
        counts, carried = self.runs[-1].intensity_counts, len(scan.intensities)
        counts[carried] = counts.get(carried, 0) + 1
        self._header_ns.append(scan.stamp_ns)
        self._record_ns.append(record_ns)


@dataclass(frozen=True)
class Survey:
    """What a recording holds besides its ranges: scans by topic, and where the robot was."""

    scans: tuple[ScanLog, ...]
    transforms: Transforms
    poses: PoseLog
    velocities: VelocityLog


def is_scan(scan: Scan) -> bool:
    """Tell whether a message holds enough beams to be a scan."""
    return len(scan.ranges) >= _MIN_BEAMS


def choose_scan_topics(recording: Recording, named: Collection[str]) -> tuple[Topic, ...]:
    """Return the scan topics named, or all that hold messages.

    Raises
    ------
    RecordingError
        If there is no such topic, or none at all.
    """
    topics = recording.scan_topics
    for name in named:
        if name.strip("/") not in {topic.name.strip("/") for topic in topics}:
            raise RecordingError(
                recording.path,
                f"no scan topic {name!r}; scan topics: {_listing(topics)}; all topics: "
                f"{_listing(recording.topics)}",
            )
    if named:
        wanted = {name.strip("/") for name in named}
        return tuple(topic for topic in topics if topic.name.strip("/") in wanted)
    if not topics:
        raise RecordingError(
            recording.path,
            "expected a topic of 2D lidar scans (sensor_msgs/msg/LaserScan), found "
            f"{_listing(recording.topics)}",
        )
    return tuple(topic for topic in topics if topic.messages) or topics


def make_survey(
    recording: Recording,
    topics: Collection[Topic],
    poses: Collection[Topic],
    velocity: Topic | None,
) -> Survey:
    """Read everything once.

    Parameters
    ----------
    recording
        What to read.
    topics, poses, velocity
        Its topics of scans, of poses, and of the velocity commands.

    Raises
    ------
    RecordingError
        If the recording is damaged, or a topic holds fewer scans than it says.
    """
    scans = {topic.name: ScanLog(topic) for topic in topics}
    transforms, log, velocities = Transforms(), PoseLog(), VelocityLog(velocity)
    readers: dict[tuple[str, str], Callable[[Message], None]] = {}

    def read_scan(message: Message) -> None:
        scans[message.topic].add(recording.scan(message), message.record_ns)

    def read_pose(message: Message) -> None:
        log.add(message.topic, recording.pose(message), message.record_ns)

    def read_transforms(message: Message) -> None:
        for sample in recording.transforms(message):
            transforms.add(sample, message.record_ns)

    def read_velocity(message: Message) -> None:
        velocities.add(message.record_ns, *recording.velocity(message))

    commands = () if velocity is None else (velocity,)
    for group, reader in (
        (topics, read_scan),
        (poses, read_pose),
        (recording.transform_topics, read_transforms),
        (commands, read_velocity),
    ):
        readers |= {(topic.name, topic.type): reader for topic in group}
    wanted = (*topics, *poses, *recording.transform_topics, *commands)
    for message in with_progress(recording, wanted, "survey"):
        readers[message.topic, message.type](message)
    for found in scans.values():
        _check_count(recording, found)
    return Survey(tuple(scans.values()), transforms, log, velocities)


def with_progress(
    recording: Recording, topics: Collection[Topic], what: str, start_ns: int = 0
) -> Iterator[Message]:
    """Yield the messages of some topics beside a bar that shows the bytes of the recording."""
    size = sum(path.stat().st_size for path in recording.files())
    share = size / max(1, sum(topic.messages for topic in topics))
    with tqdm(total=size, desc=what, unit="B", unit_scale=True, disable=None, leave=False) as bar:
        for message in recording.messages(topics, start_ns):
            yield message
            bar.update(share)


def _check_count(recording: Recording, found: ScanLog) -> None:
    expected = found.topic.messages
    if len(found) + found.empty < expected or not len(found):
        raise RecordingError(
            recording.path,
            f"{found.topic.name}: expected {expected or 'some'} scans, found {len(found)}"
            + (f" and {found.empty} without beams" if found.empty else ""),
        )


def _listing(topics: Collection[Topic]) -> str:
    return ", ".join(f"{t.name} ({t.type}, {t.messages} messages)" for t in topics) or "none at all"
