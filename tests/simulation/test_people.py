"""Walking, standing, and giving way."""

import numpy as np
import pytest

from semantic2d_dataset.simulation.people import Walker, populate, step_aside, walk
from semantic2d_dataset.simulation.trajectories import floor_of
from semantic2d_dataset.simulation.worlds import draw_world

TIMES = np.arange(0, 8, 0.02)


def straight(speed=1.2, start=0.0):
    path = np.stack((np.arange(0, 20, 0.05), np.zeros(400)), axis=-1)
    return Walker(path, speed, start, 0.0, 1.3, 0.065, 0.2, 1.0)


@pytest.fixture(scope="module")
def crowd():
    world = draw_world("lobby", 3)
    floor = floor_of(world)
    rng = np.random.Generator(np.random.PCG64(3))
    return floor, world.tour, populate(floor, world.tour, 20, rng)


def test_feet_rest_half_of_the_time_and_never_slide_backward():
    legs = walk((straight(),), TIMES)
    speed = np.diff(legs[:, 0, 0]) / 0.02
    assert np.mean(np.abs(speed) < 1e-6) == pytest.approx(0.5, abs=0.06)
    assert speed.min() > -1e-6
    assert speed.max() == pytest.approx(2.4, abs=1e-6)


def test_body_between_the_legs_moves_at_walking_speed():
    legs = walk((straight(),), TIMES)
    body = legs[:, :, 0].mean(axis=1)
    np.testing.assert_allclose(np.diff(body) / 0.02, 1.2, atol=1e-6)


def test_legs_are_side_by_side_and_one_stride_apart_at_most():
    legs = walk((straight(),), TIMES)
    gap = legs[:, 0] - legs[:, 1]
    np.testing.assert_allclose(gap[:, 1], 0.2, atol=1e-9)
    assert 0.5 < np.abs(gap[:, 0]).max() <= 0.65 + 1e-9


def test_somebody_who_stands_does_not_move():
    standing = Walker(np.array(((1.0, 2.0),)), 0.0, 0.0, 0.5, 1.3, 0.06, 0.2, 1.0)
    legs = walk((standing,), TIMES)
    assert (legs == legs[0]).all()
    np.testing.assert_allclose(legs[0, :, :2].mean(axis=0), (1.0, 2.0))


def test_walkers_turn_round_at_the_end_of_their_path():
    legs = walk((straight(start=18.0),), TIMES)
    assert legs[:, :, 0].max() < 20.4
    assert legs[-1, :, 0].mean() < legs[:, :, 0].mean(axis=1).max() - 1


def test_nobody_walks_or_stands_in_an_obstacle(crowd):
    floor, _, people = crowd
    legs = walk(people, np.arange(0, 60, 0.25))
    middles = legs.reshape(len(legs), -1, 2, 3)[..., :2].mean(axis=2)
    assert floor.clearance_at(middles).min() > 0.15


def test_half_of_the_people_walk_and_some_stand_in_groups(crowd):
    _, _, people = crowd
    standing = np.array([w.path[0] for w in people if len(w.path) == 1])
    assert len(people) == 20
    assert len(standing) == 10
    apart = np.hypot(*(standing[:, None] - standing).transpose(2, 0, 1)) + 9 * np.eye(10)
    assert apart.min() < 1.0


def test_nobody_stands_in_the_way_of_the_robot(crowd):
    _, tour, people = crowd
    standing = np.array([w.path[0] for w in people if len(w.path) == 1])
    assert np.hypot(*(standing[:, None] - tour).transpose(2, 0, 1)).min() > 1.1


def test_people_give_way_to_the_robot_without_a_jump():
    legs = walk((straight(),), TIMES)
    robot = np.tile((4.0, 0.05), (len(TIMES), 1))
    moved = step_aside(legs, robot)
    body = moved[..., :2].mean(axis=1)
    assert np.hypot(*(body - robot).T).min() > 0.5
    far = np.hypot(*(legs[..., :2].mean(axis=1) - robot).T) > 1.2
    np.testing.assert_array_equal(moved[far], legs[far])


def test_no_people_are_no_legs():
    assert walk((), TIMES).shape == (len(TIMES), 0, 3)
