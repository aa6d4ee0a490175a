"""Recordings of ROS 1 and ROS 2, whatever file holds them; the only module that knows rosbags."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Iterator
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self, TypeVar

from rosbags.interfaces import MessageDefinitionFormat
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from semantic2d_dataset.errors import RecordingError

Taken = TypeVar("Taken")

ROSBAGS_VERSION = version("rosbags")

_HEADER = "std_msgs/msg/Header"
_MAX_STAMP_NS = 2**63 - 1
_SUFFIXES = (".bag", ".db3", ".mcap")
_SOURCES = (*_SUFFIXES, ".zstd", ".yaml")
# First bytes of what people pass, and how to go on from there.
_PACKED = {
    b"PK\x03\x04": "a zip archive: unpack it, and give the bag that was in it",
    b"\x1f\x8b": "gzip data: decompress it (gunzip), and give the bag that was in it",
    b"BZh": "bzip2 data: decompress it (bunzip2), and give the bag that was in it",
    b"\xfd7zXZ": "xz data: decompress it (unxz), and give the bag that was in it",
    b"\x28\xb5\x2f\xfd": (
        "zstd data: give the folder with its metadata.yaml, or decompress it (unzstd)"
    ),
}
_ROS2_MAGIC = {b"SQLite format 3\x00": ".db3", b"\x89MCAP0\r\n": ".mcap"}


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
    raw: bytes


class Bag:
    """A ROS 1 or ROS 2 recording, open for reading in the order of recording.

    Use it as a context manager.

    Parameters
    ----------
    path
        A ROS 1 ``.bag``, a ROS 2 ``.db3`` or ``.mcap``, or the folder with their
        ``metadata.yaml``.

    Raises
    ------
    FileNotFoundError
        If there is no such file or folder.
    RecordingError
        If it is no bag, or one that cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self.ros1 = _is_ros1(self.path)
        self._standard = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        self._stores: dict[str, Typestore] = {}
        try:
            self._reader: Reader1 | Reader2 = (Reader1 if self.ros1 else Reader2)(self.path)
            self._reader.open()
            self.topics = _topics_of(self._reader)
        except PermissionError:
            raise
        except Exception as err:
            raise RecordingError(self.path, f"cannot be opened as a bag: {_cause(err)}") from err

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._reader.close()

    def of_type(self, types: Collection[str]) -> tuple[Topic, ...]:
        """Return the topics of one of these types."""
        return tuple(topic for topic in self.topics if topic.type in types)

    def messages(self, topics: Collection[Topic]) -> Iterator[Message]:
        """Yield the messages of some topics.

        Raises
        ------
        RecordingError
            Where the recording is damaged, with the time that was reached.
        """
        wanted = {(topic.name, topic.type) for topic in topics}
        connections = [c for c in self._reader.connections if (c.topic, c.msgtype) in wanted]
        if not connections:  # an empty selection means every topic to rosbags
            return
        last, read = "", 0
        try:
            for connection, record_ns, raw in self._reader.messages(connections):
                _check_stamp(record_ns)
                last = f" of {connection.topic} at {seconds(record_ns)}"
                read += 1
                yield Message(connection.topic, connection.msgtype, record_ns, raw)
        except Exception as err:
            after = f"after {read} messages, the last{last}" if read else "at its first message"
            raise RecordingError(self.path, f"is damaged {after}: {_cause(err)}") from err

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
            store = self._store_of(message.type)
            deserialise = store.deserialize_ros1 if self.ros1 else store.deserialize_cdr
            return take(deserialise(message.raw, message.type))
        except Exception as err:
            raise RecordingError(
                self.path,
                f"{message.topic}: the message at {seconds(message.record_ns)} is no readable "
                f"{message.type}: {_cause(err)}",
            ) from err

    def is_standard(self, type_: str) -> bool:
        """Tell whether the bag means by a type, and by its header, what ROS means by it."""
        try:
            found = self._store_of(type_).fielddefs
            known = self._standard.fielddefs
            return all(found[name][1] == known[name][1] for name in (type_, _HEADER))
        except Exception:  # rosbags fails in many ways on a definition that it cannot read
            return False

    def sources(self) -> list[dict[str, str | int]]:
        """Return name, bytes and SHA-256 of the files that the recording consists of."""
        files = [self.path]
        if self.path.is_dir():
            files = sorted(p for p in self.path.iterdir() if p.suffix in _SOURCES and p.is_file())
        return [
            {"name": file.name, "bytes": file.stat().st_size, "sha256": _sha256(file)}
            for file in files
        ]

    def _store_of(self, type_: str) -> Typestore:
        """Types as the bag defines them; only those that are read are ever compiled."""
        if type_ not in self._stores:
            texts = (
                c.msgdef.data
                for c in self._reader.connections
                if c.msgtype == type_ and c.msgdef.format == MessageDefinitionFormat.MSG
            )
            text = next((text for text in texts if text.strip()), None)
            store = self._standard
            if text is not None:
                store = get_typestore(Stores.EMPTY)
                store.register(get_types_from_msg(text, type_))
            self._stores[type_] = store
        return self._stores[type_]


def seconds(stamp_ns: int) -> str:
    """Write a stamp as seconds, to the millisecond."""
    return f"{stamp_ns // 10**9}.{stamp_ns // 10**6 % 1000:03d} s"


def _topics_of(reader: Reader1 | Reader2) -> tuple[Topic, ...]:
    counts: dict[tuple[str, str], int] = {}
    for connection in reader.connections:
        key = (connection.topic, connection.msgtype)
        counts[key] = counts.get(key, 0) + connection.msgcount
    return tuple(Topic(*key, count) for key, count in sorted(counts.items()))


def _is_ros1(path: Path) -> bool:
    """Tell ROS 1 from ROS 2 by the first bytes; refuse what is neither."""
    if path.is_dir():
        _check_folder(path)
        return False
    with path.open("rb") as file:  # FileNotFoundError and PermissionError pass as they are
        head = file.read(64)
    if not head:
        raise RecordingError(path, "the file is empty")
    if head.startswith(b"#ROSBAG V2.0"):
        return True
    _check_version(path, head)
    for magic, advice in _PACKED.items():
        if head.startswith(magic):
            raise RecordingError(path, f"expected a bag, found {advice}")
    for magic, suffix in _ROS2_MAGIC.items():
        if head.startswith(magic):
            if path.suffix != suffix:
                raise RecordingError(
                    path, f"this is a ROS 2 bag whose name must end with {suffix}: rename it"
                )
            return False
    raise RecordingError(
        path,
        f"not a ROS bag: expected a ROS 1 .bag, or a ROS 2 .db3, .mcap or folder, found a file "
        f"that starts with {head[:16]!r}",
    )


def _check_version(path: Path, head: bytes) -> None:
    if head.startswith((b"#ROSBAG", b"#ROSRECORD", b"#ROSLOG")):
        line = head.splitlines()[0].decode("ascii", "replace")
        raise RecordingError(
            path,
            f"expected a bag of version 2.0, found {line!r}: convert it with ROS 1 "
            "(rosbag fix OLD.bag NEW.bag)",
        )


def _check_folder(path: Path) -> None:
    if (path / "metadata.yaml").is_file():
        return
    bags = sorted(p.name for p in path.iterdir() if p.suffix in _SUFFIXES)
    advice = f"give one of its bags: {', '.join(bags[:8])}" if bags else "it holds no bag"
    raise RecordingError(path, f"a folder without metadata.yaml is no ROS 2 recording; {advice}")


def _check_stamp(record_ns: int) -> None:
    if not 0 <= record_ns <= _MAX_STAMP_NS:
        raise ValueError(f"a message has the record time {record_ns}")


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _cause(err: Exception) -> str:
    """Name a failure of rosbags or of what it rests on, in one line."""
    text = " ".join(str(err).split())
    return f"{type(err).__name__}{': ' + text if text else ''}"
