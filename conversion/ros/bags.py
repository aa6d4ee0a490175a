"""Recordings of ROS 1 and ROS 2, whatever files hold them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol, Self, TypeVar

from conversion.messages.recordings import Message, Topic
from conversion.ros.bag_files import ROS1, bags_in, find_files, kind_of
from conversion.ros.definitions import Connection, Definitions, known_distros
from conversion.ros.merging import Stream, merge
from conversion.ros.rosbag1 import Rosbag1
from conversion.ros.rosbag2 import Rosbag2
from conversion.ros.salvage import describe
from conversion.wording import one_line, seconds
from semantic2d_dataset.errors import RecordingError

__all__ = ["ROSBAGS_VERSION", "Bag", "bags_in", "seconds"]

Taken = TypeVar("Taken")

ROSBAGS_VERSION = version("rosbags")

_MAX_STAMP_NS = 2**63 - 1
_MAX_SHOWN = 3


class BagFile(Protocol):
    """One file of a recording, open for reading."""

    path: Path
    connections: list[Connection]

    @property
    def start_ns(self) -> int:
        """No message was recorded before."""
        ...

    def messages(self, connections: Collection[Connection], start_ns: int) -> Iterator[Message]:
        """Yield the messages of some connections by time, from `start_ns` on."""
        ...

    def close(self) -> None:
        """Close it."""
        ...


class Bag:
    """A ROS 1 or ROS 2 recording, open for reading in the order of recording.

    Use it as a context manager.

    Parameters
    ----------
    paths
        A ROS 1 ``.bag``, a ROS 2 ``.db3`` or ``.mcap`` (``.zstd`` too), or a folder with the
        files of one recording; or several files of one recording.
    distro
        The release of ROS whose message definitions are used where the files have none, such as
        ``humble``; None takes what metadata.yaml says, else Humble, for ROS 1 Noetic.

    Attributes
    ----------
    path
        The first path.
    topics
        Every topic, sorted by name.
    notices
        What had to be guessed.

    Raises
    ------
    FileNotFoundError
        If there is no such file or folder.
    RecordingError
        If it is no bag, or one that cannot be read.
    InvalidInputError
        If the release is not known.
    """

    def __init__(self, paths: Path | Sequence[Path], *, distro: str | None = None) -> None:
        given = [Path(paths)] if isinstance(paths, str | Path) else [Path(path) for path in paths]
        self.path = given[0]
        found = find_files(given)
        self.ros1 = _is_ros1(found.files)
        self._files = [*found.files, *found.metadata]
        self._open: list[BagFile] = []
        try:
            for path in found.files:
                self._open.append(_open(path))
            connections = [c for file in self._open for c in file.connections]
            self.topics = _topics_of(connections)
            told = found.distro if found.distro in known_distros(ros1=self.ros1) else None
            self._definitions = Definitions(connections, ros1=self.ros1, distro=distro or told)
        except BaseException:
            self.close()
            raise
        self.notices = self._find_notices(given, None if distro or told else connections)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Close its files."""
        while self._open:
            self._open.pop().close()

    def of_type(self, types: Collection[str]) -> tuple[Topic, ...]:
        """Return the topics of one of these types."""
        return tuple(topic for topic in self.topics if topic.type in types)

    def messages(self, topics: Collection[Topic], start_ns: int = 0) -> Iterator[Message]:
        """Yield the messages of some topics that were recorded at `start_ns` or later, by time.

        Raises
        ------
        RecordingError
            Where the recording is damaged, with the time that was reached.
        """
        wanted = {(topic.name, topic.type): topic.messages for topic in topics}
        last: Message | None = None
        read, last_ns = 0, 0
        try:
            for message in self._merged(wanted, start_ns):
                _, _, record_ns, raw = message
                if type(record_ns) is not int or not last_ns <= record_ns <= _MAX_STAMP_NS:
                    raise ValueError(  # noqa: TRY301
                        f"the next, of {message.topic}, has the time {record_ns!r}"
                    )
                if type(raw) is not bytes:  # SQLite's columns take any type
                    raise TypeError(f"the next, of {message.topic}, holds {raw!r}")  # noqa: TRY301
                last, last_ns = message, record_ns
                read += 1
                yield message
            expected = sum(wanted.values())
            if start_ns == 0 and read < expected:
                raise ValueError(f"expected {expected} messages of the chosen topics")  # noqa: TRY301
        except Exception as err:
            after = "at its first message"
            if last is not None:
                where = f"the last of {last.topic} at {seconds(last.record_ns)}"
                after = f"after {read} messages, {where}"
            path, cause = self.path, err
            if isinstance(err, _DamagedFileError):
                path, cause = err.path, err.cause
            raise RecordingError(path, f"is damaged {after}: {one_line(cause)}") from cause

    def read(self, message: Message, take: Callable[[Any], Taken]) -> Taken:
        """Deserialise a message by the definition that the bag holds, else by ROS's own.

        Parameters
        ----------
        message
            One of this bag's.
        take
            Takes what is wanted from its fields, which a bag may define as it likes.

        Raises
        ------
        RecordingError
            If its bytes do not fit the definition, the type is unknown, or `take` fails.
        """
        try:
            store = self._definitions.store_of(message.type)
            deserialise = store.deserialize_ros1 if self.ros1 else store.deserialize_cdr
            return take(deserialise(message.raw, message.type))
        except Exception as err:
            raise RecordingError(
                self.path,
                f"{message.topic}: the message at {seconds(message.record_ns)} is no readable "
                f"{message.type}: {one_line(err)}",
            ) from err

    def is_standard(self, type_: str) -> bool:
        """Tell whether the bag means by a type, and by all in it, what ROS means by it."""
        return self._definitions.is_standard(type_)

    def fields_of(self, type_: str) -> Mapping[str, Any]:
        """Return rosbags' ``fielddefs`` of a type and of all in it, as the bag defines them.

        Raises
        ------
        Exception
            If the definition cannot be read (rosbags raises many kinds), or there is none.
        """
        fields: Mapping[str, Any] = self._definitions.store_of(type_).fielddefs
        return fields

    def files(self) -> list[Path]:
        """Return the files that the recording consists of."""
        return list(self._files)

    def _merged(self, wanted: Collection[tuple[str, str]], start_ns: int) -> Iterator[Message]:
        streams = []
        read = _read_one_of_many if len(self._open) > 1 else _read
        for file in self._open:
            chosen = [c for c in file.connections if (c.topic, c.type) in wanted]
            if chosen:  # an empty selection means every topic to rosbags
                streams.append(Stream(file.start_ns, partial(read, file, chosen, start_ns)))
        return merge(streams)

    def _find_notices(
        self, given: Sequence[Path], guessed: Collection[Connection] | None
    ) -> tuple[str, ...]:
        notices = []
        if len(self._open) > len(given) and len(self._files) == len(self._open):
            names = ", ".join(path.name for path in self._files[:_MAX_SHOWN])
            notices.append(f"{len(self._open)} files taken as one recording: {names}")
        bare = {c.type for c in guessed or () if not c.definition.strip()}
        if bare:
            notices.append(
                f"the recording defines {len(bare)} of its types nowhere: those of ROS "
                f"{self._definitions.distro} are used; --distro names another release"
            )
        return tuple(notices)


class _DamagedFileError(Exception):
    """One of several files is damaged."""

    def __init__(self, path: Path, cause: Exception) -> None:
        super().__init__(path, cause)
        self.path = path
        self.cause = cause


def _read(file: BagFile, chosen: Collection[Connection], start_ns: int) -> Iterator[Message]:
    return file.messages(chosen, start_ns)


def _read_one_of_many(
    file: BagFile, chosen: Collection[Connection], start_ns: int
) -> Iterator[Message]:
    try:
        yield from file.messages(chosen, start_ns)
    except Exception as err:
        raise _DamagedFileError(file.path, err) from err


def _is_ros1(files: Sequence[Path]) -> bool:
    kinds = [kind_of(path) for path in files]
    for path, kind in zip(files, kinds, strict=True):
        if (kind == ROS1) != (kinds[0] == ROS1):
            raise RecordingError(
                path, f"is a bag of another ROS than {files[0].name}: convert them one by one"
            )
    return kinds[0] == ROS1


def _open(path: Path) -> BagFile:
    try:
        return Rosbag1(path) if kind_of(path) == ROS1 else Rosbag2(path)
    except (PermissionError, RecordingError):
        raise
    except Exception as err:
        raise RecordingError(
            path, f"cannot be opened as a bag: {one_line(err)}; {describe(path)}"
        ) from err


def _topics_of(connections: Collection[Connection]) -> tuple[Topic, ...]:
    counts: dict[tuple[str, str], int] = {}
    for connection in connections:
        key = (connection.topic, connection.type)
        counts[key] = counts.get(key, 0) + connection.messages
    return tuple(Topic(*key, count) for key, count in sorted(counts.items()))
