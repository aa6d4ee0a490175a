from dataclasses import replace

import numpy as np
import pytest

from salsa.alignment import Alignment, align
from salsa.smoothing import Smoothing, read_odometry, smooth
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.sequence import SequenceHeader, SequenceReader, SequenceWriter
from semantic2d_dataset.scene.geometry import Pose2, compose, invert
from semantic2d_dataset.scene.maps import FREE, OCCUPIED, SemanticMap
from semantic2d_dataset.scene.scans import ScanBatch
from tests.salsa import rooms

SCANS = 120
STAMPS = 1_700_000_000_000_000_000 + np.arange(SCANS) * 50_000_000


def aligned(poses, sigma=(0.003, 0.003, 0.001), accepted=None):
    n = len(poses)
    covariance = np.repeat(np.diag(np.square(sigma))[None], n, axis=0)
    accepted = np.ones(n, bool) if accepted is None else accepted
    return Alignment(poses, np.zeros(n, "f4"), np.ones(n, "f4"), accepted, covariance)


def test_sure_poses_stay_where_they_are():
    truth = rooms.true_poses(SCANS)
    rough = rooms.rough_poses(truth)  # jumps about: no odometry at all
    found = smooth(aligned(truth), rough, STAMPS, Smoothing())
    metres, degrees = rooms.errors(found, truth)
    assert np.median(metres) < 0.01
    assert metres.max() < 0.05
    assert np.median(degrees) < 0.5


def test_scans_without_a_place_of_their_own_are_carried_by_the_motion():
    truth = rooms.true_poses(SCANS)
    rough = truth + np.linspace(0, 1, SCANS)[:, None] * np.array((0.6, -0.4, 0.1))
    accepted = np.ones(SCANS, bool)
    accepted[40:80] = False
    poses = np.where(accepted[:, None], truth, rough)
    found = smooth(aligned(poses, accepted=accepted), rough, STAMPS, Smoothing())
    assert rooms.errors(rough[40:80], truth[40:80])[0].min() > 0.2
    assert rooms.errors(found[40:80], truth[40:80])[0].max() < 0.08


def test_unknown_poses_stay_unknown_and_the_others_go_on():
    truth = rooms.true_poses(SCANS)
    rough = truth.copy()
    rough[[0, 50]] = np.nan
    found = smooth(aligned(rough), rough, STAMPS, Smoothing())
    assert np.isnan(found[[0, 50]]).all()
    np.testing.assert_allclose(
        np.delete(found, (0, 50), 0), np.delete(truth, (0, 50), 0), atol=1e-3
    )


def test_a_jump_of_the_rough_poses_bends_nothing():
    truth = rooms.true_poses(SCANS)
    rough = truth + np.where(np.arange(SCANS) < 60, 0.0, 1.0)[:, None] * np.array((0.7, 0.0, 0.2))
    found = smooth(aligned(truth), rough, STAMPS, Smoothing())
    assert rooms.errors(found, truth)[0].max() < 0.03


def test_a_leap_to_nowhere_has_no_say():
    truth = rooms.true_poses(SCANS)
    rough = truth.copy()
    rough[60, 0] = 1e200
    accepted = np.arange(SCANS) != 60
    found = smooth(aligned(truth, accepted=accepted), rough, STAMPS, Smoothing())
    assert rooms.errors(found[accepted], truth[accepted])[0].max() < 0.03


def test_odometry_in_a_frame_of_its_own_tells_the_motion():
    truth = rooms.true_poses(SCANS)
    odometry = compose(np.array((5.0, -3.0, 2.0)), truth)
    rough = rooms.rough_poses(truth, metres=0.3)
    accepted = np.zeros(SCANS, bool)
    accepted[[0, -1]] = True
    found = smooth(
        aligned(np.where(accepted[:, None], truth, rough), accepted=accepted),
        rough,
        STAMPS,
        Smoothing(),
        odometry=odometry,
    )
    assert rooms.errors(found, truth)[0].max() < 0.1


def test_a_corridor_does_not_slide_where_its_ends_are_out_of_sight():
    """The lidar sees 6 m; in the middle of 40 m nothing tells where along it was."""
    occupancy = np.full((60, 880), FREE, np.uint8)
    occupancy[[10, 50], 40:840] = OCCUPIED
    occupancy[10:51, [40, 839]] = OCCUPIED
    occupancy[11:18, 120:127] = OCCUPIED  # a pillar that the first scans see
    scene = SemanticMap(occupancy, np.full_like(occupancy, 9), 0.05, Pose2(0, 0, 0))
    lidar = replace(rooms.LIDAR, range_max=6.0)
    truth = np.stack((np.linspace(4.5, 39.5, SCANS), np.full(SCANS, 1.4), np.zeros(SCANS)), -1)
    walls = [(2.025, 0.525, 41.975, 2.525), (6.025, 0.575, 6.325, 0.875)]
    ranges = np.stack([rooms.cast(pose, lidar, walls) for pose in truth])
    rough = truth + np.linspace(0, 1, SCANS)[:, None] ** 2 * np.array((0.7, 0.0, 0.0))
    batch = ScanBatch(lidar, ranges.astype("f4"), None, None, rough, STAMPS)
    found = align(batch, scene)
    middle = slice(25, 95)
    smoothed = smooth(found, rough, STAMPS, Smoothing())
    before = np.abs(found.poses - truth)[middle, 0]
    after = np.abs(smoothed - truth)[middle, 0]
    assert before.max() > 0.4
    assert after.max() < 0.5 * before.max()
    assert np.abs(smoothed - truth)[:, 1].max() < 0.02


def with_odometry(path, columns):
    truth = rooms.true_poses(5)
    batch = rooms.batch_at(truth, truth)
    said = b'{"columns": [' + ",".join(f'"{name}"' for name in columns).encode() + b"]}"
    half = np.sin(truth[:, 2] / 2), np.cos(truth[:, 2] / 2)
    zero = np.zeros(5)
    rows = np.stack((truth[:, 0], truth[:, 1], zero, zero, *half), axis=-1)
    with SequenceWriter(path, SequenceHeader("room", "test", rooms.LIDAR)) as writer:
        writer.append(
            {
                "scans/ranges": batch.ranges,
                "scans/stamps_ns": batch.stamps_ns,
                "streams/odom/stamps_ns": batch.stamps_ns,
                "streams/odom/data": rows[:, : len(columns)],
                "streams/odom/about": np.frombuffer(said, np.uint8),
            }
        )
    return truth


POSE = [f"pose.pose.position.{axis}" for axis in "xy"]
POSE += [f"pose.pose.orientation.{axis}" for axis in "xyzw"]


def test_odometry_is_read_from_a_stream_at_the_stamps_of_the_scans(tmp_path):
    truth = with_odometry(tmp_path / "in.h5", POSE)
    with SequenceReader(tmp_path / "in.h5") as reader:
        found = read_odometry(reader, "odom")
    np.testing.assert_allclose(compose(invert(truth), found), 0.0, atol=1e-9)


def test_a_stream_that_is_not_there_or_holds_no_poses_is_named(tmp_path):
    with_odometry(tmp_path / "in.h5", POSE[:2])
    with SequenceReader(tmp_path / "in.h5") as reader:
        with pytest.raises(InvalidInputError, match="no stream 'imu'; it has odom"):
            read_odometry(reader, "imu")
        with pytest.raises(InvalidInputError, match="expected the columns pose.pose.position.x"):
            read_odometry(reader, "odom")


def test_numbers_below_zero_are_refused():
    with pytest.raises(InvalidInputError, match="smoothing: expected numbers above 0"):
        Smoothing(motion_m=0.0)
