import math

import numpy as np
import pytest

from conversion.carmen.kinds import LaserKind
from conversion.carmen.lines import split_line


def line(ranges, laser=(0, 0, 0), robot=(0, 0, 0)):
    words = ["FLASER", len(ranges), *ranges, *laser, *robot, 1.0, "host", 1.0]
    return split_line(None, 1, " ".join(map(str, words)).encode() + b"\n")


def kind_of(lines):
    lines = list(lines)
    kind = LaserKind(lines[0], {})
    for each in lines:
        kind.add(each, {})
    return kind


def scans(far, share, count=60, beams=180, longest=20.0):
    """Scans with random ranges, rounded to centimetres, of which some are `far`."""
    rng = np.random.default_rng(3)
    for _ in range(count):
        ranges = np.round(rng.uniform(0.5, longest, beams), 2)
        ranges[rng.random(beams) < share] = far
        yield line(ranges.tolist())


@pytest.mark.parametrize("far", [81.83, 81.91, 50.0, 32.77, 29.99])
def test_a_range_that_recurs_beyond_all_others_is_no_return(far):
    found = kind_of(scans(far, 0.03)).no_return
    assert [each.value_m for each in found] == [far]
    assert found[0].share == pytest.approx(0.03, abs=0.01)


def test_a_code_of_the_sick_is_no_return_however_rare():
    kind = kind_of(scans(81.87, 0.001))
    assert [each.value_m for each in kind.no_return] == [81.87]
    assert "81.87 m" in next(kind.notices(corrected=True))


@pytest.mark.parametrize("far", [32.77, 50.0])
def test_a_usual_cut_off_is_no_return_however_plain_the_rest(far):
    found = kind_of(line([2.0, 3.0, far]) for _ in range(5)).no_return
    assert [each.value_m for each in found] == [far]


def test_the_largest_of_a_few_plain_ranges_is_a_measurement():
    assert kind_of(line([1.25, 2.5, 3.75]) for _ in range(50)).no_return == ()
    assert kind_of(line([4.0] * 180) for _ in range(50)).no_return == ()


def test_ranges_that_spread_are_never_taken_for_no_return():
    assert kind_of(scans(1.0, 0.0)).no_return == ()
    beyond_sick = kind_of(scans(100.0, 0.0, longest=120.0))
    assert beyond_sick.no_return == ()


def test_a_range_that_recurs_among_others_is_a_measurement():
    assert kind_of(scans(5.0, 0.05)).no_return == ()


def test_one_far_corner_seen_by_a_robot_at_rest_is_a_measurement():
    ranges = np.linspace(1.0, 9.0, 180).tolist()
    assert kind_of(line(ranges) for _ in range(100)).no_return == ()


def test_an_offset_that_never_changes_is_the_mount():
    def moved(x, y, yaw):
        c, s = math.cos(yaw), math.sin(yaw)
        laser = (x + 0.3 * c - 0.1 * s, y + 0.3 * s + 0.1 * c, yaw + math.pi)
        return line([1.0, 2.0], laser, (x, y, yaw))

    kind = kind_of(moved(x, 2 * x, 0.7 * x) for x in range(30))
    assert kind.is_rigid
    assert kind.mount[:2] == pytest.approx((0.3, 0.1))
    assert abs(kind.mount[2]) == pytest.approx(math.pi)


def test_an_offset_that_changes_is_no_mount():
    kind = kind_of(line([1.0, 2.0], (x, 0, 0), (1.1 * x, 0, 0)) for x in range(10))
    assert not kind.is_rigid
    assert kind.mount == (0, 0, 0)


def test_poses_that_are_not_finite_are_left_out():
    kind = kind_of([line([1.0, 2.0], (math.nan, 0, 0)), line([1.0, 2.0])])
    assert (kind.lines, kind.poses) == (2, 1)


def test_poses_without_a_sign_of_slam_are_questioned():
    kind = kind_of(scans(81.83, 0.0))
    assert "plain odometry" in " ".join(kind.notices(corrected=False))
    assert "plain odometry" not in " ".join(kind.notices(corrected=True))


def test_assumed_angles_are_told():
    told = " ".join(kind_of([line([1.0] * 100)]).notices(corrected=True))
    assert "100 beams and no angles" in told
    assert "--lidar" in told
