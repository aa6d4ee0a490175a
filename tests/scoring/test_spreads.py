import numpy as np
import pytest

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scoring.metrics import Evaluator
from semantic2d_dataset.scoring.spreads import spread, spread_of_seeds

TRUTH = np.random.default_rng(0).integers(0, 9, 500)  # no walls


def result(seed, **changes):
    rng = np.random.default_rng(seed)
    guess = np.where(rng.random(500) < 0.5, TRUTH, rng.integers(0, 9, 500))
    said = {
        "dataset": "toy",
        "dataset_version": "1.0.0",
        "scheme": "block",
        "split": "test",
        "lidars": ["near"],
        "scans": 5,
        "metadata": {"method": "guess"},
        "digests": {"predictions": str(seed)},
        "evaluator_version": "1.0",
    }
    return Evaluator().update(TRUTH, guess).compute() | {"submission": said | changes}


def test_a_spread_is_mean_and_standard_deviation_of_every_score():
    results = [result(seed) for seed in range(4)]
    said = spread_of_seeds(results)
    assert said["count"] == 4
    figures = [each["mIoU"] for each in results]
    assert said["mIoU"] == {"mean": np.mean(figures), "std": np.std(figures)}
    figures = [each["Chair"]["ca"] for each in results]
    assert said["classes"]["Chair"]["ca"] == {"mean": np.mean(figures), "std": np.std(figures)}
    assert said["classes"]["Wall"]["iou"] is None
    assert spread(results[:1])["mCA"]["std"] == 0.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"split": "val"}, "split is 'test' in one file and 'val' in another"),
        ({"metadata": {"method": "other"}}, "semantic2d compare"),
        ({"digests": {"predictions": "0"}}, "two of the files are the same"),
    ],
)
def test_only_several_seeds_of_one_method_and_task_have_a_spread(changes, message):
    with pytest.raises(InvalidInputError, match=message):
        spread_of_seeds([result(0), result(1, **changes)])
