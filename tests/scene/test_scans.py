from dataclasses import replace

import numpy as np
import pytest

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.scans import ScanBatch
from tests.generators import SMALL_LIDAR, make_arrays


def make_batch(scans: int = 5) -> ScanBatch:
    arrays = make_arrays(scans)
    return ScanBatch(
        SMALL_LIDAR,
        arrays["scans/ranges"],
        arrays["scans/intensities"],
        arrays["scans/labels"],
        arrays["poses/refined"],
        arrays["scans/stamps_ns"],
    )


def test_a_scan_of_a_batch_is_its_row():
    batch = make_batch()
    scan = batch[3]
    np.testing.assert_array_equal(scan.ranges, batch.ranges[3])
    np.testing.assert_array_equal(scan.valid, batch.valid[3])
    assert scan.stamp_ns == batch.stamps_ns[3]


def test_a_batch_ends():
    assert len(list(make_batch(4))) == 4


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("ranges", np.zeros((5, 37))),
        ("ranges", np.zeros((5, 36), np.float32)),
        ("ranges", [1.0, 2.0]),
        ("intensities", np.zeros((4, 37), np.float32)),
        ("labels", np.zeros((5, 37), np.int64)),
        ("poses", np.zeros((5, 2))),
        ("stamps_ns", np.zeros(5)),
    ],
)
def test_array_of_the_wrong_kind_is_named(field, value):
    with pytest.raises(InvalidInputError, match=f"{field}: expected"):
        replace(make_batch(), **{field: value})


@pytest.mark.parametrize("field", ["ranges", "intensities", "labels", "pose"])
def test_scan_of_the_wrong_shape_is_named(field):
    with pytest.raises(InvalidInputError, match=f"{field}: expected"):
        replace(make_batch()[0], **{field: np.zeros(2, np.float32)})
