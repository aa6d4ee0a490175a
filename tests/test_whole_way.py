"""From a recording to a score through the command line, on generated and on real input."""

import json
import sys

import numpy as np
import pytest

from semantic2d_dataset import cli, load_dataset, publish
from semantic2d_dataset.access.registry import open_dataset
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D
from semantic2d_dataset.scoring.predictions import PredictionsWriter


@pytest.fixture
def run(monkeypatch, capsys):
    """Run the command and return what it printed as JSON."""

    def run_it(*words):
        monkeypatch.setattr(sys, "argv", ["semantic2d", *map(str, words), "--json"])
        with pytest.raises(SystemExit) as end:
            cli.main()
        captured = capsys.readouterr()
        assert end.value.code in (0, None), captured.err
        return json.loads(captured.out)

    return run_it


def predict_truth(path, data, scheme):
    with PredictionsWriter(
        path,
        dataset=data.manifest.name,
        dataset_version=data.manifest.version,
        scheme=scheme,
        split="test",
        taxonomy=SEMANTIC2D,
        metadata={"method": "truth"},
    ) as writer:
        for entry in data.sequences():
            rows = data.scheme(scheme).scans_of(entry.id, "test")
            labels = data.reader(entry.id).read("scans/labels")[rows]
            writer.add(entry.id, rows, np.where(labels == 255, 0, labels).astype(np.uint8))


def test_stock_room_cart_is_converted_labelled_loaded_and_scored(shared_data, run, tmp_path):
    cart = shared_data / "thesis_cart"
    raw, labelled = tmp_path / "cart.h5", tmp_path / "data" / "sequences" / "cart.h5"
    labelled.parent.mkdir(parents=True)
    run("convert", cart / "rosbag" / "rosbag2_test", "--out", raw, "--environment", "stock-room")
    with SequenceReader(raw) as reader:
        assert len(reader) == 316
        assert np.isfinite(reader.read("poses/initial")).all(axis=1).sum() >= 300
    said = run(
        *("salsa", "label", raw, "--map", cart / "map" / "processed.yaml"),
        *("--annotation", cart / "map" / "processed.json"),
        *("--out", labelled, "--plot", tmp_path / "labelled.png"),
    )
    assert said["scans_accepted"] >= 300
    assert said["near_before"] < 0.5
    assert said["near_after"] > 0.8
    assert (tmp_path / "labelled.png").stat().st_size > 10_000
    publish(tmp_path / "data", name="stock-room", version="1.0.0")
    train = load_dataset(tmp_path / "data", lidar="scan-360", split="train", features="RIA")
    assert {4, 7, 9} <= set(np.flatnonzero(train.class_counts))  # people, shelves, walls
    data = open_dataset(tmp_path / "data")
    predict_truth(tmp_path / "p.h5", data, "block")
    result = run("score", tmp_path / "p.h5", "--data", tmp_path / "data")
    assert result["mIoU"] == 1.0
    assert result["submission"]["scans"] == len(data.scheme("block").scans_of(*_only(data)))


def _only(data):
    (entry,) = data.sequences()
    return entry.id, "test"


def test_mini_is_trained_on_predicted_and_scored(mini, run, tmp_path):
    words = ("baseline", "train", "s3net", "--preset", "quick", "--epochs", "1")
    run(*words, "--out", tmp_path / "run", "--lidar", "wlr716")
    predictions = tmp_path / "p.h5"
    run("baseline", "predict", tmp_path / "run", "--out", predictions, "--samples", "4")
    result = run("score", predictions, "--out", tmp_path / "result.json")
    assert 0.04 < result["mIoU"] < 1
    assert result == json.loads((tmp_path / "result.json").read_text())
    assert list(result["per_lidar"]) == ["wlr-716"]
    rows = run("leaderboard", "table", tmp_path / "result.json")
    assert len(rows) == 1
    info = run("info", "semantic2d-mini")
    assert info["sequences"] == len(mini.sequences())
