"""Data sets unlike the release, trained on and predicted for by every network."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from baselines.architectures import ARCHITECTURES
from baselines.checkpoints import load_checkpoint
from semantic2d_dataset import open_dataset
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.manifest import publish
from semantic2d_dataset.format.sequence import SequenceHeader, SequenceWriter
from semantic2d_dataset.scene.lidars import LidarSpec
from semantic2d_dataset.scene.taxonomy import Taxonomy
from semantic2d_dataset.scoring.submission import PredictionsReader, score_predictions
from tests.baselines.test_cli import run
from tests.generators import SMALL_LIDAR, make_arrays

FOUR = Taxonomy(
    ("Ground", "Tree", "Car", "Kerb"), ((0, 0, 0), (0, 255, 0), (0, 0, 255), (90, 90, 90))
)
SPINNING = LidarSpec("spinning", "Spinning", 360, 0.0, np.deg2rad(1.0), 0.1, 20.0)


def make_data(folder: Path, lidar: LidarSpec, *drop: str) -> Path:
    """Publish scans of four classes."""
    (folder / "sequences").mkdir(parents=True)
    for number, place in enumerate(("park", "street", "yard")):
        arrays = make_arrays(40, lidar, number)
        kept = {name: values for name, values in arrays.items() if name not in drop}
        labels = kept["scans/labels"]
        kept["scans/labels"] = np.where(labels == 255, 255, labels % 4).astype(np.uint8)
        header = SequenceHeader(
            environment=place,
            recording="first",
            lidar=lidar,
            license="CC0-1.0",
            stamps_source="synthetic",
            provenance={"source": "generated", "seed": number},
            taxonomy=FOUR,
        )
        with SequenceWriter(folder / "sequences" / f"{place}.h5", header) as writer:
            writer.append(kept)
    publish(folder, name="outdoors", version="1.0.0")
    return folder


@pytest.fixture(scope="module")
def four_classes(tmp_path_factory) -> Path:
    return make_data(tmp_path_factory.mktemp("data") / "four", SMALL_LIDAR)


@pytest.fixture(scope="module")
def no_intensity(tmp_path_factory) -> Path:
    return make_data(tmp_path_factory.mktemp("data") / "ring", SPINNING, "scans/intensities")


def train(model: str, data: Path, lidar: LidarSpec, out: Path, *more: object) -> None:
    words = ("--data", data, "--lidar", lidar.name, "--out", out)
    run("train", model, *words, "--preset", "quick", "--epochs", 1, *more)


def score(model: Path, data: Path, out: Path) -> dict:
    run("predict", model, "--data", data, "--samples", 2, "--out", out)
    return score_predictions(out, open_dataset(data))


@pytest.mark.parametrize("model", ARCHITECTURES)
def test_scans_of_four_classes_are_trained_on_and_scored(
    model: str, four_classes: Path, tmp_path: Path
):
    train(model, four_classes, SMALL_LIDAR, tmp_path / "run")
    trained = load_checkpoint(tmp_path / "run")
    assert trained.taxonomy == FOUR
    assert trained.network.classes == 4
    scored = score(tmp_path / "run", four_classes, tmp_path / "p.h5")
    with PredictionsReader(tmp_path / "p.h5") as reader:
        assert reader.metadata["method"] == trained.network.title
    assert 0 <= scored["mIoU"] < 1
    assert "Tree" in json.dumps(scored)


@pytest.mark.parametrize("model", ARCHITECTURES)
def test_a_ring_of_360_beams_without_intensity_is_trained_on_and_scored(
    model: str, no_intensity: Path, tmp_path: Path
):
    train(model, no_intensity, SPINNING, tmp_path / "run", "--features", "RPA")
    trained = load_checkpoint(tmp_path / "run")
    assert (trained.lidar.beams, trained.network.channels) == (360, 4)
    assert getattr(trained.network, "circular", True)
    assert 0 <= score(tmp_path / "run", no_intensity, tmp_path / "p.h5")["mIoU"] < 1


@pytest.mark.parametrize("features", ["RIA", "I"])
@pytest.mark.parametrize("model", ARCHITECTURES)
def test_intensity_where_there_is_none_is_one_clear_error_and_no_file(
    model: str, features: str, no_intensity: Path, tmp_path: Path
):
    with pytest.raises(InvalidInputError, match="spinning gives no intensities; leave I out"):
        train(model, no_intensity, SPINNING, tmp_path / "run", "--features", features)
    assert not (tmp_path / "run").exists()
