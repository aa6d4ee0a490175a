"""What Datasets of scans have in common: whole batches at once, and the loader that suits them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, overload

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader, Dataset

from semantic2d_dataset.access.class_counts import balancing_weights
from semantic2d_dataset.access.torch_samplers import (
    BlockShuffleSampler,
    ClassBalancedSampler,
    Shard,
)
from semantic2d_dataset.errors import InvalidInputError

Batch = dict[str, Any]

_MIXED_CHUNKS = 16


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


class BatchedDataset(Dataset[Batch], ABC):
    """Items that are fetched by whole batches.

    A DataLoader fetches whole batches at once; give it ``collate_fn=dataset.collate``, or use
    `loader`, which also shuffles by blocks where the data does not fit in memory.
    """

    chunks_in_run: int = 1
    """How many neighbouring chunks of a file are read together."""

    @abstractmethod
    def __len__(self) -> int: ...

    @property
    @abstractmethod
    def in_memory(self) -> bool:
        """Whether items are drawn from memory in any order at the same cost."""

    @property
    @abstractmethod
    def scan_class_counts(self) -> NDArray[np.int32]:
        """Labelled beams with a return of each scan by class id, (N, K) i4."""

    @abstractmethod
    def chunk_runs(self) -> list[range]:
        """Return runs of items that are read together."""

    @abstractmethod
    def fetch_batch(self, wanted: NDArray[np.int64]) -> Batch:
        """Return a collated batch of the items of numbers from 0 on."""

    def __getitem__(self, index: int) -> Batch:
        return self.__getitems__([index])[0]

    def __getitems__(self, indices: Sequence[int]) -> BatchView:
        """Fetch the items of a whole batch at once."""
        wanted = np.asarray(indices, np.int64)
        wanted = np.where(wanted < 0, wanted + len(self), wanted)
        if wanted.size and not (wanted.min() >= 0 and wanted.max() < len(self)):
            raise IndexError(f"expected indices below {len(self)}, found {list(indices)}")
        return BatchView(self.fetch_batch(wanted))

    @staticmethod
    def collate(items: Sequence[Batch]) -> Batch:
        """Collate a batch; what ``__getitems__`` returned is one already."""
        if isinstance(items, BatchView):
            return items.batch
        collated: Batch = torch.utils.data.default_collate(list(items))
        return collated

    def loader(
        self,
        batch_size: int = 256,
        *,
        shuffle: bool = False,
        seed: int = 0,
        balance: float = 0.0,
        shard: Shard | None = None,
        **options: Any,
    ) -> DataLoader[Batch]:
        """Return a DataLoader suited to this data set.

        Parameters
        ----------
        batch_size
            Items in a batch.
        shuffle
            Draw a new order each epoch: over everything in memory, by blocks otherwise. The
            order depends on the seed and the number of the epoch alone, which
            ``loader.sampler.set_epoch`` sets, to resume.
        seed
            Seed of the order.
        balance
            Draw scans with rare classes more often: 0 not, 0.5 by the square root of the
            inverse of their frequency, up to 1 for the inverse itself, see
            `class_counts.balancing_weights`. Reads every label once, when first asked for.
        shard
            The part of this process where several train together, such as `Shard.current`;
            everything where not given.
        options
            Passed on to `torch.utils.data.DataLoader`.

        Raises
        ------
        InvalidInputError
            If `balance` is out of its domain or given without `shuffle`, or there are fewer
            items than processes.
        """
        if balance and not shuffle:
            raise InvalidInputError("balance draws scans at random: it needs shuffle=True")
        if shuffle:
            options["sampler"] = self._sampler(seed, balance, shard or Shard())
            options.setdefault("generator", torch.Generator().manual_seed(seed))
        elif shard is not None:
            options["sampler"] = shard.cut(len(self)).tolist()
        return DataLoader(self, batch_size=batch_size, collate_fn=self.collate, **options)

    def _sampler(self, seed: int, balance: float, shard: Shard) -> BlockShuffleSampler:
        runs = self.chunk_runs()
        window = None if self.in_memory else _MIXED_CHUNKS // self.chunks_in_run
        if not balance:
            return BlockShuffleSampler(runs, seed=seed, window=window, shard=shard)
        weights = balancing_weights(self.scan_class_counts, balance)
        return ClassBalancedSampler(runs, weights, seed=seed, window=window, shard=shard)
