"""How well a model of one lidar serves another (paper, section on lidar types).

A model is trained for each lidar on its own scans. Every other lidar's scans are then reprojected
to that lidar's beams and standardised by statistics of their own, which need no label; they are
labelled by the model as it is, and by a copy fine-tuned on the validation split, the tenth of
the data that the paper uses. That copy sees no other label: it is also chosen on the validation
split, which a learning rate that falls to nothing makes a choice between equals, so that the test
split takes no part. Labels are brought back to the beams that the lidar measured, and scored
there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from baselines import inference
from baselines.architectures import build_network
from baselines.checkpoints import load_checkpoint
from baselines.configs import TrainingConfig
from baselines.networks import SegmentationNetwork
from baselines.reprojection import ReprojectedScans, Reprojection
from baselines.training import train
from semantic2d_dataset.access.features import Statistics, channel_count
from semantic2d_dataset.access.registry import OpenDataset
from semantic2d_dataset.access.torch_datasets import LidarDataset
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.lidars import LIDARS, LidarSpec
from semantic2d_dataset.scoring.metrics import Evaluator

_SCANS_AT_ONCE = 64

# The published rate. On semantic2d-mini, fine-tuned on the validation scans of one half of the
# recordings and validated on those of the other (4 epochs; Hokuyo to WLR-716, Hokuyo to RPLIDAR-S2,
# RPLIDAR-S2 to Hokuyo), it gave 56.1, 51.0 and 55.5 % mIoU; 2.5e-4 gave 54.3, 49.5 and 54.9, 1e-3
# gave 51.9, 48.5 and 53.2. The models as they are had 56.8, 50.8 and 53.7.
_FINE_TUNING_RATE = 1e-4

Result = Mapping[str, Any]
"""As `Evaluator.compute` returns it."""


@dataclass(frozen=True)
class Transfer:
    """How a model of one lidar labels the test scans of one.

    Parameters
    ----------
    trained_on, tested_on
        Names of the lidars.
    fine_tuned
        Whether the model was fine-tuned on the lidar that it is tested on.
    in_view
        Scores over the beams that the model's lidar would see.
    all_beams
        Scores over all beams, those out of its view labelled as the background.
    """

    trained_on: str
    tested_on: str
    fine_tuned: bool
    in_view: Result
    all_beams: Result

    @property
    def out_of_view(self) -> float:
        """Share of the scored points that lie out of the model's field of view."""
        seen, scored = int(self.in_view["points"]), int(self.all_beams["points"])
        return 1 - seen / max(scored, 1)


@dataclass(frozen=True)
class TransferStudy:
    """What is trained and tested.

    Parameters
    ----------
    data
        An open data set.
    lidars
        Names of at least two of its lidars.
    config, fine_tuning
        Settings of the trainings from scratch, and of the fine-tunings (see `fine_tuning_of`).
        Time limits are ignored: figures that depend on how busy a machine was tell nothing.
    scheme
        How the data set is divided.
    samples
        Latents drawn for each scan that is tested.

    Raises
    ------
    DatasetNotFoundError, InvalidInputError
        If there are fewer than two lidars, or one that the data set has not.
    """

    data: OpenDataset
    lidars: Sequence[str]
    config: TrainingConfig
    fine_tuning: TrainingConfig
    scheme: str = "block"
    samples: int = inference.SAMPLES

    def __post_init__(self) -> None:
        names = tuple(self.data.sequences(name)[0].lidar for name in self.lidars)
        if len(names) < 2 or len(set(names)) < len(names):
            raise InvalidInputError(
                f"{self.data.manifest.name}: expected at least two different lidars, "
                f"found {', '.join(names) or 'none'}"
            )
        object.__setattr__(self, "lidars", names)
        for name in ("config", "fine_tuning"):
            object.__setattr__(self, name, replace(getattr(self, name), time_limit_s=None))

    def spec_of(self, lidar: str) -> LidarSpec:
        """Return the geometry of a lidar of the data set."""
        return self.data.reader(self.data.sequences(lidar)[0].id).header.lidar


def lidars_of(data: OpenDataset) -> tuple[str, ...]:
    """Return the names of a data set's lidars, those of the release first and in its order."""
    names = {entry.lidar for entry in data.sequences()}
    return (*(name for name in LIDARS if name in names), *sorted(names - set(LIDARS)))


def fine_tuning_of(config: TrainingConfig, epochs: int | None = None) -> TrainingConfig:
    """Return the settings to fine-tune with what was trained with `config`.

    A quarter of its epochs, unless given, at a low learning rate that falls to nothing and with
    frozen batch norms: on little data, a high rate makes a model forget, and statistics of scans
    with a blind quarter take it apart.
    """
    return replace(
        config,
        epochs=max(1, config.epochs // 4) if epochs is None else epochs,
        learning_rate=min(_FINE_TUNING_RATE, config.learning_rate),
        schedule="one-cycle",
        frozen_norms=True,
        time_limit_s=None,
    )


def measure_transfer(
    study: TransferStudy, folder: Path, *, device: str | torch.device = "cpu"
) -> list[Transfer]:
    """Train, fine-tune and test a model of every lidar on every lidar.

    Models stay in the folder, below ``scratch`` and ``fine-tuned``; those that are complete are
    not trained again, and one that was interrupted is trained on.

    Parameters
    ----------
    study
        What to train and test.
    folder
        Made where missing.
    device
        Where to train and test.

    Returns
    -------
    list of Transfer
        By the lidar trained on, then tested on, in the order of the study; a model of another
        lidar first as it is, then fine-tuned.

    Raises
    ------
    InvalidInputError
        If a lidar lacks what the features need, or a model in the folder has other settings.
    WriteError
        If the folder cannot be written.
    """
    _check(study)
    found = []
    with tqdm(total=len(study.lidars) ** 2, desc="pairs of lidars", disable=None) as bar:
        for lidar in study.lidars:
            model = _train_from_scratch(study, lidar, Path(folder), device)
            for other in study.lidars:
                found.append(_test(study, model, lidar, other, fine_tuned=False))
                if other != lidar:
                    tuned = _fine_tune(study, model, lidar, other, Path(folder), device)
                    found.append(_test(study, tuned, lidar, other, fine_tuned=True))
                bar.update()
    return found


def _check(study: TransferStudy) -> None:
    """Find what cannot work before hours of training."""
    channels = channel_count(study.config.features)
    statistics = Statistics((0.0,) * channels, (1.0,) * channels)
    for lidar in study.lidars:
        for split in ("train", "val", "test"):
            scans = LidarDataset(
                study.data,
                lidar=lidar,
                split=split,
                scheme=study.scheme,
                features=study.config.features,
                statistics=statistics,
                in_memory=False,
            )
        build_network(study.config.model, channels, len(scans.taxonomy), scans.lidar)
        if lidar == study.lidars[0]:
            taxonomy = scans.taxonomy
        if scans.taxonomy != taxonomy:
            raise InvalidInputError(
                f"{study.data.manifest.name}: {lidar} has other classes than {study.lidars[0]}"
            )


def _train_from_scratch(
    study: TransferStudy, lidar: str, folder: Path, device: str | torch.device
) -> SegmentationNetwork:
    scans = _scans(study, lidar, lidar, "train")
    val = _scans(study, lidar, lidar, "val", scans.statistics)
    here = folder / "scratch" / lidar
    train(study.config, scans, val, here, device=device, resume=True, about=_about(study))
    return load_checkpoint(here, device=device).network


def _fine_tune(
    study: TransferStudy,
    model: SegmentationNetwork,
    trained_on: str,
    tested_on: str,
    folder: Path,
    device: str | torch.device,
) -> SegmentationNetwork:
    scans = _scans(study, tested_on, trained_on, "val")
    here = folder / "fine-tuned" / f"{trained_on}--{tested_on}"
    about = {**_about(study), "reprojected_from": tested_on}
    options: dict[str, Any] = {"device": device, "resume": True, "about": about}
    train(study.fine_tuning, scans, scans, here, initial=model, **options)
    return load_checkpoint(here, device=device).network


def _test(
    study: TransferStudy,
    model: SegmentationNetwork,
    trained_on: str,
    tested_on: str,
    *,
    fine_tuned: bool,
) -> Transfer:
    """Label the test scans as the model's lidar would see them, and score them as measured."""
    seen = _scans(study, tested_on, trained_on, "test")
    measured = LidarDataset(study.data, lidar=tested_on, split="test", scheme=study.scheme)
    reprojection = Reprojection(measured.lidar, seen.lidar)
    in_view, all_beams = Evaluator(seen.taxonomy), Evaluator(seen.taxonomy)
    device = next(model.parameters()).device
    batches = zip(seen.loader(_SCANS_AT_ONCE), measured.loader(_SCANS_AT_ONCE), strict=True)
    for i, (batch, truth) in enumerate(batches):
        seed = int(np.random.SeedSequence((study.config.seed, i)).generate_state(1)[0])
        features = batch["features"].to(device)
        found = inference.infer(model, features, samples=study.samples, seed=seed)
        labels = reprojection.back(found.labels, outside=seen.taxonomy.background_id)
        expected, valid = truth["label"].numpy().astype(np.uint8), truth["valid"].numpy()
        in_view.update(expected, labels, valid & reprojection.in_view)
        all_beams.update(expected, labels, valid)
    return Transfer(trained_on, tested_on, fine_tuned, in_view.compute(), all_beams.compute())


def _scans(
    study: TransferStudy,
    lidar: str,
    target: str,
    split: str,
    statistics: Statistics | None = None,
) -> LidarDataset:
    """Load scans of one lidar, reprojected to the beams of the target where that is another."""
    options: dict[str, Any] = {
        "lidar": lidar,
        "split": split,
        "scheme": study.scheme,
        "features": study.config.features,
        "statistics": statistics,
    }
    if lidar == target:
        return LidarDataset(study.data, **options)
    return ReprojectedScans(study.data, target=study.spec_of(target), **options)


def _about(study: TransferStudy) -> dict[str, str]:
    manifest = study.data.manifest
    return {"name": manifest.name, "version": manifest.version, "scheme": study.scheme}
