from functools import reduce

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.metrics import confusion_matrix, jaccard_score, recall_score

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, Taxonomy
from semantic2d_dataset.scoring import metrics
from semantic2d_dataset.scoring.metrics import Evaluator, class_names, format_table, percent

CLASSES = len(SEMANTIC2D)
ALL = list(range(CLASSES))


@st.composite
def labelled(draw):
    """Truth with gaps, prediction, and valid or None; few classes at times, few points at times."""
    seed = draw(st.integers(0, 2**32 - 1))
    size = draw(st.sampled_from((0, 1, 7, 1081, 40_001)))
    pool = draw(st.lists(st.sampled_from(ALL), min_size=1, max_size=CLASSES, unique=True))
    rng = np.random.default_rng(seed)
    truth = rng.choice([*pool, 255] if draw(st.booleans()) else pool, size).astype(np.uint8)
    wrong = rng.random(size) < draw(st.sampled_from((0.0, 0.3, 1.0)))
    prediction = np.where(wrong | (truth == 255), rng.integers(0, CLASSES, size), truth)
    valid = rng.random(size) < 0.8 if draw(st.booleans()) else None
    return truth, prediction.astype(np.uint8), valid


def check_against_scikit_learn(case):
    truth, prediction, valid = case
    result = Evaluator().update(truth, prediction, valid).compute()
    scored = (truth != 255) & (True if valid is None else valid)
    t, p = truth[scored], prediction[scored]
    assert result["points"] == t.size
    assert result["ignored"] == truth.size - t.size
    if t.size == 0:
        assert np.sum(result["confusion"]) == 0
        assert result["mIoU"] is result["mCA"] is result["Chair"]["iou"] is None
        return
    assert (np.array(result["confusion"]) == confusion_matrix(t, p, labels=ALL)).all()
    iou = jaccard_score(t, p, labels=ALL, average=None, zero_division=0)
    recall = recall_score(t, p, labels=ALL, average=None, zero_division=0)
    for c, name in enumerate(SEMANTIC2D.names):
        in_truth, in_prediction = (t == c).any(), (p == c).any()
        assert result[name]["iou"] == (iou[c] if in_truth or in_prediction else None)
        assert result[name]["ca"] == (recall[c] if in_truth else None)
        assert result[name]["support"] == (t == c).sum()
    there = {"mIoU": np.union1d(t, p), "mCA": np.unique(t)}
    for mean, figures in (("mIoU", iou), ("mCA", recall)):
        averaged = there[mean][there[mean] > 0]  # as average="macro" of those classes
        assert result[mean] == (np.average(figures[averaged]) if averaged.size else None)
        assert result["classes_averaged"][mean] == averaged.size


@settings(deadline=None)
@given(labelled())
def test_counts_and_scores_are_those_of_scikit_learn(case):
    check_against_scikit_learn(case)


@pytest.mark.long
@settings(deadline=None, max_examples=1000)
@given(labelled())
def test_a_thousand_scores_are_those_of_scikit_learn(case):
    check_against_scikit_learn(case)


@settings(deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from((0, 1, 2, 3, 1000, 16_384, 16_385, 33_333)),
    st.integers(2, metrics._MOST_PACKED),
    st.booleans(),
)
def test_both_ways_to_count_agree_on_any_bytes(seed, size, classes, masked):
    rng = np.random.default_rng(seed)
    truth, prediction = rng.choice([*range(18), 254, 255], (2, size)).astype(np.uint8)
    valid = rng.random(size) < 0.7 if masked else None
    packed = metrics._count_packed(truth, prediction, valid, classes)
    plain = metrics._count_any(truth, prediction, valid, classes)
    assert (packed[0] == plain[0]).all()
    assert packed[1] == plain[1]


def test_means_are_the_macro_averages_of_scikit_learn_to_the_last_digit():
    rng = np.random.default_rng(0)
    for _ in range(25):
        truth = rng.integers(0, CLASSES, 300)
        guess = np.where(rng.random(300) < 0.3, rng.integers(0, CLASSES, 300), truth)
        result = Evaluator().update(truth, guess).compute()
        for mean, score in (("mIoU", jaccard_score), ("mCA", recall_score)):
            assert result[mean] == score(truth, guess, labels=ALL[1:], average="macro")


@settings(deadline=None)
@given(labelled())
def test_means_are_over_the_scored_classes_that_have_the_figure(case):
    result = Evaluator().update(*case).compute()
    for mean, key in (("mIoU", "iou"), ("mCA", "ca"), ("mCA_tn", "ca_tn")):
        figures = [result[name][key] for name in SEMANTIC2D.names[1:]]
        present = [figure for figure in figures if figure is not None]
        assert result["classes_averaged"][mean] == len(present)
        assert result[mean] == (pytest.approx(np.mean(present)) if present else None)


@settings(deadline=None)
@given(labelled())
def test_ca_tn_is_the_equation_of_the_paper(case):
    result = Evaluator().update(*case).compute()
    matrix = np.array(result["confusion"])
    for c, name in enumerate(SEMANTIC2D.names):
        tp = matrix[c, c]
        fn, fp = matrix[c].sum() - tp, matrix[:, c].sum() - tp
        tn = matrix.sum() - tp - fn - fp
        expected = (tp + tn) / (tp + fp + fn + tn) if tp + fn else None
        assert result[name]["ca_tn"] == expected


@settings(deadline=None, max_examples=30)
@given(st.lists(labelled(), min_size=2, max_size=5), st.randoms(use_true_random=False))
def test_neither_order_nor_grouping_changes_anything(cases, random):
    one = Evaluator()
    for case in cases:
        one.update(*case)
    random.shuffle(cases)
    left = reduce(Evaluator.merge, [Evaluator().update(*case) for case in cases])
    right = reduce(lambda a, b: b.merge(a), [Evaluator().update(*case) for case in cases])
    assert one.compute() == left.compute() == right.compute()


def test_perfect_predictions_score_exactly_one():
    truth = np.random.default_rng(0).integers(0, CLASSES, 9_999)
    result = Evaluator().update(truth, truth).compute()
    assert result["mIoU"] == result["mCA"] == result["mCA_tn"] == 1.0
    assert all(result[name]["iou"] == 1.0 for name in SEMANTIC2D.names)


def test_other_is_shown_and_never_averaged():
    result = Evaluator().update([0, 0, 1], [1, 1, 1]).compute()
    assert result["Other"] == {"iou": 0.0, "ca": 0.0, "ca_tn": pytest.approx(1 / 3), "support": 2}
    assert result["mIoU"] == result["Chair"]["iou"] == 1 / 3
    assert result["classes_averaged"] == {"mIoU": 1, "mCA": 1, "mCA_tn": 1}


def test_a_class_that_only_the_prediction_holds_has_an_iou_of_zero_and_no_ca():
    result = Evaluator().update([1, 1], [1, 9]).compute()
    assert result["Wall"] == {"iou": 0.0, "ca": None, "ca_tn": None, "support": 0}
    assert result["Door"] == {"iou": None, "ca": None, "ca_tn": None, "support": 0}
    assert result["mIoU"] == 0.25
    assert result["mCA"] == 0.5
    assert result["classes_averaged"] == {"mIoU": 2, "mCA": 1, "mCA_tn": 1}


def test_nothing_to_average_gives_none():
    result = Evaluator().compute()
    assert (result["mIoU"], result["mCA"], result["mCA_tn"]) == (None, None, None)
    assert (result["points"], result["ignored"]) == (0, 0)


def test_points_without_label_or_return_are_counted_as_ignored_whatever_they_hold():
    truth = np.array([1, 255, 77, 2], np.uint8)
    prediction = np.array([1, 99, 3, 200], np.uint8)
    valid = np.array([True, True, False, False])
    result = Evaluator().update(truth, prediction, valid).compute()
    assert (result["points"], result["ignored"]) == (1, 3)
    as_i8 = (truth.astype(np.int64) - 256 * ~valid, prediction.astype(np.int64) - 512 * ~valid)
    assert Evaluator().update(*as_i8, valid).compute() == result


def test_result_has_the_promised_keys_and_survives_json():
    result = Evaluator().update([1], [1]).compute()
    assert set(result) == {
        *("mIoU", "mCA", "mCA_tn", "confusion", "points", "ignored", "classes_averaged"),
        *SEMANTIC2D.names,
    }
    assert class_names(result) == SEMANTIC2D.names
    assert np.shape(result["confusion"]) == (10, 10)


@pytest.mark.parametrize("dtype", [np.int8, np.uint16, np.int32, np.int64, np.uint64])
def test_every_integer_dtype_counts_alike(dtype):
    rng = np.random.default_rng(1)
    truth, prediction = rng.integers(0, CLASSES, (2, 30, 40))
    expected = Evaluator().update(truth.astype(np.uint8), prediction.astype(np.uint8)).compute()
    assert Evaluator().update(truth.astype(dtype), prediction.astype(dtype)).compute() == expected


@pytest.mark.parametrize("few", [0, 1 << 30])
def test_many_chunks_and_strided_arrays_count_every_point(monkeypatch, few):
    monkeypatch.setattr(metrics, "_CHUNK", 1_001)
    monkeypatch.setattr(metrics, "_FEW", few)
    rng = np.random.default_rng(2)
    truth, prediction = rng.integers(0, CLASSES, (2, 101, 111)).astype(np.uint8)
    valid = rng.random((101, 111)) < 0.5
    result = Evaluator().update(truth[:, ::2], prediction[:, ::2], valid[:, ::2]).compute()
    kept = valid[:, ::2]
    expected = confusion_matrix(truth[:, ::2][kept], prediction[:, ::2][kept], labels=ALL)
    assert (np.array(result["confusion"]) == expected).all()
    assert result["ignored"] == (~kept).sum()


@pytest.mark.parametrize("classes", [2, 14, 15, 16, 17, 255])
def test_taxonomies_of_other_sizes_use_every_id(classes, monkeypatch):
    monkeypatch.setattr(metrics, "_FEW", 0)
    names = tuple(f"class {c}" for c in range(classes))
    taxonomy = Taxonomy(names, ((1, 2, 3),) * classes)
    ids = np.arange(classes, dtype=np.uint8)
    result = Evaluator(taxonomy).update(ids, ids[::-1].copy()).compute()
    assert (np.array(result["confusion"]) == np.eye(classes)[::-1]).all()
    with pytest.raises(InvalidInputError, match=r"prediction\[0\]: .*found 255"):
        Evaluator(taxonomy).update(ids, np.full(classes, 255, np.uint8))


@pytest.mark.parametrize("dtype", [np.uint8, np.int32])
@pytest.mark.parametrize("value", [10, 14, 15, 16, 100, 254])
@pytest.mark.parametrize("few", [0, 1 << 30])
def test_ids_that_are_no_class_are_refused_with_their_position(value, dtype, few, monkeypatch):
    monkeypatch.setattr(metrics, "_FEW", few)
    good = np.ones((2, 3), dtype)
    bad = good.copy()
    bad[1, 2] = value
    evaluator = Evaluator()
    with pytest.raises(InvalidInputError, match=rf"truth\[1, 2\]: .*found {value}"):
        evaluator.update(bad, good)
    with pytest.raises(InvalidInputError, match=rf"prediction\[1, 2\]: .*found {value}"):
        evaluator.update(good, bad)
    assert evaluator.compute()["points"] == 0


def test_unlabelled_is_no_prediction():
    with pytest.raises(InvalidInputError, match=r"prediction\[0\]: .*found 255"):
        Evaluator().update(np.uint8([1]), np.uint8([255]))


@pytest.mark.parametrize("value", [-1, 256, 266, 2**40])
def test_ids_beyond_a_byte_are_refused_and_never_wrapped(value):
    for truth, prediction in (([value], [1]), ([1], [value])):
        with pytest.raises(InvalidInputError, match=f"found {value}"):
            Evaluator().update(truth, prediction)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([1.0], [1]), "truth: expected integer class ids, found float64"),
        (([1], [True]), "prediction: expected integer class ids, found bool"),
        (([1], ["a"]), "prediction: expected integer"),
        (([1, 2], [1]), r"truth \(2,\), prediction \(1,\)"),
        (([[1, 2]], [1, 2]), "one shape"),
        (([1, 2], [1, 2], [True]), r"valid \(1,\)"),
        (([1, 2], [1, 2], [1, 0]), "valid: expected bool, found int64"),
    ],
)
def test_shapes_and_dtypes_that_do_not_fit_are_refused(arguments, message):
    with pytest.raises(InvalidInputError, match=message):
        Evaluator().update(*map(np.array, arguments))


def test_torch_tensors_on_the_cpu_are_accepted():
    torch = pytest.importorskip("torch")
    truth, prediction = torch.tensor([1, 255, 2]), torch.tensor([1, 1, 3])
    result = Evaluator().update(truth, prediction, torch.tensor([True, True, False])).compute()
    assert (result["points"], result["ignored"], result["mIoU"]) == (1, 2, 1.0)


def test_scores_of_different_taxonomies_do_not_merge():
    other = Taxonomy(("a", "b"), ((0, 0, 0), (1, 1, 1)))
    with pytest.raises(InvalidInputError, match="different taxonomies"):
        Evaluator().merge(Evaluator(other))


def test_a_class_cannot_hide_a_key_of_the_result():
    taken = Taxonomy(("Other", "points"), ((0, 0, 0), (1, 1, 1)))
    with pytest.raises(InvalidInputError, match="no class can be called points"):
        Evaluator(taken)


def test_table_shows_every_class_in_percent_and_what_was_left_out():
    table = format_table(Evaluator().update([1, 1, 9, 255], [1, 9, 9, 9]).compute())
    lines = table.splitlines()
    assert lines[2].split() == ["Chair", "50.00", "50.00", "66.67", "2"]
    assert lines[3].split() == ["Door", "-", "-", "-", "0"]
    assert lines[11].split() == ["Mean", "50.00", "75.00", "66.67", "3"]
    assert "mIoU 2, mCA 2, mCA_tn 2; the background never is" in table
    assert "Not scored (no return or no label): 1 points" in table
    assert len({len(line) for line in lines[:12]}) == 1


def test_percent_of_nothing_is_a_dash():
    assert (percent(None), percent(1.0)) == ("-", "100.00")
