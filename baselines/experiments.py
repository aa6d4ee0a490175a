"""Which trainings make up each table of the paper."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass
from itertools import combinations

from baselines.architectures import ARCHITECTURES
from baselines.detectors import DETECTORS
from baselines.s3net import S3Net
from baselines.sampled_labels import SEEDS
from semantic2d_dataset.access.features import FEATURES
from semantic2d_dataset.errors import InvalidInputError

COMBINATIONS = tuple(
    "".join(letters) for n in range(1, len(FEATURES) + 1) for letters in combinations(FEATURES, n)
)
"""All 15 subsets of the features, in the order of the paper's table."""

MAIN_FEATURES = ("R", "RI", "RIA")
"""The combinations that the paper's findings and pictures are about."""

TRANSFER = "transfer"
"""The experiment across lidars, which `transfer.measure_transfer` runs."""


@dataclass(frozen=True)
class RunSpec:
    """One training: a model, the letters of its features, the lidar and the seed.

    A method that learns nothing has no features; it is scored only.
    """

    model: str
    features: str
    lidar: str
    seed: int

    @property
    def name(self) -> str:
        """The name of its folder."""
        what = f"{self.model}-{self.features}" if self.features else self.model
        return f"{what}-{self.lidar}-seed{self.seed}"


@dataclass(frozen=True)
class Method:
    """A row of a table: a model with features, trained with every seed or with the first only."""

    model: str
    features: str
    _: KW_ONLY
    every_seed: bool = True

    def runs(self, lidar: str, seeds: tuple[int, ...]) -> tuple[RunSpec, ...]:
        """Return its trainings."""
        chosen = seeds if self.every_seed else seeds[:1]
        return tuple(RunSpec(self.model, self.features, lidar, seed) for seed in chosen)


@dataclass(frozen=True)
class Experiment:
    """A table to be reproduced.

    Parameters
    ----------
    name
        On the command line.
    title
        Above the table.
    methods
        Its rows.
    """

    name: str
    title: str
    methods: tuple[Method, ...]


_NEWER = tuple(name for name in ARCHITECTURES if name != S3Net.name)

EXPERIMENTS: Mapping[str, Experiment] = {
    experiment.name: experiment
    for experiment in (
        Experiment(
            "table-segmentation",
            "Segmentation results",
            (
                *(Method(name, "", every_seed=False) for name in DETECTORS),
                *(
                    Method(S3Net.name, letters, every_seed=letters in MAIN_FEATURES)
                    for letters in COMBINATIONS
                ),
                *(Method(name, "RIA") for name in _NEWER),
            ),
        ),
        Experiment(
            "ablation",
            "Segmentation results of S3-Net by features",
            tuple(Method(S3Net.name, letters) for letters in COMBINATIONS),
        ),
    )
}


def find_experiment(name: str) -> Experiment:
    """Return an experiment by its name.

    Raises
    ------
    InvalidInputError
        If there is none of that name.
    """
    if name not in EXPERIMENTS:
        known = ", ".join((*EXPERIMENTS, TRANSFER))
        raise InvalidInputError(f"unknown experiment {name!r}; known are {known}")
    return EXPERIMENTS[name]


def parse_seeds(text: str) -> tuple[int, ...]:
    """Read seeds, such as ``0,1,2``.

    Raises
    ------
    InvalidInputError
        If they are anything but different whole numbers from 0.
    """
    words = [word.strip() for word in text.split(",")]
    plain = all(word.isascii() and word.isdigit() for word in words)
    seeds = tuple(int(word) for word in words) if plain else ()
    if not seeds or len(set(seeds)) != len(seeds) or max(seeds) >= SEEDS:
        raise InvalidInputError(
            f"seeds: expected different whole numbers from 0, such as 0,1,2; found {text!r}"
        )
    return seeds
