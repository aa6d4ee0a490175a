from __future__ import annotations

import struct

import numpy as np
import pytest

from conversion.messages.scans import LASER_SCAN, Beams, decode_cdr, decode_ros1
from conversion.ros.bags import Bag
from conversion.ros.recording import RosRecording
from tests.conversion.recordings import KINDS, LASER, START_NS, Recording

NAN_BITS = np.array([0x7F800001, 0x7FC12345, 0xFFC00000, 0x00000001], np.uint32).view(np.float32)


def odd_scans(kind: str) -> Recording:
    """Scans whose frame, length and values try every alignment and every kind of float."""
    drive = Recording(kind)
    random = np.random.default_rng(1)
    for n in range(40):
        ranges = random.integers(0, 2**32, n, np.uint32).view(np.float32)
        intensities = random.integers(0, 2**32, n * (n % 2), np.uint32).view(np.float32)
        frame = "/laser_frame"[: n % 12] + "é" * (n % 2)
        drive.add_scan(START_NS + n, ranges, intensities=intensities, frame=frame, topic="/a")
    drive.add_scan(START_NS + 99, [*NAN_BITS, np.inf, -np.inf, 0.0, -0.0], topic="/b")
    return drive


def same(a, b) -> bool:
    bits = all(
        x.astype("<f4").tobytes() == y.astype("<f4").tobytes()
        for x, y in zip(a[6:], b[6:], strict=True)
    )
    return bits and a[:6] == b[:6]


@pytest.mark.parametrize("kind", KINDS)
def test_every_message_decodes_as_rosbags_deserialises_it(kind, tmp_path):
    fast = decode_ros1 if kind == "ros1" else decode_cdr
    with RosRecording(Bag(odd_scans(kind).write(tmp_path))) as recording:
        assert recording.bag.is_standard(LASER_SCAN)
        messages = list(recording.messages(recording.scan_topics))
        assert len(messages) == 41
        for message in messages:
            found = fast(message.raw)
            assert found is not None
            assert same(found, recording.parse_scan(message))
            assert same(found, recording.scan(message))


@pytest.mark.parametrize(("kind", "fast"), [("ros1", decode_ros1), ("db3", decode_cdr)])
def test_bytes_of_another_layout_are_not_decoded(kind, fast):
    drive = Recording(kind)
    drive.add_scan(START_NS, [1.0] * 8)
    serialise = drive.store.serialize_ros1 if kind == "ros1" else drive.store.serialize_cdr
    raw = bytes(serialise(drive.messages[0][3], LASER))
    assert fast(raw) is not None
    assert fast(raw + b"\0") is None
    for length in range(len(raw)):
        assert fast(raw[:length]) is None


def test_big_endian_cdr_is_left_to_rosbags(tmp_path):
    drive = Recording("db3")
    drive.add_scan(START_NS, [1.5] * 8, intensities=range(8))
    big = bytes(drive.store.serialize_cdr(drive.messages[0][3], LASER, little_endian=False))
    assert decode_cdr(big) is None
    drive.store.serialize_cdr = lambda *_: big
    with RosRecording(Bag(drive.write(tmp_path))) as recording:
        (message,) = recording.messages(recording.topics)
        scan = recording.scan(message)
    assert scan.ranges.tolist() == [1.5] * 8
    assert scan.stamp_ns == START_NS


def test_a_scan_of_ros1_after_2038_keeps_its_stamp(tmp_path):
    drive = Recording("ros1")
    drive.add_scan(START_NS, [1.5] * 8)
    late = 3_000_000_000
    whole = bytearray(drive.store.serialize_ros1(drive.messages[0][3], LASER))
    whole[4:8] = late.to_bytes(4, "little")
    drive.store.serialize_ros1 = lambda *_: bytes(whole)
    with RosRecording(Bag(drive.write(tmp_path))) as recording:
        (message,) = recording.messages(recording.topics)
        assert recording.scan(message).stamp_ns == late * 10**9
        assert recording.parse_scan(message).stamp_ns == late * 10**9


def test_a_bag_with_its_own_laser_scan_is_read_by_its_own_definition(tmp_path):
    drive = Recording("ros1")
    drive.add_scan(START_NS, [1.5] * 8)
    path = drive.write(tmp_path)
    data = path.read_bytes()
    assert b"float32 angle_min\nfloat32 angle_max\n" in data
    swapped = data.replace(
        b"float32 angle_min\nfloat32 angle_max\n", b"float32 angle_max\nfloat32 angle_min\n"
    )
    path.write_bytes(swapped)
    with RosRecording(Bag(path)) as recording:
        assert not recording.bag.is_standard(LASER_SCAN)
        (message,) = recording.messages(recording.topics)
        assert recording.scan(message).angle_min == 0.75


def scan_with(**values):
    drive = Recording("ros1")
    drive.add_scan(START_NS, [1.0] * 8, **values)
    return decode_ros1(bytes(drive.store.serialize_ros1(drive.messages[0][3], LASER)))


def test_clockwise_beams_are_described_counter_clockwise():
    beams = Beams.of(scan_with(angle_min=1.0, increment=-0.25))
    assert (beams.angle_min, beams.angle_increment, beams.reversed) == (-0.75, 0.25, True)


def test_a_change_of_beams_is_told():
    beams = Beams.of(scan_with())
    assert beams.difference(scan_with()) is None
    assert beams.difference(scan_with(limits=(0.2, 10.0))) is None
    assert beams.difference(scan_with(angle_min=-1.001)) is None
    assert "angles -0.900000" in beams.difference(scan_with(angle_min=-0.9))
    assert "angles" in beams.difference(scan_with(angle_min=0.75, increment=-0.25))
    assert "frame 'other' after 'laser'" in beams.difference(scan_with(frame="other"))


def test_leading_slashes_of_frames_are_dropped():
    assert scan_with(frame="/laser").frame == "laser"


def test_a_frame_longer_than_the_message_is_not_decoded():
    assert decode_ros1(struct.pack("<4I", 0, 1, 2, 2**32 - 1) + bytes(100)) is None
    assert decode_cdr(b"\0\1\0\0" + struct.pack("<iII", 1, 2, 2**32 - 1) + bytes(100)) is None
