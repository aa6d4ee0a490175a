"""What every recording of messages offers, whatever file holds it: a bag, a log."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, Self

from conversion.messages.tracks import Values

if TYPE_CHECKING:
    from pathlib import Path

    from conversion.messages.scans import Scan
    from conversion.plan import Arrays


class Topic(NamedTuple):
    """A topic of one type, and how many messages the recording says that it holds."""

    name: str
    type: str
    messages: int


class Message(NamedTuple):
    """One message as it was recorded."""

    topic: str
    type: str
    record_ns: int
    raw: Any


class PoseSample(NamedTuple):
    """A pose in a frame; its values are None where the message holds no pose."""

    stamp_ns: int
    frame: str
    values: Values | None


class TransformSample(NamedTuple):
    """A transform between two frames, without leading slashes."""

    stamp_ns: int
    parent: str
    child: str
    values: Values
    static: bool


class Recording(Protocol):
    """A recording, open for reading in the order of recording; a context manager.

    Every failure is a `RecordingError` that names the path, and topic and time where known.
    """

    path: Path
    """What the user named; of several files of one recording the first."""
    kind: str
    """Such as ``ROS 1 bag``, for people."""
    topics: tuple[Topic, ...]
    """Every topic, sorted by name."""
    scan_topics: tuple[Topic, ...]
    pose_topics: tuple[Topic, ...]
    transform_topics: tuple[Topic, ...]
    velocity_topics: tuple[Topic, ...]
    versions: Mapping[str, str]
    """Versions of the libraries that read it, for the provenance."""
    notices: tuple[str, ...]
    """What had to be guessed or repaired to open it."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *error: object) -> None: ...

    def files(self) -> Sequence[Path]:
        """Return the files that the recording consists of."""
        ...

    def messages(self, topics: Collection[Topic], start_ns: int = 0) -> Iterator[Message]:
        """Yield the messages of some topics, record times never going backward.

        Those recorded before `start_ns` are left out.
        """
        ...

    def scan(self, message: Message) -> Scan:
        """Decode a message of a scan topic."""
        ...

    def pose(self, message: Message) -> PoseSample:
        """Decode a message of a pose topic."""
        ...

    def transforms(self, message: Message) -> Sequence[TransformSample]:
        """Decode a message of a transform topic; transforms that are no poses are left out."""
        ...

    def velocity(self, message: Message) -> tuple[float, float]:
        """Decode a message of a velocity topic: forward, m/s, and turning, rad/s."""
        ...

    def streams(self, names: Collection[str], start_ns: int, stop_ns: int) -> Iterator[Arrays]:
        """Yield arrays ``streams/<name>/*`` of topics, of what was recorded from start to stop.

        Parameters
        ----------
        names
            Topics; ``all`` means every topic that can be kept.
        start_ns, stop_ns
            Record times, both included.
        """
        ...
