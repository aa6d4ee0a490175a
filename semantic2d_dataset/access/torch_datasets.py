"""PyTorch Datasets: one class per lidar of the release, and one for any other."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import torch
from numpy.typing import NDArray

from semantic2d_dataset.access.buffers import Buffers
from semantic2d_dataset.access.features import (
    Statistics,
    channel_count,
    features_of,
    normalise_features,
    targets_of,
)
from semantic2d_dataset.access.histories import History, PastScans
from semantic2d_dataset.access.leak_warnings import warn_of_leaks
from semantic2d_dataset.access.registry import OpenDataset, open_dataset
from semantic2d_dataset.access.scan_source import Fields, ScanSource
from semantic2d_dataset.access.torch_batches import Batch, BatchedDataset
from semantic2d_dataset.access.transforms import Transform
from semantic2d_dataset.errors import DatasetNotFoundError, InvalidInputError
from semantic2d_dataset.scene.geometry import incidence_angles
from semantic2d_dataset.scene.lidars import HOKUYO_UTM_30LX_EW, RPLIDAR_S2, WLR_716, LidarSpec
from semantic2d_dataset.scene.taxonomy import Taxonomy

# A past scan lies in the same chunk, or in the one before: neighbours are read together.
_CHUNKS_WITH_PAST = 4


class LidarDataset(BatchedDataset):
    """Labelled scans of one lidar from one split of a data set.

    Items are dicts of tensors. Without `features`: ``ranges``, ``intensities`` (where the lidar
    gives them), ``incidence``, each (B,) f4 in m, sensor units and rad; ``label`` (B,) i64, 255
    where unlabelled; ``valid`` (B,) bool, true where the beam has a return; ``pose`` (3,) f8 x y
    yaw; ``scan_id`` str. With `features`: ``features`` (C, B) f4, standardised, and ``label``,
    ``valid``, ``scan_id``. With `history`, k past scans besides, the oldest first:
    ``history_features`` (k, C, B) f4, standardised alike, or ``history_ranges`` and
    ``history_intensities`` (k, B) f4; ``history_poses`` (k, 3) f4, the past base in the current
    base's frame; ``history_valid`` (k,) bool, whether there is such a scan; ``history_dt_s``
    (k,) f4, its age; where asked for, ``history_points`` (k, B, 2) f4 and ``history_label``
    (k, B) i64. A scan that is not there has no return.

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
    history
        Past scans that come with each scan; not beside a transform, which would not change them
        alike.

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
        history: History | None = None,
    ) -> None:
        name = lidar or (self.spec.name if self.spec else None)
        if name is None:
            raise InvalidInputError("say which lidar, such as lidar='hokuyo'")
        self.features = None if features is None else normalise_features(features)
        if split == "train":
            warn_of_leaks(data, scheme)
        self.transform, self.transform_seed = transform, transform_seed
        self._buffers = Buffers()
        if history is not None and transform is not None:
            raise InvalidInputError(
                "a transform changes each scan by itself, so that its past would not fit it; "
                "give either history or transform"
            )
        self.source = self.open_source(
            data, lidar=name, split=split, scheme=scheme, in_memory=in_memory
        )
        if "I" in (self.features or "") and not self.source.has_intensities:
            raise InvalidInputError(
                f"{data.manifest.name}: {self.lidar.name} gives no intensities; leave I out of "
                f"the features {self.features}"
            )
        self._past = PastScans(self.source, history) if history else None
        self.chunks_in_run = 1 if history is None else _CHUNKS_WITH_PAST
        self._statistics: Statistics | None = None
        if self.features:
            found = statistics or _train_part(self.source).compute_statistics(self.features)
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

    def fetch_batch(self, wanted: NDArray[np.int64]) -> Batch:
        """Return a collated batch of the items of numbers from 0 on."""
        fields, rows = self.source.fetch(wanted)
        if self.transform is not None:
            fields = {name: values[rows] for name, values in fields.items()}
            rng = np.random.default_rng((self.transform_seed, *wanted.tolist()))
            fields, rows = self.transform(fields, self.lidar, rng), np.arange(len(wanted))
        ids = self.source.scan_ids[wanted].tolist()
        batch = self._tensors(fields, rows) | {"scan_id": ids}
        return batch if self._past is None else batch | self._past_tensors(wanted, self._past)

    def chunk_runs(self) -> list[range]:
        """Return runs of items that are read together."""
        return self.source.chunk_runs(self.chunks_in_run)

    @property
    def in_memory(self) -> bool:
        """Whether the split is kept in memory."""
        return self.source.in_memory

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

    @property
    def scan_class_counts(self) -> NDArray[np.int32]:
        """Labelled beams with a return of each scan by class id, (N, K) i4."""
        return self.source.scan_class_counts

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

    def _past_tensors(self, wanted: NDArray[np.int64], past: PastScans) -> Batch:
        """Return the past of some items: k scans each, whose beams are computed like theirs."""
        found = past.fetch(wanted)
        if self.features:
            shape = found["ranges"].shape
            flat = {
                name: found.pop(name).reshape(-1, shape[-1])
                for name in ("ranges", "intensities")
                if name in found
            }
            inputs = features_of(
                flat["ranges"],
                flat.get("intensities"),
                self.lidar,
                self.features,
                self.statistics,
                buffers=self._buffers,
            )
            found["features"] = inputs.reshape(*shape[:2], -1, shape[-1])
        if "labels" in found:
            found["label"] = found.pop("labels").astype(np.int64)
        return {f"history_{name}": torch.from_numpy(found[name]) for name in found}


class HokuyoUTM30LXEW(LidarDataset):
    """Scans of the Hokuyo UTM-30LX-EW: 1081 beams over 270 degrees."""

    spec = HOKUYO_UTM_30LX_EW


class WLR716(LidarDataset):
    """Scans of the WLR-716: 811 beams over 270 degrees."""

    spec = WLR_716


class RPLidarS2(LidarDataset):
    """Scans of the RPLIDAR-S2: 1972 beams over 360 degrees."""

    spec = RPLIDAR_S2


def _train_part(source: ScanSource) -> ScanSource:
    if source.split == "train":
        return source
    try:
        return source.of_split("train")
    except DatasetNotFoundError as err:
        trained = " or ".join(map(repr, source.data.lidars_of(source.scheme, "train")))
        raise InvalidInputError(
            f"{source.data.manifest.name}: the scheme {source.scheme!r} has no train scan of "
            f"{source.lidar.name} to standardise its features by; load the scans that the model "
            f"is trained on (split='train', lidar={trained}), and give their statistics here: "
            "statistics=train.statistics"
        ) from err


_CLASSES = {
    cls.spec.name: cls for cls in (HokuyoUTM30LXEW, WLR716, RPLidarS2) if cls.spec is not None
}


def load_lidar(
    data: OpenDataset, *, lidar: str, split: str | None = "train", **options: Any
) -> LidarDataset:
    """Load one lidar's scans of one split, by the class of that lidar.

    Parameters
    ----------
    data
        An open data set.
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
    """
    found = data.sequences(lidar)[0].lidar
    return _CLASSES.get(found, LidarDataset)(data, lidar=found, split=split, **options)
