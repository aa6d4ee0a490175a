from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from baselines import speed
from baselines.checkpoints import Checkpoint
from baselines.evaluation import (
    ALL_CLASSES,
    Evaluation,
    evaluate,
    format_evaluation,
    write_evaluation,
)
from baselines.inference import predict
from baselines.s3net import S3Net
from semantic2d_dataset import Evaluator, load_dataset, open_dataset
from semantic2d_dataset.access.torch_datasets import LidarDataset
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scoring.submission import PredictionsReader, score_predictions

SAMPLES = 5


@pytest.fixture(scope="module")
def scans(dataset_folder: Path) -> LidarDataset:
    return load_dataset(dataset_folder, lidar="small", split="test", features="RIA")


@pytest.fixture(scope="module")
def checkpoint(scans: LidarDataset) -> Checkpoint:
    torch.manual_seed(0)
    network = S3Net()
    for layer in network.modules():
        if isinstance(layer, torch.nn.BatchNorm2d):
            layer.momentum = 1.0
    network(next(iter(scans.loader(32)))["features"])
    return Checkpoint(network.eval(), "RIA", scans.statistics, scans.lidar, scans.taxonomy)


@pytest.fixture(scope="module")
def evaluation(checkpoint: Checkpoint, scans: LidarDataset) -> Evaluation:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(speed, "_SECONDS", 0.05)
        return evaluate(checkpoint, scans, samples=SAMPLES, seed=2)


def test_scores_are_those_of_the_written_predictions(
    evaluation, checkpoint, scans, dataset_folder: Path, tmp_path: Path
):
    path = tmp_path / "predictions.h5"
    predict(checkpoint, scans, path, samples=SAMPLES, seed=2, with_samples=True)
    data = open_dataset(dataset_folder)
    voted = score_predictions(path, data)
    assert all(evaluation.majority[key] == voted[key] for key in ("mIoU", "mCA", "confusion"))
    one_by_one = [Evaluator() for _ in range(SAMPLES)]
    with PredictionsReader(path) as reader:
        for name in reader.sequence_ids:
            truth, rows = data.reader(name), reader.read(name, "scan_index")
            labels, ranges = (truth.read(f"scans/{n}")[rows] for n in ("labels", "ranges"))
            valid = truth.lidar.has_return(ranges)
            for evaluator, sample in zip(one_by_one, reader.read(name, "samples"), strict=True):
                evaluator.update(labels, sample, valid)
    results = [evaluator.compute() for evaluator in one_by_one]
    for metric, mean, key in (("CA", "mCA", "ca"), ("IoU", "mIoU", "iou")):
        figures = [result[mean] for result in results]
        expected = (np.mean(figures), np.std(figures))
        assert evaluation.rows[metric][ALL_CLASSES] == pytest.approx(expected)
        figures = [result["Wall"][key] for result in results]
        assert evaluation.rows[metric]["Wall"] == pytest.approx((np.mean(figures), np.std(figures)))
    assert evaluation.rows["IoU"][ALL_CLASSES][1] > 0


def test_what_was_scored_and_how_fast_is_said(evaluation, scans):
    assert evaluation.scans == len(scans)
    assert (evaluation.samples, evaluation.seed, evaluation.lidar) == (SAMPLES, 2, "small")
    assert evaluation.dataset == {
        "name": "generated",
        "version": "1.0.0",
        "scheme": "block",
        "split": "test",
    }
    assert evaluation.speed["one_pass"] > evaluation.speed["sampled"] > 0
    assert evaluation.speed["threads"] == 1


def test_uncertainty_is_of_the_scored_points(evaluation):
    points = evaluation.majority["points"]
    assert evaluation.calibration["points"] == points
    information, right = evaluation.mutual_information, 0
    right = np.trace(evaluation.majority["confusion"]) / points
    expected = right * information["right"] + (1 - right) * information["wrong"]
    assert information["all"] == pytest.approx(expected)
    assert information["all"] > 0


def test_one_seed_gives_one_evaluation_but_for_the_clock(
    evaluation, checkpoint, scans, monkeypatch
):
    monkeypatch.setattr(speed, "_SECONDS", 0.05)
    again = evaluate(checkpoint, scans, samples=SAMPLES, seed=2)
    for part in ("rows", "majority", "calibration", "mutual_information"):
        assert getattr(again, part) == getattr(evaluation, part)


def test_files_hold_all_of_it_and_nothing_else_is_left(evaluation, tmp_path: Path):
    write_evaluation(evaluation, tmp_path)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"evaluation.json", "reliability.png", "confusion.png"}
    said = json.loads((tmp_path / "evaluation.json").read_text())
    assert said["rows"]["CA"]["Wall"] == list(evaluation.rows["CA"]["Wall"])
    assert said["majority"]["mIoU"] == evaluation.majority["mIoU"]


def test_the_table_has_a_line_for_each_class_and_says_what_is_missing(evaluation):
    from dataclasses import replace

    rows = {m: dict(r) | {"Sofa": None} for m, r in evaluation.rows.items()}
    lines = format_evaluation(replace(evaluation, rows=rows)).splitlines()
    wall = next(line for line in lines if line.startswith("Wall"))
    mean, std = evaluation.rows["CA"]["Wall"]
    assert f"{100 * mean:.2f} ± {100 * std:.2f}" in wall
    assert next(line for line in lines if line.startswith("Sofa")).split()[1:3] == ["-", "-"]
    assert evaluation.speed["processor"] in lines[-1]


def test_scans_that_do_not_fit_the_model_are_refused(checkpoint, dataset_folder: Path):
    other = load_dataset(dataset_folder, lidar="small", split="test", features="RI")
    with pytest.raises(InvalidInputError, match="features='RIA'"):
        evaluate(checkpoint, other, samples=1)
