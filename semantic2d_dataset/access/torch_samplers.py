"""Orders in which PyTorch draws items."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from torch.utils.data import Sampler


class BlockShuffleSampler(Sampler[int]):
    """Shuffle runs of items, and the items of neighbouring runs with each other.

    A run is one chunk of a file, so that a batch reads few chunks, each of them once.

    Parameters
    ----------
    runs
        Runs of items that are stored together.
    seed
        Seed of the order; every epoch (every iteration) draws a new one.
    window
        How many runs are mixed with each other.
    """

    def __init__(self, runs: Sequence[range], *, seed: int = 0, window: int = 16) -> None:
        self._runs = list(runs)
        self._seed = seed
        self._window = window
        self._epoch = 0

    def __len__(self) -> int:
        return sum(map(len, self._runs))

    def __iter__(self) -> Iterator[int]:
        rng = np.random.default_rng((self._seed, self._epoch))
        self._epoch += 1
        order = rng.permutation(len(self._runs))
        for start in range(0, len(order), self._window):
            chosen = [self._runs[i] for i in order[start : start + self._window]]
            items = np.concatenate([np.arange(run.start, run.stop) for run in chosen])
            yield from rng.permutation(items).tolist()
