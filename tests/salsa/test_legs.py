import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from salsa.legs import Outline, find_standing, fit_circle


def arc(x, y, radius, *, turn=2 * np.pi, noise=0.0, points=12, seed=0):
    angles = np.linspace(0.0, turn, points, endpoint=turn < 6)
    rim = np.stack((x + radius * np.cos(angles), y + radius * np.sin(angles)), axis=-1)
    return rim + np.random.default_rng(seed).normal(0.0, noise, rim.shape)


def outline(*parts):
    points = np.concatenate(parts)
    return Outline(points, np.ones(len(points)))


def box(x, y, length, width):
    across = np.linspace(-0.5, 0.5, 9)
    edges = [np.stack((length * across, np.full(9, s * width / 2)), -1) for s in (-1, 1)]
    edges += [np.stack((np.full(9, s * length / 2), width * across), -1) for s in (-1, 1)]
    return np.concatenate(edges) + np.array((x, y))


@given(
    x=st.floats(-50, 50), y=st.floats(-50, 50), radius=st.floats(0.02, 2), turn=st.floats(2, 6.2)
)
def test_a_circle_is_found_from_a_part_of_its_rim(x, y, radius, turn):
    middle, found, error = fit_circle(arc(x, y, radius, turn=turn), np.ones(12))
    np.testing.assert_allclose(middle, (x, y), atol=1e-6)
    assert found == pytest.approx(radius, abs=1e-6)
    assert error < 1e-6


@pytest.mark.parametrize("gap", [0.2, 0.3])
def test_two_legs_side_by_side_are_somebody_who_stands(gap):
    left, right = (arc(x, 2.0, 0.06, noise=0.004, seed=int(9 * x)) for x in (1.0, 1.0 + gap))
    assert find_standing([outline(left), outline(right)]).tolist() == [True, True]
    assert find_standing([outline(left, right)]).tolist() == [True]


def test_legs_seen_from_one_side_are_legs():
    left, right = (arc(x, 0.0, 0.07, turn=2.6, points=8) for x in (0.0, 0.25))
    assert find_standing([outline(left, right)]).all()


def test_a_single_round_thing_is_nobody():
    assert not find_standing([outline(arc(0.0, 0.0, 0.07))]).any()
    far = [outline(arc(x, 0.0, 0.07)) for x in (0.0, 0.8)]
    assert not find_standing(far).any()


def test_chair_legs_boxes_and_bins_are_nobody():
    chair = [outline(arc(x, y, 0.02)) for x in (0.0, 0.42) for y in (0.0, 0.42)]
    assert not find_standing(chair).any()
    for length, width in ((0.2, 0.11), (0.4, 0.22), (0.45, 0.3), (1.6, 0.7)):
        assert not find_standing([outline(box(0.0, 0.0, length, width))]).any()
    assert not find_standing([outline(arc(0.0, 0.0, 0.24))]).any()


def test_nothing_and_single_points_are_nobody():
    assert find_standing([]).shape == (0,)
    assert not find_standing([outline(np.zeros((1, 2))), outline(np.zeros((5, 2)))]).any()
