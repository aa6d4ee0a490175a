"""Train a network: batches in, the epoch that validates best out."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from tqdm import tqdm

from baselines.architectures import build_network
from baselines.configs import TrainingConfig, learning_rate_at
from baselines.labelled_scans import LabelledScans, check_scans
from baselines.locks import alone_in
from baselines.losses import median_frequency_weights
from baselines.networks import SegmentationNetwork
from baselines.steps import freeze_norms, keep_freed_memory, momentum_of_micro_batches, step
from baselines.team import Team, join_team
from baselines.training_runs import (
    TrainingRun,
    can_resume,
    discard_run,
    restore_run,
    save_run,
)
from semantic2d_dataset.access.features import channel_count
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.taxonomy import UNLABELLED
from semantic2d_dataset.scoring.metrics import Evaluator


@dataclass(frozen=True)
class TrainingResult:
    """What a training left: the folder, its best epoch (from 1) and that epoch's score.

    ``best_miou`` is a fraction over the validation split; ``epochs`` counts those trained.
    """

    folder: Path
    best_epoch: int
    best_miou: float
    epochs: int
    seconds: float


def train(
    config: TrainingConfig,
    train_dataset: LabelledScans,
    val_dataset: LabelledScans,
    folder: Path,
    *,
    device: str | torch.device | None = None,
    resume: bool = False,
    about: Mapping[str, str] | None = None,
    initial: SegmentationNetwork | None = None,
) -> TrainingResult:
    """Train a network and keep the epoch of the highest validation mIoU.

    Every epoch ends with complete files in `folder`: the best model (`load_checkpoint`),
    ``log.csv``, and the state to resume from. An interruption loses the epoch under way only.
    On one machine, the same seed gives the same model, resumed or not, unless a time limit ends
    it: the schedule follows the clock then. Under torchrun, each process takes its share of every
    batch, and the gradients are averaged; batch norms see the own share.

    Parameters
    ----------
    config
        Settings.
    train_dataset, val_dataset
        Scans of one lidar, standardised by the statistics of the training split.
    folder
        Made where missing.
    device
        ``cuda`` where there is one, else ``cpu``, unless given.
    resume
        Go on where an earlier training in `folder` stopped, if there is one.
    about
        Name, version and scheme of the data set, to be kept with the model.
    initial
        Start from a copy of the weights of this network, to fine-tune it; from random ones where
        not given.

    Raises
    ------
    InvalidInputError
        If a data set is empty or they do not fit, the training in `folder` had other settings, or
        `initial` is another network than is trained.
    WriteError
        If `folder` cannot be written.
    """
    check_scans(config, train_dataset, val_dataset)
    where = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))
    keep_freed_memory()
    with join_team(where) as team, _as_writer(team, Path(folder)), _own_random_state(where):
        _check_team(team, config, len(train_dataset))
        run = _start(config, train_dataset, where, initial, team)
        if resume and can_resume(Path(folder)):
            restore_run(run, config, train_dataset, Path(folder))
        elif team.rank == 0:
            discard_run(Path(folder))
        clock = _Clock(config, run.seconds)
        network = team.wrap(run.network)
        with _progress_bar(team) as bar:
            while not clock.is_over(len(run.log)):
                row = _train_epoch(run, network, train_dataset, config, clock, bar)
                found = validate(run.network, val_dataset) if team.rank == 0 else 0.0
                row["val_miou"] = team.tell(found, where)
                run.seconds = row["seconds"] = clock.elapsed
                run.log.append(row)
                if team.rank == 0:
                    save_run(run, config, train_dataset, Path(folder), about or {})
                bar.set_postfix(mIoU=f"{row['val_miou']:.3f}", loss=f"{row['loss']:.1f}")
    best = run.best
    return TrainingResult(
        Path(folder), int(best["epoch"]), best["val_miou"], len(run.log), run.seconds
    )


def _as_writer(team: Team, folder: Path) -> AbstractContextManager[None]:
    """Let the first process of a team, which alone writes, be alone in the folder."""
    return alone_in(folder) if team.rank == 0 else contextlib.nullcontext()


def _own_random_state(device: torch.device) -> AbstractContextManager[None]:
    """Leave torch's random state, on the CPU and the device, as it was found."""
    if device.type != "cuda":
        return torch.random.fork_rng([])
    here = torch.cuda.current_device() if device.index is None else device.index
    return torch.random.fork_rng([here])


def validate(
    network: SegmentationNetwork, dataset: LabelledScans, *, batch_size: int = 32
) -> float:
    """Return the mIoU, a fraction, of labels by the expected logits."""
    device = next(network.parameters()).device
    evaluator = Evaluator(dataset.taxonomy)
    network.eval()
    with torch.inference_mode():
        for batch in dataset.loader(batch_size, shuffle=False, seed=0):
            features = batch["features"].to(device)
            logits = network.expected_logits(features)
            labels = logits.argmax(1).to("cpu", torch.uint8).numpy()
            truth = batch["label"].to(torch.uint8).numpy()
            evaluator.update(truth, labels, batch["valid"].numpy())
    return evaluator.compute()["mIoU"] or 0.0


class _Clock:
    """How far a training is: by epochs, or by time where that is limited."""

    def __init__(self, config: TrainingConfig, seconds_before: float) -> None:
        self.config = config
        self._started = time.monotonic() - seconds_before

    @property
    def elapsed(self) -> float:
        return time.monotonic() - self._started

    @property
    def time_is_up(self) -> bool:
        return self.config.time_limit_s is not None and self.elapsed >= self.config.time_limit_s

    def is_over(self, epochs: int) -> bool:
        return self.time_is_up or epochs >= self.config.epochs

    def progress(self, epochs: float) -> float:
        limit = self.config.time_limit_s
        by_time = 0.0 if limit is None else self.elapsed / limit
        return min(1.0, max(epochs / self.config.epochs, by_time))


def _start(
    config: TrainingConfig,
    dataset: LabelledScans,
    device: torch.device,
    initial: SegmentationNetwork | None,
    team: Team,
) -> TrainingRun:
    torch.manual_seed(config.seed)
    channels, classes = channel_count(config.features), len(dataset.taxonomy)
    network = build_network(config.model, channels, classes, dataset.lidar).to(device)
    if initial is not None:
        _copy_weights(initial, network)
    momentum_of_micro_batches(network, config.batch_size / team.size, config.micro_batch)
    optimiser = torch.optim.Adam(
        network.parameters(), config.learning_rate, weight_decay=config.weight_decay, fused=True
    )
    weights = median_frequency_weights(dataset.class_counts) ** config.class_weight_power
    return TrainingRun(network, optimiser, weights.to(device), team)


def _copy_weights(initial: SegmentationNetwork, network: SegmentationNetwork) -> None:
    try:
        network.load_state_dict(initial.state_dict())
    except RuntimeError as err:
        raise InvalidInputError(
            f"cannot start a {network.name} with {network.channels} channels and "
            f"{network.classes} classes from a {initial.name} with {initial.channels} and "
            f"{initial.classes}"
        ) from err


def _train_epoch(
    run: TrainingRun,
    network: nn.Module,
    dataset: LabelledScans,
    config: TrainingConfig,
    clock: _Clock,
    bar: tqdm[Any],
) -> dict[str, float]:
    """Train one epoch, cut short where the time is up; return its row of the log."""
    done = len(run.log)
    seed = _seed_of_epoch(config, done)
    torch.manual_seed(seed + run.team.rank)
    loader = dataset.loader(config.batch_size, shuffle=True, seed=seed)
    sums: dict[str, float] = {}
    scans, rate = 0, 0.0
    run.network.train()
    if config.frozen_norms:
        freeze_norms(run.network)
    for i, batch in enumerate(loader):
        rate = learning_rate_at(config, clock.progress(done + i / len(loader)))
        for group in run.optimiser.param_groups:
            group["lr"] = rate
        count = len(batch["label"])
        if count < run.team.size:
            continue  # the few scans of a last batch do not go round
        terms = step(
            network,
            run.optimiser,
            run.team.share(_to(batch, run.device)),
            run.class_weights,
            betas=config.betas,
            micro_batch=config.micro_batch,
            bf16=config.bf16,
        )
        for name, value in terms.items():
            sums[name] = sums.get(name, 0.0) + count * value
        scans += count
        bar.update(clock.progress(done + (i + 1) / len(loader)) - bar.n)
        if clock.time_is_up:
            break
    return {
        "epoch": done + 1,
        "seconds": 0.0,
        "learning_rate": rate,
        **{name: value / scans for name, value in sums.items()},
    }


def _seed_of_epoch(config: TrainingConfig, epoch: int) -> int:
    """Order of scans and latents of an epoch depend on its number and the seed, nothing else."""
    return int(np.random.SeedSequence((config.seed, epoch)).generate_state(1)[0])


def _to(batch: Mapping[str, Tensor], device: torch.device) -> dict[str, Tensor]:
    target = batch["label"].masked_fill(~batch["valid"], UNLABELLED)
    return {"features": batch["features"].to(device), "target": target.to(device)}


def _check_team(team: Team, config: TrainingConfig, scans: int) -> None:
    if min(scans, config.batch_size) < team.size:
        raise InvalidInputError(
            f"{scans} scans in batches of {config.batch_size} are too few for {team.size} processes"
        )
    if team.size > 1 and config.time_limit_s is not None:
        raise InvalidInputError(
            f"{team.size} processes cannot keep one time limit; say how many epochs instead"
        )


def _progress_bar(team: Team) -> tqdm[Any]:
    return tqdm(
        total=1.0,
        desc="training",
        bar_format="{desc} {percentage:3.0f}% |{bar}| {elapsed}<{remaining}{postfix}",
        disable=None if team.rank == 0 else True,
    )
