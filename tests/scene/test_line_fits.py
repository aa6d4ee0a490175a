import numpy as np
import pytest

from semantic2d_dataset.scene.line_fits import fit_in_turns, fit_jointly, project_ends

VAR_R, VAR_PHI = 0.02**2, 1e-5**2
FITS = pytest.mark.parametrize("fit", [fit_in_turns, fit_jointly])


def seen(angle, radius, bearings, noise=0.0):
    """Points of a line in normal form as beams at `bearings` (from its normal) hit it."""
    ranges = radius / np.cos(bearings) + noise
    x, y = ranges * np.cos(angle + bearings), ranges * np.sin(angle + bearings)
    return x, y, VAR_R / ranges**2


def fitted(fit, points, angle, radius, thresh=1e-4):
    """Line (11,) after the fit, which starts at the angle and radius given."""
    line = np.full(11, np.nan)
    line[:2] = angle, radius
    fit(points, line, VAR_PHI, thresh, thresh)
    return line


@FITS
@pytest.mark.parametrize("angle", [-3.0, -np.pi / 2, 0.0, 0.7, np.pi / 2])
def test_points_of_a_line_give_the_line(fit, angle):
    points = seen(angle, 2.0, np.linspace(-0.5, 0.8, 60))
    line = fitted(fit, points, angle + 0.02, 2.03, thresh=1e-9)
    np.testing.assert_allclose(line[:2], [angle, 2.0], atol=1e-6)


def scatter(bearings, lines=400):
    """Joint fits (lines, 11) of one line, seen again and again."""
    rng = np.random.default_rng(0)
    noise = rng.normal(0, VAR_R**0.5, (lines, len(bearings)))
    return np.array([fitted(fit_jointly, seen(0.3, 2.0, bearings, one), 0.3, 2.0) for one in noise])


@pytest.mark.parametrize("bearings", [np.linspace(-0.4, 0.4, 50), np.linspace(0.6, 0.9, 50)])
def test_the_covariance_of_the_joint_fit_is_the_scatter_of_its_lines(bearings):
    lines = scatter(bearings)
    radius, angle = lines[:, 1], lines[:, 0]
    said = lines[:, 8:].mean(axis=0)
    found = np.cov(radius, angle)
    np.testing.assert_allclose([found[0, 0], found[0, 1], found[1, 1]], said, rtol=0.3, atol=2e-6)


@pytest.mark.parametrize("bearings", [np.linspace(-0.4, 0.4, 50), np.linspace(0.6, 0.9, 50)])
def test_the_joint_fit_is_right_in_the_mean(bearings):
    lines = scatter(bearings)
    standard_error = np.std(lines[:, :2], axis=0) / len(lines) ** 0.5
    assert (np.abs(lines[:, :2].mean(axis=0) - [0.3, 2.0]) < 4 * standard_error).all()


def test_the_classic_fit_stops_short_where_angle_and_radius_depend_on_each_other():
    points = seen(0.0, 2.0, np.linspace(0.9, 1.0, 60))  # far from the foot of the normal
    classic = fitted(fit_in_turns, points, 0.05, 2.1)
    joint = fitted(fit_jointly, points, 0.05, 2.1)
    assert abs(classic[0]) > 1e-3
    assert abs(joint[0]) < 1e-5


def test_points_that_are_no_line_keep_their_chord():
    rng = np.random.default_rng(0)
    for _ in range(200):
        x, y = rng.normal(0, 5, (2, 3))
        line = fitted(fit_jointly, (x, y, VAR_R / (x**2 + y**2)), 0.5, 1.0)
        unsettled = np.isnan(line[8])
        assert (line[:2].tolist() == [0.5, 1.0]) == unsettled
        assert np.isfinite(line[:2]).all()


def test_points_that_are_one_keep_their_chord():
    line = fitted(fit_jointly, tuple(np.full((3, 20), 0.5)), 0.5, 1.0)
    assert line[:2].tolist() == [0.5, 1.0]


def test_ends_move_straight_onto_the_line():
    line = np.zeros(11)
    line[:6] = np.pi / 2, 1.0, -2.0, 1.5, 3.0, 0.7
    project_ends(line)
    np.testing.assert_allclose(line[2:6], [-2.0, 1.0, 3.0, 1.0], atol=1e-12)
