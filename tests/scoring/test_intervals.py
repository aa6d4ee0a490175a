import numpy as np
import pytest

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, Taxonomy
from semantic2d_dataset.scoring.intervals import Blocks, compare_blocks, intervals
from semantic2d_dataset.scoring.metrics import Evaluator


def make_blocks(share_right, *, blocks=40, seed=0, points=500, classes=10):
    """Blocks whose truth depends on the seed 7 alone, and predictions that are often right."""
    truths = np.random.default_rng(7).integers(0, classes, (blocks, points))
    rng = np.random.default_rng(seed)
    matrices = []
    for truth in truths:
        right = rng.random(points) < share_right + rng.normal(0, 0.05)
        guess = np.where(right, truth, rng.integers(0, classes, points))
        matrices.append(Evaluator().update(truth, guess).confusion)
    windows = tuple(("hall--a", n) for n in range(blocks))
    return Blocks(windows, np.stack(matrices), SEMANTIC2D)


def miou(confusion):
    evaluator = Evaluator()
    evaluator.confusion = confusion
    return evaluator.compute()["mIoU"]


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
    whole = make_blocks(0.6, blocks=4000, points=60)
    true = miou(whole.confusion.sum(axis=0))
    held = 0
    for part in np.split(np.arange(4000), 80):
        blocks = Blocks(tuple(("r", n) for n in part), whole.confusion[part], SEMANTIC2D)
        low, high = intervals(blocks, draws=300)["mIoU"]
        held += low <= true <= high
    assert 0.85 <= held / 80 <= 1.0


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


def test_the_p_value_is_right_about_as_often_as_it_says():
    p = [
        compare_blocks(
            make_blocks(0.6, seed=n, blocks=25, points=80),
            make_blocks(0.6, seed=n + 500, blocks=25, points=80),
            draws=199,
        )["mIoU"]["p"]
        for n in range(80)
    ]
    assert 0.0 <= np.mean(np.array(p) <= 0.1) <= 0.2
    assert np.mean(np.array(p) <= 0.5) > 0.3


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
