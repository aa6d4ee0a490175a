import math

import numpy as np
import pytest

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.lidars import LidarSpec
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, Taxonomy
from semantic2d_dataset.scoring.conditions import (
    BANDS,
    count_conditions,
    describe_bands,
    figure_of,
    summarise,
)
from semantic2d_dataset.scoring.metrics import Evaluator

LIDAR = LidarSpec("test", "Test 1", 41, -1.0, 0.05, 0.1, 20.0)
FROM_ZERO = LidarSpec("zero", "Test 2", 41, -1.0, 0.05, 0.0, 20.0)
PERSON = SEMANTIC2D.id_of("Person")
LIMITS = np.float32((0.1, 1, 2, 4, 8, 16, 20))  # of the lidar and of the bands


def make_scans(seed, scans=9):
    rng = np.random.default_rng(seed)
    shape = (scans, LIDAR.beams)
    smooth = np.cumsum(rng.normal(0, 0.2, shape), axis=1) + rng.uniform(0, 20, (scans, 1))
    limits = np.concatenate([np.nextafter(LIMITS, np.float32(side)) for side in (-1, 99)])
    exact = rng.choice([*LIMITS, *limits, np.inf, np.nan, -np.inf, 0.0], shape)
    ranges = np.where(rng.random(shape) < 0.2, exact, smooth).astype(np.float32)
    truth = np.repeat(rng.integers(0, 10, (scans, 9)), 5, axis=1)[:, : LIDAR.beams]
    truth[rng.random(shape) < 0.05] = 255
    return truth.astype(np.uint8), rng.integers(0, 10, shape).astype(np.uint8), ranges


def plain_range(r):
    name = "0-1"
    for low, band in ((1, "1-2"), (2, "2-4"), (4, "4-8"), (8, "8-16"), (16, "16+")):
        name = band if r >= low else name
    return name


def plain_incidence(r, following):
    """Band of the angle between a beam and the normal of the segment to the next endpoint."""
    if following is None:
        return "unknown"
    x = following * math.cos(LIDAR.angle_increment) - r
    y = following * math.sin(LIDAR.angle_increment)
    degrees = abs(90 - math.degrees(math.atan2(y, x)))
    return next(f"{a}-{b}" for a, b in ((0, 30), (30, 60), (60, 75), (75, 90)) if degrees <= b)


def plain_bands(truth, ranges, lidar):
    """Band labels (N, B) by condition, in plain words, beam by beam; "" where none is scored."""
    found = {name: np.full(truth.shape, "", object) for name in BANDS}
    for n, (labels, measured) in enumerate(zip(truth.tolist(), ranges.tolist(), strict=True)):
        r = [x if x > 0 and lidar.range_min <= x < 20 else None for x in measured]
        seen = [255 if x is None else t for t, x in zip(labels, r, strict=True)]
        for k, own in enumerate(seen):
            if own == 255:
                continue
            near = {*seen[max(0, k - 2) : k + 3]} - {own, 255}
            following = r[k + 1] if k + 1 < len(r) else r[k - 1]
            found["range_m"][n, k] = plain_range(r[k])
            found["incidence_deg"][n, k] = plain_incidence(r[k], following)
            found["border"][n, k] = "border" if near else "inside"
            found["people"][n, k] = "in the scan" if PERSON in seen else "none in the scan"
            found["motion"][n, k] = "moving" if own == PERSON else "static"
    return found


@pytest.mark.parametrize("lidar", [LIDAR, FROM_ZERO], ids=lambda lidar: lidar.name)
@pytest.mark.parametrize("seed", range(10))
def test_every_band_is_the_confusion_matrix_of_its_points(seed, lidar):
    truth, prediction, ranges = make_scans(seed)
    found = count_conditions(truth, prediction, ranges, lidar, SEMANTIC2D)
    for name, bands in plain_bands(truth, ranges, lidar).items():
        for band, counts in zip(BANDS[name], found[name], strict=True):
            expected = np.zeros((10, 10), int)
            np.add.at(expected, (truth[bands == band], prediction[bands == band]), 1)
            assert (counts == expected).all(), (name, band)


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


def test_bands_that_are_chosen_by_true_class_are_told_apart_by_their_accuracy():
    assert {name: figure_of(name) for name in BANDS if name != "motion"} == dict.fromkeys(
        ("people", "range_m", "incidence_deg", "border"), "mIoU"
    )
    assert figure_of("motion") == "mCA"


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
