from __future__ import annotations

import os
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from baselines.checkpoints import load_checkpoint
from baselines.published_weights import load_published, published_statistics
from baselines.s3net import S3Net
from semantic2d_dataset.access.features import Statistics
from semantic2d_dataset.errors import CorruptFileError, InvalidInputError, UnsafeFileError
from semantic2d_dataset.scene.lidars import HOKUYO_UTM_30LX_EW, WLR_716
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D
from tests.baselines.generated import make_scans
from tests.baselines.test_cli import run


@pytest.fixture(scope="module")
def state() -> dict[str, torch.Tensor]:
    torch.manual_seed(5)
    return S3Net().state_dict()


def test_published_weights_give_the_published_outputs_once_imported(
    shared_data: Path, tmp_path: Path
):
    with np.load(shared_data / "s3net_reference.npz", allow_pickle=False) as held:
        arrays = {name: torch.from_numpy(held[name].copy()) for name in held.files}
    state = {n.removeprefix("state/"): a for n, a in arrays.items() if n.startswith("state/")}
    torch.save({"epoch": 7, "model": state, "optimizer": {}}, tmp_path / "s3net.pth")
    run("import", tmp_path / "s3net.pth", "--out", tmp_path / "runs" / "published")
    checkpoint = load_checkpoint(tmp_path / "runs" / "published")
    assert checkpoint.lidar == HOKUYO_UTM_30LX_EW
    assert checkpoint.taxonomy == SEMANTIC2D
    assert checkpoint.statistics.mean == (4.518406, 3081.8167, 0.5959513)
    assert checkpoint.statistics.std == (8.2914915, 1529.4413, 0.4783924)
    assert checkpoint.training["imported"]["file"] == "s3net.pth"
    features = torch.stack([arrays[name] for name in ("range", "intensity", "incidence")], 1)
    with torch.inference_mode():
        law = checkpoint.network.encode(features)
        logits = checkpoint.network.expected_logits(features)
    for found, name in ((law.mean, "z_mu"), (law.log_sd, "z_log_sd"), (logits, "logits_mean")):
        torch.testing.assert_close(found, arrays[name], rtol=0, atol=1e-4)


@pytest.mark.parametrize(
    ("key", "prefix", "zipped"),
    [("model", "", True), ("model_state_dict", "", True), ("model", "module.", False)],
)
def test_every_published_form_gives_the_same_network(
    state, key: str, prefix: str, zipped, tmp_path: Path
):
    held = {key: {prefix + name: value for name, value in state.items()}, "epoch": 3}
    torch.save(held, tmp_path / "s.pth", _use_new_zipfile_serialization=zipped)
    network = load_published(tmp_path / "s.pth").network
    assert not network.training
    assert all(torch.equal(value, state[name]) for name, value in network.state_dict().items())


def test_imported_weights_predict_on_the_scans_of_a_data_set(
    state, dataset_folder: Path, tmp_path: Path
):
    torch.save({"model": state}, tmp_path / "s.pth")
    words = ("--out", tmp_path / "run", "--data", dataset_folder, "--lidar", "small")
    run("import", tmp_path / "s.pth", *words)
    checkpoint = load_checkpoint(tmp_path / "run")
    assert checkpoint.lidar.beams == 37
    assert checkpoint.statistics != published_statistics("RIA")
    words = ("--data", dataset_folder, "--samples", 1, "--out", tmp_path / "p.h5")
    assert "scans labelled" in run("predict", tmp_path / "run", *words)


def test_a_model_that_is_there_is_not_replaced_unless_forced(state, tmp_path: Path):
    torch.save({"model": state}, tmp_path / "s.pth")
    words = ("import", tmp_path / "s.pth", "--out", tmp_path / "run")
    run(*words)
    with pytest.raises(InvalidInputError, match="exists already"):
        run(*words)
    run(*words, "--force")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--lidar", "wlr716"), "published for hokuyo-utm-30lx-ew only; for wlr-716 give others"),
        (("--features", "RP"), "published for R, I and A only"),
        (("--features", "X"), "unknown features"),
        (("--lidar", "none"), "unknown lidar"),
    ],
)
def test_without_published_statistics_others_are_asked_for(
    state, words, message: str, tmp_path: Path
):
    torch.save({"model": state}, tmp_path / "s.pth")
    with pytest.raises(InvalidInputError, match=message):
        run("import", tmp_path / "s.pth", "--out", tmp_path / "run", *words)
    assert not (tmp_path / "run").exists()


def test_other_lidars_features_and_classes_are_a_matter_of_arguments(tmp_path: Path):
    network = S3Net(2)
    torch.save({"model": network.state_dict()}, tmp_path / "s.pth")
    chosen = load_published(tmp_path / "s.pth", features="AR")
    assert chosen.features == "RA"
    assert chosen.statistics == Statistics((4.518406, 0.5959513), (8.2914915, 0.4783924))
    given = Statistics((4.0, 0.5), (2.0, 0.5))
    other = load_published(tmp_path / "s.pth", features="RA", lidar=WLR_716, statistics=given)
    features = make_scans(1, WLR_716.beams)[0][:, :2]
    assert other.network.expected_logits(features).shape == (1, 10, WLR_716.beams)


class Harm:
    def __reduce__(self):
        return os.mkdir, ("harm",)


def save_zip(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a", "b")


def broken(change: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    def save(path: Path) -> None:
        torch.save({"model": S3Net().state_dict()}, path)
        path.write_bytes(change(path.read_bytes()))

    return save


UNREADABLE: dict[str, tuple[Callable[[Path], object], type[Exception], str]] = {
    "folder": (Path.mkdir, CorruptFileError, "found a folder"),
    "empty": (lambda p: p.write_bytes(b""), CorruptFileError, "found an empty file"),
    "text": (lambda p: p.write_text("hello world"), CorruptFileError, "not a file that torch"),
    "other zip": (save_zip, CorruptFileError, "not a file that torch.save wrote"),
    "half": (broken(lambda b: b[: len(b) // 2]), CorruptFileError, "or truncated; get it again"),
    "start": (broken(lambda b: b[:10]), CorruptFileError, "or truncated; get it again"),
    "code": (
        lambda p: torch.save({"model": Harm()}, p),
        UnsafeFileError,
        "nothing of it was run",
    ),
    "code beside weights": (
        lambda p: torch.save({"model": S3Net().state_dict(), "log": Harm()}, p),
        UnsafeFileError,
        "nothing of it was run",
    ),
    "plain pickle of code": (
        lambda p: p.write_bytes(pickle.dumps(Harm(), protocol=2)),
        UnsafeFileError,
        "nothing of it was run",
    ),
    "whole network": (lambda p: torch.save(S3Net(), p), UnsafeFileError, "more than tensors"),
    "list": (lambda p: torch.save([1], p), CorruptFileError, "found list"),
    "other keys": (
        lambda p: torch.save({"weights": {}, "epoch": 1, "a": 0, "b": 0}, p),
        CorruptFileError,
        "under model or model_state_dict, found the keys weights, epoch, a and 1 more",
    ),
    "tensors without numbers": (
        lambda p: torch.save({"model": S3Net().to("meta").state_dict()}, p),
        CorruptFileError,
        "with tensors",
    ),
    "no tensors": (lambda p: torch.save({"model": {"a": 1}}, p), CorruptFileError, "with tensors"),
}


@pytest.mark.parametrize("name", UNREADABLE)
def test_what_is_no_published_file_is_one_clear_error_and_runs_nothing(
    name: str, tmp_path: Path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    save, error, message = UNREADABLE[name]
    save(tmp_path / "s.pth")
    with pytest.raises(error, match=message) as raised:
        load_published(tmp_path / "s.pth")
    assert str(tmp_path / "s.pth") in str(raised.value)
    assert [path.name for path in tmp_path.iterdir()] == ["s.pth"]


def test_a_missing_file_is_said_to_be_missing(tmp_path: Path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.pth"):
        load_published(tmp_path / "nowhere.pth")


def test_a_huge_file_is_never_read(tmp_path: Path):
    with (tmp_path / "s.pth").open("wb") as stream:
        stream.truncate(1 << 40)
    with pytest.raises(UnsafeFileError, match="an S3-Net never takes above"):
        load_published(tmp_path / "s.pth")


def test_a_small_file_that_unpacks_to_a_huge_one_is_never_unpacked(tmp_path: Path):
    with zipfile.ZipFile(tmp_path / "s.pth", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data/0", bytes((64 << 20) + 1))
    assert (tmp_path / "s.pth").stat().st_size < 1 << 20
    with pytest.raises(UnsafeFileError, match="unpacks to 67108865 bytes"):
        load_published(tmp_path / "s.pth")


HEAD, MEAN = "_encoder._encoder._conv_1.0.weight", "_encoder._encoder_z_mu.bias"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({MEAN: None}, f"{MEAN} is missing"),
        ({"extra": torch.zeros(1)}, "extra is unknown"),
        ({"extra": torch.zeros(1).expand(1 << 44)}, "extra is unknown"),
        ({HEAD: torch.zeros(32, 2, 4)}, r"\(32, 2, 4\) instead of \(32, 3, 4\)"),
        ({MEAN: torch.tensor([float("nan")])}, f"{MEAN} is not finite"),
    ],
)
def test_weights_of_another_network_are_refused_by_name(state, changes, message, tmp_path: Path):
    weights = {k: v for k, v in (state | changes).items() if v is not None}
    torch.save({"model": weights}, tmp_path / "s.pth")
    with pytest.raises(CorruptFileError, match=f"S3-Net of 3 channels and 10 classes: .*{message}"):
        load_published(tmp_path / "s.pth")


def test_only_the_first_of_many_problems_are_named(tmp_path: Path):
    torch.save({"model": torch.nn.Linear(1, 1).state_dict()}, tmp_path / "s.pth")
    with pytest.raises(CorruptFileError, match=r"is missing and \d+ more$"):
        load_published(tmp_path / "s.pth")
