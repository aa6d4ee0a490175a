"""ROS 1 bags of version 2.0, a chunk at a time.

rosbags keeps an entry for every message of a bag in memory, about 150 bytes; here only the
chunks that are being read are known by their messages, so that any length can be read.
The format: https://wiki.ros.org/Bags/Format/2.0
"""

from __future__ import annotations

import os
import struct
from collections.abc import Collection, Iterator
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from conversion.messages.recordings import Message
from conversion.ros.compression import MAX_PIECE, decompress
from conversion.ros.definitions import Connection
from conversion.ros.merging import Stream, merge

MAGIC = b"#ROSBAG V2.0\n"

_MESSAGE, _BAG, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 4, 5, 6, 7
_U32 = struct.Struct("<I")
_COUNT = np.dtype([("connection", "<u4"), ("messages", "<u4")])
_ENTRY = np.dtype([("sec", "<u4"), ("nsec", "<u4"), ("offset", "<u4")])

Fields = dict[bytes, bytes]


class Chunk(NamedTuple):
    """What the index says of a chunk."""

    at: int
    start_ns: int
    end_ns: int
    counts: NDArray[Any]


class Record(NamedTuple):
    """The header of a record, and where its data lie."""

    fields: Fields
    at: int
    size: int

    @property
    def op(self) -> int:
        """The kind of record."""
        return self.number(b"op", 1)

    def number(self, name: bytes, size: int) -> int:
        """Return an unsigned number of so many bytes."""
        value = self.fields.get(name, b"")
        if len(value) != size:
            raise ValueError(f"a record without its field {name.decode()!r}")
        return int.from_bytes(value, "little")

    def time_ns(self, name: bytes) -> int:
        """Return a time."""
        value = self.number(name, 8)
        return (value & 0xFFFFFFFF) * 10**9 + (value >> 32)

    def text(self, name: bytes) -> str:
        """Return a text."""
        if name not in self.fields:
            raise ValueError(f"a record without its field {name.decode()!r}")
        return self.fields[name].decode()


class Rosbag1:
    """A ROS 1 bag, open for reading.

    Parameters
    ----------
    path
        A file that starts with `MAGIC`.

    Raises
    ------
    ValueError
        If it has no index, or one that is damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = path.open("rb")
        try:
            self._size = os.fstat(self._file.fileno()).st_size
            self._read_index()
        except BaseException:
            self._file.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @property
    def start_ns(self) -> int:
        """No message was recorded before."""
        return min((chunk.start_ns for chunk in self._chunks), default=0)

    def messages(self, connections: Collection[Connection], start_ns: int) -> Iterator[Message]:
        """Yield the messages of some connections that were recorded at `start_ns` or later.

        Raises
        ------
        ValueError
            If a chunk is damaged, or holds something else than the index says.
        """
        wanted = {connection.id: connection for connection in connections}
        chunks = (
            chunk
            for chunk in self._chunks
            if chunk.end_ns >= start_ns and not wanted.keys().isdisjoint(chunk.counts["connection"])
        )
        return merge(
            Stream(chunk.start_ns, partial(self._messages_of, chunk, wanted, start_ns))
            for chunk in chunks
        )

    def _read_index(self) -> None:
        head = self._record(len(MAGIC))
        if head.op != _BAG:
            raise ValueError("the bag header is damaged")
        if head.fields.get(b"encryptor"):
            raise ValueError("the bag is encrypted: decrypt it with ROS 1 (rosbag decrypt)")
        at, chunks = head.number(b"index_pos", 8), head.number(b"chunk_count", 4)
        if at == 0:
            raise ValueError("the bag has no index: its recorder did not end properly")
        self.connections: list[Connection] = []
        self._chunks: list[Chunk] = []
        for _ in range(head.number(b"conn_count", 4)):
            record = self._record(at)
            self.connections.append(_connection_of(record, self._data(record)))
            at = record.at + record.size
        for _ in range(chunks):
            record = self._record(at)
            self._chunks.append(_chunk_of(record, self._data(record)))
            at = record.at + record.size
        self._count_messages()

    def _count_messages(self) -> None:
        totals = {connection.id: 0 for connection in self.connections}
        for chunk in self._chunks:
            for number, messages in chunk.counts.tolist():
                if number not in totals:
                    raise ValueError(f"the index names a connection {number} that is not there")
                totals[number] += messages
        self.connections = [c._replace(messages=totals[c.id]) for c in self.connections]

    def _messages_of(
        self, chunk: Chunk, wanted: dict[int, Connection], start_ns: int
    ) -> Iterator[Message]:
        """Messages of a chunk by time, each checked against the index that follows the chunk."""
        record = self._record(chunk.at)
        data = unpack_chunk(record, self._data(record))
        entries, times, of = self._entries(record.at + record.size, chunk, wanted)
        order = np.flatnonzero(times >= start_ns)
        order = order[np.lexsort((entries["offset"][order], times[order]))]
        stamps = entries[order].tobytes()
        listed = (column[order].tolist() for column in (entries["offset"], times, of))
        around = dict.fromkeys(wanted, (b"", b""))
        for k, (offset, record_ns, number) in enumerate(zip(*listed, strict=True)):
            stamp = stamps[12 * k : 12 * k + 8]
            # all headers of a connection are alike but for their time
            head = stamp.join(around[number])
            at = offset + len(head)
            if len(head) == len(stamp) or not data.startswith(head, offset):
                at = _find_message(data, offset, number, stamp)
                before, found, after = data[offset:at].partition(b"time=")
                around[number] = (before + found, after[8:])
            (size,) = _U32.unpack_from(data, at)
            raw = data[at + 4 : at + 4 + size]
            if len(raw) != size:
                raise ValueError("a chunk ends within a message")
            connection = wanted[number]
            yield Message(connection.topic, connection.type, record_ns, raw)

    def _entries(
        self, at: int, chunk: Chunk, wanted: Collection[int]
    ) -> tuple[NDArray[Any], NDArray[np.int64], NDArray[np.uint32]]:
        """Index entries of the wanted connections in a chunk, their times and connections."""
        entries: list[NDArray[Any]] = []
        of: list[NDArray[np.uint32]] = []
        for _ in range(len(chunk.counts)):
            record = self._record(at)
            at = record.at + record.size
            number, count = record.number(b"conn", 4), record.number(b"count", 4)
            told = chunk.counts["messages"][chunk.counts["connection"] == number]
            if record.op != _INDEX or record.size != count * _ENTRY.itemsize or count not in told:
                raise ValueError("the index of a chunk is damaged")
            if number in wanted:
                entries.append(np.frombuffer(self._data(record), _ENTRY))
                of.append(np.full(count, number, np.uint32))
        found = np.concatenate(entries) if entries else np.empty(0, _ENTRY)
        times = found["sec"].astype(np.int64) * 10**9 + found["nsec"]
        if times.size and not chunk.start_ns <= times.min() <= times.max() <= chunk.end_ns:
            raise ValueError("a chunk holds messages of other times than its index says")
        return found, times, np.concatenate(of) if of else np.empty(0, np.uint32)

    def _record(self, at: int) -> Record:
        return read_record(self._file, at, self._size)

    def _data(self, record: Record) -> bytes:
        self._file.seek(record.at)
        return self._file.read(record.size)


def read_record(file: BinaryIO, at: int, size: int) -> Record:
    """Read the header of the record at a place of a file of so many bytes.

    Raises
    ------
    ValueError
        If there is none, or it does not end within the file.
    """
    file.seek(at)
    length = _length(file.read(4))
    if not 0 < length <= size - at - 8:
        raise ValueError(f"the file ends within the record at byte {at}")
    fields = _fields_of(file.read(length))
    found = Record(fields, at + 8 + length, _length(file.read(4)))
    if found.size > size - found.at:
        raise ValueError(f"the file ends within the record at byte {at}")
    if found.size > MAX_PIECE:
        raise ValueError(f"the record at byte {at} has {found.size} bytes: more than can be read")
    return found


def unpack_chunk(record: Record, data: bytes) -> bytes:
    """Decompress a chunk, never to more than its header says.

    Raises
    ------
    Exception
        If the chunk is damaged.
    """
    if record.op != _CHUNK:
        raise ValueError("the index points to something that is no chunk")
    return decompress(record.text(b"compression"), data, record.number(b"size", 4))


def walk_chunk(data: bytes) -> Iterator[Record]:
    """Yield the records of an unpacked chunk, with places in it."""
    at = 0
    while at < len(data):
        found = _record_in(data, at)
        yield found
        at = found.at + found.size


def _record_in(data: bytes, at: int) -> Record:
    length = _length(data[at : at + 4])
    fields = _fields_of(data[at + 4 : at + 4 + length])
    found = Record(fields, at + length + 8, _length(data[at + 4 + length : at + 8 + length]))
    if found.size > len(data) - found.at:
        raise ValueError("a chunk ends within a record")
    return found


def _find_message(data: bytes, at: int, number: int, stamp: bytes) -> int:
    """Where the header of the message that the index places here ends."""
    record = _record_in(data, at)
    while record.op == _CONNECTION:  # the first message of a connection comes after it
        at = record.at + record.size
        record = _record_in(data, at)
    same = record.number(b"conn", 4) == number and record.fields.get(b"time") == stamp
    if record.op != _MESSAGE or not same:
        raise ValueError("the index of a chunk does not fit its messages")
    return record.at - 4


def _length(data: bytes) -> int:
    if len(data) != _U32.size:
        raise ValueError("the file ends within a record")
    return int.from_bytes(data, "little")


def _fields_of(header: bytes) -> Fields:
    fields: Fields = {}
    at = 0
    while at < len(header):
        length = _length(header[at : at + 4])
        name, equals, value = header[at + 4 : at + 4 + length].partition(b"=")
        if not equals or at + 4 + length > len(header):
            raise ValueError("a record header is damaged")
        fields[name] = value
        at += 4 + length
    return fields


def _connection_of(record: Record, data: bytes) -> Connection:
    if record.op != _CONNECTION:
        raise ValueError("the index holds something else where connections should be")
    about = Record(_fields_of(data), 0, 0)
    return Connection(
        record.number(b"conn", 4),
        _plain_topic(record.text(b"topic")),
        _ros2_name(about.text(b"type")),
        0,
        about.text(b"message_definition"),
    )


def _chunk_of(record: Record, data: bytes) -> Chunk:
    if record.op != _CHUNK_INFO or record.number(b"ver", 4) != 1:
        raise ValueError("the index holds something else where chunks should be")
    counts = np.frombuffer(data, _COUNT)
    if len(counts) != record.number(b"count", 4):
        raise ValueError("the index of the chunks is damaged")
    times = (record.time_ns(b"start_time"), record.time_ns(b"end_time"))
    return Chunk(record.number(b"chunk_pos", 8), *times, counts)


def _plain_topic(name: str) -> str:
    """Drop the doubled slashes that ROS 1 let pass."""
    parts = (part for part in name.split("/") if part)
    return ("/" if name.startswith("/") else "") + "/".join(parts)


def _ros2_name(type_: str) -> str:
    """Name a type as ROS 2 does: package/msg/Name."""
    path = PurePosixPath(type_)
    return str(path if path.parent.name in ("msg", "action") else path.parent / "msg" / path.name)
