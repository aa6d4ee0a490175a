"""PyTorch Datasets: one class per lidar of the release, and one for any other."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Self, overload

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader, Dataset

from semantic2d_dataset.access.buffers import Buffers
from semantic2d_dataset.access.features import (
    Statistics,
    channel_count,
    features_of,
    normalise_features,
    targets_of,
)
from semantic2d_dataset.access.registry import OpenDataset, open_dataset
from semantic2d_dataset.access.scan_source import Fields, ScanSource
from semantic2d_dataset.access.torch_samplers import BlockShuffleSampler
from semantic2d_dataset.access.transforms import Transform
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.geometry import incidence_angles
from semantic2d_dataset.scene.lidars import HOKUYO_UTM_30LX_EW, RPLIDAR_S2, WLR_716, LidarSpec
from semantic2d_dataset.scene.taxonomy import Taxonomy

Batch = dict[str, Any]


class BatchView(Sequence[Batch]):
    """A collated batch that also reads as the list of its items, for any collate function."""

    def __init__(self, batch: Batch) -> None:
        self.batch = batch

    def __len__(self) -> int:
        return len(self.batch["scan_id"])

    @overload
    def __getitem__(self, index: int) -> Batch: ...
    @overload
    def __getitem__(self, index: slice) -> list[Batch]: ...
    def __getitem__(self, index: int | slice) -> Batch | list[Batch]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        return {key: value[index] for key, value in self.batch.items()}


class LidarDataset(Dataset[Batch]):
    """Labelled scans of one lidar from one split of a data set.

    Items are dicts of tensors. Without `features`: ``ranges``, ``intensities`` (where the lidar
    gives them), ``incidence``, each (B,) f4 in m, sensor units and rad; ``label`` (B,) i64, 255
    where unlabelled; ``valid`` (B,) bool, true where the beam has a return; ``pose`` (3,) f8 x y
    yaw; ``scan_id`` str. With `features`: ``features`` (C, B) f4, standardised, and ``label``,
    ``valid``, ``scan_id``.

    A DataLoader fetches whole batches at once; give it ``collate_fn=dataset.collate``, or use
    `loader`, which also shuffles by blocks where the data does not fit in memory.

    Parameters
    ----------
    data
        An open data set.
    lidar
        Id or short name of the lidar.
    split
        ``train``, ``val`` (or ``dev``), ``test``; None takes every scan.
    scheme
        How the data set is divided; ``block`` is disjoint in time.
    features
        Letters of R, I, P, A in any order, or None for the raw fields.
    statistics
        Standardises features; those of the train split where not given.
    in_memory
        Keep the split in memory; where not given, when it fits in half of what is free.
    transform
        Changes scans before their features are computed, such as
        `transforms.default_augmentation`; statistics and `class_counts` stay those of the scans
        as they were measured.
    transform_seed
        Its randomness comes from this seed and the indices of the batch, in their order: it is
        the same with any number of workers, and differs between epochs that are shuffled, but
        for a scan that is a batch by itself.

    Raises
    ------
    DatasetNotFoundError, InvalidInputError
        If the lidar, split, scheme or features are unknown, or the split is empty.
    CorruptFileError
        If a file is damaged.
    """

    spec: ClassVar[LidarSpec | None] = None

    def __init__(
        self,
        data: OpenDataset,
        *,
        lidar: str | None = None,
        split: str | None = "train",
        scheme: str = "block",
        features: str | None = None,
        statistics: Statistics | None = None,
        in_memory: bool | None = None,
        transform: Transform | None = None,
        transform_seed: int = 0,
    ) -> None:
        name = lidar or (self.spec.name if self.spec else None)
        if name is None:
            raise InvalidInputError("say which lidar, such as lidar='hokuyo'")
        self.features = None if features is None else normalise_features(features)
        self.transform, self.transform_seed = transform, transform_seed
        self._buffers = Buffers()
        self._measured_by = name
        self.source = self.open_source(
            data, lidar=name, split=split, scheme=scheme, in_memory=in_memory
        )
        if "I" in (self.features or "") and not self.source.has_intensities:
            raise InvalidInputError(
                f"{data.manifest.name}: {self.lidar.name} gives no intensities; leave I out of "
                f"the features {self.features}"
            )
        self._statistics: Statistics | None = None
        if self.features:
            found = statistics or self._train_source().compute_statistics(self.features)
            if len(found.mean) != channel_count(self.features):
                raise InvalidInputError(
                    f"features {self.features} have {channel_count(self.features)} channels, the "
                    f"statistics {len(found.mean)}"
                )
            self._statistics = found

    @classmethod
    def from_path(cls, path: str | Path, **options: Any) -> Self:
        """Open one's own data set by its folder; options as for the class."""
        return cls(open_dataset(Path(path)), **options)

    def open_source(self, data: OpenDataset, **options: Any) -> ScanSource:
        """Open the scans of a split; a subclass may give them another geometry."""
        return ScanSource(data, **options)

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, index: int) -> Batch:
        return self.__getitems__([index])[0]

    def __getitems__(self, indices: Sequence[int]) -> BatchView:
        """Fetch the items of a whole batch at once."""
        wanted = np.asarray(indices, np.int64)
        wanted = np.where(wanted < 0, wanted + len(self), wanted)
        if wanted.size and not (wanted.min() >= 0 and wanted.max() < len(self)):
            raise IndexError(f"expected indices below {len(self)}, found {list(indices)}")
        fields, rows = self.source.fetch(wanted)
        if self.transform is not None:
            fields = {name: values[rows] for name, values in fields.items()}
            rng = np.random.default_rng((self.transform_seed, *wanted.tolist()))
            fields, rows = self.transform(fields, self.lidar, rng), np.arange(len(wanted))
        ids = self.source.scan_ids[wanted].tolist()
        return BatchView(self._tensors(fields, rows) | {"scan_id": ids})

    @property
    def lidar(self) -> LidarSpec:
        """The sensor."""
        return self.source.lidar

    @property
    def taxonomy(self) -> Taxonomy:
        """The classes that labels refer to."""
        return self.source.taxonomy

    @property
    def statistics(self) -> Statistics:
        """What standardises the features.

        Raises
        ------
        InvalidInputError
            If the data set was loaded without features.
        """
        if self._statistics is None:
            raise InvalidInputError(
                f"{self.source.data.manifest.name}: was loaded without features, which alone are "
                "standardised; load it with, say, features='RIA'"
            )
        return self._statistics

    @cached_property
    def class_counts(self) -> NDArray[np.int64]:
        """Number of labelled beams with a return by class id, (C,) i8, over this split."""
        return self.source.class_counts()

    @staticmethod
    def collate(items: Sequence[Batch]) -> Batch:
        """Collate a batch; what ``__getitems__`` returned is one already."""
        if isinstance(items, BatchView):
            return items.batch
        collated: Batch = torch.utils.data.default_collate(list(items))
        return collated

    def loader(
        self, batch_size: int = 256, *, shuffle: bool = False, seed: int = 0, **options: Any
    ) -> DataLoader[Batch]:
        """Return a DataLoader suited to this data set.

        Parameters
        ----------
        batch_size
            Items in a batch.
        shuffle
            Draw a new order each epoch: over everything in memory, by blocks otherwise.
        seed
            Seed of the order.
        options
            Passed on to `torch.utils.data.DataLoader`.
        """
        if shuffle and not self.source.in_memory:
            options["sampler"] = BlockShuffleSampler(self.source.chunk_runs(), seed=seed)
        elif shuffle:
            options |= {"shuffle": True, "generator": torch.Generator().manual_seed(seed)}
        return DataLoader(self, batch_size=batch_size, collate_fn=self.collate, **options)

    def _train_source(self) -> ScanSource:
        source = self.source
        if source.split == "train":
            return source
        return self.open_source(
            source.data,
            lidar=self._measured_by,
            split="train",
            scheme=source.scheme,
            in_memory=False,
        )

    def _tensors(self, fields: Fields, rows: NDArray[np.int64]) -> Batch:
        label, valid = targets_of(
            fields["ranges"], fields["labels"], self.lidar, rows, buffers=self._buffers
        )
        batch = {"label": torch.from_numpy(label), "valid": torch.from_numpy(valid)}
        if self.features:
            inputs = features_of(
                fields["ranges"],
                fields.get("intensities"),
                self.lidar,
                self.features,
                self.statistics,
                rows,
                buffers=self._buffers,
            )
            return {"features": torch.from_numpy(inputs)} | batch
        ranges = fields["ranges"][rows]
        batch |= {
            "ranges": torch.from_numpy(ranges),
            "incidence": torch.from_numpy(incidence_angles(ranges, self.lidar.angle_increment)),
            "pose": torch.from_numpy(fields["poses"][rows]),
        }
        if "intensities" in fields:
            batch["intensities"] = torch.from_numpy(fields["intensities"][rows])
        return batch


class HokuyoUTM30LXEW(LidarDataset):
    """Scans of the Hokuyo UTM-30LX-EW: 1081 beams over 270 degrees."""

    spec = HOKUYO_UTM_30LX_EW


class WLR716(LidarDataset):
    """Scans of the WLR-716: 811 beams over 270 degrees."""

    spec = WLR_716


class RPLidarS2(LidarDataset):
    """Scans of the RPLIDAR-S2: 1972 beams over 360 degrees."""

    spec = RPLIDAR_S2


_CLASSES = {
    cls.spec.name: cls for cls in (HokuyoUTM30LXEW, WLR716, RPLidarS2) if cls.spec is not None
}


def load_dataset(
    name: str | Path, *, lidar: str, split: str | None = "train", **options: Any
) -> LidarDataset:
    """Load one lidar's scans of one split of a data set.

    Parameters
    ----------
    name
        ``semantic2d-mini`` (made on first use), or the folder of a data set.
    lidar
        ``hokuyo``, ``wlr716``, ``rplidar``, or any name that the data set uses.
    split
        ``train``, ``val`` (or ``dev``), ``test``; None takes every scan.
    options
        As for `LidarDataset`.

    Raises
    ------
    DatasetNotFoundError, InvalidInputError, CorruptFileError
        As from `LidarDataset`.

    Examples
    --------
    >>> train = load_dataset("semantic2d-mini", lidar="hokuyo", features="RIA")  # doctest: +SKIP
    """
    data = open_dataset(name)
    found = data.sequences(lidar)[0].lidar
    return _CLASSES.get(found, LidarDataset)(data, lidar=found, split=split, **options)
