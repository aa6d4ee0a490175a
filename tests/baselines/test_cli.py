from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from baselines import speed
from baselines.checkpoints import load_checkpoint
from baselines.cli import app
from semantic2d_dataset import open_dataset
from semantic2d_dataset.errors import (
    DatasetNotFoundError,
    InvalidInputError,
    Semantic2DError,
    WriteError,
)
from semantic2d_dataset.scoring.submission import score_predictions
from tests.conftest import PROJECT


def run(*words: object) -> str:
    result = CliRunner().invoke(app, [str(word) for word in words])
    if result.exception is not None:
        raise result.exception
    return result.stdout


@pytest.fixture(scope="module")
def model(dataset_folder: Path, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "s3net"
    options = ("--data", dataset_folder, "--lidar", "small", "--preset", "quick", "--epochs", 1)
    said = json.loads(run("train", "s3net", *options, "--out", out, "--json"))
    assert said["best_epoch"] == said["epochs"] == 1
    return out


def test_a_trained_model_predicts_what_can_be_scored(
    model: Path, dataset_folder: Path, tmp_path: Path
):
    out = tmp_path / "predictions.h5"
    said = run("predict", model, "--data", dataset_folder, "--samples", 2, "--out", out, "--json")
    data = open_dataset(dataset_folder)
    scored = score_predictions(out, data)
    assert json.loads(said)["scans"] == scored["submission"]["scans"]
    assert 0 <= scored["mIoU"] < 1


def test_a_training_with_augmentation_says_so_and_keeps_the_statistics(
    model: Path, dataset_folder: Path, tmp_path: Path
):
    out = tmp_path / "augmented"
    usual = ("--data", dataset_folder, "--lidar", "small", "--preset", "quick", "--epochs", 1)
    run("train", "s3net", *usual, "--augment", "--out", out)
    plain, augmented = (load_checkpoint(folder) for folder in (model, out))
    assert (plain.training["augment"], augmented.training["augment"]) == (False, True)
    assert plain.statistics == augmented.statistics
    assert (out / "log.csv").read_text() != (model / "log.csv").read_text()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("other",), "unknown model 'other'; known are s3net"),
        (("s3net", "--features", "RX"), "unknown features 'RX'"),
        (("s3net", "--preset", "best"), "unknown preset 'best'; known are quick, paper"),
        (("s3net", "--epochs", 0), "epochs: expected above 0"),
        (("s3net", "--seed", -1), "seed: expected a whole number from 0"),
        (("s3net", "--scheme", "none"), "unknown scheme 'none'"),
        (("s3net", "--lidar", "none"), "no sequence of the lidar 'none'"),
        (("s3net", "--data", "nowhere"), "nowhere"),
        (("s3net", "--device", "abacus"), "device 'abacus' cannot be used here"),
    ],
)
def test_what_cannot_be_trained_is_one_clear_error_and_no_file(
    words, message: str, dataset_folder: Path, tmp_path: Path
):
    usual = ("--data", dataset_folder, "--lidar", "small", "--preset", "quick", "--epochs", 1)
    out = tmp_path / "run"
    with pytest.raises(Semantic2DError, match=message):
        run("train", words[0], *usual, "--out", out, *words[1:])
    assert not out.exists()


def test_a_model_that_is_there_is_not_replaced_unless_forced(model: Path, dataset_folder: Path):
    with pytest.raises(InvalidInputError, match="exists already"):
        run("train", "s3net", "--data", dataset_folder, "--lidar", "small", "--out", model)


def test_predictions_that_are_there_are_not_replaced_unless_forced(
    model: Path, dataset_folder: Path, tmp_path: Path
):
    out = tmp_path / "predictions.h5"
    out.write_text("precious")
    words = ("predict", model, "--data", dataset_folder, "--samples", 1, "--out", out)
    with pytest.raises(InvalidInputError, match="exists already"):
        run(*words)
    assert out.read_text() == "precious"
    assert "scans labelled" in run(*words, "--force")


def test_a_model_is_evaluated_into_a_folder_that_is_not_replaced_unless_forced(
    model: Path, dataset_folder: Path, tmp_path: Path
):
    out = tmp_path / "scores"
    words = ("evaluate", model, "--data", dataset_folder, "--samples", 2, "--out", out)
    said = run(*words)
    assert "All classes" in said
    assert "over 2 samples" in said
    assert json.loads((out / "evaluation.json").read_text())["samples"] == 2
    with pytest.raises(InvalidInputError, match="exists already"):
        run(*words)
    assert json.loads(run(*words, "--force", "--json"))["model"] == "S3-Net"


def test_a_missing_model_is_one_clear_error(dataset_folder: Path, tmp_path: Path):
    with pytest.raises(DatasetNotFoundError, match="no trained model here"):
        run("predict", tmp_path, "--data", dataset_folder, "--out", tmp_path / "p.h5")


def test_a_model_of_another_lidar_is_refused(model: Path, dataset_folder: Path, tmp_path: Path):
    text = (model / "model.json").read_text()
    copy = tmp_path / "copy"
    copy.mkdir()
    for path in model.glob("model*"):
        (copy / path.name).write_bytes(path.read_bytes())
    (copy / "model.json").write_text(text.replace('"range_max": 20.0', '"range_max": 30.0'))
    with pytest.raises(InvalidInputError, match="choose scans of the same lidar"):
        run("predict", copy, "--data", dataset_folder, "--out", tmp_path / "p.h5")


def test_listing_the_commands_imports_nothing_heavy():
    code = "import sys, baselines.cli; print({'torch', 'numba', 'h5py'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def test_a_model_goes_to_a_robot_and_labels_a_recording(
    model: Path, dataset_folder: Path, tmp_path: Path
):
    onnx, source = tmp_path / "model.onnx", dataset_folder / "sequences/lobby--first--small.h5"
    said = json.loads(run("export", model, "--onnx", "--out", onnx, "--json"))
    assert said["bytes"] == onnx.stat().st_size
    assert said["difference"] < 1e-4
    for name, given in (("run.h5", model), ("onnx.h5", onnx)):
        words = ("label", source, "--model", given, "--samples", 2, "--out", tmp_path / name)
        said = json.loads(run(*words, "--json"))
        assert said["scans"] == 150
        assert sum(said["points"].values()) > 0.8 * 150 * 37
        with pytest.raises(InvalidInputError, match="exists already"):
            run(*words)
        assert "points labelled: Other" in run(*words, "--force")
    with pytest.raises(InvalidInputError, match="an ONNX file runs on the CPU"):
        run(*words, "--force", "--device", "cuda")


def test_export_says_what_it_needs(model: Path, tmp_path: Path):
    with pytest.raises(InvalidInputError, match="say as what to write the model: --onnx"):
        run("export", model, "--out", tmp_path / "m.onnx")
    with pytest.raises(WriteError, match="does not exist"):
        run("export", model, "--onnx", "--out", tmp_path / "no" / "m.onnx")
    with pytest.raises(DatasetNotFoundError, match="no trained model here"):
        run("export", tmp_path, "--onnx", "--out", tmp_path / "m.onnx")
    assert list(tmp_path.iterdir()) == []


def test_a_missing_package_is_one_line_that_says_what_to_install(model: Path, tmp_path: Path):
    code = (
        "import sys; sys.modules['onnxscript'] = None; from semantic2d_dataset.cli import main; "
        f"sys.argv[1:] = ['baseline', 'export', {str(model)!r}, '--onnx', '--out', 'm.onnx']; "
        "main()"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(PROJECT)},
    )
    message = "error: this command needs ONNX: pip install 'semantic2d-dataset[onnx]'\n"
    assert (done.returncode, done.stderr) == (1, message)


def test_a_reproduced_table_is_printed_and_written_in_three_formats_with_pictures(
    dataset_folder: Path, tmp_path: Path, monkeypatch
):
    monkeypatch.setattr(speed, "_SECONDS", 0.01)
    usual = ("--data", dataset_folder, "--lidar", "small", "--epochs", 1, "--samples", 2)
    text = run("reproduce", "table-segmentation", *usual, "--out", tmp_path)
    folder = tmp_path / "table-segmentation"
    assert {path.name for path in folder.iterdir()} == {
        *("table.txt", "table.md", "table.tex", "results.json"),
        *("miou_by_features.png", "iou_by_class.png"),
    }
    assert text.startswith((folder / "table.txt").read_text())
    said = json.loads((folder / "results.json").read_text())
    for method in ("S3-Net (R)", "S3-Net (R+I+P+A)"):
        ours, published = [row for row in said["rows"] if row["method"] == method]
        assert (ours["published"], published["published"]) == (False, True)
        assert (ours["ranked"], published["ranked"]) == (True, False)
        lines = (folder / "table.md").read_text().count(f"{method} |"), text.count(f"{method} †")
        assert lines == (1, 1)
    assert published["figures"]["IoU"]["All"] == [0.2565, 0.0075]
    assert text.count("Line extraction †") == text.count("Leg detection †") == 1
    assert "one thread" in text
    assert "Intel i5-8250U" in text


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("ablation", "--seeds", "a"), "seeds: expected different whole numbers from 0"),
        (("other",), "unknown experiment 'other'; known are table-segmentation, ablation"),
        (("ablation", "--preset", "best"), "unknown preset 'best'"),
        (("ablation", "--scheme", "none"), "unknown scheme 'none'"),
        (("ablation", "--lidar", "none"), "no sequence of the lidar 'none'"),
    ],
)
def test_what_cannot_be_reproduced_is_one_clear_error_and_no_file(
    words, message: str, dataset_folder: Path, tmp_path: Path
):
    usual = ("--data", dataset_folder, "--lidar", "small")
    with pytest.raises(Semantic2DError, match=message):
        run("reproduce", words[0], *usual, "--out", tmp_path / "out", *words[1:])
    assert not (tmp_path / "out").exists()
