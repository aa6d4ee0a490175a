from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from baselines.cli import DETECTORS as NAMES
from baselines.cli import app
from baselines.detectors import DETECTORS, merged_scores, predict
from semantic2d_dataset import open_dataset
from semantic2d_dataset.access.scan_source import ScanSource
from semantic2d_dataset.errors import DatasetNotFoundError, InvalidInputError
from semantic2d_dataset.format.manifest import publish
from semantic2d_dataset.format.sequence import SequenceHeader, SequenceWriter
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, Taxonomy
from semantic2d_dataset.scoring.submission import PredictionsReader, score_predictions, validate
from tests.generators import SMALL_LIDAR, make_arrays


def run(*words: object):
    return CliRunner().invoke(app, [str(word) for word in words])


def source_of(data, lidar: str, split: str | None = "test") -> ScanSource:
    return ScanSource(data, lidar=lidar, split=split, scheme="block", in_memory=False)


def test_the_words_of_the_command_are_the_detectors():
    assert tuple(DETECTORS) == NAMES


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("lidar", ["hokuyo", "rplidar"])
def test_predictions_of_a_split_are_valid_and_belong_to_their_scans(
    name: str, lidar: str, mini, tmp_path: Path
):
    detector, path = DETECTORS[name], tmp_path / "p.h5"
    source = source_of(mini, lidar)
    assert predict(detector, source, path) == len(source)
    assert validate(path, mini) == []
    with PredictionsReader(path) as reader:
        assert (reader.scheme, reader.split) == ("block", "test")
        assert reader.metadata == {"method": detector.method, "features": "R", "parameters": 0}
        for number in range(0, len(source), 37):
            sequence, _, row = source.scan_ids[number].rpartition("/")
            place = reader.read(sequence, "scan_index").tolist().index(int(row))
            fields, rows = source.fetch(np.array([number]))
            expected = detector.label(fields["ranges"][rows], source.lidar)
            assert np.array_equal(reader.read(sequence, "labels")[place], expected[0])


def test_mini_is_labelled_about_as_well_as_geometry_can(mini, tmp_path: Path):
    floors = {"lines": (0.68, 0.5), "legs": (0.7, 0.6)}
    for name, (ca, iou) in floors.items():
        predict(DETECTORS[name], source_of(mini, "hokuyo"), tmp_path / name)
        result = score_predictions(tmp_path / name, mini)
        merged = merged_scores(result["confusion"], SEMANTIC2D, DETECTORS[name].truth)
        assert merged["ca"] > ca
        assert merged["iou"] > iou


def test_merged_scores_are_those_of_one_class():
    rng = np.random.default_rng(0)
    confusion = rng.integers(0, 1000, (10, 10))
    merged = merged_scores(confusion, SEMANTIC2D, ("Wall", "Door", "Elevator"))
    inside = np.isin(np.arange(10), (2, 3, 9))
    hits = confusion[inside][:, inside].sum()
    missed, false = confusion[inside][:, ~inside].sum(), confusion[~inside][:, inside].sum()
    assert merged == {
        "ca": hits / (hits + missed),
        "iou": hits / (hits + missed + false),
        "support": hits + missed,
        "classes": ["Wall", "Door", "Elevator"],
    }


def test_merging_one_class_gives_its_own_scores(mini, tmp_path: Path):
    predict(DETECTORS["legs"], source_of(mini, "hokuyo"), tmp_path / "p.h5")
    result = score_predictions(tmp_path / "p.h5", mini)
    merged = merged_scores(result["confusion"], SEMANTIC2D, DETECTORS["legs"].truth)
    assert (merged["ca"], merged["iou"]) == (result["Person"]["ca"], result["Person"]["iou"])


def test_classes_that_a_taxonomy_lacks_are_not_merged():
    own = Taxonomy(("Other", "wall", "People"), ((0, 0, 0), (1, 1, 1), (2, 2, 2)))
    confusion = [[5, 1, 0], [2, 6, 0], [1, 0, 0]]
    merged = merged_scores(confusion, own, ("Wall", "Door", "Elevator"))
    assert merged == {"ca": 6 / 8, "iou": 6 / 9, "support": 8, "classes": ["wall"]}
    assert merged_scores(confusion, own, ("Person",))["classes"] == ["People"]
    with pytest.raises(InvalidInputError, match="none of the classes Door is in Other"):
        merged_scores(confusion, own, ("Door",))
    with pytest.raises(InvalidInputError, match=r"of 3 classes, found shape \(2, 2\)"):
        merged_scores(np.ones((2, 2)), own, ("Wall",))


def test_what_nothing_holds_has_no_score():
    merged = merged_scores(np.zeros((10, 10), int), SEMANTIC2D, ("Person",))
    assert (merged["ca"], merged["iou"], merged["support"]) == (None, None, 0)


@pytest.mark.parametrize(("name", "lacks"), [("lines", "Wall"), ("legs", "Person")])
def test_a_data_set_without_the_class_is_one_clear_error_and_no_file(
    name: str, lacks: str, tmp_path: Path
):
    folder = tmp_path / "own"
    (folder / "sequences").mkdir(parents=True)
    header = SequenceHeader(
        environment="hall",
        recording="one",
        lidar=SMALL_LIDAR,
        license="CC0-1.0",
        stamps_source="synthetic",
        provenance={},
        taxonomy=Taxonomy(("Other", "Dog"), ((0, 0, 0), (1, 1, 1))),
    )
    arrays = make_arrays(150)
    arrays["scans/labels"] = np.minimum(arrays["scans/labels"], 1)
    with SequenceWriter(folder / "sequences" / "hall--one--small.h5", header) as writer:
        writer.append(arrays)
    publish(folder, name="own", version="1.0.0", license="CC0-1.0")
    out = tmp_path / "p.h5"
    result = run("predict", name, "--data", folder, "--lidar", "small", "--out", out)
    assert isinstance(result.exception, InvalidInputError)
    assert f"own: {DETECTORS[name].method} finds {lacks} and nothing else" in str(result.exception)
    assert list(tmp_path.iterdir()) == [folder]


def test_the_command_says_what_it_did(dataset_folder: Path, tmp_path: Path):
    out = tmp_path / "p.h5"
    words = ("predict", "legs", "--data", dataset_folder, "--lidar", "small", "--out", out)
    said = json.loads(run(*words, "--json").stdout)
    assert said["method"] == "Leg detection"
    assert (
        score_predictions(out, open_dataset(dataset_folder))["submission"]["scans"]
        == (said["scans"])
    )
    assert isinstance(run(*words).exception, InvalidInputError)
    assert "scans labelled by Leg detection" in run(*words, "--force").stdout


@pytest.mark.parametrize(
    "option", [("--samples", 3), ("--probabilities",), ("--device", "cpu"), ("--seed", 1)]
)
def test_options_of_networks_are_wrong_usage_with_a_detector(option, tmp_path: Path):
    result = run("predict", "lines", "--out", tmp_path / "p.h5", *option)
    assert result.exit_code == 2
    assert f"it has no {option[0]}" in result.stderr.replace("\n", " ")


def test_a_folder_called_as_a_detector_is_a_folder(tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "legs").mkdir()
    result = run("predict", "./legs", "--out", tmp_path / "p.h5")
    assert isinstance(result.exception, DatasetNotFoundError)
    assert "no trained model here" in str(result.exception)
