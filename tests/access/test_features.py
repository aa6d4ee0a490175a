import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semantic2d_dataset.access.features import (
    Moments,
    Statistics,
    channel_count,
    features_of,
    normalise_features,
)
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.geometry import incidence_angles, to_points
from tests.generators import SMALL_LIDAR, make_arrays

ARRAYS = make_arrays(20)
RANGES, INTENSITIES = ARRAYS["scans/ranges"], ARRAYS["scans/intensities"]
VALID = SMALL_LIDAR.has_return(RANGES)


def test_channels_come_in_the_order_ranges_intensities_points_incidence():
    found = features_of(RANGES, INTENSITIES, SMALL_LIDAR, "RIPA")
    kept = np.where(VALID, RANGES, 0).astype(np.float32)
    points = to_points(kept, SMALL_LIDAR.bearings)
    expected = (
        kept,
        np.where(VALID, INTENSITIES, 0),
        points[..., 0],
        points[..., 1],
        incidence_angles(kept, SMALL_LIDAR.angle_increment),
    )
    assert found.shape == (20, 5, 37)
    for channel, values in enumerate(expected):
        np.testing.assert_allclose(found[:, channel], values, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("letters", ["R", "I", "P", "A", "RI", "RA", "IA", "PA", "RPA", "RIPA"])
def test_any_subset_is_the_same_channels_of_all(letters):
    every = features_of(RANGES, INTENSITIES, SMALL_LIDAR, "RIPA")
    places = {"R": [0], "I": [1], "P": [2, 3], "A": [4]}
    chosen = [place for letter in letters for place in places[letter]]
    found = features_of(RANGES, INTENSITIES, SMALL_LIDAR, letters)
    assert found.shape[1] == channel_count(letters)
    np.testing.assert_array_equal(found, every[:, chosen])


def test_standardised_features_have_mean_zero_and_std_one():
    raw = features_of(RANGES, INTENSITIES, SMALL_LIDAR, "RIPA")
    moments = Moments()
    for block in (slice(0, 7), slice(7, None)):
        moments.update(raw[block], VALID[block])
    statistics = moments.compute()
    found = features_of(RANGES, INTENSITIES, SMALL_LIDAR, "RIPA", statistics)
    beams = found.transpose(1, 0, 2)[:, VALID]
    np.testing.assert_allclose(beams.mean(axis=1), 0, atol=1e-4)
    np.testing.assert_allclose(beams.std(axis=1), 1, atol=1e-3)


@given(st.lists(st.integers(0, 19), max_size=30))
def test_rows_pick_scans_in_any_order(rows):
    picked = features_of(RANGES, None, SMALL_LIDAR, "RA", rows=np.array(rows, np.int64))
    np.testing.assert_array_equal(picked, features_of(RANGES, None, SMALL_LIDAR, "RA")[rows])


def test_intensity_that_is_not_finite_counts_as_zero():
    intensities = INTENSITIES.copy()
    intensities[:, 3] = np.nan
    found = features_of(RANGES, intensities, SMALL_LIDAR, "I")
    assert (found[:, 0, 3] == 0).all()


def test_letters_may_be_written_as_in_the_paper():
    assert normalise_features("A+I+R") == "RIA"
    assert normalise_features("ripa") == "RIPA"


@pytest.mark.parametrize("letters", ["", "X", "RR", "R I"])
def test_unknown_letters_say_what_there_is(letters):
    with pytest.raises(InvalidInputError, match=r"expected some of R \(ranges\)"):
        normalise_features(letters)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"intensities": None}, "gives no intensities; leave I out"),
        ({"intensities": INTENSITIES[:5]}, "intensities: expected"),
        ({"ranges": RANGES.astype(np.float64)}, "ranges: expected float32"),
        ({"ranges": RANGES[:, :5]}, "ranges: expected float32 \\(any, 37\\)"),
        (
            {"statistics": Statistics((1.0,) * 3, (1.0,) * 3), "which": "RI"},
            "have 2 channels, the statistics 3",
        ),
        ({"rows": np.array([20])}, "rows must lie in 0..19"),
        ({"rows": np.array([-1])}, "rows must lie in 0..19"),
    ],
)
def test_input_that_does_not_fit_is_named(changes, says):
    given = {"ranges": RANGES, "intensities": INTENSITIES, "lidar": SMALL_LIDAR, "which": "RIA"}
    with pytest.raises(InvalidInputError, match=says):
        features_of(**(given | changes))


@pytest.mark.parametrize(("mean", "std"), [((1.0,), ()), ((1.0,), (0.0,)), ((np.nan,), (1.0,))])
def test_statistics_that_cannot_standardise_are_refused(mean, std):
    with pytest.raises(InvalidInputError, match="one mean and one std"):
        Statistics(mean, std)
