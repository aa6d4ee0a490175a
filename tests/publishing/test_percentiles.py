import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semantic2d_dataset.publishing.percentiles import Percentiles

FLOATS = st.floats(-1e6, 1e6, width=32, allow_subnormal=False)


@given(st.lists(FLOATS, min_size=1, max_size=50), st.integers(0, 100))
def test_percentiles_are_those_of_sorted_values_within_their_resolution(values, percent):
    counted = Percentiles()
    array = np.array(values, np.float32)
    counted.update(array[: len(array) // 2])
    counted.update(array[len(array) // 2 :])
    rank = max(1, int(np.ceil(percent / 100 * len(array))))
    expected = float(np.sort(array)[rank - 1])
    (found,) = counted.compute([percent])
    assert found == pytest.approx(expected, rel=2**-11, abs=1e-30)


def test_whole_numbers_are_found_exactly_and_nothing_where_there_is_nothing():
    counted = Percentiles()
    assert counted.compute([50]) is None
    counted.update(np.arange(1, 101, dtype=np.float32))
    assert counted.compute([1, 50, 99]) == [1.0, 50.0, 99.0]
