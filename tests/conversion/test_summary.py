from __future__ import annotations

import numpy as np
import pytest

from conversion.summary import Tally
from semantic2d_dataset.scene.lidars import LidarSpec

LIDAR = LidarSpec("four", "Four", 4, -1.0, 0.5, 0.1, 10.0)


def tally(*blocks: tuple[list, list | None]) -> Tally:
    found = Tally(LIDAR)
    for ranges, intensities in blocks:
        arrays = {"scans/ranges": np.array(ranges, np.float32)}
        if intensities is not None:
            arrays["scans/intensities"] = np.array(intensities, np.float32)
        found.add(arrays)
    return found


def test_every_beam_is_counted_once():
    found = tally(([[1, np.inf, -np.inf, np.nan]], None), ([[0, 10, 0.05, 9], [1, 1, 1, 1]], None))
    assert found.scans == 3
    assert found.shares == pytest.approx(
        {
            "returns": 6 / 12,
            "no return (+inf)": 1 / 12,
            "too close (-inf)": 1 / 12,
            "invalid (NaN)": 1 / 12,
            "outside the limits": 3 / 12,
        }
    )


@pytest.mark.parametrize(
    ("intensities", "kind"),
    [
        (None, "none"),
        ([[0, 0, 0, 0]], "all zero"),
        ([[7, 7, np.nan, 7]], "constant"),
        ([[0, 7, 7, 7]], "measured"),
        ([[np.nan] * 4], "none"),
    ],
)
def test_the_kind_of_intensity_is_told(intensities, kind):
    assert tally(([[1, 1, 1, 1]], intensities)).intensity_kind == kind


def test_intensities_that_fit_only_reversed_run_backward():
    ranges = [[1, 2, np.inf, np.inf], [1, np.inf, 3, 4]]
    against = [[0, 0, 5, 5], [5, 5, 0, 5]]
    assert tally((ranges, against)).intensities_run_backward
    assert not tally((ranges, np.array(against)[:, ::-1])).intensities_run_backward


def test_without_zeros_or_misses_nothing_is_suggested():
    assert not tally(([[1, 2, 3, 4]], [[5, 6, 7, 8]])).intensities_run_backward
    assert not tally(([[1, 2, 3, np.inf]], None)).intensities_run_backward
