"""Exact hits on simple shapes."""

import math

import numpy as np
import pytest

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.geometry import to_base, to_points, transform
from semantic2d_dataset.scene.lidars import LIDARS, LidarSpec
from semantic2d_dataset.simulation.raycast import cast

NO_LEGS = np.zeros((1, 0, 3))
NO_CIRCLES = np.zeros((0, 3))
NO_SEGMENTS = np.zeros((0, 4))
RING = LidarSpec("ring", "ring", 360, -math.pi, 2 * math.pi / 360, 0.1, 50.0)
SQUARE = np.array(
    ((-4.0, -3.0, 5.0, -3.0), (5.0, -3.0, 5.0, 6.0), (5.0, 6.0, -4.0, 6.0), (-4.0, 6.0, -4.0, -3.0))
)


def brute_force(segments, circles, origin, direction):
    """Nearest hit of one ray, straight from the textbook."""
    best, which = math.inf, -1
    for i, (x1, y1, x2, y2) in enumerate(segments):
        a = np.array(((direction[0], x1 - x2), (direction[1], y1 - y2)))
        if abs(np.linalg.det(a)) < 1e-12:
            continue
        r, u = np.linalg.solve(a, (x1 - origin[0], y1 - origin[1]))
        if r > 0 and 0 <= u <= 1 and r < best:
            best, which = r, i
    for i, (x, y, radius) in enumerate(circles):
        to = np.array((x, y)) - origin
        along = to @ direction
        inside = radius**2 - to @ to + along**2
        if inside >= 0 and 0 < along - math.sqrt(inside) < best:
            best, which = along - math.sqrt(inside), len(segments) + i
    return best, which


def test_random_scenes_agree_with_a_textbook_ray_caster():
    rng = np.random.default_rng(3)
    corners = rng.uniform(-8, 8, (25, 2))
    segments = np.hstack((corners, corners + rng.uniform(-3, 3, (25, 2))))
    circles = np.column_stack((rng.uniform(-8, 8, (15, 2)), rng.uniform(0.02, 0.5, 15)))
    poses = np.array(((0.2, -0.1, 0.3), (3.0, 2.0, -2.9)))
    hits = cast(segments, circles, np.zeros((2, 0, 3)), poses, RING)
    for n, pose in enumerate(poses):
        if np.any(np.hypot(*(circles[:, :2] - pose[:2]).T) < circles[:, 2]):
            pytest.fail("the scene must not enclose the lidar")
        for k, bearing in enumerate(RING.bearings + pose[2]):
            ray = np.array((math.cos(bearing), math.sin(bearing)))
            distance, which = brute_force(segments, circles, pose[:2], ray)
            assert hits.primitives[n, k] == which
            assert hits.distances[n, k] == pytest.approx(distance, abs=1e-9)


@pytest.mark.parametrize("lidar", LIDARS.values(), ids=LIDARS)
def test_endpoints_of_every_mount_lie_on_the_walls_in_the_map(lidar):
    poses = np.array(((0.5, 1.0, 0.0), (1.0, 2.0, 2.5)))
    hits = cast(SQUARE, NO_CIRCLES, np.zeros((2, 0, 3)), poses, lidar)
    points = to_base(to_points(hits.distances, lidar.bearings), lidar.base_T_lidar)
    x, y = np.moveaxis(transform(poses, points), -1, 0)
    on_wall = np.minimum(np.minimum(abs(x + 4), abs(x - 5)), np.minimum(abs(y + 3), abs(y - 6)))
    assert np.isfinite(hits.distances).all()
    assert on_wall.max() < 1e-9


def test_upside_down_lidar_sees_what_is_on_the_left_at_negative_bearings():
    left = np.array(((0.0, 2.0, 0.3),))
    hits = cast(NO_SEGMENTS, left, NO_LEGS, np.zeros((1, 3)), LIDARS["wlr-716"])
    assert (LIDARS["wlr-716"].bearings[hits.primitives[0] >= 0] < 0).all()
    assert (hits.primitives[0] >= 0).any()


def test_beams_beyond_the_field_of_view_see_nothing():
    behind = np.array(((-3.0, 0.0, 0.3),))
    hits = cast(NO_SEGMENTS, behind, NO_LEGS, np.zeros((1, 3)), LIDARS["hokuyo-utm-30lx-ew"])
    assert (hits.primitives == -1).all()
    assert np.isinf(hits.distances).all()


def test_segment_behind_the_robot_is_seen_across_the_wrap_of_the_bearing():
    hits = cast(np.array(((-2.0, -1.0, -2.0, 1.0),)), NO_CIRCLES, NO_LEGS, np.zeros((1, 3)), RING)
    seen = np.flatnonzero(hits.primitives[0] == 0)
    assert seen.min() == 0
    assert seen.max() == 359
    np.testing.assert_allclose(hits.distances[0, 0], 2.0, atol=1e-12)


def test_cosine_is_one_at_the_normal_and_falls_off_as_the_angle_of_incidence():
    wall = np.array(((2.0, -20.0, 2.0, 20.0),))
    hits = cast(wall, NO_CIRCLES, NO_LEGS, np.zeros((1, 3)), RING)
    seen = hits.primitives[0] == 0
    np.testing.assert_allclose(hits.cosines[0, seen], np.cos(RING.bearings[seen]), atol=1e-12)


def test_legs_are_there_at_their_scan_only_and_hide_the_wall():
    legs = np.full((2, 1, 3), (50.0, 50.0, 0.07))
    legs[1, 0] = (2.0, 0.0, 0.07)
    hits = cast(SQUARE, NO_CIRCLES, legs, np.zeros((2, 3)), RING)
    assert (hits.primitives[0] < 4).all()
    assert hits.primitives[1, 180] == 4
    assert hits.distances[1, 180] == pytest.approx(1.93)


def test_legs_of_another_number_of_scans_are_refused():
    with pytest.raises(InvalidInputError, match="legs for 1 scans, found 2"):
        cast(SQUARE, NO_CIRCLES, np.zeros((2, 0, 3)), np.zeros((1, 3)), RING)
