"""What training needs of a data set."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from torch.utils.data import DataLoader

from baselines.configs import TrainingConfig
from semantic2d_dataset.access.features import Statistics, channel_count
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.lidars import LidarSpec
from semantic2d_dataset.scene.taxonomy import Taxonomy


class LabelledScans(Protocol):
    """What training needs of a data set; `semantic2d_dataset.load_dataset` returns one."""

    @property
    def lidar(self) -> LidarSpec:
        """The sensor of all scans."""

    @property
    def taxonomy(self) -> Taxonomy:
        """The K classes of the labels."""

    @property
    def class_counts(self) -> NDArray[np.int64]:
        """Labelled beams with a return of each class, (K,) i8."""

    @property
    def statistics(self) -> Statistics:
        """What standardised the features."""

    def __len__(self) -> int: ...

    def loader(self, batch_size: int, *, shuffle: bool, seed: int) -> DataLoader[dict[str, Any]]:
        """Batches with ``features`` (N, C, B) f4, ``label`` (N, B) i8, ``valid`` (N, B) bool."""


def check_scans(config: TrainingConfig, *datasets: LabelledScans) -> None:
    """Raise InvalidInputError if scans cannot be trained on, or not together."""
    first = datasets[0]
    for dataset in datasets:
        if len(dataset) == 0:
            raise InvalidInputError("training needs at least one scan in train and val each")
        if (dataset.lidar, dataset.taxonomy) != (first.lidar, first.taxonomy):
            raise InvalidInputError("train and val are of different lidars or classes")
        if dataset.statistics != first.statistics:
            raise InvalidInputError("val must be standardised by the statistics of train")
    channels = channel_count(config.features)
    if len(first.statistics.mean) != channels:
        raise InvalidInputError(
            f"features {config.features} are {channels} channels, and the data set has "
            f"{len(first.statistics.mean)}; load it with features={config.features!r}"
        )
    if config.augment and getattr(first, "transform", None) is None:  # few data sets have one
        raise InvalidInputError(
            "augment: the training split has no transform; load it with, say, "
            "transform=default_augmentation(lidar)"
        )


def describe_scans(dataset: LabelledScans) -> dict[str, Any]:
    """Tell the scans of a training from others."""
    return {
        "lidar": dataset.lidar.name,
        "class names": list(dataset.taxonomy.names),
        "class counts": np.asarray(dataset.class_counts).tolist(),
    }
