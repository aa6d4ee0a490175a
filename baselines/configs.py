"""Settings of a training, and the presets that have a name."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from baselines.sampled_labels import check_seed
from semantic2d_dataset.access.features import normalise_features
from semantic2d_dataset.errors import InvalidInputError

_WARM_UP = 0.1  # of a one-cycle schedule


@dataclass(frozen=True)
class TrainingConfig:
    """Settings of a training; the defaults are the published ones.

    Parameters
    ----------
    model
        Name of the network, of `architectures.ARCHITECTURES`.
    features
        Letters of the input channels.
    epochs
        Passes over the training split. (The published number is not known.)
    batch_size
        Scans in one step of the optimiser.
    micro_batch
        Scans that go through the network at a time, their gradients averaged over the batch;
        None takes the whole batch. In parts of 32, the published batch takes two thirds of the
        time on a CPU, whose cache then holds a layer, but batch norms see 32 scans: `steps.step`.
    learning_rate, weight_decay
        Of Adam.
    schedule
        ``constant``, or ``one-cycle``: up over the first tenth, then down to 0 along a cosine.
    betas
        Weights of cross-entropy, Lovasz-softmax and latent divergence (paper, section on the
        loss).
    class_weight_power
        Median-frequency weights are raised to this power: 1 as published, 0 for equal classes.
    frozen_norms
        Batch norms use the running statistics that the network starts with and keep them, for
        fine-tuning: those of a few scans that look otherwise would undo what was learnt.
    seed
        Of weights, order of scans and latents.
    bf16
        Let convolutions compute with 16 bits.
    augment
        Whether the scans of the training split are changed at random: see
        `transforms.default_augmentation`. (The published training is not known to do so.)
    time_limit_s
        Stop after so many seconds; `schedule` then ends there too.
    """

    model: str = "s3net"
    features: str = "RIA"
    epochs: int = 100
    batch_size: int = 1024
    micro_batch: int | None = None
    learning_rate: float = 1e-4
    weight_decay: float = 1e-3
    schedule: str = "constant"
    betas: tuple[float, float, float] = (1.0, 1.0, 0.01)
    class_weight_power: float = 1.0
    frozen_norms: bool = False
    seed: int = 0
    bf16: bool = False
    augment: bool = False
    time_limit_s: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "features", normalise_features(self.features))
        object.__setattr__(self, "betas", tuple(self.betas))
        for name in ("epochs", "batch_size", "micro_batch", "learning_rate", "time_limit_s"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise InvalidInputError(f"{name}: expected above 0, found {value}")
        if len(self.betas) != 3:
            raise InvalidInputError(f"betas: expected 3 weights, found {len(self.betas)}")
        numbers = {"weight_decay": self.weight_decay, "class_weight_power": self.class_weight_power}
        for name, value in (*numbers.items(), *(("betas", beta) for beta in self.betas)):
            if not 0 <= value < math.inf:
                raise InvalidInputError(f"{name}: expected 0 or more, found {value}")
        check_seed(self.seed)
        if self.schedule not in ("constant", "one-cycle"):
            raise InvalidInputError(
                f"unknown schedule {self.schedule!r}; known are constant and one-cycle"
            )

    @classmethod
    def paper(cls) -> TrainingConfig:
        """Return the published settings."""
        return cls()

    @classmethod
    def quick(cls) -> TrainingConfig:
        """Return settings that reach a useful model on `semantic2d-mini` in two minutes.

        Chosen by the mIoU on its Hokuyo block test after 15 epochs, one seed each: batches of 8
        gave 59 %, of 16 56 %; in batches of 32, class weights to the power 0.5 gave 56 %, the
        published ones 49 %.
        """
        return cls(
            epochs=40,
            batch_size=8,
            learning_rate=5e-3,
            weight_decay=0.0,
            schedule="one-cycle",
            class_weight_power=0.5,
            time_limit_s=120.0,
        )


def learning_rate_at(config: TrainingConfig, progress: float) -> float:
    """Return the learning rate at a progress from 0 to 1."""
    if config.schedule == "constant":
        return config.learning_rate
    if progress < _WARM_UP:
        return config.learning_rate * (0.1 + 0.9 * progress / _WARM_UP)
    cooling = (progress - _WARM_UP) / (1 - _WARM_UP)
    return config.learning_rate * 0.5 * (1 + math.cos(math.pi * cooling))


PRESETS: Mapping[str, Callable[[], TrainingConfig]] = {
    "quick": TrainingConfig.quick,
    "paper": TrainingConfig.paper,
}


def changed_settings(now: Mapping[str, Any], before: Mapping[str, Any]) -> list[str]:
    """Name the settings, as plain values of JSON, that differ from those of an earlier run.

    A setting that the earlier run does not know had its default then.
    """
    defaults = json.loads(json.dumps(asdict(TrainingConfig())))
    return [key for key in now if now[key] != before.get(key, defaults.get(key))]
