import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.metrics import confusion_matrix

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.geometry import incidence_angles
from semantic2d_dataset.scene.lidars import LidarSpec
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, Taxonomy
from semantic2d_dataset.scoring.conditions import (
    BANDS,
    count_conditions,
    describe_bands,
    summarise,
)
from semantic2d_dataset.scoring.metrics import Evaluator

LIDAR = LidarSpec("test", "Test 1", 41, -1.0, 0.05, 0.1, 20.0)
PERSON = SEMANTIC2D.id_of("Person")


def make_scans(seed, scans=9):
    rng = np.random.default_rng(seed)
    shape = (scans, LIDAR.beams)
    smooth = np.cumsum(rng.normal(0, 0.2, shape), axis=1) + rng.uniform(0, 20, (scans, 1))
    ranges = smooth.astype(np.float32)
    ranges[rng.random(shape) < 0.1] = rng.choice((np.inf, np.nan, -np.inf, 0.0))
    truth = np.repeat(rng.integers(0, 10, (scans, 9)), 5, axis=1)[:, : LIDAR.beams]
    truth[rng.random(shape) < 0.05] = 255
    return truth.astype(np.uint8), rng.integers(0, 10, shape).astype(np.uint8), ranges


def plain_bands(truth, ranges):
    """Band labels (N, B) by condition, spelled out beam by beam."""
    valid = LIDAR.has_return(ranges)
    label = np.where(valid, truth, 255)
    r = np.where(valid, ranges, 0)
    degrees = np.rad2deg(incidence_angles(r, LIDAR.angle_increment))
    following = np.concatenate((r[:, 1:], r[:, -2:-1]), axis=1)
    border = np.zeros(truth.shape, bool)
    for n, k in np.ndindex(truth.shape):
        near = label[n, max(0, k - 2) : k + 3]
        border[n, k] = any(other not in (255, label[n, k]) for other in near)
    cut = np.stack(
        [
            pd.cut(row, (0, 1, 2, 4, 8, 16, 99), right=False, labels=BANDS["range_m"]).astype(str)
            for row in r
        ]
    )
    steep = np.stack(
        [
            pd.cut(row, (0, 30, 60, 75, 91), right=False, labels=BANDS["incidence_deg"][:4])
            for row in degrees
        ]
    )
    people = (label == PERSON).any(axis=1, keepdims=True) & np.ones_like(valid)
    return {
        "range_m": cut,
        "incidence_deg": np.where(following > 0, steep, "unknown"),
        "border": np.where(border, "border", "inside"),
        "people": np.where(people, "in the scan", "none in the scan"),
        "motion": np.where(truth == PERSON, "moving", "static"),
    }


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1))
def test_every_band_is_the_confusion_matrix_of_its_points(seed):
    truth, prediction, ranges = make_scans(seed)
    scored = LIDAR.has_return(ranges) & (truth != 255)
    found = count_conditions(truth, prediction, ranges, LIDAR, SEMANTIC2D)
    for name, bands in plain_bands(truth, ranges).items():
        for band, counts in zip(BANDS[name], found[name], strict=True):
            inside = scored & (bands == band)
            if inside.any():
                expected = confusion_matrix(truth[inside], prediction[inside], labels=range(10))
                assert (counts == expected).all(), (name, band)
            else:
                assert not counts.any()


def test_bands_of_a_condition_add_up_to_all_scored_points():
    truth, prediction, ranges = make_scans(1, 300)
    total = Evaluator().update(truth, prediction, LIDAR.has_return(ranges)).confusion
    for counts in count_conditions(truth, prediction, ranges, LIDAR, SEMANTIC2D).values():
        assert (counts.sum(axis=0) == total).all()


def test_conditions_are_described_without_empty_bands_and_as_the_evaluator_scores_them():
    truth, prediction, ranges = make_scans(2)
    ranges[:] = 3.0
    counts = count_conditions(truth, prediction, ranges, LIDAR, SEMANTIC2D)
    said = describe_bands(counts, SEMANTIC2D)
    assert set(said["range_m"]) == {"2-4"}
    result = Evaluator().update(truth, prediction).compute()
    band = said["range_m"]["2-4"]
    assert band == summarise(counts["range_m"][2], SEMANTIC2D)
    assert (band["mIoU"], band["points"]) == (result["mIoU"], result["points"])
    assert band["iou"] == {name: result[name]["iou"] for name in SEMANTIC2D.names}


def test_classes_without_people_have_nothing_that_moves():
    two = Taxonomy(("Other", "Wall"), ((0, 0, 0), (1, 1, 1)))
    truth = np.ones((1, LIDAR.beams), np.uint8)
    counts = count_conditions(truth, truth, np.full(truth.shape, 2, np.float32), LIDAR, two)
    assert counts["motion"][0].sum() == counts["people"][0].sum() == LIDAR.beams


@pytest.mark.parametrize("at", ["truth", "prediction"])
def test_ids_that_are_no_class_are_refused(at):
    arrays = dict(zip(("truth", "prediction"), np.ones((2, 3, LIDAR.beams), np.uint8), strict=True))
    arrays[at][1, 2] = 10
    with pytest.raises(InvalidInputError, match="class ids 0 to 9 at scored points"):
        count_conditions(
            **arrays,
            ranges=np.full((3, LIDAR.beams), 2, np.float32),
            lidar=LIDAR,
            taxonomy=SEMANTIC2D,
        )


def test_shapes_that_do_not_fit_are_refused():
    truth, prediction, ranges = make_scans(0)
    with pytest.raises(InvalidInputError, match="prediction: expected uint8"):
        count_conditions(truth, prediction[:-1], ranges, LIDAR, SEMANTIC2D)
