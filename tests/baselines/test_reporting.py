from __future__ import annotations

from statistics import fmean, stdev

import pytest

from baselines.reporting import _merge


def test_trainings_are_merged_to_their_mean_and_spread_and_one_keeps_that_of_its_samples():
    rows = [{"All": (mean, 0.01)} for mean in (0.2, 0.5, 0.6)]
    mean, spread = _merge(rows)["All"]
    assert (mean, spread) == pytest.approx((fmean((0.2, 0.5, 0.6)), stdev((0.2, 0.5, 0.6))))
    assert _merge(rows[:1]) == rows[0]


def test_a_class_that_only_later_trainings_have_is_not_lost():
    merged = _merge([{"All": (0.2, None)}, {"All": (0.4, None), "Sofa": (0.3, None)}])
    assert merged["Sofa"] == (0.3, None)
