from __future__ import annotations

import math
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from conversion.messages.recordings import Message
from conversion.ros.bags import Bag
from conversion.ros.recording import RosRecording
from conversion.ros.wire import POSES_CDR, POSES_ROS1, transforms_cdr, transforms_ros1
from semantic2d_dataset.errors import RecordingError
from tests.conversion.recordings import AMCL, ODOMETRY, OLD_TF, POSE, TF, Recording

POSES = (AMCL, POSE, ODOMETRY)

floats = st.floats() | st.floats(-10, 10)
frames = st.text(max_size=9) | st.sampled_from(["/map", "base_link", ""])
turns = st.tuples(*[st.floats(-math.pi, math.pi)] * 3)
places = st.tuples(floats, floats, floats)
stamps = st.integers(0, 2**31 * 10**9 - 1)


@pytest.fixture(scope="module")
def opened(tmp_path_factory) -> Iterator[dict[str, tuple[Recording, RosRecording]]]:
    """A bag of each ROS with every type, and what writes messages for it."""
    found = {}
    for kind in ("ros1", "db3"):
        drive = Recording(kind)
        for type_ in POSES:
            drive.add_pose(1, (1.0, 2.0, 0.5), topic=f"/{type_[-4:]}", type_=type_)
        for type_ in (TF, OLD_TF)[: 2 if kind == "ros1" else 1]:
            drive.add_tf(1, "map", "base", (1.0, 2.0, 0.0), topic=f"/{type_[-4:]}", type_=type_)
        path = drive.write(tmp_path_factory.mktemp(kind))
        found[kind] = (drive, RosRecording(Bag(path)))
    yield found
    for _, recording in found.values():
        recording.__exit__(None, None, None)


def raw_of(drive: Recording) -> tuple[str, bytes]:
    """The type and the bytes of the last message that was added; it is taken back."""
    _, type_, _, message = drive.messages.pop()
    ros1 = drive.kind == "ros1"
    serialise = drive.store.serialize_ros1 if ros1 else drive.store.serialize_cdr
    return type_, bytes(serialise(message, type_))


def decoded(kind: str, type_: str, raw: bytes):
    if type_ in (TF, OLD_TF):
        return (transforms_ros1 if kind == "ros1" else transforms_cdr)(raw, static=False)
    return (POSES_ROS1 if kind == "ros1" else POSES_CDR)[type_](raw)


def parsed(recording: RosRecording, type_: str, raw: bytes):
    message = Message("/x", type_, 0, raw)
    parse = recording.parse_transforms if type_ in (TF, OLD_TF) else recording.parse_pose
    return parse(message)


def write_pose(drive, type_, stamp, frame, place, turn) -> tuple[str, bytes]:
    drive.add_pose(stamp, (0.0, 0.0, 0.0), topic="/x", type_=type_, frame=frame)
    message = drive.messages[-1][3]
    pose = message.pose if type_ == POSE else message.pose.pose
    for name, value in zip("xyz", place, strict=True):
        object.__setattr__(pose.position, name, value)
    object.__setattr__(pose, "orientation", drive.turn(*turn))
    return raw_of(drive)


def write_tf(drive, type_, edges) -> tuple[str, bytes]:
    items = []
    for stamp, parent, child, place, turn in edges:
        drive.add_tf(stamp, parent, child, place, turn, type_=TF)
        items += drive.messages.pop()[3].transforms
    drive.add("/x", drive.new(type_, transforms=items), 0)
    return raw_of(drive)


@pytest.mark.parametrize("kind", ["ros1", "db3"])
@pytest.mark.parametrize("type_", POSES)
@given(stamp=stamps, frame=frames, place=places, turn=turns)
def test_a_pose_is_decoded_as_rosbags_deserialises_it(
    opened, kind, type_, stamp, frame, place, turn
):
    drive, recording = opened[kind]
    _, raw = write_pose(drive, type_, stamp, frame, place, turn)
    found = decoded(kind, type_, raw)
    assert found is not None
    assert found == parsed(recording, type_, raw)
    assert found == recording.pose(Message("/x", type_, 0, raw))


edges = st.tuples(stamps, frames, frames, places, turns)


@pytest.mark.parametrize(("kind", "type_"), [("ros1", TF), ("ros1", OLD_TF), ("db3", TF)])
@given(edges=st.lists(edges, max_size=4))
def test_transforms_are_decoded_as_rosbags_deserialises_them(opened, kind, type_, edges):
    drive, recording = opened[kind]
    _, raw = write_tf(drive, type_, edges)
    found = decoded(kind, type_, raw)
    assert found is not None
    assert found == parsed(recording, type_, raw)
    assert found == recording.transforms(Message("/x", type_, 0, raw))
    finite = [edge for edge in edges if math.hypot(*edge[3]) < 1e8]
    assert len(found) == len(finite)


EDGE = (5, "a" * 5, "b" * 6, (1.0, 2.0, 3.0), (0.1, 0.2, 0.3))


@pytest.mark.parametrize(
    ("kind", "type_"), [(kind, type_) for kind in ("ros1", "db3") for type_ in (*POSES, TF)]
)
@given(data=st.data())
def test_of_damaged_bytes_nothing_is_decoded_that_rosbags_reads_otherwise(
    opened, kind, type_, data
):
    drive, recording = opened[kind]
    if type_ == TF:
        raw = bytearray(write_tf(drive, TF, [EDGE, EDGE])[1])
    else:
        raw = bytearray(write_pose(drive, type_, *EDGE[:2], *EDGE[3:])[1])
    for at in data.draw(st.lists(st.integers(0, min(60, len(raw) - 1)), max_size=3)):
        raw[at] = data.draw(st.integers(0, 255))
    damaged = bytes(raw[: data.draw(st.sampled_from((None, -1, -8)))])
    found = decoded(kind, type_, damaged)
    try:
        expected = parsed(recording, type_, damaged)
    except RecordingError:
        assert found is None
    else:
        assert found is None or found == expected


@pytest.mark.parametrize("kind", ["ros1", "db3"])
@pytest.mark.parametrize("type_", [*POSES, TF])
def test_bytes_of_another_length_are_not_decoded(opened, kind, type_):
    drive, _ = opened[kind]
    if type_ == TF:
        raw = write_tf(drive, TF, [EDGE, EDGE])[1]
    else:
        raw = write_pose(drive, type_, *EDGE[:2], *EDGE[3:])[1]
    assert decoded(kind, type_, raw) is not None
    assert decoded(kind, type_, raw + b"\0") is None
    for length in range(len(raw)):
        assert decoded(kind, type_, raw[:length]) is None


@pytest.mark.parametrize("type_", [*POSES, TF])
def test_big_endian_cdr_is_left_to_rosbags(opened, type_):
    drive, recording = opened["db3"]
    if type_ == TF:
        drive.add_tf(7, "map", "base", (1.0, 2.0, 0.0))
    else:
        drive.add_pose(7, (1.0, 2.0, 0.0), topic="/x", type_=type_)
    message = drive.messages.pop()[3]
    raw = bytes(drive.store.serialize_cdr(message, type_, little_endian=False))
    assert decoded("db3", type_, raw) is None
    read = recording.transforms if type_ == TF else recording.pose
    found = read(Message("/x", type_, 0, raw))
    sample = found[0] if type_ == TF else found
    assert sample.stamp_ns == 7
    assert sample.values[:2] == (1.0, 2.0)


def test_a_count_of_transforms_that_cannot_be_is_not_believed():
    assert transforms_ros1(b"\xff" * 100, static=False) is None
    assert transforms_cdr(b"\0\1\0\0" + b"\xff" * 100, static=False) is None
    assert transforms_ros1(b"", static=False) is None
    assert transforms_cdr(b"\0\1\0\0", static=False) is None
