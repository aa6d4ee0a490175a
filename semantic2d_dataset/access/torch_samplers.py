"""Orders in which PyTorch draws items, for one process or a team of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray
from torch import distributed
from torch.utils.data import Sampler

from semantic2d_dataset.errors import InvalidInputError


@dataclass(frozen=True)
class Shard:
    """Which part of every epoch a process of a team takes.

    Parameters
    ----------
    rank
        Which of them this process is, from 0.
    replicas
        How many processes there are.
    uneven
        What is done with items that do not go round: ``drop`` leaves out the last ones of the
        epoch's order, at most ``replicas - 1``; ``pad`` gives its first ones out a second time;
        ``keep`` gives some processes one item more, which is right for predicting and wrong for
        training, as processes that average gradients wait for each other.

    Raises
    ------
    InvalidInputError
        If there is no such rank or way.
    """

    rank: int = 0
    replicas: int = 1
    uneven: Literal["drop", "pad", "keep"] = "drop"

    def __post_init__(self) -> None:
        if not 0 <= self.rank < self.replicas:
            raise InvalidInputError(
                f"shard: expected a rank of 0 to {self.replicas - 1}, found {self.rank}"
            )
        if self.uneven not in ("drop", "pad", "keep"):
            raise InvalidInputError(
                f"shard: uneven must be 'drop', 'pad' or 'keep', found {self.uneven!r}"
            )

    @classmethod
    def current(cls, uneven: Literal["drop", "pad", "keep"] = "drop") -> Self:
        """Return the part of this process of torch.distributed; all where that is not in use."""
        if not (distributed.is_available() and distributed.is_initialized()):
            return cls(uneven=uneven)
        return cls(distributed.get_rank(), distributed.get_world_size(), uneven)

    def size(self, count: int) -> int:
        """Return how many of so many items the part has."""
        return len(self.cut(count))

    def cut(self, count: int) -> NDArray[np.int64]:
        """Return the positions of the part in an order of so many items, neighbours all of them.

        Raises
        ------
        InvalidInputError
            If there are fewer items than processes.
        """
        if count < self.replicas:
            raise InvalidInputError(f"{count} items are too few for {self.replicas} processes")
        if self.uneven == "keep":
            borders = [count * rank // self.replicas for rank in (self.rank, self.rank + 1)]
            return np.arange(*borders)
        share = -(-count // self.replicas) if self.uneven == "pad" else count // self.replicas
        return np.arange(self.rank * share, (self.rank + 1) * share) % count


class BlockShuffleSampler(Sampler[int]):
    """Shuffle runs of items, and the items of neighbouring runs with each other.

    A run is one chunk of a file, so that a batch reads few chunks, each of them once. The
    processes of a team make the same order of runs, from seed and epoch, and each takes a
    stretch of it: it reads whole chunks, but for those at the stretch's two ends.

    Parameters
    ----------
    runs
        Runs of items that are stored together.
    seed
        Seed of the order; every epoch (every iteration) draws a new one.
    window
        How many runs are mixed with each other; all where None, as suits what is in memory.
    shard
        The part of this process.
    """

    def __init__(
        self,
        runs: Sequence[range],
        *,
        seed: int = 0,
        window: int | None = 16,
        shard: Shard | None = None,
    ) -> None:
        self._starts = np.array([run.start for run in runs], np.int64)
        self._lengths = np.array([len(run) for run in runs], np.int64)
        self._seed = seed
        self._window = window or max(1, len(runs))
        self._shard = shard or Shard()
        self._epoch = 0

    def __len__(self) -> int:
        return self._shard.size(int(self._lengths.sum()))

    def __iter__(self) -> Iterator[int]:
        rng = np.random.default_rng((self._seed, self._epoch))
        self._epoch += 1
        order = rng.permutation(len(self._lengths))
        items, run = self._repeat(*self._in_order(order), rng)
        part = self._shard.cut(len(items))
        items, run = items[part], run[part]
        window = np.cumsum(np.diff(run, prepend=run[:1]) != 0) // self._window
        for mixed in np.split(items, np.flatnonzero(np.diff(window)) + 1):
            yield from rng.permutation(mixed).tolist()

    def set_epoch(self, epoch: int) -> None:
        """Go on with an epoch, from 0: to resume, or to skip some."""
        self._epoch = epoch

    def _in_order(self, order: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return all items, run after run, and the place of each one's run in the order."""
        lengths = self._lengths[order]
        shifts = self._starts[order] - (np.cumsum(lengths) - lengths)
        return np.repeat(shifts, lengths) + np.arange(lengths.sum()), np.repeat(
            np.arange(len(order)), lengths
        )

    def _repeat(
        self,
        items: NDArray[np.int64],
        run: NDArray[np.int64],
        rng: np.random.Generator,  # noqa: ARG002 - of those who draw some items more often
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        return items, run


class ClassBalancedSampler(BlockShuffleSampler):
    """Shuffle by blocks, and draw some items more often than others.

    An epoch has as many items as there are; each is drawn as often as its weight says, rounded
    up or down anew each epoch (systematic resampling: Kitagawa 1996, appendix). Repeats stay
    beside each other until the items of a window are mixed, so that whole chunks are streamed
    as without weights, and those without an item that is drawn are not read.

    Parameters
    ----------
    runs
        Runs of items that are stored together; of all items, in their order.
    weights
        (N,) f8, how often each item is wanted, of mean 1: see `class_counts.balancing_weights`.
    options
        As for `BlockShuffleSampler`. Processes of a team share no item but one that is drawn on
        both sides of the border between two stretches.

    Raises
    ------
    InvalidInputError
        If there is not one weight for each item.
    """

    def __init__(
        self,
        runs: Sequence[range],
        weights: NDArray[np.float64],
        *,
        seed: int = 0,
        window: int | None = 16,
        shard: Shard | None = None,
    ) -> None:
        super().__init__(runs, seed=seed, window=window, shard=shard)
        if weights.shape != (self._lengths.sum(),) or not weights.min() >= 0 < weights.sum():
            raise InvalidInputError(
                f"expected {self._lengths.sum()} weights of 0 or more, found {weights.shape}"
            )
        self._sums = np.cumsum(weights) * (len(weights) / weights.sum())
        self._sums[-1] = len(weights)

    def _repeat(
        self, items: NDArray[np.int64], run: NDArray[np.int64], rng: np.random.Generator
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        times = np.diff(np.floor(self._sums + rng.random()), prepend=0.0).astype(np.int64)[items]
        return np.repeat(items, times), np.repeat(run, times)
