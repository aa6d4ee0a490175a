from __future__ import annotations

import pytest

from conversion.ros.bags import Bag
from conversion.ros.recording import RosRecording
from semantic2d_dataset.errors import RecordingError
from tests.conversion.recordings import (
    AMCL,
    KINDS,
    ODOMETRY,
    POSE,
    START_NS,
    STRING,
    Recording,
    straight_drive,
)

TWIST = "geometry_msgs/msg/Twist"


def vector(drive: Recording, x: float, z: float = 0.0):
    return drive.new("geometry_msgs/msg/Vector3", x=x, y=0.0, z=z)


@pytest.mark.parametrize("kind", KINDS)
def test_topics_are_sorted_by_what_they_hold(kind, tmp_path):
    drive = straight_drive(kind, scans=1)
    for topic, type_ in (("/amcl_pose", AMCL), ("/pose", POSE), ("/odom", ODOMETRY)):
        drive.add_pose(START_NS, (0.0, 0.0, 0.0), topic=topic, type_=type_)
    drive.add_scan(START_NS, [1.0] * 8, topic="/rear")
    drive.add("/talk", drive.new(STRING, data="hello"), START_NS)
    twist = drive.new(TWIST, linear=vector(drive, 1.0), angular=vector(drive, 0.0, -0.5))
    drive.add("/cmd_vel", twist, START_NS)
    with RosRecording(Bag(drive.write(tmp_path))) as recording:
        names = [
            [topic.name for topic in topics]
            for topics in (
                recording.scan_topics, recording.pose_topics, recording.transform_topics,
                recording.velocity_topics,
            )
        ]  # fmt: skip
        (message,) = recording.messages(recording.velocity_topics)
        assert recording.velocity(message) == (1.0, -0.5)
    assert names == [
        ["/rear", "/scan"], ["/amcl_pose", "/odom", "/pose"], ["/tf", "/tf_static"], ["/cmd_vel"],
    ]  # fmt: skip
    assert recording.kind == ("ROS 1 bag" if kind == "ros1" else "ROS 2 bag")
    assert set(recording.versions) == {"rosbags"}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("type_", [AMCL, POSE, ODOMETRY])
def test_a_pose_has_stamp_frame_and_values(kind, type_, tmp_path):
    drive = Recording(kind)
    drive.add_pose(START_NS + 5, (1.0, 2.0, 0.0), topic="/p", type_=type_, frame="/map")
    with RosRecording(Bag(drive.write(tmp_path))) as recording:
        (message,) = recording.messages(recording.pose_topics)
        found = (START_NS + 5, "map", (1.0, 2.0, 0.0, 0.0, 0.0, 0.0, 1.0))
        assert recording.pose(message) == recording.parse_pose(message) == found


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("topic", ["/tf", "/tf_static", "/robot/tf_static"])
def test_a_transform_is_static_by_its_topic(kind, topic, tmp_path):
    drive = Recording(kind)
    drive.add_tf(START_NS + 5, "/base_link", "/laser", (1.0, 2.0, 3.0), topic=topic)
    static = topic.endswith("static")
    values = (1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0)
    with RosRecording(Bag(drive.write(tmp_path))) as recording:
        (message,) = recording.messages(recording.transform_topics)
        found = [(START_NS + 5, "base_link", "laser", values, static)]
        assert recording.transforms(message) == recording.parse_transforms(message) == found


@pytest.mark.parametrize("kind", KINDS)
def test_a_type_that_the_bag_defines_otherwise_is_read_by_that(kind, tmp_path):
    drive = Recording(kind)
    drive.add_tf(START_NS, "map", "base", (1.0, 2.0, 3.0))
    path = drive.write(tmp_path)
    for file in (path,) if kind == "ros1" else tuple(path.iterdir()):
        data = file.read_bytes()
        file.write_bytes(data.replace(b"Vector3 translation", b"Vector3 translatiom"))
    with RosRecording(Bag(path)) as recording:
        (message,) = recording.messages(recording.transform_topics)
        assert not recording.bag.is_standard(message.type)
        with pytest.raises(RecordingError, match="no readable tf2_msgs/msg/TFMessage"):
            recording.transforms(message)


def test_a_recording_without_scans_opens(tmp_path):
    drive = Recording("mcap")
    drive.add("/talk", drive.new(STRING, data="hello"), START_NS)
    with RosRecording(Bag(drive.write(tmp_path))) as recording:
        assert recording.scan_topics == recording.pose_topics == ()
        assert [topic.name for topic in recording.topics] == ["/talk"]
