"""A training under way: in memory, and on disk to be resumed from."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from baselines.checkpoints import Checkpoint, has_state, read_state, save_checkpoint, write_state
from baselines.configs import TrainingConfig, changed_settings
from baselines.labelled_scans import LabelledScans, describe_scans
from baselines.networks import SegmentationNetwork
from baselines.team import Team
from semantic2d_dataset.errors import CorruptFileError, InvalidInputError
from semantic2d_dataset.format.writing import write_text_atomically

_RESUME = "resume"
_LOG_NAME = "log.csv"


@dataclass
class TrainingRun:
    """What changes while training."""

    network: SegmentationNetwork
    optimiser: torch.optim.Adam
    class_weights: Tensor
    team: Team
    log: list[dict[str, float]] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def device(self) -> torch.device:
        """Where it is trained."""
        return self.class_weights.device

    @property
    def best(self) -> dict[str, float]:
        """The row of the epoch that validates best, the earliest of equals."""
        return max(self.log, key=lambda row: row["val_miou"])


def can_resume(folder: Path) -> bool:
    """Tell whether a training in a folder left a state to resume from."""
    return has_state(folder, _RESUME)


def discard_run(folder: Path) -> None:
    """Delete the state that an earlier training left, so that a new one is never taken for it."""
    (folder / f"{_RESUME}.json").unlink(missing_ok=True)
    for weights in folder.glob(f"{_RESUME}-*.safetensors"):
        weights.unlink(missing_ok=True)


def save_run(
    run: TrainingRun,
    config: TrainingConfig,
    dataset: LabelledScans,
    folder: Path,
    about: Mapping[str, str],
) -> None:
    """Leave the files of a finished epoch; the log comes last, when the rest is there."""
    if run.best is run.log[-1]:
        reached = {key: run.log[-1][key] for key in ("epoch", "val_miou", "seconds")}
        parts = (config.features, dataset.statistics, dataset.lidar, dataset.taxonomy)
        training = asdict(config) | {"reached": reached}
        save_checkpoint(folder, Checkpoint(run.network, *parts, about, training))
    said = {
        "config": asdict(config),
        "log": run.log,
        "statistics": asdict(dataset.statistics),
        "scans": describe_scans(dataset),
    }
    moments = run.optimiser.state_dict()["state"]
    tensors = {f"network/{key}": value for key, value in run.network.state_dict().items()}
    tensors |= {
        f"optimiser/{i}/{key}": value for i, m in moments.items() for key, value in m.items()
    }
    write_state(folder, _RESUME, said, tensors)
    table = io.StringIO()
    writer = csv.DictWriter(table, list(run.log[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(run.log)
    write_text_atomically(folder / _LOG_NAME, table.getvalue())


def restore_run(
    run: TrainingRun, config: TrainingConfig, dataset: LabelledScans, folder: Path
) -> None:
    """Put a run where `save_run` left it."""
    said, tensors = read_state(folder, _RESUME)
    scans = describe_scans(dataset)
    now = asdict(config) | {"statistics": asdict(dataset.statistics)} | scans
    now = json.loads(json.dumps(now))
    try:
        before = said["config"] | {"statistics": said["statistics"]} | said.get("scans", scans)
        changed = changed_settings(now, before)
        log, seconds = list(said["log"]), float(said["log"][-1]["seconds"])
    except (KeyError, TypeError, IndexError, ValueError) as err:
        raise CorruptFileError(f"{folder}: the state to resume from is damaged: {err!r}") from err
    if changed:
        raise InvalidInputError(
            f"{folder}: cannot resume, because other settings were used for "
            f"{', '.join(changed)}; use the same, or another folder"
        )
    state = run.optimiser.state_dict()
    for name, value in tensors.items():
        kind, *rest = name.split("/")
        if kind == "optimiser":
            state["state"].setdefault(int(rest[0]), {})[rest[1]] = value
    weights = {
        name.removeprefix("network/"): value
        for name, value in tensors.items()
        if name.startswith("network/")
    }
    run.network.load_state_dict(weights)
    run.optimiser.load_state_dict(state)
    run.log, run.seconds = log, seconds
