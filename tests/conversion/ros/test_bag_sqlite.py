from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
from rosbags.rosbag2 import Reader

from conversion.ros.bags import Bag
from semantic2d_dataset.errors import RecordingError
from tests.conversion.recordings import LASER, START_NS, storage_of, straight_drive


@contextmanager
def changed(file: Path) -> Iterator[sqlite3.Connection]:
    with closing(sqlite3.connect(file)) as database:
        yield database
        database.commit()


@pytest.fixture
def file(tmp_path) -> Path:
    return storage_of(straight_drive("db3").write(tmp_path))


def messages_of(file: Path) -> list:
    with Bag(file) as bag:
        return list(bag.messages(bag.topics))


def refused(file: Path) -> str:
    with pytest.raises(RecordingError) as caught:
        messages_of(file)
    return str(caught.value)


def test_the_oldest_schema_is_read(file):
    whole = messages_of(file)
    with changed(file) as database:
        for table in ("schema", "metadata", "message_definitions"):
            database.execute(f"DROP TABLE {table}")
        for column in ("offered_qos_profiles", "type_description_hash"):
            database.execute(f"ALTER TABLE topics DROP COLUMN {column}")
    assert messages_of(file) == whole


def test_a_database_without_index_is_read_by_time(file):
    whole = messages_of(file)
    with changed(file) as database:
        database.execute("DROP INDEX timestamp_idx")
        database.execute("UPDATE messages SET id = 1000 - id")  # the last comes first
    found = messages_of(file)
    assert [message.record_ns for message in found] == [message.record_ns for message in whole]
    assert sorted(found) == sorted(whole)


def test_messages_of_no_topic_are_refused(file):
    with changed(file) as database:
        database.execute("UPDATE messages SET topic_id = 9 WHERE id = 5")
    assert "there are messages of no topic" in refused(file)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ("timestamp = 'noon'", "has the time 'noon'"),
        ("timestamp = 1.5", "has the time 1.5"),
        ("timestamp = -5", "has the time -5"),
        ("timestamp = NULL", "has the time None"),
        ("data = 'text'", "Error"),
        ("data = 7", "Error"),
        ("data = NULL", "Error"),
    ],
)
def test_a_row_that_is_no_message_is_refused(change, why, file):
    with changed(file) as database:
        database.execute("CREATE TABLE loose AS SELECT * FROM messages")  # without NOT NULL
        database.execute("DROP TABLE messages")
        database.execute("ALTER TABLE loose RENAME TO messages")
        database.execute(f"UPDATE messages SET {change} WHERE id = 20")
    text = refused(file)
    assert "damaged" in text
    assert why in text or "expected 26 messages" in text


def test_an_index_that_does_not_fit_its_table_is_refused(file):
    first = START_NS.to_bytes(8, "big")
    data = bytearray(file.read_bytes())
    places = [at for at in range(len(data)) if data.startswith(first, at)]
    assert len(places) >= 6  # three messages at that time, in the table and in the index
    for at in (places[0], places[-1]):
        damaged = data.copy()
        damaged[at + 7] ^= 1
        file.write_bytes(damaged)
        assert "the table of messages does not fit its index" in refused(file)


def test_definitions_that_are_no_text_are_none(file):
    whole = messages_of(file)
    with changed(file) as database:
        database.execute("UPDATE message_definitions SET encoded_message_definition = x'00ff'")
    assert messages_of(file) == whole


def test_a_database_that_is_no_bag_is_refused(tmp_path):
    with changed(tmp_path / "a.db3") as database:
        database.execute("CREATE TABLE birds (name TEXT)")
    assert "it has no table 'messages'" in refused(tmp_path / "a.db3")


def test_a_view_in_place_of_a_table_never_hangs(file):
    endless = (
        "CREATE VIEW messages AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n) "
        "SELECT id, 1 AS topic_id, id AS timestamp, x'00' AS data FROM n"
    )
    with changed(file) as database:
        database.execute("DROP TABLE messages")
        database.execute(endless)
    assert "cannot be opened" in refused(file)


def test_topics_without_messages_are_listed(file):
    with changed(file) as database:
        database.execute("DELETE FROM messages WHERE topic_id = 3")
    with Bag(file) as bag:
        assert [topic for topic in bag.topics if topic.type == LASER] == [("/scan", LASER, 0)]
        assert list(bag.messages(bag.of_type((LASER,)))) == []
        assert next(bag.messages(bag.topics)).record_ns == START_NS


def test_a_recorded_bag_holds_what_rosbags_finds_in_it(shared_data):
    path = shared_data / "thesis_cart" / "rosbag" / "rosbag2_test"
    with Reader(path) as reader, Bag(path) as bag:
        expected = [(c.topic, c.msgtype, ns, hash(bytes(raw))) for c, ns, raw in reader.messages()]
        found = [(*m[:3], hash(m.raw)) for m in bag.messages(bag.topics)]
    assert len(found) == 752
    assert sorted(found) == sorted(expected)
    assert [m[2] for m in found] == [m[2] for m in expected]
