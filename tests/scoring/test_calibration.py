from functools import reduce

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, Taxonomy
from semantic2d_dataset.scoring.calibration import BINS, Calibration, are_probabilities

CLASSES = len(SEMANTIC2D)


def softmax(logits):
    powers = np.exp(logits - logits.max(-1, keepdims=True))
    return powers / powers.sum(-1, keepdims=True)


@st.composite
def predicted(draw):
    """Truth with gaps (N, B), probabilities (N, B, K) f2 or f4, and valid or None."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    shape = draw(st.sampled_from(((0, 5), (1, 1), (2, 7), (3, 361))))
    logits = rng.normal(0, draw(st.sampled_from((0.1, 2.0, 30.0))), (*shape, CLASSES))
    probabilities = softmax(logits).astype(draw(st.sampled_from((np.float16, np.float32))))
    guess = probabilities.argmax(-1)
    truth = np.where(rng.random(shape) < 0.6, guess, rng.integers(0, CLASSES, shape))
    truth[rng.random(shape) < 0.1] = 255
    valid = rng.random(shape) < 0.8 if draw(st.booleans()) else None
    return truth.astype(np.uint8), probabilities, valid


def plain_figures(truth, probabilities, valid):
    """What the definitions say, bin by bin."""
    counted = (truth != 255) & (True if valid is None else valid)
    p = probabilities[counted].astype(np.float64)
    hit = p.argmax(1) == truth[counted]
    confidence = p.max(1)
    terms = p * np.log(np.where(p > 0, p, 1))
    entropy = np.minimum(-terms.sum(1), np.log(CLASSES))
    return hit, confidence, entropy


@settings(deadline=None)
@given(predicted())
def test_figures_are_those_of_the_plain_definitions(case):
    hit, confidence, entropy = plain_figures(*case)
    result = Calibration().update(*case).compute()
    assert result["points"] == hit.size
    assert result["ignored"] == case[0].size - hit.size
    bins = np.minimum((confidence * BINS).astype(int), BINS - 1)
    gaps = []
    for i, row in enumerate(result["confidence_bins"]):
        chosen = bins == i
        assert row["points"] == chosen.sum()
        if chosen.any():
            assert row["accuracy"] == hit[chosen].mean()
            assert row["confidence"] == pytest.approx(confidence[chosen].mean(), abs=1e-8)
            gaps.append((chosen.sum(), abs(hit[chosen].mean() - confidence[chosen].mean())))
        else:
            assert row["accuracy"] is row["confidence"] is None
    for row in result["entropy_bins"]:  # sums are of the same points, whichever bin rounding chose
        last = row["high"] == result["entropy_bins"][-1]["high"]
        inside = (entropy >= row["low"] + 1e-9) & ((entropy < row["high"] - 1e-9) | last)
        assert row["points"] >= inside.sum()
        if row["points"] == inside.sum() > 0:
            assert row["error"] == pytest.approx(1 - hit[inside].mean())
            assert row["entropy"] == pytest.approx(entropy[inside].mean(), abs=1e-8)
    if hit.size:
        assert result["ece"] == pytest.approx(sum(n * g for n, g in gaps) / hit.size, abs=1e-8)
        assert result["mce"] == pytest.approx(max(g for _, g in gaps), abs=1e-8)
        assert result["accuracy"] == hit.mean()
        assert result["entropy"] == pytest.approx(entropy.mean(), abs=1e-8)
    else:
        assert result["ece"] is result["mce"] is result["aurc"] is result["accuracy"] is None


@settings(deadline=None, max_examples=30)
@given(st.lists(predicted(), min_size=2, max_size=5), st.randoms(use_true_random=False))
def test_neither_order_nor_grouping_changes_anything(cases, random):
    one = Calibration()
    for case in cases:
        one.update(*case)
    random.shuffle(cases)
    left = reduce(Calibration.merge, [Calibration().update(*case) for case in cases])
    right = reduce(lambda a, b: b.merge(a), [Calibration().update(*case) for case in cases])
    assert one.compute() == left.compute() == right.compute()


@settings(deadline=None)
@given(st.lists(st.integers(0, CLASSES - 1), min_size=1, max_size=50))
def test_certain_and_right_is_calibrated_to_zero(ids):
    truth = np.array([ids])
    result = Calibration().update(truth, np.eye(CLASSES, dtype=np.float16)[truth]).compute()
    assert result["ece"] == result["mce"] == result["aurc"] == result["entropy"] == 0
    assert result["accuracy"] == result["confidence"] == 1
    assert [row["points"] for row in result["confidence_bins"]] == [0] * (BINS - 1) + [len(ids)]


def test_certain_and_wrong_is_as_far_off_as_can_be():
    result = Calibration().update([[1, 2]], np.eye(CLASSES, dtype=np.float32)[[[3, 3]]]).compute()
    assert result["ece"] == result["mce"] == result["aurc"] == 1


def test_labels_drawn_from_the_probabilities_are_calibrated():
    rng = np.random.default_rng(0)
    probabilities = softmax(rng.normal(0, 2, (200, 1000, CLASSES))).astype(np.float32)
    drawn = (probabilities.cumsum(-1) < rng.random((200, 1000, 1))).sum(-1)
    result = Calibration().update(np.minimum(drawn, CLASSES - 1), probabilities).compute()
    assert result["ece"] < 0.005
    errors = [row["error"] for row in result["entropy_bins"] if row["points"] > 1000]
    assert errors == sorted(errors)


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_area_under_risk_is_the_mean_error_of_the_surest_points(seed):
    rng = np.random.default_rng(seed)
    probabilities = softmax(rng.normal(0, 2, (1, 20_000, CLASSES))).astype(np.float32)
    skilled = rng.random((1, 20_000)) < probabilities.max(-1)
    truth = np.where(skilled, probabilities.argmax(-1), probabilities.argmin(-1))
    hit, _, entropy = plain_figures(truth, probabilities, None)
    wrong = np.cumsum(~hit[np.argsort(entropy)])
    expected = (wrong / np.arange(1, hit.size + 1)).mean()
    result = Calibration().update(truth, probabilities).compute()
    assert result["aurc"] == pytest.approx(expected, abs=0.002)
    assert result["aurc"] < 1 - result["accuracy"]


GOOD = np.full((1, 2, CLASSES), 0.1, np.float32)


def changed(value):
    made = GOOD.copy()
    made[0, 1, 3] = value
    return made


@pytest.mark.parametrize(
    ("truth", "probabilities", "valid", "message"),
    [
        ([[0, 1]], changed(np.nan), None, r"probabilities\[0, 1\]: expected numbers from 0 to 1"),
        ([[0, 1]], changed(-0.1), None, r"probabilities\[0, 1\]"),
        ([[0, 1]], changed(1.5), None, r"probabilities\[0, 1\]"),
        ([[0, 1]], changed(0.0), None, "add up to 1"),
        ([[0, 1]], GOOD[:, :, :9], None, r"probabilities: expected floats of shape \(1, 2, 10\)"),
        ([[0, 1]], GOOD.astype(int), None, "probabilities: expected floats"),
        ([[0, 10]], GOOD, None, r"truth\[0, 1\]: expected a class id 0 to 9"),
        ([[0, -1]], GOOD, None, r"truth\[0, 1\]: .* found -1"),
        ([[0.0, 1.0]], GOOD, None, "truth: expected integer class ids"),
        ([[0, 1]], GOOD, [[True]], r"valid: expected bool of shape \(1, 2\)"),
        ([[0, 1]], GOOD, [[1, 0]], "valid: expected bool"),
    ],
)
def test_what_cannot_be_counted_is_refused_and_leaves_nothing(
    truth, probabilities, valid, message: str
):
    calibration = Calibration()
    with pytest.raises(InvalidInputError, match=message):
        calibration.update(truth, probabilities, valid)
    assert calibration.compute() == Calibration().compute()


@pytest.mark.parametrize(
    ("row", "good"),
    [
        ([0.5, 0.485], True),  # rounding of half precision
        ([0.5, 0.475], False),
        ([0.5, 0.515], True),
        ([0.5, 0.525], False),
        ([1.0, 0.0], True),
        ([1.01, 0.0], False),
        ([1.01, -0.01], False),
        ([np.nan, 1.0], False),
        ([np.inf, 0.0], False),
    ],
)
def test_the_validator_and_the_evaluator_take_the_same_rows_for_probabilities(row, good):
    rows = np.zeros((1, 2, CLASSES), np.float32)
    rows[0] = [[*row, *[0.0] * (CLASSES - 2)], np.eye(CLASSES)[3]]
    assert are_probabilities(rows).tolist() == [[good, True]]
    if good:
        Calibration().update([[0, 3]], rows)
    else:
        with pytest.raises(InvalidInputError, match=r"probabilities\[0, 0\]"):
            Calibration().update([[0, 3]], rows)


def test_bins_are_fifteen_of_equal_width_and_a_value_between_two_is_of_the_upper():
    result = Calibration().compute()
    assert BINS == len(result["confidence_bins"]) == len(result["entropy_bins"]) == 15
    lows = [row["low"] for row in result["entropy_bins"]]
    assert lows == pytest.approx(np.arange(15) * np.log(CLASSES) / 15)
    halves = np.zeros((1, 1, CLASSES), np.float32)
    halves[..., :2] = 0.5
    result = Calibration(bins=2).update([[0]], halves).compute()
    assert [row["points"] for row in result["confidence_bins"]] == [0, 1]


def test_no_rounding_gives_more_entropy_than_there_can_be():
    rounded = np.full((1, 1, CLASSES), 0.1015, np.float32)
    result = Calibration().update([[0]], rounded).compute()
    assert result["entropy"] == pytest.approx(np.log(CLASSES), abs=1e-8)
    assert result["entropy_bins"][-1]["points"] == 1


def test_probabilities_of_points_that_are_not_counted_may_be_anything():
    result = Calibration().update([[0, 255]], changed(np.nan)).compute()
    assert (result["points"], result["ignored"]) == (1, 1)
    result = Calibration().update([[0, 77]], changed(np.nan), [[True, False]]).compute()
    assert (result["points"], result["ignored"]) == (1, 1)


def test_different_classes_or_bins_are_never_merged():
    for other in (Calibration(Taxonomy(("A", "B"), ((0, 0, 0), (1, 1, 1)))), Calibration(bins=3)):
        with pytest.raises(InvalidInputError, match="cannot merge"):
            Calibration().merge(other)
    with pytest.raises(InvalidInputError, match="bins: expected at least 1"):
        Calibration(bins=0)
