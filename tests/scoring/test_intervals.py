import numpy as np
import pytest

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, Taxonomy
from semantic2d_dataset.scoring.intervals import Blocks, compare_blocks, intervals
from semantic2d_dataset.scoring.metrics import Evaluator


def make_blocks(share_right, *, blocks=40, seed=0, points=500, classes=10):
    """Blocks whose truth depends on the seed 7 alone, and predictions that are often right."""
    shape = (blocks, points)
    truth = np.random.default_rng(7).integers(0, classes, shape)
    rng = np.random.default_rng(seed)
    right = rng.random(shape) < share_right + rng.normal(0, 0.05, (blocks, 1))
    guess = np.where(right, truth, rng.integers(0, classes, shape))
    keys = (np.arange(blocks)[:, None] * 10 + truth) * 10 + guess
    confusion = np.bincount(keys.ravel(), minlength=100 * blocks).reshape(blocks, 10, 10)
    return Blocks(tuple(("hall--a", n) for n in range(blocks)), confusion, SEMANTIC2D)


def scores_of(confusion):
    evaluator = Evaluator()
    evaluator.confusion = confusion
    return evaluator.compute()


def miou(confusion):
    return scores_of(confusion)["mIoU"]


def test_an_interval_is_that_of_scores_of_resampled_blocks():
    blocks = make_blocks(0.6)
    said = intervals(blocks, draws=400, seed=3)
    rng = np.random.default_rng(3)
    weights = rng.multinomial(40, np.full(40, 1 / 40), 400)
    drawn = [miou((w[:, None, None] * blocks.confusion).sum(axis=0)) for w in weights]
    assert said["mIoU"] == pytest.approx(np.quantile(drawn, (0.025, 0.975)).tolist(), abs=1e-12)
    assert said["mIoU"][0] < miou(blocks.confusion.sum(axis=0)) < said["mIoU"][1]
    assert (said["draws"], said["blocks"], said["block_s"]) == (400, 40, 10.0)
    assert list(said["classes"]) == list(SEMANTIC2D.names)
    assert intervals(blocks, draws=400, seed=3) == said


def test_intervals_hold_the_truth_about_as_often_as_they_say():
    whole = make_blocks(0.6, blocks=6000, points=60)
    true = {name: scores_of(whole.confusion.sum(axis=0))[name] for name in ("mIoU", "mCA")}
    held = dict.fromkeys(true, 0)
    for part in np.split(np.arange(6000), 100):
        blocks = Blocks(tuple(("r", n) for n in part), whole.confusion[part], SEMANTIC2D)
        said = intervals(blocks, draws=200)
        for name, value in true.items():
            held[name] += said[name][0] <= value <= said[name][1]
    assert all(90 <= count <= 99 for count in held.values()), held


def test_one_block_has_no_interval_and_an_absent_class_neither():
    alone = make_blocks(0.6, blocks=1)
    assert intervals(alone)["mIoU"] is None
    few = make_blocks(0.6, classes=3)
    few.confusion[:, :, 5:] = 0
    few.confusion[:, 5:] = 0
    assert intervals(few)["classes"]["Wall"] is None


def test_a_better_submission_is_told_from_a_worse_one_and_alike_ones_are_not():
    worse, better = make_blocks(0.55, seed=1), make_blocks(0.65, seed=2)
    said = compare_blocks(worse, better, draws=500)["mIoU"]
    assert said["difference"] == said["b"] - said["a"] > 0
    assert said["interval"][0] > 0
    assert said["p"] == 1 / 501
    alike = compare_blocks(worse, make_blocks(0.55, seed=3), draws=500)["mIoU"]
    assert alike["interval"][0] < 0 < alike["interval"][1]
    assert alike["p"] > 0.05
    same = compare_blocks(worse, worse, draws=500)["mIoU"]
    assert (same["difference"], same["interval"], same["p"]) == (0.0, [0.0, 0.0], 1.0)


def differences(one, other):
    first, second = (scores_of(blocks.sum(axis=0)) for blocks in (one, other))
    return {
        "mIoU": second["mIoU"] - first["mIoU"],
        "mCA": second["mCA"] - first["mCA"],
        "Other": second["Other"]["iou"] - first["Other"]["iou"],
    }


def test_a_comparison_is_that_of_resampled_and_of_swapped_blocks():
    blocks_a, blocks_b = make_blocks(0.57, seed=1, blocks=12), make_blocks(0.6, seed=2, blocks=12)
    a, b = blocks_a.confusion, blocks_b.confusion
    weights = np.random.default_rng(5).multinomial(12, np.full(12, 1 / 12), 300)[..., None, None]
    swaps = np.random.default_rng((5, 1)).integers(0, 2, (300, 12))[..., None, None] == 1
    found = differences(a, b)
    drawn = [differences(w * a, w * b) for w in weights]
    swapped = [differences(np.where(s, b, a), np.where(s, a, b)) for s in swaps]
    said = compare_blocks(blocks_a, blocks_b, draws=300, seed=5)
    for name, row in (said | said["classes"]).items():
        if name in found:
            assert row["difference"] == pytest.approx(found[name], abs=1e-12)
            limits = np.quantile([each[name] for each in drawn], (0.025, 0.975))
            assert row["interval"] == pytest.approx(limits.tolist(), abs=1e-12)
            farther = sum(abs(each[name]) >= abs(found[name]) - 1e-12 for each in swapped)
            assert row["p"] == (1 + farther) / 301
            assert 1 < farther < 290  # so that it tells one from another


def test_p_values_are_spread_evenly_where_there_is_no_difference():
    p = [
        compare_blocks(
            make_blocks(0.6, seed=n, blocks=20, points=80),
            make_blocks(0.6, seed=n + 500, blocks=20, points=80),
            draws=99,
        )["mIoU"]["p"]
        for n in range(120)
    ]
    shares = {level: np.mean(np.array(p) <= level) for level in (0.1, 0.25, 0.5, 0.75, 0.9)}
    assert all(abs(share - level) < 0.1 for level, share in shares.items()), shares


def test_swapping_the_two_changes_the_sign_alone():
    a, b = make_blocks(0.5, seed=1), make_blocks(0.6, seed=2)
    there, back = (compare_blocks(*pair, draws=300) for pair in ((a, b), (b, a)))
    for name in ("mIoU", "mCA"):
        assert there[name]["difference"] == -back[name]["difference"]
        assert there[name]["interval"] == pytest.approx([-x for x in back[name]["interval"][::-1]])
        assert there[name]["p"] == back[name]["p"]


def test_submissions_for_other_scans_classes_or_labels_are_not_compared():
    blocks = make_blocks(0.6)
    two = Taxonomy(("Other", "Wall"), ((0, 0, 0), (1, 1, 1)))
    for other in (
        make_blocks(0.6, blocks=39),
        Blocks(blocks.windows, blocks.confusion[:, :2, :2], two),
    ):
        with pytest.raises(InvalidInputError, match="the same scans and classes"):
            compare_blocks(blocks, other)
    with pytest.raises(InvalidInputError, match="different labels"):
        compare_blocks(blocks, Blocks(blocks.windows, blocks.confusion[::-1], SEMANTIC2D))
