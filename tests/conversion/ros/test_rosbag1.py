from __future__ import annotations

import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Reader

from conversion.ros.bags import Bag
from conversion.ros.rosbag1 import Rosbag1
from tests.conversion.recordings import START_NS, Recording, straight_drive


def field(name: bytes, value: bytes) -> bytes:
    return struct.pack("<I", len(name) + 1 + len(value)) + name + b"=" + value


def record(fields: list[tuple[bytes, bytes]], data: bytes) -> bytes:
    head = b"".join(field(*each) for each in fields)
    return struct.pack("<I", len(head)) + head + struct.pack("<I", len(data)) + data


def u32(value: int) -> bytes:
    return struct.pack("<I", value)


def write_as_ros_does(path: Path, messages: list[tuple[int, int, bytes]], order: str) -> None:
    """Write messages (connection, time in ns, data), the fields of headers in any order.

    As rosbag of ROS does it, the index places the first message of a connection at the record of
    the connection that comes before it; rosbags' writer places it behind.
    """
    numbers = sorted({number for number, _, _ in messages})
    about = field(b"type", b"std_msgs/String") + field(b"md5sum", b"0" * 32)
    about += field(b"message_definition", b"string data") + field(b"topic", b"/other")
    connections = {
        n: record([(b"conn", u32(n)), (b"op", b"\7"), (b"topic", b"//t//%d" % n)], about)
        for n in numbers
    }
    body, entries = b"", dict.fromkeys(numbers, b"")
    for number, ns, data in messages:
        stamp = struct.pack("<II", ns // 10**9, ns % 10**9)
        entries[number] += stamp + u32(len(body))
        if len(entries[number]) == 12:
            body += connections[number]
        known = {"c": (b"conn", u32(number)), "o": (b"op", b"\2"), "t": (b"time", stamp)}
        body += record([known[letter] for letter in order], data)
    start = b"#ROSBAG V2.0\n"
    at = len(start) + 4096
    out = record([(b"compression", b"none"), (b"op", b"\5"), (b"size", u32(len(body)))], body)
    for n in numbers:
        head = [(b"conn", u32(n)), (b"count", u32(len(entries[n]) // 12)), (b"op", b"\4")]
        out += record([*head, (b"ver", u32(1))], entries[n])
    index_at = at + len(out)
    out += b"".join(connections.values())
    times = [ns for _, ns, _ in messages]
    first, last = (struct.pack("<II", ns // 10**9, ns % 10**9) for ns in (min(times), max(times)))
    counts = b"".join(u32(n) + u32(len(entries[n]) // 12) for n in numbers)
    out += record(
        [
            (b"chunk_pos", struct.pack("<Q", at)), (b"count", u32(len(numbers))),
            (b"end_time", last), (b"op", b"\6"), (b"start_time", first), (b"ver", u32(1)),
        ],
        counts,
    )  # fmt: skip
    head = [(b"chunk_count", u32(1)), (b"conn_count", u32(len(numbers)))]
    head += [(b"index_pos", struct.pack("<Q", index_at)), (b"op", b"\3")]
    bare = len(record(head, b""))
    path.write_bytes(start + record(head, b" " * (4096 - bare)) + out)


@pytest.mark.parametrize("order", ["cot", "oct", "tco", "toc"])
def test_headers_may_have_their_fields_in_any_order(order, tmp_path):
    random = np.random.default_rng(1)
    messages = [
        (int(random.integers(0, 3)), START_NS + int(ns), b"time=" + bytes(n % 7))
        for n, ns in enumerate(random.integers(0, 50, 60))
    ]
    write_as_ros_does(tmp_path / "a.bag", messages, order)
    with Reader(tmp_path / "a.bag") as reader:
        expected = sorted((c.topic, c.msgtype, ns, raw) for c, ns, raw in reader.messages())
    with Bag(tmp_path / "a.bag") as bag:
        found = list(bag.messages(bag.topics))
    assert [m.record_ns for m in found] == sorted(ns for _, ns, _ in messages)
    assert sorted(map(tuple, found)) == expected
    assert found[0].topic.startswith("/t/")


RECORDED = [
    "pf_localisation/trace0.bag",
    "pf_localisation/simpath2.bag",
    "leg_tracker_benchmarks/general_tracking_moving_1.bag.zip",
]


@pytest.mark.parametrize("name", RECORDED)
def test_a_recorded_bag_holds_what_rosbags_finds_in_it(name, shared_data, tmp_path):
    path = shared_data / name
    if path.suffix == ".zip":
        with zipfile.ZipFile(path) as archive:
            (member,) = archive.namelist()
            (tmp_path / "a.bag").write_bytes(archive.read(member))
        path = tmp_path / "a.bag"
    with AnyReader([path]) as reader, Bag(path) as bag:
        expected = [(c.topic, c.msgtype, ns, hash(bytes(raw))) for c, ns, raw in reader.messages()]
        found = [(*m[:3], hash(m.raw)) for m in bag.messages(bag.topics)]
    assert sorted(found) == sorted(expected)
    assert [m[2] for m in found] == [m[2] for m in expected]


def small_bag(folder: Path) -> bytearray:
    drive = Recording("ros1")
    for n in range(3):
        drive.add_scan(START_NS + n, [1.0] * 8)
    return bytearray(drive.write(folder).read_bytes())


def fault(folder: Path, data: bytes) -> str:
    (folder / "bad.bag").write_bytes(data)
    with pytest.raises(ValueError, match=".") as caught:
        bag = Rosbag1(folder / "bad.bag")
        try:
            list(bag.messages(bag.connections, 0))
        finally:
            bag.close()
    return str(caught.value)


FAULTS = [
    (b"op=\x05", b"op=\x04", "points to something that is no chunk"),
    (b"op=\x04", b"op=\x02", "the index of a chunk is damaged"),
    (b"count=\x03\0\0\0", b"count=\x02\0\0\0", "the index of a chunk is damaged"),
    (b"compression=none", b"compression=nope", "compressed by 'nope'"),
    (b"op=\x02", b"op=\x04", "does not fit its messages"),
    (b"conn=\0\0\0\0\x0d\0\0\0time", b"conn=\1\0\0\0\x0d\0\0\0time", "does not fit its messages"),
    (b"time=\0", b"time=\1", "does not fit its messages"),
]


@pytest.mark.parametrize(("old", "new", "why"), FAULTS)
def test_a_chunk_that_differs_from_its_index_is_refused(old, new, why, tmp_path):
    data = bytes(small_bag(tmp_path))
    assert old in data
    assert why in fault(tmp_path, data.replace(old, new, 1))


def test_times_out_of_the_range_of_their_chunk_are_refused(tmp_path):
    data = bytes(small_bag(tmp_path))
    at = data.rindex(b"end_time=") + 13
    data = data[:at] + b"\1\0\0\0" + data[at + 4 :]
    assert "messages of other times than its index says" in fault(tmp_path, data)


def test_an_encrypted_bag_is_refused_with_a_way_on(tmp_path):
    data = small_bag(tmp_path)
    at = data.index(b"chunk_count=") - 4
    data[at : at + 20] = field(b"encryptor", b"x" * 6)
    assert "encrypted: decrypt it with ROS 1 (rosbag decrypt)" in fault(tmp_path, bytes(data))


def test_a_size_beyond_memory_is_not_believed(tmp_path):
    data = bytes(small_bag(tmp_path))
    grown = data.replace(field(b"compression", b"none"), field(b"compression", b"bz2") + b"\0", 1)
    at = data.index(b"size=") + 5
    huge = data[:at] + struct.pack("<I", 2**32 - 1) + data[at + 4 :]
    assert "more than can be read" in fault(tmp_path, huge)
    assert fault(tmp_path, grown)


def test_a_thousand_chunks_are_kept_one_at_a_time(tmp_path):
    path = straight_drive("ros1", scans=1500).write(tmp_path, chunk=200)
    bag = Rosbag1(path)
    try:
        assert len(bag._chunks) > 1000
        seen, most = bag._messages_of, 0
        now = 0

        def counted(*arguments):
            nonlocal now, most
            now += 1
            most = max(most, now)
            yield from seen(*arguments)
            now -= 1

        bag._messages_of = counted
        assert sum(1 for _ in bag.messages(bag.connections, 0)) == 3002
        assert most <= 3
    finally:
        bag.close()
