from dataclasses import replace

import numpy as np
import pytest

from salsa.alignment import Acceptance, align, check_inside, measure
from salsa.fields import map_field
from semantic2d_dataset.errors import AlignmentError, InvalidInputError
from semantic2d_dataset.scene.geometry import Pose2, compose
from semantic2d_dataset.scene.maps import FREE, OCCUPIED, SemanticMap
from semantic2d_dataset.scene.scans import ScanBatch
from tests.salsa import rooms

PERSON = (5.1, 2.4, 5.4, 2.7)


@pytest.mark.parametrize("lidar", [rooms.LIDAR, rooms.UPSIDE_DOWN, rooms.BACKWARD])
def test_amcl_errors_shrink_below_2_cm_whatever_the_mount(lidar):
    truth = rooms.true_poses(60)
    batch = rooms.batch_at(truth, rooms.rough_poses(truth), lidar, extra=[PERSON])
    found = align(batch, rooms.room_map())
    metres, degrees = rooms.errors(found.poses, truth)
    assert np.median(metres) < 0.02
    assert np.median(degrees) < 0.3
    assert metres.max() < 0.05
    assert found.accepted.all()


def test_starts_half_a_metre_and_ten_degrees_off_are_found_by_search():
    truth = rooms.true_poses(60)
    angles = np.random.default_rng(3).uniform(-np.pi, np.pi, 60)
    offsets = np.stack((0.5 * np.cos(angles), 0.5 * np.sin(angles), 0.17 * np.sign(angles)), -1)
    found = align(rooms.batch_at(truth, compose(truth, offsets)), rooms.room_map())
    metres, _ = rooms.errors(found.poses, truth)
    assert found.accepted.mean() >= 0.95
    assert metres[found.accepted].max() < 0.2


def test_a_drift_of_two_metres_is_followed_from_scan_to_scan():
    truth = rooms.true_poses(80)
    drift = np.linspace(0, 1, 80)[:, None] * np.array((1.6, -1.2, 0.6))
    batch = rooms.batch_at(truth, truth + drift)
    found = align(batch, rooms.room_map(), acceptance=Acceptance(max_correction_m=2.1))
    metres, _ = rooms.errors(found.poses, truth)
    assert found.accepted.all()
    assert metres.max() < 0.05


def test_a_block_goes_on_where_the_last_one_ended():
    truth = rooms.true_poses(11)
    rough = compose((1.5, -4.0, 0.9), truth)  # a drift as of long ago: the search does not span it
    batch = rooms.batch_at(truth[1:], rough[1:])
    far = Acceptance(max_correction_m=9.0)
    alone = align(batch, rooms.room_map(), acceptance=far)
    helped = align(batch, rooms.room_map(), acceptance=far, before=np.stack((truth[0], rough[0])))
    refused = align(batch, rooms.room_map(), before=np.stack((truth[0], rough[0])))
    assert rooms.errors(alone.poses, truth[1:])[0].min() > 0.2
    assert not alone.accepted.any()
    assert rooms.errors(helped.poses, truth[1:])[0].max() < 0.05
    assert helped.accepted.all()
    np.testing.assert_array_equal(refused.poses, helped.poses)
    assert not refused.accepted.any()  # too far from where it was said to be


def test_lines_alone_recover_the_pose_too():
    truth = rooms.true_poses(20)
    batch = rooms.batch_at(truth, rooms.rough_poses(truth))
    found = align(batch, rooms.room_map(), points="lines")
    assert np.median(rooms.errors(found.poses, truth)[0]) < 0.02


def test_moving_the_map_frame_moves_the_poses_alike():
    truth = rooms.true_poses(10)
    rough = rooms.rough_poses(truth)
    origin = np.array((-3.0, 7.0, 0.8))
    here = align(rooms.batch_at(truth, rough), rooms.room_map())
    there = align(
        rooms.batch_at(truth, compose(origin, rough)), rooms.room_map(Pose2(*origin.tolist()))
    )
    metres, degrees = rooms.errors(there.poses, compose(origin, here.poses))
    assert metres.max() < 1e-6
    assert degrees.max() < 1e-6
    np.testing.assert_allclose(there.inlier_ratio, here.inlier_ratio, atol=1e-6)
    trace = np.trace(here.covariance[:, :2, :2], axis1=1, axis2=2)
    np.testing.assert_allclose(np.trace(there.covariance[:, :2, :2], axis1=1, axis2=2), trace)


def test_a_scan_without_pose_keeps_none_and_is_not_accepted():
    truth = rooms.true_poses(6)
    rough = rooms.rough_poses(truth)
    rough[[0, 3]] = np.nan
    found = align(rooms.batch_at(truth, rough), rooms.room_map())
    assert np.isnan(found.poses[[0, 3]]).all()
    assert np.isnan(found.covariance[[0, 3]]).all()
    assert found.accepted.tolist() == [False, True, True, False, True, True]


def test_a_scan_of_another_place_or_without_returns_is_not_accepted():
    truth = rooms.true_poses(3)
    batch = rooms.batch_at(truth, truth)
    batch.ranges[0] = np.random.default_rng(0).uniform(0.3, 3.0, rooms.LIDAR.beams)
    batch.ranges[2] = np.inf
    found = align(batch, rooms.room_map())
    assert found.accepted.tolist() == [False, True, False]
    assert found.inlier_ratio[2] == 0


def test_a_corridor_is_uncertain_along_its_axis_and_not_across():
    occupancy = np.full((60, 800), FREE, np.uint8)
    occupancy[[10, 50]] = OCCUPIED
    scene = SemanticMap(occupancy, np.full_like(occupancy, 255), 0.05, Pose2(0, 0, 0))
    lidar = replace(rooms.LIDAR, range_max=6.0)
    pose = np.array((20.0, 1.4, 0.1))
    ranges = rooms.cast(pose, lidar, [(-50.0, 0.525, 90.0, 2.525)])
    batch = ScanBatch(
        lidar, ranges[None].astype("f4"), None, None, pose[None] + (0, 0.1, 0.02), np.zeros(1, "i8")
    )
    found = align(batch, scene)
    assert found.covariance[0, 0, 0] > 100 * found.covariance[0, 1, 1]
    assert abs(found.poses[0, 1] - 1.4) < 0.02
    assert np.linalg.eigvalsh(found.covariance[0]).min() > 0


def test_measuring_leaves_poses_as_they_are():
    truth = rooms.true_poses(4)
    rough = truth + np.array((0.3, 0.0, 0.0))
    batch = rooms.batch_at(truth, rough)
    at_start, at_truth = (
        measure(batch, rough, rooms.room_map()),
        measure(batch, truth, rooms.room_map()),
    )
    np.testing.assert_array_equal(at_start.poses, rough)
    assert at_start.inlier_ratio.max() < 0.8
    assert at_truth.inlier_ratio.min() > 0.95


def test_poses_outside_the_map_are_an_error_that_says_where_it_lies():
    truth = rooms.true_poses(3)
    with pytest.raises(AlignmentError, match="3 poses lie outside the map, which spans 9.0 x 7.0"):
        check_inside(truth + np.array((500.0, 0.0, 0.0)), map_field(rooms.room_map()))


def test_scans_outside_the_map_are_not_accepted_and_others_are():
    truth = rooms.true_poses(3)
    rough = truth + np.array((500.0, 0.0, 0.0))
    found = align(rooms.batch_at(truth, rough), rooms.room_map())
    assert not found.accepted.any()
    rough[1] = truth[1]
    check_inside(rough, map_field(rooms.room_map()))
    found = align(rooms.batch_at(truth, rough), rooms.room_map())
    assert found.accepted.tolist() == [False, True, False]


def test_an_empty_map_is_an_error():
    scene = rooms.room_map()
    empty = replace(scene, occupancy=np.zeros_like(scene.occupancy))
    with pytest.raises(AlignmentError, match="no occupied cell"):
        align(rooms.batch_at(rooms.true_poses(1), rooms.true_poses(1)), empty)


def test_limits_out_of_range_are_refused():
    with pytest.raises(InvalidInputError, match="acceptance limits"):
        Acceptance(min_inlier_ratio=1.5)
    with pytest.raises(InvalidInputError, match="acceptance limits"):
        Acceptance(max_correction_m=np.inf)
