from __future__ import annotations

import csv
from dataclasses import replace
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from baselines.checkpoints import load_checkpoint
from baselines.configs import TrainingConfig
from baselines.locks import alone_in
from baselines.s3net import S3Net
from baselines.steps import momentum_of_micro_batches, step
from baselines.training import TrainingResult, train, validate
from semantic2d_dataset import load_dataset
from semantic2d_dataset.errors import CorruptFileError, InvalidInputError
from semantic2d_dataset.scene.lidars import HOKUYO_UTM_30LX_EW
from tests.baselines.generated import ToyScans, make_scans

CONFIG = TrainingConfig(epochs=12, batch_size=8, learning_rate=5e-3, schedule="one-cycle")


@pytest.fixture(scope="module")
def scans() -> tuple[ToyScans, ToyScans]:
    return ToyScans(64), ToyScans(16, seed=1)


@pytest.fixture(scope="module")
def trained(scans, tmp_path_factory) -> TrainingResult:
    return train(CONFIG, *scans, tmp_path_factory.mktemp("run"))


def log_of(folder: Path) -> list[dict[str, float]]:
    with (folder / "log.csv").open() as stream:
        return [{k: float(v) for k, v in row.items()} for row in csv.DictReader(stream)]


def weights_of(folder: Path) -> dict[str, torch.Tensor]:
    return load_checkpoint(folder).network.state_dict()


def same(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor]) -> bool:
    return all(torch.equal(first[name], second[name]) for name in first)


def test_training_learns_what_can_be_learnt(scans, trained: TrainingResult):
    losses = [row["loss"] for row in log_of(trained.folder)]
    assert losses[-1] < 0.6 * losses[0]
    assert trained.best_miou > 0.3
    assert validate(load_checkpoint(trained.folder).network, scans[1]) == trained.best_miou


def test_the_epoch_that_validates_best_is_kept(trained: TrainingResult):
    log = log_of(trained.folder)
    best = max(log, key=lambda row: row["val_miou"])
    assert (trained.best_epoch, trained.best_miou) == (best["epoch"], best["val_miou"])
    assert load_checkpoint(trained.folder).training["reached"]["epoch"] == best["epoch"]


def test_one_seed_gives_one_model(scans, trained: TrainingResult, tmp_path: Path):
    torch.manual_seed(99)
    train(CONFIG, *scans, tmp_path / "again")
    train(replace(CONFIG, seed=1), *scans, tmp_path / "other")
    assert same(weights_of(trained.folder), weights_of(tmp_path / "again"))
    assert not same(weights_of(trained.folder), weights_of(tmp_path / "other"))


def test_training_leaves_the_random_state_of_the_caller_alone(scans, tmp_path: Path):
    torch.manual_seed(4)
    expected = torch.rand(3)
    torch.manual_seed(4)
    train(replace(CONFIG, epochs=1), *scans, tmp_path)
    assert torch.equal(torch.rand(3), expected)


def test_an_interrupted_training_keeps_its_epochs_and_resumes_to_the_same_end(
    scans, trained: TrainingResult, tmp_path: Path
):
    interrupted = ToyScans(64)
    interrupted.batches_until_interrupt = 2 * 8 + 3  # in the third epoch of eight
    with pytest.raises(KeyboardInterrupt):
        train(CONFIG, interrupted, scans[1], tmp_path)
    assert len(log_of(tmp_path)) == 2
    load_checkpoint(tmp_path)
    names = {path.name.partition("-")[0] for path in tmp_path.iterdir()}
    assert names == {"log.csv", "model", "model.json", "resume", "resume.json", ".lock"}
    resumed = train(CONFIG, *scans, tmp_path, resume=True)
    assert resumed.epochs == 12
    assert same(weights_of(tmp_path), weights_of(trained.folder))
    drop = {"seconds": 0}
    for one, other in zip(log_of(tmp_path), log_of(trained.folder), strict=True):
        assert one | drop == other | drop


def test_an_interruption_in_the_first_epoch_leaves_no_model(scans, tmp_path: Path):
    interrupted = ToyScans(64)
    interrupted.batches_until_interrupt = 3
    with pytest.raises(KeyboardInterrupt):
        train(CONFIG, interrupted, scans[1], tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [".lock"]  # which is empty


def test_a_finished_training_is_not_trained_further(scans, trained: TrainingResult):
    before = weights_of(trained.folder)
    again = train(CONFIG, *scans, trained.folder, resume=True)
    assert (again.epochs, again.best_epoch) == (trained.epochs, trained.best_epoch)
    assert same(weights_of(trained.folder), before)


def test_resuming_with_other_settings_is_refused(scans, trained: TrainingResult):
    with pytest.raises(InvalidInputError, match="other settings were used for learning_rate"):
        train(replace(CONFIG, learning_rate=1e-3), *scans, trained.folder, resume=True)


def test_a_damaged_state_is_never_resumed(scans, tmp_path: Path):
    train(replace(CONFIG, epochs=1), *scans, tmp_path)
    (weights,) = tmp_path.glob("resume-*.safetensors")
    content = bytearray(weights.read_bytes())
    content[-1] ^= 1
    weights.write_bytes(content)
    with pytest.raises(CorruptFileError, match="SHA-256"):
        train(replace(CONFIG, epochs=1), *scans, tmp_path, resume=True)


def test_a_time_limit_ends_training_with_a_whole_checkpoint(scans, tmp_path: Path, monkeypatch):
    ticks = count(step=0.01)  # a clock that does not know how busy the machine is
    monkeypatch.setattr("baselines.training.time", SimpleNamespace(monotonic=lambda: next(ticks)))
    result = train(replace(CONFIG, epochs=10_000, time_limit_s=2.0), *scans, tmp_path)
    assert 1 < result.epochs < 100
    assert log_of(tmp_path)[-1]["learning_rate"] < 0.1 * CONFIG.learning_rate
    load_checkpoint(tmp_path)


def test_beams_without_a_return_do_not_train(scans, tmp_path: Path):
    wrong = ToyScans(64)
    wrong.valid[:, ::2] = False
    wrong.labels[:, ::2] = 255
    right = ToyScans(64)
    right.valid[:, ::2] = False
    for name, data in (("wrong", wrong), ("right", right)):
        counted = type("Counted", (ToyScans,), {"class_counts": scans[0].class_counts})
        data.__class__ = counted
        train(replace(CONFIG, epochs=1), data, scans[1], tmp_path / name)
    assert same(weights_of(tmp_path / "wrong"), weights_of(tmp_path / "right"))


def step_in_parts(micro_batch: int | None, betas: tuple, *, training: bool):
    features, labels = make_scans(64, 361)
    torch.manual_seed(0)
    network = S3Net().train(training)
    momentum_of_micro_batches(network, 64, micro_batch)
    torch.manual_seed(1)
    loss = step(
        network,
        torch.optim.SGD(network.parameters(), lr=0.0),
        {"features": features, "target": labels},
        torch.ones(10),
        betas=betas,
        micro_batch=micro_batch,
    )["loss"]
    gradient = torch.cat([p.grad.flatten() for p in network.parameters()])
    running = torch.cat([b.flatten() for n, b in network.named_buffers() if "running" in n])
    return loss, gradient, running


def test_micro_batches_give_the_gradient_of_the_batch_where_scans_do_not_meet():
    whole, parts = (step_in_parts(m, (1.0, 0.0, 0.01), training=False) for m in (None, 16))
    assert parts[0] == pytest.approx(whole[0], rel=1e-5)
    assert (parts[1] - whole[1]).norm() < 1e-4 * whole[1].norm()


def test_micro_batches_keep_loss_and_running_statistics_within_one_percent():
    whole, parts = (step_in_parts(m, (1.0, 1.0, 0.01), training=True) for m in (None, 16))
    assert parts[0] == pytest.approx(whole[0], rel=0.01)
    assert (parts[2] - whole[2]).norm() < 0.01 * whole[2].norm()


def test_empty_and_unlike_data_sets_are_refused(scans, tmp_path: Path):
    with pytest.raises(InvalidInputError, match="at least one scan"):
        train(CONFIG, ToyScans(0), scans[1], tmp_path)
    other = ToyScans(4)
    other.lidar = HOKUYO_UTM_30LX_EW
    with pytest.raises(InvalidInputError, match="different lidars"):
        train(CONFIG, scans[0], other, tmp_path)
    with pytest.raises(InvalidInputError, match="features RI are 2 channels"):
        train(replace(CONFIG, features="RI"), *scans, tmp_path)


def test_scans_without_features_or_without_the_wanted_augmentation_are_refused(
    scans, dataset_folder: Path, tmp_path: Path
):
    raw = load_dataset(dataset_folder, lidar="small")
    with pytest.raises(InvalidInputError, match="generated: was loaded without features"):
        train(CONFIG, raw, raw, tmp_path)
    with pytest.raises(InvalidInputError, match="augment: the training split has no transform"):
        train(replace(CONFIG, augment=True), *scans, tmp_path)
    assert not list(tmp_path.iterdir())


def test_fine_tuning_starts_from_a_copy_of_the_initial_weights(
    scans, trained: TrainingResult, tmp_path: Path
):
    initial = load_checkpoint(trained.folder).network
    before = {name: value.clone() for name, value in initial.state_dict().items()}
    still = replace(CONFIG, epochs=1, learning_rate=1e-12, weight_decay=0.0, frozen_norms=True)
    result = train(still, *scans, tmp_path / "still", initial=initial)
    assert result.best_miou == pytest.approx(trained.best_miou, abs=1e-3)
    after = weights_of(tmp_path / "still")
    running = [name for name in before if "running" in name]
    assert running
    assert all(torch.equal(after[name], before[name]) for name in running)
    assert same(initial.state_dict(), before)
    with pytest.raises(InvalidInputError, match="cannot start a s3net with 2 channels"):
        fewer = ToyScans(8)
        fewer.statistics = type(fewer.statistics)((0.0, 0.0), (1.0, 1.0))
        train(replace(CONFIG, features="RI"), fewer, fewer, tmp_path / "other", initial=initial)


def test_a_training_is_not_resumed_on_scans_that_were_labelled_anew(scans, tmp_path: Path):
    train(replace(CONFIG, epochs=1), *scans, tmp_path)
    relabelled = ToyScans(64)
    relabelled.labels[relabelled.labels == 1] = 2
    with pytest.raises(InvalidInputError, match="other settings were used for class counts"):
        train(replace(CONFIG, epochs=1), relabelled, scans[1], tmp_path, resume=True)


def test_two_trainings_do_not_share_a_folder(scans, tmp_path: Path):
    with (
        alone_in(tmp_path),
        pytest.raises(InvalidInputError, match="another process works here"),
    ):
        train(CONFIG, *scans, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [".lock"]


def test_a_new_training_is_never_taken_for_the_one_that_it_replaces(scans, tmp_path: Path):
    train(replace(CONFIG, epochs=2), *scans, tmp_path)
    interrupted = ToyScans(64)
    interrupted.batches_until_interrupt = 3
    with pytest.raises(KeyboardInterrupt):
        train(replace(CONFIG, epochs=2), interrupted, scans[1], tmp_path)
    load_checkpoint(tmp_path)  # the old model, until the new one has an epoch
    assert not list(tmp_path.glob("resume*"))
