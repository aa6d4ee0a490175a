import numpy as np
import pytest

from conversion.layouts.rows import natural_order, only_finite, refuse_options, to_ranges
from conversion.options import Options
from semantic2d_dataset.errors import InvalidInputError


def test_options_without_meaning_are_refused_by_name(tmp_path):
    refuse_options(tmp_path, "table", Options(lidar="hokuyo", license="MIT", no_return=(1.0,)))
    with pytest.raises(InvalidInputError, match="--scan-topic, --map-frame: has no meaning for a"):
        refuse_options(tmp_path, "table", Options(scan_topics=("/scan",), map_frame="w"))
    refuse_options(tmp_path, "table", Options(velocity="none"), ("velocity",))


def test_ranges_keep_their_bits_but_for_those_of_no_return():
    values = np.array([0.0, -0.0, np.nan, np.inf, -np.inf, 1.5, 65.533, 65.532], np.float32)
    found = to_ranges(values, 1.0, (65.533,))
    assert found[6] == np.inf
    np.testing.assert_array_equal(np.delete(found, 6).view(np.uint32),
                                  np.delete(values, 6).view(np.uint32))  # fmt: skip


@pytest.mark.parametrize("dtype", [np.uint16, np.int32, np.float64])
def test_ranges_in_millimetres_become_metres(dtype):
    found = to_ranges(np.array([[0, 1234, 65533]], dtype), 0.001, (0.0, 65.533))
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, np.float32([[np.inf, 1.234, np.inf]]))


def test_a_pose_that_is_not_finite_is_unknown_as_a_whole():
    found = only_finite(np.array([(1.0, 2.0, np.inf), (1.0, 2.0, 3.0)]))
    np.testing.assert_array_equal(found, [[np.nan] * 3, [1, 2, 3]])


def test_names_are_ordered_by_their_numbers():
    names = ["s10.npy", "s2.npy", "s01.npy", "a.npy", "s2b.npy"]
    expected = ["a.npy", "s01.npy", "s2.npy", "s2b.npy", "s10.npy"]
    assert sorted(names, key=natural_order) == expected
