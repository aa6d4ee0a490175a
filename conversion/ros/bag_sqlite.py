"""Files of ROS 2 bags that are SQLite databases."""

from __future__ import annotations

import sqlite3
from collections.abc import Collection, Iterator
from pathlib import Path

from conversion.messages.recordings import Message
from conversion.ros.compression import MAX_PIECE, ZSTD_MAGIC, decompress_message
from conversion.ros.definitions import Connection

_HEADER = 100  # bytes
_LARGEST_PAGE = 65536
# What both the table and its index say of the messages; a damaged page says something else.
_SUMS = "SUM(id), SUM(timestamp & 4294967295), SUM(timestamp >> 32)"


class SqliteBag:
    """A ``.db3``, open for reading.

    rosbags reads such files too. Here a file may have any name, and what a damaged page or a row
    cut off would change is found, as far as a format without checksums lets it be.

    Raises
    ------
    ValueError
        If it is cut short, or its recorder did not end properly.
    sqlite3.Error
        If it is damaged in another way, or holds no bag.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        _check_whole(path)
        _check_journal(path)
        self._database = open_database(path)
        try:
            self._database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_PIECE)
            self._read_topics()
        except BaseException:
            self._database.close()
            raise

    def close(self) -> None:
        """Close the database."""
        self._database.close()

    def messages(self, connections: Collection[Connection], start_ns: int) -> Iterator[Message]:
        """Yield the messages of some connections that were recorded at `start_ns` or later.

        Raises
        ------
        sqlite3.Error
            If a page is damaged.
        """
        names = {connection.id: connection[1:3] for connection in connections}
        marks = ", ".join("?" * len(names))
        rows = self._database.execute(
            "SELECT topic_id, timestamp, data FROM messages "  # noqa: S608  marks are no values
            f"WHERE topic_id IN ({marks}) AND timestamp >= ? ORDER BY timestamp, id",
            (*names, start_ns),
        )
        for number, record_ns, raw in rows:
            topic, type_ = names[number]
            if raw.startswith(ZSTD_MAGIC):
                raw = decompress_message(raw)  # noqa: PLW2901
            yield Message(topic, type_, record_ns, raw)

    def _read_topics(self) -> None:
        check_tables(self._database)
        definitions = self._definitions()
        found = self._database.execute(
            f"SELECT topic_id, COUNT(*), MIN(timestamp), {_SUMS} "  # noqa: S608  a constant
            "FROM messages NOT INDEXED GROUP BY topic_id"
        ).fetchall()
        counts = {row[0]: row[1] for row in found}
        self.start_ns = min((row[2] for row in found), default=0)
        self._check_index([sum(column) for column in list(zip(*found, strict=True))[3:]])
        topics = self._database.execute("SELECT id, name, type FROM topics ORDER BY id").fetchall()
        if counts.keys() - {number for number, _, _ in topics}:
            raise ValueError("there are messages of no topic")
        self.connections = [
            Connection(number, name, type_, counts.get(number, 0), *definitions.get(type_, ("",)))
            for number, name, type_ in topics
        ]
        if any(not isinstance(text, str) for topic in topics for text in topic[1:]):
            raise ValueError("there are topics whose name is no text")

    def _definitions(self) -> dict[str, tuple[str, bool]]:
        """Text and language of the definitions of types; recorders before Iron wrote none."""
        if not self._database.execute("PRAGMA table_info(message_definitions)").fetchall():
            return {}
        rows = self._database.execute(
            "SELECT topic_type, encoded_message_definition, encoding FROM message_definitions"
        )
        return {
            type_: (text, encoding == "ros2idl")
            for type_, text, encoding in rows
            if isinstance(text, str)
        }

    def _check_index(self, sums: list[int]) -> None:
        """Compare what the table says with what the index on times says, which orders it."""
        for row in self._database.execute("PRAGMA index_list(messages)").fetchall():
            (name,) = self._database.execute("SELECT quote(?)", (row[1],)).fetchone()
            columns = self._database.execute(f"PRAGMA index_info({name})").fetchall()
            if [column[2] for column in columns] == ["timestamp"]:
                told = self._database.execute(
                    f"SELECT {_SUMS} FROM messages INDEXED BY {name}"  # noqa: S608  it is quoted
                ).fetchone()
                if sums and list(told) != sums:
                    raise ValueError("the table of messages does not fit its index")


def open_database(path: Path) -> sqlite3.Connection:
    """Open a database that nobody writes to, whatever its name is."""
    uri = f"{path.absolute().as_uri()}?mode=ro&immutable=1"
    return sqlite3.connect(uri, uri=True, check_same_thread=False)


def check_tables(database: sqlite3.Connection) -> None:
    """Refuse what is no table: a view may never end.

    Raises
    ------
    ValueError
        If it is no database of a bag.
    """
    kinds = dict(database.execute("SELECT name, type FROM sqlite_master"))
    kinds.setdefault("message_definitions", "table")
    for name in ("messages", "topics", "message_definitions"):
        if kinds.get(name) != "table":
            raise ValueError(f"it has no table {name!r}: expected a database of ros2 bag")


def _check_whole(path: Path) -> None:
    """Refuse a file that lacks bytes: SQLite takes what lacks of a page as zeros."""
    with path.open("rb") as file:
        header = file.read(_HEADER)
    page = int.from_bytes(header[16:18], "big")
    page, pages = _LARGEST_PAGE if page == 1 else page, int.from_bytes(header[28:32], "big")
    size = path.stat().st_size
    if page and (size < page * pages or size % page):
        raise ValueError(f"it is cut short: {size} bytes are not {pages} pages of {page}")


def _check_journal(path: Path) -> None:
    """Refuse a database whose last messages lie in a journal beside it."""
    for suffix in ("-wal", "-journal"):
        journal = path.with_name(path.name + suffix)
        if journal.is_file() and journal.stat().st_size:
            raise ValueError(
                f"its recorder did not end properly, and {journal.name} holds messages; put them "
                f"into it with: sqlite3 {path.name} 'PRAGMA wal_checkpoint(TRUNCATE);'"
            )
