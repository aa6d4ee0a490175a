"""Transforms over time, and the sources of poses that they make."""

import pytest

from conversion.inspection.pose_sources import TransformTimes
from conversion.messages.recordings import TransformSample
from tests.conversion.inspection.test_inspection import TENTH, inspect
from tests.conversion.recordings import START_NS, Recording

STILL = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def times(*pairs, static=()):
    found = TransformTimes()
    for n, (parent, child) in enumerate(pairs):
        found.add(TransformSample(n, parent, child, STILL, (parent, child) in static), n * TENTH)
    return found


def test_ancestors_begin_with_the_root():
    found = times(("map", "odom"), ("odom", "base"), ("base", "laser"))
    assert found.ancestors("laser") == ("map", "odom", "base")
    assert found.ancestors("map") == ()


def test_frames_in_a_circle_end():
    found = times(("a", "b"), ("b", "a"))
    assert set(found.ancestors("a")) == {"a", "b"}
    assert len(found.reports()) == 2


def test_the_moving_transforms_of_a_chain_begin_with_the_sparsest():
    pairs = [("map", "odom"), ("odom", "base")] * 5 + [("odom", "base"), ("base", "laser")]
    found = times(*pairs, static={("base", "laser")})
    assert [len(line) for line in found.moving(("map", "odom", "base", "laser"))] == [5, 6]
    assert [len(line) for line in found.moving(("laser", "base", "odom"))] == [6]
    assert found.moving(("base", "laser")) == []


def test_a_chain_has_the_longest_gap_of_its_transforms(tmp_path):
    drive = drive_with(("map", "odom"), scans=60)
    for n in [*range(20), *range(40, 60)]:
        for half in (0, TENTH // 2):
            drive.add_tf(START_NS + n * TENTH + half, "odom", "base_link", (0.1 * n, 0.0, 0.0))
    (pose, _) = inspect(drive.write(tmp_path)).poses
    assert pose.longest_gap_s == pytest.approx(2.05)
    assert 0.6 < pose.covers < 0.7


def test_thousands_of_frames_are_not_all_timed():
    found = times(*(("map", f"marker_{n}") for n in range(3000)))
    assert len(found.reports()) == 400


def drive_with(*transforms, frame="laser", scans=20):
    """Scans at 10 Hz, and moving transforms with each."""
    drive = Recording("ros1")
    for n in range(scans):
        ns = START_NS + n * TENTH
        for parent, child in transforms:
            drive.add_tf(ns, parent, child, (0.1 * n, 0.0, 0.0))
        drive.add_scan(ns, [1.0, 2.0, 3.0], frame=frame)
    return drive


def test_every_frame_above_the_robot_makes_a_source(tmp_path):
    drive = drive_with(("earth", "map"), ("map", "odom"), ("odom", "base_link"))
    found = inspect(drive.write(tmp_path))
    assert {pose.name: pose.option for pose in found.poses} == {
        "tf map -> odom -> base_link": "--poses tf",
        "tf earth -> map -> odom -> base_link": "--poses tf --map-frame earth",
        "tf odom -> base_link": "--poses tf --map-frame odom",
    }
    assert [pose.automatic for pose in found.poses] == [True, False, False]


def test_without_a_base_the_lidar_is_followed(tmp_path):
    found = inspect(drive_with(("map", "laser")).write(tmp_path))
    assert [pose.name for pose in found.poses] == ["tf map -> laser"]
    assert found.poses[0].covers == 1


def test_a_frame_fixed_to_the_robot_is_no_source(tmp_path):
    drive = drive_with(("map", "base_footprint"))
    for n in range(20):
        drive.add_tf(START_NS + n * TENTH, "base_footprint", "base_link", (0.0, 0.0, 0.1))
    found = inspect(drive.write(tmp_path))
    assert [pose.name for pose in found.poses] == ["tf map -> base_footprint -> base_link"]


def test_a_chain_that_leaves_the_plane_is_no_automatic_source(tmp_path):
    drive = drive_with(("odom", "base_link"))
    for n in range(20):
        drive.add_tf(START_NS + n * TENTH, "map", "odom", (0.0, 0.0, 0.0), (1.2, 0.0, 0.0))
    found = inspect(drive.write(tmp_path))
    tilted = next(pose for pose in found.poses if pose.frame == "map")
    assert tilted.notes == ("leaves the plane",)
    assert not tilted.automatic


def test_messages_without_a_pose_are_noted(tmp_path):
    drive = drive_with()
    for n in range(20):
        x = float("nan") if n % 4 == 0 else 0.1 * n
        drive.add_pose(START_NS + n * TENTH, (x, 0.0, 0.0), topic="/amcl_pose")
    (pose,) = inspect(drive.write(tmp_path)).poses
    assert pose.samples == 15
    assert pose.notes == ("5 messages hold no pose",)
