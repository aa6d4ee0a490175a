from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from baselines import checkpoints
from baselines.checkpoints import Checkpoint, load_checkpoint, save_checkpoint
from baselines.s3net import S3Net
from semantic2d_dataset.access.features import Statistics
from semantic2d_dataset.errors import (
    CorruptFileError,
    DatasetNotFoundError,
    FormatVersionError,
    WriteError,
)
from semantic2d_dataset.scene.lidars import HOKUYO_UTM_30LX_EW
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D

STATISTICS = Statistics((4.5, 3081.8, 0.6), (8.3, 1529.4, 0.5))


def make_checkpoint(seed: int = 0) -> Checkpoint:
    torch.manual_seed(seed)
    parts = ("RIA", STATISTICS, HOKUYO_UTM_30LX_EW, SEMANTIC2D)
    return Checkpoint(S3Net(), *parts, {"name": "mini"}, {"seed": seed, "betas": [1, 1, 0.01]})


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    save_checkpoint(tmp_path, make_checkpoint())
    return tmp_path


def change(folder: Path, **values: object) -> None:
    path = folder / "model.json"
    said = json.loads(path.read_text())
    path.write_text(json.dumps(said | values))


def test_what_is_saved_is_loaded(folder: Path):
    saved, loaded = make_checkpoint(), load_checkpoint(folder)
    for name in ("features", "statistics", "lidar", "taxonomy", "dataset", "training"):
        assert getattr(loaded, name) == getattr(saved, name)
    for name, value in saved.network.state_dict().items():
        assert torch.equal(loaded.network.state_dict()[name], value)
    assert not loaded.network.training


def test_a_new_checkpoint_replaces_the_old_one_and_its_weights(folder: Path):
    save_checkpoint(folder, make_checkpoint(1))
    assert load_checkpoint(folder).training["seed"] == 1
    assert len(list(folder.iterdir())) == 2


def test_a_kill_between_the_two_files_leaves_the_old_checkpoint(folder: Path, monkeypatch):
    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(checkpoints, "write_text_atomically", killed)
    with pytest.raises(KeyboardInterrupt):
        save_checkpoint(folder, make_checkpoint(1))
    assert load_checkpoint(folder).training["seed"] == 0


def test_no_checkpoint_is_said_to_be_missing(tmp_path: Path):
    with pytest.raises(DatasetNotFoundError, match="no trained model here"):
        load_checkpoint(tmp_path / "nowhere")


def test_a_missing_folder_is_never_written(tmp_path: Path):
    with pytest.raises(WriteError):
        save_checkpoint(tmp_path / "nowhere", make_checkpoint())


@pytest.mark.parametrize("place", [0, 100, -1])
def test_any_flipped_byte_of_the_weights_is_refused(folder: Path, place: int):
    (weights,) = folder.glob("*.safetensors")
    content = bytearray(weights.read_bytes())
    content[place] ^= 1
    weights.write_bytes(content)
    with pytest.raises(CorruptFileError, match="differs from its recorded SHA-256"):
        load_checkpoint(folder)


def test_truncated_weights_are_refused(folder: Path):
    (weights,) = folder.glob("*.safetensors")
    weights.write_bytes(weights.read_bytes()[:-10])
    with pytest.raises(CorruptFileError, match=r"expected \d+ bytes, found \d+"):
        load_checkpoint(folder)


def test_missing_weights_are_refused(folder: Path):
    next(folder.glob("*.safetensors")).unlink()
    with pytest.raises(CorruptFileError, match="missing"):
        load_checkpoint(folder)


def test_weights_outside_the_folder_are_never_opened(folder: Path):
    change(folder, weights={"file": "../other.safetensors", "bytes": 1, "sha256": ""})
    with pytest.raises(CorruptFileError, match="expected weights in a .safetensors file here"):
        load_checkpoint(folder)


def test_a_newer_major_format_is_refused(folder: Path):
    change(folder, format_version="2.0")
    with pytest.raises(FormatVersionError, match=r"written in format 2.0.*install"):
        load_checkpoint(folder)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"format": "other"}', "[" * 100_000])
def test_a_file_that_is_not_a_checkpoint_is_refused(folder: Path, text: str):
    (folder / "model.json").write_text(text)
    with pytest.raises(CorruptFileError):
        load_checkpoint(folder)


TWO_CLASSES = {"names": ["a", "b"], "colours": [[0, 0, 0]] * 2, "background_id": 0}


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"format_version": "one"}, "format version"),
        ({"weights": None}, "does not say which weights"),
        ({"architecture": {"name": "other"}}, "unknown model 'other'"),
        ({"architecture": {"name": "s3net", "channels": 3}}, "classes"),
        ({"features": "RI"}, "RI are 2 channels, and the statistics 3"),
        ({"features": 5}, "not the description"),
        ({"statistics": {"mean": [0, 0], "std": [1]}}, "one mean and one std"),
        ({"lidar": {"name": "x"}}, "base_T_lidar"),
        ({"taxonomy": TWO_CLASSES}, "2 names for 10 classes"),
        ({"training": None}, "not the description"),
    ],
)
def test_each_broken_part_is_refused(folder: Path, values: dict, message: str):
    change(folder, **values)
    with pytest.raises(CorruptFileError, match=message):
        load_checkpoint(folder)


def test_weights_of_another_architecture_are_refused(folder: Path):
    change(folder, features="RI", architecture={"name": "s3net", "channels": 2, "classes": 10})
    change(folder, statistics={"mean": [0, 0], "std": [1, 1]})
    with pytest.raises(CorruptFileError, match="the weights are of another architecture"):
        load_checkpoint(folder)
