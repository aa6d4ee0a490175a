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
    for mean in ("mIoU", "mCA", "mCA_tn"):
        figures = [each[mean] for each in results]
        assert said[mean] == {"mean": np.mean(figures), "std": np.std(figures)}
    figures = [each["Chair"]["ca"] for each in results]
    assert said["classes"]["Chair"]["ca"] == {"mean": np.mean(figures), "std": np.std(figures)}
    assert said["classes"]["Wall"]["iou"] is None
    assert spread(results[:1])["mCA"]["std"] == 0.0


def test_a_score_of_zero_counts_and_one_that_is_missing_does_not():
    results = [Evaluator().update([1, 2], guess).compute() for guess in ([1, 2], [2, 1], [1, 9])]
    classes = spread(results)["classes"]
    assert classes["Chair"]["iou"] == {"mean": np.mean([1, 0, 1]), "std": np.std([1, 0, 1])}
    assert classes["Wall"]["iou"] == {"mean": 0.0, "std": 0.0}
    assert classes["Wall"]["ca"] is None


@pytest.mark.parametrize(
    "name",
    ["dataset", "dataset_version", "scheme", "split", "lidars", "scans", "evaluator_version"],
)
def test_results_of_different_tasks_have_no_spread(name):
    with pytest.raises(InvalidInputError, match=f"^{name} is .* and 'other' in another"):
        spread_of_seeds([result(0), result(1, **{name: "other"})])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"metadata": {"method": "other"}}, "only results of one method .* semantic2d compare"),
        ({"metadata": {"method": "guess", "features": "RI"}}, "metadata.features is None"),
        ({"digests": {"predictions": "0"}}, "two of the files are the same"),
    ],
)
def test_only_several_seeds_of_one_method_have_a_spread(changes, message):
    with pytest.raises(InvalidInputError, match=message):
        spread_of_seeds([result(0), result(1, **changes)])


def test_trainings_may_differ_in_their_seeds_and_where_they_were_timed():
    timed = {"method": "guess", "seeds": [1], "hardware": "another", "scans_per_second": 3.0}
    assert spread_of_seeds([result(0), result(1, metadata=timed)])["count"] == 2
