"""Drives through free space."""

import numpy as np
import pytest

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.geometry import wrap_angle
from semantic2d_dataset.simulation.plans import PLANS
from semantic2d_dataset.simulation.trajectories import drive, floor_of, snap_places
from semantic2d_dataset.simulation.worlds import draw_world


@pytest.fixture(scope="module", params=PLANS)
def ride(request):
    world = draw_world(request.param, 11)
    floor = floor_of(world)
    rng = np.random.Generator(np.random.PCG64(11))
    return floor, drive(floor, world.tour, 1200, rng)


def test_robot_keeps_clear_of_everything(ride):
    floor, driven = ride
    assert floor.clearance_at(driven.poses[:, :2]).min() > 0.25


def test_robot_looks_where_it_goes_and_commands_say_so(ride):
    _, driven = ride
    step = np.diff(driven.poses[:, :2], axis=0) * 20
    speed = np.hypot(*step.T)
    np.testing.assert_allclose(speed, driven.velocity[:-1, 0], atol=0.12)
    moving = speed > 0.2
    course = np.arctan2(step[:, 1], step[:, 0])[moving]
    assert np.abs(wrap_angle(course - driven.poses[:-1, 2][moving])).max() < 0.25
    assert speed.max() < 1.0
    assert np.abs(driven.velocity[:, 1]).max() < 1.3


def test_initial_poses_drift_smoothly_by_eight_centimetres_and_two_degrees(ride):
    _, driven = ride
    error = driven.initial_poses - driven.poses
    error[:, 2] = wrap_angle(error[:, 2])
    assert np.sqrt(np.mean(np.sum(error[:, :2] ** 2, axis=-1))) == pytest.approx(0.08, abs=1e-3)
    assert np.rad2deg(np.sqrt(np.mean(error[:, 2] ** 2))) == pytest.approx(2.0, abs=0.02)
    assert np.abs(np.diff(error[:, :2], axis=0)).max() < 0.02


def test_one_scan_is_a_drive_too():
    world = draw_world("lounge", 1)
    driven = drive(floor_of(world), world.tour, 1, np.random.Generator(np.random.PCG64(1)))
    assert driven.poses.shape == (1, 3)
    assert np.isfinite(driven.velocity).all()


def test_clearance_that_nothing_has_is_refused():
    floor = floor_of(draw_world("corridor", 1))
    with pytest.raises(InvalidInputError, match=r"no place has 9\.0 m"):
        snap_places(floor, np.zeros((1, 2)), 9.0)
