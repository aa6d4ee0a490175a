from __future__ import annotations

import struct
from pathlib import Path

import lz4.frame
import numpy as np
import pytest

from conversion.ros.bags import Bag
from conversion.ros.compression import zstd
from semantic2d_dataset.errors import RecordingError
from tests.conversion.recordings import (
    START_NS,
    Recording,
    add_checksums,
    storage_of,
    straight_drive,
)

MAGIC = b"\x89MCAP0\r\n"
PACK = {"": bytes, "lz4": lz4.frame.compress, "zstd": zstd.compress}


def record(op: int, data: bytes) -> bytes:
    return bytes([op]) + struct.pack("<Q", len(data)) + data


def rewrite(mcap: Path, codec: str | None) -> None:
    """Write an MCAP anew without a summary: its chunks compressed, or its messages bare."""
    data, at, out = mcap.read_bytes(), 8, MAGIC
    while data[at] != 0x02:
        op, size = data[at], int.from_bytes(data[at + 1 : at + 9], "little")
        body = data[at + 9 : at + 9 + size]
        if op == 0x06:
            inner = body[40:]  # times, size, checksum, no codec, length
            packed = PACK[codec](inner) if codec is not None else b""
            head = body[:28] + struct.pack("<I", len(codec or "")) + (codec or "").encode()
            chunk = record(op, head + struct.pack("<Q", len(packed)) + packed)
            out += inner if codec is None else chunk
        elif op in (0x01, 0x0F):
            out += record(op, body)
        if op == 0x0F:
            break
        at += 9 + size
    mcap.write_bytes(out + record(0x02, bytes(20)) + MAGIC)


@pytest.mark.parametrize("codec", [None, "", "lz4", "zstd"])
def test_an_mcap_without_index_is_read(codec, tmp_path):
    file = storage_of(straight_drive("mcap", scans=100).write(tmp_path))
    with Bag(file) as bag:
        expected = list(bag.messages(bag.topics))
    rewrite(file, codec)
    with Bag(file) as bag:
        # as recorded, where several have one time
        found = list(bag.messages(bag.topics))
        assert sorted(found) == sorted(expected)
        assert [topic.messages for topic in bag.topics] == [100, 100, 2]
        later = [m for m in found if m.record_ns >= START_NS + 10**9]
        assert list(bag.messages(bag.topics, START_NS + 10**9)) == later
        both = zip(bag.messages(bag.topics), bag.messages(bag.topics), strict=True)
        assert all(one == other for one, other in both)
        assert list(bag.messages(bag.topics)) == found


@pytest.mark.parametrize("run", [200, 1 << 22])
def test_bare_messages_out_of_order_are_read_by_time(run, tmp_path, monkeypatch):
    monkeypatch.setattr("conversion.ros.bag_mcap._RUN", run)
    times = np.random.default_rng(2).permutation(60)
    drive = Recording("mcap")
    for n in times.tolist():
        drive.add_scan(START_NS, [1.0 * n] * 8, record_ns=START_NS + n)
    file = storage_of(drive.write(tmp_path))
    rewrite(file, None)
    with Bag(file) as bag:
        found = [message.record_ns - START_NS for message in bag.messages(bag.topics)]
        late = [message.record_ns - START_NS for message in bag.messages(bag.topics, START_NS + 31)]
    assert found == list(range(60))
    assert late == list(range(31, 60))


def test_an_mcap_of_no_profile_is_read(tmp_path):
    file = storage_of(straight_drive("mcap").write(tmp_path))
    data = file.read_bytes()
    at = data.index(b"ros2")
    length = int.from_bytes(data[9:17], "little")
    assert at == 21
    shorter = data[:9] + struct.pack("<Q", length - 4) + bytes(4) + data[25:]
    file.write_bytes(shorter)
    rewrite(file, "zstd")
    with Bag(file) as bag:
        assert len(list(bag.messages(bag.topics))) == 26


def test_an_mcap_of_another_profile_is_refused(tmp_path):
    file = storage_of(straight_drive("mcap").write(tmp_path))
    file.write_bytes(file.read_bytes().replace(b"ros2", b"json", 1))
    with pytest.raises(
        RecordingError, match="its profile is 'json': expected an MCAP of ROS 2; 26 messages"
    ):
        Bag(file)


def test_a_chunk_that_does_not_fit_its_checksum_is_refused(tmp_path):
    file = storage_of(straight_drive("mcap").write(tmp_path))
    add_checksums(file)
    data = bytearray(file.read_bytes())
    data[data.index(b"laser") + 40] ^= 1  # in a message
    file.write_bytes(data)
    with (
        pytest.raises(RecordingError, match="a chunk does not fit its checksum"),
        Bag(file) as bag,
    ):
        list(bag.messages(bag.topics))


@pytest.mark.parametrize("codec", ["lz4", "zstd"])
def test_a_chunk_that_grows_beyond_what_it_announced_is_refused(codec, tmp_path):
    file = storage_of(straight_drive("mcap").write(tmp_path))
    data = bytearray(file.read_bytes())
    at = 8
    while data[at] != 0x06:
        at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
    size = int.from_bytes(data[at + 25 : at + 33], "little")
    data[at + 25 : at + 33] = struct.pack("<Q", size - 1)
    file.write_bytes(data)
    rewrite(file, codec)
    with pytest.raises(RecordingError, match=f"has not the {size - 1} bytes"):
        Bag(file)


def test_channels_of_another_encoding_disturb_nothing(tmp_path):
    file = storage_of(straight_drive("mcap").write(tmp_path))
    data = file.read_bytes()
    assert data.count(b"ros2msg") == 4  # both schemas, in the chunk and in the summary
    at = data.rindex(b"ros2msg")
    file.write_bytes(data[:at] + b"jsonsch" + data[at + 7 :])
    with Bag(file) as bag:
        assert len(list(bag.messages(bag.topics))) == 26


def test_what_is_no_ending_of_an_mcap_is_refused(tmp_path):
    file = storage_of(straight_drive("mcap").write(tmp_path))
    file.write_bytes(file.read_bytes() + b"\0")
    with pytest.raises(RecordingError, match=r"its end is missing.*26 messages can be read"):
        Bag(file)
