"""What could be read of a bag that is damaged, and how to repair it."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from pathlib import Path

from conversion.ros.bag_files import MCAP, ROS1, SQLITE, kind_of
from conversion.ros.bag_mcap import (
    CHANNEL,
    CHUNK,
    HEAD,
    MESSAGE,
    START,
    message_of,
    read_piece,
    records_of,
    topic_of,
    walk,
)
from conversion.ros.bag_sqlite import check_tables, open_database
from conversion.ros.compression import MAX_PIECE
from conversion.ros.rosbag1 import MAGIC, read_record, unpack_chunk, walk_chunk
from conversion.wording import seconds

_ADVICE = {
    ROS1: "rosbag reindex {0} (of ROS 1) writes its index anew",
    MCAP: "mcap recover {0} -o NEW.mcap (of https://mcap.dev) saves what it holds",
    SQLITE: "sqlite3 {0} .recover | sqlite3 NEW.db3 saves what it holds",
}
_CONNECTION_OP, _CHUNK_OP, _MESSAGE_OP = 7, 5, 2

Found = tuple[str, int]
"""Topic and record time of a message."""


def describe(path: Path) -> str:
    """Say how many messages of a damaged file can be read, up to which, and what repairs it."""
    try:
        kind = kind_of(path)
        walk = _WALKS[kind]
    except Exception:  # it was a bag when it was opened, or is compressed as a whole
        return "no message can be read"
    count, last = 0, ("", 0)
    with suppress(Exception):  # the damage itself
        for found in walk(path):
            count, last = count + 1, found
    advice = _ADVICE[kind].format(path.name)
    if not count:
        return f"no message can be read; {advice}"
    topic, record_ns = last
    return f"{count} messages can be read, the last of {topic} at {seconds(record_ns)}; {advice}"


def _walk_rosbag1(path: Path) -> Iterator[Found]:
    topics: dict[int, str] = {}
    with path.open("rb") as file:
        size, at = os.fstat(file.fileno()).st_size, len(MAGIC)
        while at < size:
            record = read_record(file, at, size)
            at = record.at + record.size
            if record.op == _CHUNK_OP:
                file.seek(record.at)
                for inner in walk_chunk(unpack_chunk(record, file.read(record.size))):
                    if inner.op == _CONNECTION_OP:
                        topics[inner.number(b"conn", 4)] = inner.text(b"topic")
                    elif inner.op == _MESSAGE_OP:
                        yield topics[inner.number(b"conn", 4)], inner.time_ns(b"time")


def _walk_mcap(path: Path) -> Iterator[Found]:
    topics: dict[int, str] = {}
    with path.open("rb") as file:
        for op, at, size in records_of(file, START, os.fstat(file.fileno()).st_size):
            if op in (CHUNK, CHANNEL, MESSAGE) and size <= MAX_PIECE:
                yield from _found_in(read_piece(file, at - HEAD, size + HEAD), topics)


def _found_in(data: bytes, topics: dict[int, str]) -> Iterator[Found]:
    for op, at, size in walk(data):
        if op == CHANNEL:
            number, topic = topic_of(data[at : at + size])
            topics[number] = topic
        elif op == MESSAGE:
            number, record_ns = message_of(data, at)
            yield topics[number], record_ns


def _walk_sqlite(path: Path) -> Iterator[Found]:
    with closing(open_database(path)) as database:
        database.execute("PRAGMA writable_schema = ON")  # else a file cut short is not opened
        check_tables(database)
        topics = dict(database.execute("SELECT id, name FROM topics"))
        for number, record_ns in database.execute("SELECT topic_id, timestamp FROM messages"):
            yield topics[number], record_ns


_WALKS: dict[str, Callable[[Path], Iterator[Found]]] = {
    ROS1: _walk_rosbag1,
    MCAP: _walk_mcap,
    SQLITE: _walk_sqlite,
}
