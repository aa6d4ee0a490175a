"""Files of ROS 2 bags in the format MCAP, a chunk at a time.

rosbags decompresses chunks to whatever size comes out of them, checks no summary, and takes each
record apart by several reads; here sizes and checksums are compared first, and reading is faster.
The format: https://mcap.dev/spec
"""

from __future__ import annotations

import os
import struct
import zlib
from collections import Counter
from collections.abc import Collection, Iterator
from functools import partial
from io import BufferedReader
from pathlib import Path
from typing import BinaryIO, NamedTuple

from conversion.messages.recordings import Message
from conversion.ros.compression import MAX_PIECE, ZSTD_MAGIC, decompress, decompress_message
from conversion.ros.definitions import Connection
from conversion.ros.merging import Stream, merge

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK = range(1, 7)
HEAD = 9
"""Bytes of a record before what it holds."""
START = 8
"""Where records begin."""

_CHUNK_INDEX, _STATISTICS, _DATA_END = 0x08, 0x0B, 0x0F
_MAGIC = b"\x89MCAP0\r\n"
_PROFILES = ("ros2", "")
_IDL = ("ros2idl", "omgidl")
_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, time of recording, time of publishing
_CHUNK = struct.Struct("<QQQII")  # first and last time, size, checksum, length of the codec
_FOOTER = struct.Struct("<BQQQI8s")  # op, length, places of the summary, its checksum, magic
_LONGEST_CODEC = 32
_LONGEST_HEADER = 1 << 16
_RUN = 1 << 22  # bytes of messages outside of chunks that are read together

Record = tuple[int, int, int]
"""Op of a record, where its content begins, and its size."""


class Piece(NamedTuple):
    """A chunk, or a run of messages outside of chunks.

    Parameters
    ----------
    at, size
        Where it lies in the file, the head of its first record included.
    start_ns, end_ns
        When the first and the last message in it were recorded.
    channels
        Of the messages in it; empty where it is not known.
    """

    at: int
    size: int
    start_ns: int
    end_ns: int
    channels: frozenset[int]


class McapBag:
    """An ``.mcap``, open for reading.

    Raises
    ------
    Exception
        If it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._schemas: dict[int, tuple[str, str, bool]] = {}
        self._channels: dict[int, tuple[int, str]] = {}
        self._pieces: list[Piece] = []
        self._counts: Counter[int] = Counter()
        self._file = path.open("rb")
        try:
            self._read()
        except BaseException:
            self._file.close()
            raise
        self.connections = [self._connection(number) for number in sorted(self._channels)]

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @property
    def start_ns(self) -> int:
        """No message was recorded before."""
        return min((piece.start_ns for piece in self._pieces), default=0)

    def messages(self, connections: Collection[Connection], start_ns: int) -> Iterator[Message]:
        """Yield the messages of some connections that were recorded at `start_ns` or later.

        Raises
        ------
        Exception
            If a chunk is damaged.
        """
        names = {connection.id: connection[1:3] for connection in connections}
        return merge(
            Stream(piece.start_ns, partial(self._messages_of, piece, names, start_ns))
            for piece in self._pieces
            if piece.end_ns >= start_ns
            and not (piece.channels and piece.channels.isdisjoint(names))
        )

    def _messages_of(
        self, piece: Piece, names: dict[int, tuple[str, str]], start_ns: int
    ) -> Iterator[Message]:
        data = read_piece(self._file, piece.at, piece.size)
        found = []
        for op, at, size in walk(data):
            if op == MESSAGE:
                channel, record_ns = message_of(data, at)
                if channel in names and record_ns >= start_ns:
                    found.append((record_ns, at + _MESSAGE.size, at + size, channel))
        found.sort()
        if found and not piece.start_ns <= found[0][0] <= found[-1][0] <= piece.end_ns:
            raise ValueError("a chunk holds messages of other times than its index says")
        for record_ns, at, end, channel in found:
            raw = data[at:end]
            if raw.startswith(ZSTD_MAGIC):
                raw = decompress_message(raw)
            yield Message(*names[channel], record_ns, raw)

    def _read(self) -> None:
        end = os.fstat(self._file.fileno()).st_size - _FOOTER.size
        start = self._read_profile()
        self._file.seek(max(end, 0))
        footer = self._file.read(_FOOTER.size)
        if end < start or not footer.endswith(_MAGIC) or footer[0] != FOOTER:
            raise ValueError("its end is missing: it was not closed, or not copied as a whole")
        _, _, summary, _, crc, _ = _FOOTER.unpack(footer)
        if summary and not start <= summary <= end:
            raise ValueError("its summary lies outside of the file")
        if not summary or not self._read_summary(summary, end, footer, crc):
            self._pieces.clear()
            self._counts.clear()
            self._scan(start, summary or end)

    def _read_profile(self) -> int:
        """Check what the file is for, and return where its records begin."""
        head = self._file.read(START + HEAD)
        op, size = _RECORD.unpack_from(head, START)
        if op != HEADER or size > _LONGEST_HEADER:
            raise ValueError("its header is damaged")
        profile, _ = _text(self._file.read(size), 0)
        if profile not in _PROFILES:
            raise ValueError(f"its profile is {profile!r}: expected an MCAP of ROS 2")
        return len(head) + int(size)

    def _read_summary(self, at: int, end: int, footer: bytes, crc: int) -> bool:
        """Read the summary, and tell whether it says all that is needed."""
        if end - at > MAX_PIECE:
            raise ValueError(f"its summary has {end - at} bytes: more than can be read")
        self._file.seek(at)
        data = self._file.read(end - at)
        if crc and zlib.crc32(footer[: _FOOTER.size - 12], zlib.crc32(data)) != crc:
            raise ValueError("its summary does not fit its checksum")
        counted, messages = False, 0
        for op, start, size in walk(data):
            content = data[start : start + size]
            if op == _CHUNK_INDEX:
                self._pieces.append(_piece_of(content))
            elif op == _STATISTICS:
                counted, messages = True, int.from_bytes(content[:8], "little")
                self._counts.update(_map_of(content, 42, "<HQ"))
            else:
                self._note(op, content)
        return counted and messages == self._counts.total() and bool(self._pieces or not messages)

    def _scan(self, at: int, end: int) -> None:
        """Find the chunks and messages of a file that has no index of them."""
        run: list[Record] = []
        for op, start, size in records_of(self._file, at, end):
            if run and (op != MESSAGE or start + size - run[0][1] > _RUN):
                self._add_piece(run)
                run = []
            if op == MESSAGE:
                run.append((op, start, size))
            elif op == CHUNK:
                self._add_piece([(op, start, size)])
            elif op in (SCHEMA, CHANNEL):
                self._file.seek(start)
                self._note(op, self._file.read(size))
        if run:
            self._add_piece(run)

    def _add_piece(self, records: list[Record]) -> None:
        """Add a chunk, or a run of messages, by what lies in it."""
        first, last = records[0][1] - HEAD, records[-1][1] + records[-1][2]
        piece = Piece(first, last - first, 0, 0, frozenset())
        data = read_piece(self._file, piece.at, piece.size)
        times, channels = [], Counter[int]()
        for op, at, size in walk(data):
            if op == MESSAGE:
                channel, record_ns = message_of(data, at)
                times.append(record_ns)
                channels[channel] += 1
            else:
                self._note(op, data[at : at + size])
        if times:
            known = (min(times), max(times), frozenset(channels))
            self._pieces.append(Piece(piece.at, piece.size, *known))
            self._counts += channels

    def _note(self, op: int, content: bytes) -> None:
        """Note a schema or a channel."""
        number = int.from_bytes(content[:2], "little")
        if op == SCHEMA:
            name, at = _text(content, 2)
            encoding, at = _text(content, at)
            text, _ = _text(content, at)
            self._schemas[number] = (name, text, encoding in _IDL)
        elif op == CHANNEL:
            self._channels[number] = (int.from_bytes(content[2:4], "little"), topic_of(content)[1])

    def _connection(self, number: int) -> Connection:
        schema, topic = self._channels[number]
        name, text, idl = self._schemas.get(schema, ("", "", False))
        return Connection(number, topic, name, self._counts[number], text, idl)


def walk(data: bytes) -> Iterator[Record]:
    """Yield the records of a piece of a file.

    Raises
    ------
    ValueError
        If it ends within a record.
    """
    at, end = 0, len(data)
    while at < end:
        if end - at < HEAD:
            raise ValueError("a chunk ends within a record")
        op, size = _RECORD.unpack_from(data, at)
        at += HEAD
        if size > end - at or (op == MESSAGE and size < _MESSAGE.size):
            raise ValueError("a chunk ends within a record")
        yield op, at, size
        at += size


def records_of(file: BinaryIO, at: int, end: int) -> Iterator[Record]:
    """Yield the records of a part of a file; what they hold is not read.

    Raises
    ------
    ValueError
        If it ends within a record.
    """
    while at < end:
        file.seek(at)
        head = file.read(HEAD)
        if len(head) < HEAD:
            raise ValueError("the file ends within a record")
        op, size = _RECORD.unpack(head)
        at += HEAD
        if size > end - at:
            raise ValueError("the file ends within a record")
        if op == _DATA_END:
            return
        yield op, at, size
        at += size


def read_piece(file: BufferedReader, at: int, size: int) -> bytes:
    """Read records, or the record of a chunk and return the records in it.

    Parameters
    ----------
    at, size
        Where they lie, the heads of the records included.

    Raises
    ------
    Exception
        If they are damaged.
    """
    if size > MAX_PIECE:
        raise ValueError(f"a chunk has {size} bytes: more than can be read")
    file.seek(at)
    if file.peek(1)[:1] == bytes([CHUNK]):
        return _read_chunk(file, size)
    data = file.read(size)
    if len(data) != size:
        raise ValueError("the file ends within a record")
    return data


def message_of(data: bytes, at: int) -> tuple[int, int]:
    """Return channel and time of recording of a message."""
    channel, _, record_ns, _ = _MESSAGE.unpack_from(data, at)
    return channel, record_ns


def topic_of(content: bytes) -> tuple[int, str]:
    """Return number and topic of a channel."""
    return int.from_bytes(content[:2], "little"), _text(content, 4)[0]


def _read_chunk(file: BufferedReader, size: int) -> bytes:
    head = file.read(HEAD + _CHUNK.size)
    _, told = _RECORD.unpack_from(head)
    _, _, unpacked, crc, length = _CHUNK.unpack_from(head, HEAD)
    codec = file.read(min(length, _LONGEST_CODEC)).decode()
    packed = int.from_bytes(file.read(8), "little")
    if told != size - HEAD or packed != told - _CHUNK.size - length - 8:
        raise ValueError("a chunk has another size than its index says")
    data = decompress(codec, file.read(packed), unpacked)
    if crc and zlib.crc32(data) != crc:
        raise ValueError("a chunk does not fit its checksum")
    return data


def _piece_of(content: bytes) -> Piece:
    start_ns, end_ns, at, size = struct.unpack_from("<4Q", content)
    return Piece(at, size, start_ns, end_ns, frozenset(_map_of(content, 32, "<HQ")))


def _map_of(content: bytes, at: int, layout: str) -> dict[int, int]:
    size = int.from_bytes(content[at : at + 4], "little")
    entries = content[at + 4 : at + 4 + size]
    if len(entries) != size:
        raise ValueError("the summary ends within a record")
    return dict(struct.iter_unpack(layout, entries))


def _text(content: bytes, at: int) -> tuple[str, int]:
    size = int.from_bytes(content[at : at + 4], "little")
    text = content[at + 4 : at + 4 + size]
    if len(text) != size:
        raise ValueError("a text does not end")
    return text.decode(), at + 4 + size
