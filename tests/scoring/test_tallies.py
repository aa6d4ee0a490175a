import numpy as np
import pytest

from semantic2d_dataset.access.registry import open_dataset
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.executors import Processes
from semantic2d_dataset.scoring import tallies
from semantic2d_dataset.scoring.calibration import Calibration
from semantic2d_dataset.scoring.metrics import Evaluator
from semantic2d_dataset.scoring.submission import (
    count_predictions,
    result_to_json,
    score_predictions,
)
from tests.scoring.guesses import SAMPLES, guesses, write_guesses


@pytest.fixture(scope="module")
def data(dataset_folder):
    return open_dataset(dataset_folder)


@pytest.fixture(scope="module")
def predictions(data, tmp_path_factory):
    return write_guesses(tmp_path_factory.mktemp("tallies") / "p.h5", data)


def test_uncertainty_is_that_of_scans_in_their_order(data, predictions):
    result = score_predictions(predictions, data)
    sure, drawn = Calibration(), [Evaluator() for _ in range(SAMPLES)]
    for entry in data.manifest.sequences:
        indices, _, probabilities, samples = guesses(data, entry.id)
        batch = data.reader(entry.id).batch()
        truth, valid = batch.labels[indices], batch.valid[indices]
        sure.update(truth, probabilities, valid)
        for evaluator, labels in zip(drawn, samples, strict=True):
            evaluator.update(truth, labels, valid)
    assert result["calibration"] == sure.compute()
    figures = [evaluator.compute()["mIoU"] for evaluator in drawn]
    assert result["samples"]["mIoU"] == {"mean": np.mean(figures), "std": np.std(figures)}
    assert result["samples"]["count"] == SAMPLES


def test_windows_and_conditions_add_up_to_the_confusion(data, predictions):
    for tally in count_predictions(predictions, data).tallies:
        total = tally.evaluator.confusion
        assert (sum(tally.windows.values()) == total).all()
        for counts in tally.conditions.values():
            assert (counts.sum(axis=0) == total).all()


def test_environments_and_lidars_are_scored_apart(data, predictions):
    result = score_predictions(predictions, data)
    places = result["conditions"]["environment"]
    assert set(places) == {"corridor", "lobby", "office"}
    assert sum(said["points"] for said in places.values()) == result["points"]


def test_lidars_of_a_recording_share_its_windows(mini):
    name = mini.manifest.sequences[0].id
    found = set()
    for lidar in ("hokuyo-utm-30lx-ew", "wlr-716", "rplidar-s2"):
        with mini.reader(f"{name.rsplit('--', 1)[0]}--{lidar}") as reader:
            found.add(tuple(w for w, _ in tallies.windows_of(reader, np.arange(len(reader)))))
    (windows,) = found
    assert len(windows) in (2, 3)  # 17 s in windows of 10 s


def test_neither_workers_nor_order_change_a_byte_of_the_result(data, predictions):
    alone = result_to_json(score_predictions(predictions, data))
    with Processes(4) as executor:
        assert result_to_json(score_predictions(predictions, data, executor=executor)) == alone
        counted = count_predictions(predictions, data, executor=executor).tallies
    assert tallies.merge_tallies(reversed(counted)) == counted


def test_a_sequence_is_counted_once(data, predictions):
    counted = count_predictions(predictions, data).tallies
    with pytest.raises(InvalidInputError, match="counted twice"):
        tallies.merge_tallies([*counted, counted[0]])
