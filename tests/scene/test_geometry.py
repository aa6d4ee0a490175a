import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene import geometry
from semantic2d_dataset.scene.lidars import HOKUYO_UTM_30LX_EW, RPLIDAR_S2, WLR_716

numbers = st.floats(-50, 50)
poses = arrays(np.float64, (4, 3), elements=numbers)
points = arrays(np.float64, (4, 5, 2), elements=numbers)


@given(poses, points)
def test_a_pose_and_its_inverse_cancel(pose, point):
    there = geometry.transform(pose, point)
    np.testing.assert_allclose(geometry.transform(geometry.invert(pose), there), point, atol=1e-9)


@given(poses, poses, points)
def test_composed_poses_move_points_as_one_after_the_other(first, second, point):
    once = geometry.transform(geometry.compose(first, second), point)
    twice = geometry.transform(first, geometry.transform(second, point))
    np.testing.assert_allclose(once, twice, atol=1e-9)


@given(st.floats(-1e4, 1e4))
def test_wrapped_angles_point_the_same_way(angle):
    wrapped = geometry.wrap_angle(angle)
    assert -np.pi <= wrapped < np.pi
    assert np.cos(wrapped - angle) == pytest.approx(1.0)


def test_mount_is_applied_forward():
    base = geometry.to_base(np.array([1.0, 0.0]), HOKUYO_UTM_30LX_EW.base_T_lidar)
    np.testing.assert_allclose(base, [0.88, 0.0])


def test_upside_down_lidar_sees_its_left_on_the_right():
    base = geometry.to_base(np.array([0.0, 1.0]), WLR_716.base_T_lidar)
    np.testing.assert_allclose(base, [0.065, -1.0], atol=1e-6)


def test_lidar_mounted_backward_looks_behind():
    base = geometry.to_base(np.array([1.0, 0.0]), RPLIDAR_S2.base_T_lidar)
    np.testing.assert_allclose(base, [-0.935, 0.0], atol=1e-6)


def test_points_of_beams_without_range_are_nan():
    found = geometry.to_points(np.array([2.0, np.inf, np.nan]), np.array([np.pi / 2, 0.0, 0.0]))
    np.testing.assert_allclose(found[0], [0.0, 2.0], atol=1e-12)
    assert np.isnan(found[1:]).all()


def paper_incidence(ranges, step):
    """The paper's equations for d, beta and alpha, in double precision."""
    near = ranges.astype(np.float64)
    far = np.roll(near, -1)
    far[-1] = near[-2]  # the last beam uses the segment before it
    with np.errstate(all="ignore"):
        d = np.sqrt(near**2 + far**2 - 2 * near * far * np.cos(step))
        beta = np.arccos(np.clip((d**2 + near**2 - far**2) / (2 * d * near), -1, 1))
        return np.nan_to_num(np.abs(np.pi / 2 - beta))


@given(
    arrays(np.float32, 12, elements=st.floats(0.125, 60, width=32)),
    st.floats(1e-3, 0.05),
)
def test_incidence_follows_the_equations_of_the_paper(ranges, step):
    found = geometry.incidence_angles(ranges, step)
    np.testing.assert_allclose(found, paper_incidence(ranges, step), atol=2e-3)


def test_incidence_on_a_wall_is_the_angle_to_its_normal():
    bearings = HOKUYO_UTM_30LX_EW.bearings
    ahead = np.abs(bearings) < 1.2
    ranges = (2.0 / np.cos(bearings[ahead])).astype(np.float32)  # a wall 2 m ahead
    found = geometry.incidence_angles(ranges, HOKUYO_UTM_30LX_EW.angle_increment)
    np.testing.assert_allclose(found, np.abs(bearings[ahead]), atol=0.005)


def test_incidence_beside_a_missing_return_is_that_of_range_zero():
    ranges = np.array([np.inf, 2.0, np.nan, -np.inf, 3.0, 0.0], np.float32)
    found = geometry.incidence_angles(ranges, 0.01)
    np.testing.assert_allclose(found, [0, np.pi / 2, 0, 0, np.pi / 2, 0], atol=1e-6)


def test_incidence_needs_two_beams():
    with pytest.raises(InvalidInputError, match="B >= 2"):
        geometry.incidence_angles(np.ones((3, 1), np.float32), 0.01)


def test_interpolated_yaw_takes_the_shorter_arc():
    stamps = np.array([0, 1_000_000_000])
    ends = np.array([[0.0, 0.0, 3.0], [1.0, 2.0, -3.0]])
    found = geometry.interpolate_poses(stamps, ends, [500_000_000])
    np.testing.assert_allclose(found[0, :2], [0.5, 1.0])
    assert abs(found[0, 2]) == pytest.approx(np.pi)


def test_poses_outside_the_known_span_are_nan():
    found = geometry.interpolate_poses([10, 20], np.zeros((2, 3)), [9, 10, 20, 21])
    assert np.isnan(found[:, 0]).tolist() == [True, False, False, True]
    assert np.isnan(geometry.interpolate_poses([], np.zeros((0, 3)), [1])).all()


def test_pose_that_is_not_finite_is_refused():
    with pytest.raises(InvalidInputError):
        geometry.Pose2(0.0, float("nan"), 0.0)
