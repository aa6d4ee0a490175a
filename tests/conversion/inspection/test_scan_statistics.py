"""What the beams of scans hold."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from conversion.inspection.scan_statistics import CELL_M, KINDS, ScanStatistics
from semantic2d_dataset.scene.lidars import LidarSpec

LOW, HIGH = 0.2, 30.0


def statistics(ranges, intensities=None, limits=(LOW, HIGH)):
    found = ScanStatistics(*limits)
    given = None if intensities is None else np.asarray(intensities, np.float32)
    found.add(np.asarray(ranges, np.float32), given)
    return found


def walls(scans=200, beams=90, *, seed=1):
    """Ranges of a robot that moves: none recurs."""
    return np.random.default_rng(seed).uniform(0.5, 9.0, (scans, beams)).astype(np.float32)


def test_every_beam_is_one_kind():
    row = [1.0, np.inf, -np.inf, np.nan, 0.0, 0.1, 30.0, -1.0, 200.0, 2.0]
    assert statistics([row]).shares == {
        "returns": 0.2,
        "no return (+inf)": 0.1,
        "too close (-inf)": 0.1,
        "invalid (NaN)": 0.1,
        "zero": 0.1,
        "below range_min": 0.2,
        "range_max and more": 0.2,
    }


@given(hnp.arrays(np.float32, (5, 7), elements=st.floats(width=32)))
def test_returns_are_those_of_the_lidar_and_shares_sum_to_one(ranges):
    lidar = LidarSpec("x", "x", 7, -1.0, 0.1, LOW, HIGH)
    found = statistics(ranges)
    assert found.shares["returns"] == pytest.approx(lidar.has_return(ranges).mean())
    assert sum(found.shares.values()) == pytest.approx(1)
    np.testing.assert_allclose(found.shares_by_beam.sum(axis=1), 1)


def test_blocks_add_up_to_the_whole():
    ranges = walls()
    whole, parts = statistics(ranges, ranges), ScanStatistics(LOW, HIGH)
    for block in np.split(ranges, 4):
        parts.add(block, block)
    assert parts.shares == whole.shares
    assert parts.intensities == whole.intensities
    assert parts.quantiles(0.1, 0.9) == whole.quantiles(0.1, 0.9)
    np.testing.assert_array_equal(parts.shares_by_beam, whole.shares_by_beam)


def test_quantiles_are_right_to_a_centimetre():
    ranges = walls()
    found = statistics(ranges).quantiles(0.01, 0.5, 0.99)
    np.testing.assert_allclose(found, np.quantile(ranges, (0.01, 0.5, 0.99)), atol=2 * CELL_M)


def test_quantiles_leave_out_what_is_no_return():
    ranges = walls()
    ranges[:, :40] = 0.01
    assert statistics(ranges).quantiles(0.01)[0] > 0.49
    assert statistics(np.full((3, 4), np.inf)).quantiles(0.5) is None


@pytest.mark.parametrize("value", [81.83, 50.0, 29.99, 12.0])
def test_a_value_that_recurs_beyond_all_others_looks_like_no_return(value):
    ranges = walls()
    ranges[np.random.default_rng(2).random(ranges.shape) < 0.04] = value
    (found,) = statistics(ranges, limits=(LOW, 60.0)).recurring
    assert found.value_m == value
    assert found.share == pytest.approx(0.04, abs=0.005)
    assert found.no_return
    assert found.counts_as_return == (value < 60)


def test_range_max_and_zero_look_like_no_return_and_count_as_none():
    ranges = walls()
    random = np.random.default_rng(2).random(ranges.shape)
    ranges[random < 0.04] = HIGH
    ranges[random > 0.97] = 0.0
    zero, most = statistics(ranges).recurring
    assert (zero.value_m, zero.no_return, zero.counts_as_return) == (0.0, True, False)
    assert (most.value_m, most.no_return, most.counts_as_return) == (HIGH, True, False)


def test_two_codes_side_by_side_are_both_found():
    ranges = walls()
    random = np.random.default_rng(2).random(ranges.shape)
    ranges[random < 0.04] = 81.83
    ranges[random > 0.97] = 81.91
    found = statistics(ranges, limits=(LOW, 80.0)).recurring
    assert [value.value_m for value in found] == [81.83, 81.91]
    assert all(value.no_return for value in found)


def test_a_code_below_range_min_is_no_missing_return():
    ranges = walls()
    ranges[np.random.default_rng(2).random(ranges.shape) < 0.04] = 0.019
    (found,) = statistics(ranges).recurring
    assert found.value_m == 0.019
    assert not found.no_return


def test_beams_that_are_masked_with_zero_are_dead_and_no_missing_return():
    ranges = walls()
    ranges[:, :6] = 0.0
    found = statistics(ranges)
    assert found.dead_beams == 6
    assert [value.no_return for value in found.recurring] == [False]


def test_a_standing_robot_before_a_wall_has_no_recurring_value():
    noise = np.random.default_rng(3).normal(0, 0.005, (400, 90))
    ranges = np.round(2.0 + np.linspace(0, 0.4, 90) + noise, 3)
    assert statistics(ranges).recurring == ()


def test_a_standing_robot_in_a_simulation_without_noise_has_no_missing_return():
    row = np.linspace(0.5, 9.0, 30)
    found = statistics(np.tile(row, (50, 1))).recurring
    assert len(found) == 30
    assert not any(value.no_return for value in found)
    assert not any(value.no_return for value in statistics(np.full((50, 30), 2.0)).recurring)


def test_values_within_the_room_are_no_missing_returns_however_often_they_recur():
    ranges = walls()
    ranges[np.random.default_rng(2).random(ranges.shape) < 0.3] = 1.0
    (found,) = statistics(ranges).recurring
    assert found.counts_as_return
    assert not found.no_return


@pytest.mark.parametrize(
    ("intensities", "kind", "span"),
    [
        (None, "none", (None, None)),
        (np.zeros((2, 3)), "all zero", (0, 0)),
        (np.full((2, 3), 47.0), "constant", (47, 47)),
        ([[0, 1, 2], [3, 4, 5]], "measured", (0, 5)),
        ([[1e-43, 2e-43, 0], [1e-44, 0, 0]], "denormal", None),
        (np.full((2, 3), np.nan), "invalid", (None, None)),
    ],
)
def test_intensities_are_of_a_kind(intensities, kind, span):
    found = statistics(np.ones((2, 3)), intensities).intensities
    assert found.kind == kind
    if span is not None:
        assert (found.low, found.high) == span


def test_odd_intensities_are_counted():
    row = [[0.0, 1e-40, -2.0, np.nan, np.inf, 5.0, 6.0, 7.0, 8.0, 9.0]]
    found = statistics(np.ones((1, 10)), row).intensities
    assert (found.zero, found.denormal, found.negative, found.invalid) == (0.1, 0.1, 0.1, 0.2)


def test_many_beam_counts_are_counted_in_bounded_memory():
    found = ScanStatistics(LOW, HIGH)
    for beams in range(2, 60):
        found.add(np.ones((1, beams), np.float32))
    found.add(np.ones((9, 5), np.float32))
    assert found.scans == 67
    assert found.shares["returns"] == 1
    assert found.shares_by_beam.shape == (5, len(KINDS))
