from __future__ import annotations

import sqlite3

import numpy as np
import pytest

from conversion.ros.bags import Bag
from conversion.ros.definitions import Connection, Definitions, known_distros
from conversion.ros.recording import RosRecording
from tests.conversion.recordings import LASER, START_NS, TF, storage_of, straight_drive

RULE = "=" * 80
SCAN_IDL = """// generated from rosidl_adapter/resource/msg.idl.em
// with input from sensor_msgs/msg/LaserScan.msg

#include "std_msgs/msg/Header.idl"

module sensor_msgs {
  module msg {
    @verbatim (language="comment", text=
      "Single scan from a planar laser range-finder" "\\n"
      "If you have another ranging device ...")
    struct LaserScan {
      std_msgs::msg::Header header;

      @verbatim (language="comment", text= "start angle of the scan [rad]")
      @unit (value="rad")
      float angle_min;
      float angle_max;
      float angle_increment;
      float time_increment;
      float scan_time;
      float range_min;
      float range_max;
      sequence<float> ranges;
      sequence<float> intensities;
    };
  };
};
"""
HEADER_IDL = """#include "builtin_interfaces/msg/Time.idl"
module std_msgs { module msg {
  struct Header { builtin_interfaces::msg::Time stamp; string frame_id; };
}; };
"""
TIME_IDL = """module builtin_interfaces { module msg {
  struct Time { long sec; unsigned long nanosec; };
}; };
"""
IDL = (
    f"{RULE}\nIDL: {LASER}\n{SCAN_IDL}\n{RULE}\nIDL: std_msgs/msg/Header\n{HEADER_IDL}\n"
    f"{RULE}\nIDL: builtin_interfaces/msg/Time\n{TIME_IDL}"
)


def of(type_: str, *texts: str, idl: bool = False, ros1: bool = False) -> Definitions:
    found = [Connection(n, f"/{n}", type_, 1, text, idl) for n, text in enumerate(texts)]
    return Definitions(found, ros1=ros1)


def test_a_definition_in_idl_means_what_the_message_means():
    assert of(LASER, IDL, idl=True).is_standard(LASER)
    assert of(LASER, SCAN_IDL, idl=True).is_standard(LASER)  # what it includes is ROS's
    swapped = IDL.replace("angle_min;", "x;").replace("angle_max;", "angle_min;")
    assert not of(LASER, swapped, idl=True).is_standard(LASER)


@pytest.mark.parametrize("swapped", [False, True])
def test_a_bag_with_definitions_in_idl_is_read_by_them(swapped, tmp_path):
    folder = straight_drive("db3").write(tmp_path)
    text = IDL
    if swapped:
        text = text.replace("angle_min;", "x;").replace("angle_max;", "angle_min;")
        text = text.replace("float x;", "float angle_max;")
    with sqlite3.connect(storage_of(folder)) as database:
        database.execute(
            "UPDATE message_definitions SET encoding = 'ros2idl', encoded_message_definition = ? "
            "WHERE topic_type = ?",
            (text, LASER),
        )
    database.close()
    with RosRecording(Bag(folder)) as recording:
        assert recording.bag.is_standard(LASER) != swapped
        message = next(recording.messages(recording.scan_topics))
        scan = recording.scan(message)
    assert scan.angle_min == (0.75 if swapped else -1.0)
    assert scan.stamp_ns == START_NS + 50_000_000
    assert len(scan.ranges) == 8
    assert np.isfinite(scan.ranges).all()


def test_what_a_definition_leaves_out_is_the_release_s():
    text = "std_msgs/Header header\nmy/Part part\ngeometry_msgs/Pose[] poses"
    with pytest.raises(ValueError, match="the definition of my/msg/All lacks that of my/msg/Part"):
        of("my/msg/All", text).store_of("my/msg/All")
    whole = of("my/msg/All", f"{text}\n{RULE}\nMSG: my/Part\nfloat32 x")
    known = whole.store_of("my/msg/All").fielddefs
    assert {"std_msgs/msg/Header", "geometry_msgs/msg/Quaternion", "my/msg/Part"} <= known.keys()


def test_one_type_that_means_two_things_is_refused():
    same = of("my/msg/A", "float32 x", "float32 x  # metres")
    assert same.store_of("my/msg/A").fielddefs["my/msg/A"][1][0][0] == "x"
    with pytest.raises(ValueError, match="the bag defines my/msg/A in 2 ways"):
        of("my/msg/A", "float32 x", "float64 x").store_of("my/msg/A")


@pytest.mark.parametrize(
    "text",
    [
        "geometry_msgs/Point[100000000] points",
        "string[100000000] names",
        "B b\n" + RULE + "\nMSG: my/B\ngeometry_msgs/Point[9999999] points",
    ],
)
def test_an_array_that_would_take_forever_is_refused(text):
    with pytest.raises(ValueError, match="elements: more than can be read"):
        of("my/msg/A", text).store_of("my/msg/A")


def test_a_definition_of_a_megabyte_is_refused():
    with pytest.raises(ValueError, match="has 1048577 characters"):
        of("my/msg/A", " " * (2**20 - 8) + "float32 x").store_of("my/msg/A")


def test_large_arrays_of_numbers_are_read():
    store = of("my/msg/A", "float32[1000000] grid").store_of("my/msg/A")
    raw = b"\0\1\0\0" + bytes(4_000_000)
    assert store.deserialize_cdr(raw, "my/msg/A").grid.shape == (1_000_000,)


def test_a_type_that_contains_itself_is_no_standard_one():
    assert not of(TF, "tf2_msgs/TFMessage again").is_standard(TF)


def test_releases_are_those_of_the_ros_of_the_bag():
    assert known_distros(ros1=True) == ("noetic",)
    assert {"foxy", "humble", "jazzy"} <= set(known_distros(ros1=False))
    assert Definitions([], ros1=False, distro="Jazzy").distro == "jazzy"
    for ros1 in (True, False):
        assert Definitions([], ros1=ros1).is_standard(TF)
        assert Definitions([], ros1=ros1).is_standard(LASER)
