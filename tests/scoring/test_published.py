from dataclasses import FrozenInstanceError
from itertools import combinations
from statistics import fmean

import pytest

from semantic2d_dataset.scene.taxonomy import SEMANTIC2D
from semantic2d_dataset.scoring.published import ALL, METRICS, published_segmentation

TABLE = published_segmentation()
CLASSES = {SEMANTIC2D.names[c] for c in SEMANTIC2D.scored_ids}
ROUNDED = 0.005 + 0.005  # percent: the mean of printed classes, and the printed mean
SLIPS = {("RIP", "CA"): (36.40, 36.39), ("IPA", "CA"): (37.20, 37.22)}
"""Means in percent, printed and of the printed classes, that rounding does not explain."""


def test_every_printed_mean_but_two_is_that_of_the_printed_classes():
    wrong = {}
    for row in TABLE.rows:
        for metric in METRICS:
            means = {name: 100 * mean for name, (mean, _) in row.figures[metric].items()}
            printed, found = means.pop(ALL), fmean(means.values())
            if abs(printed - found) > ROUNDED + 1e-9:
                wrong[row.features, metric] = (pytest.approx(printed), round(found, 2))
    assert wrong == SLIPS


def test_the_table_has_two_detectors_and_every_combination_of_features():
    combinations_of_features = ["".join(c) for n in range(1, 5) for c in combinations("RIPA", n)]
    assert [row.features for row in TABLE.rows] == [None, None, *combinations_of_features]
    assert [row.method for row in TABLE.rows[:2]] == ["Line extraction", "Leg detection"]
    assert {row.method for row in TABLE.rows[2:]} == {"S3-Net"}


def test_networks_have_all_classes_and_a_spread_and_detectors_only_their_own_and_none():
    for row in TABLE.rows:
        for metric in METRICS:
            figures = row.figures[metric]
            assert set(figures) - {ALL} <= CLASSES
            assert (set(figures) == CLASSES | {ALL}) == (row.features is not None)
            assert {std is None for _, std in figures.values()} == {row.features is None}
            assert all(0 < mean < 1 for mean, _ in figures.values())


def test_no_class_has_less_accuracy_than_iou():
    for row in TABLE.rows:
        for name, (iou, _) in row.figures["IoU"].items():
            assert row.figures["CA"][name][0] >= iou


def test_a_row_is_found_by_method_and_features_and_cannot_be_changed():
    best = TABLE.find("S3-Net", "RIA")
    assert best is max(TABLE.rows, key=lambda row: row.figures["IoU"][ALL])
    assert best.frames_per_second == 270.32
    assert best.figures["CA"]["Trash bin"] == (0.6333, 0.0136)
    assert TABLE.find("Leg detection").figures["IoU"] == {
        ALL: (0.0295, None),
        "Person": (0.0295, None),
    }
    assert TABLE.find("S3-Net") is None
    with pytest.raises(FrozenInstanceError):
        best.method = "Ours"
