import numpy as np
from scipy import ndimage

from salsa.fields import map_field
from salsa.residuals import cost_of, distance_at, fit_quality, look_up, weigh, workspace
from tests.salsa import rooms

FIELD = map_field(rooms.room_map())
POINTS = np.random.default_rng(0).uniform(-2.0, 2.0, (2, 300)).astype(np.float32)
POSE = np.array((4.5, 3.5, 0.7))


def looked_up(pose):
    work = workspace(POINTS.shape[1])
    count = look_up(POINTS, np.asarray(pose), FIELD.surface, FIELD.resolution, work)
    return work.seen[:, :count].copy(), count


def test_between_the_centres_of_cells_distances_are_bilinear():
    u, v = np.random.default_rng(1).uniform(5, 120, (2, 50))
    expected = ndimage.map_coordinates(FIELD.distance_m, (v, u), order=1)
    found = [distance_at(*place, FIELD.surface) for place in zip(u, v, strict=True)]
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert distance_at(-0.1, 5.0, FIELD.surface) == -1.0
    assert distance_at(5.0, FIELD.distance_m.shape[0] - 1.0, FIELD.surface) == -1.0


def test_slopes_are_those_of_the_distance():
    """Of the whole, by moving the pose a little; kinks between cells are few."""
    seen, count = looked_up(POSE)
    assert count == POINTS.shape[1]
    for k in range(3):
        step = np.zeros(3)
        step[k] = 1e-3
        numeric = (looked_up(POSE + step)[0][0] - looked_up(POSE - step)[0][0]) / 2e-3
        assert np.median(np.abs(numeric - seen[1 + k] / FIELD.resolution)) < 0.01


def test_points_beyond_the_map_are_left_out_and_cost_one():
    seen, count = looked_up((-500.0, 0.0, 0.0))
    assert count == 0
    assert cost_of(seen, count, POINTS.shape[1], 0.1) == 1.0
    assert fit_quality(seen, count, POINTS.shape[1], 0.1) == (np.inf, 0.0)


def test_the_normal_equations_are_sums_over_the_points():
    seen, count = looked_up(POSE)
    found = weigh(seen, count, FIELD.resolution, 0.1)
    d, slopes = seen[0].astype(float), seen[1:].astype(float) / FIELD.resolution
    w = (0.01 / (0.01 + d**2)) ** 2
    np.testing.assert_allclose(found.hessian, (slopes * w) @ slopes.T, rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(found.gradient, slopes @ (w * d), rtol=1e-3, atol=1e-2)
    np.testing.assert_allclose(
        (found.squares, found.weights), ((w * d**2).sum(), w.sum()), rtol=1e-4
    )
