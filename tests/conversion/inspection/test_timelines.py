"""When messages came, in memory that does not grow with them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from conversion.inspection.timelines import Timeline

SECOND = 10**9


def timeline(stamps):
    line = Timeline()
    line.extend(stamps)
    return line


def test_steady_messages_have_their_exact_rate_and_are_regular():
    line = timeline(np.arange(101) * SECOND // 20)
    assert line.rate_hz == 20
    assert line.period_s == pytest.approx(0.05)
    assert line.regularity == 1
    assert line.duration_s == 5


def test_a_gap_is_found_with_its_time_and_lowers_the_rate_but_not_the_period():
    stamps = np.concatenate((np.arange(100), np.arange(200, 300))) * SECOND // 10
    line = timeline(stamps)
    assert line.longest.start_ns == 99 * SECOND // 10
    assert line.longest.seconds == pytest.approx(10.1)
    assert line.period_s == pytest.approx(0.1)
    assert line.rate_hz == pytest.approx(199 / 29.9)
    assert line.regularity == pytest.approx(198 / 199)


def test_nothing_and_one_message_have_no_rate():
    assert Timeline().rate_hz is None
    assert Timeline().first_ns is None
    assert Timeline().longest is None
    one = timeline([SECOND])
    assert (one.first_ns, one.last_ns, len(one)) == (SECOND, SECOND, 1)
    assert (one.rate_hz, one.period_s, one.regularity, one.longest) == (None,) * 4


def test_messages_at_one_time_have_no_rate_but_a_period_of_zero():
    line = timeline([SECOND] * 5)
    assert line.rate_hz is None
    assert line.period_s == 0


@given(
    gaps=st.lists(st.integers(0, 10**13), min_size=1, max_size=60),
    cut=st.integers(0, 60),
)
def test_one_by_one_is_the_same_as_all_at_once(gaps, cut):
    stamps = 5 * SECOND + np.cumsum(gaps)
    whole, parts, single = timeline(stamps), timeline(stamps[:cut]), Timeline()
    parts.extend(stamps[cut:])
    for stamp in stamps.tolist():
        single.add(stamp)
    for line in (parts, single):
        assert (len(line), line.rate_hz, line.longest) == (len(whole), whole.rate_hz, whole.longest)
        assert line.period_s == whole.period_s
        for mine, theirs in zip(line.rates(), whole.rates(), strict=True):
            np.testing.assert_array_equal(mine, theirs)


@given(st.lists(st.integers(0, 10**14), min_size=1, max_size=60))
def test_counts_over_time_hold_every_message_and_stay_few(gaps):
    stamps = np.cumsum(gaps)
    edges, rates = timeline(stamps).rates()
    assert len(rates) <= 1024
    assert (rates * np.diff(edges)).sum() == pytest.approx(len(stamps), rel=1e-6)
    assert edges[0] <= stamps[0] / 1e9 <= stamps[-1] / 1e9 <= edges[-1] + 1e-6
