"""What samples of a model say of scans."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.errors import InvalidInputError

SEEDS = 2**32
"""Seeds are whole numbers from 0 up to this, which every generator takes."""


@dataclass(frozen=True)
class SampledLabels:
    """What S samples say of N scans.

    Parameters
    ----------
    labels
        (N, B) u1: the class that most samples chose; of equals, the lowest id.
    probabilities
        (N, B, K) f4: softmax, mean over the samples.
    entropy
        (N, B) f4, nats: of those probabilities.
    mutual_information
        (N, B) f4, nats: that entropy less the mean entropy of the samples, which is how much they
        disagree; 0 for a network without a latent.
    samples
        (S, N, B) u1: the class that each sample chose.
    """

    labels: NDArray[np.uint8]
    probabilities: NDArray[np.float32]
    entropy: NDArray[np.float32]
    mutual_information: NDArray[np.float32]
    samples: NDArray[np.uint8]


def check_draw(samples: int, seed: int) -> None:
    """Raise InvalidInputError if so many samples cannot be drawn from such a seed."""
    if samples < 1:
        raise InvalidInputError(f"samples: expected at least 1, found {samples}")
    check_seed(seed)


def check_seed(seed: int) -> None:
    """Raise InvalidInputError if a number is no seed."""
    if not 0 <= seed < SEEDS:
        raise InvalidInputError(
            f"seed: expected a whole number from 0 to {SEEDS - 1}, found {seed}"
        )


def choose(logits: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return the class that each sample chooses, (S, N, B) u1, from its logits (S, N, K, B)."""
    chosen: NDArray[np.uint8] = logits.argmax(2).astype(np.uint8)
    return chosen


def elect(chosen: NDArray[np.uint8], classes: int) -> NDArray[np.uint8]:
    """Return the class (N, B) u1 that most of the samples (S, N, B) u1 chose."""
    elected: NDArray[np.uint8] = chosen[0]
    if len(chosen) > 1:
        ids = np.arange(classes, dtype=np.uint8)[:, None]
        votes = (chosen[:, :, None] == ids).sum(0, dtype=np.int32)  # (N, K, B)
        elected = votes.argmax(1).astype(np.uint8)
    return elected


def summarise(logits: NDArray[np.float32]) -> SampledLabels:
    """Return what the samples of logits (S, N, K, B) f4 say of N scans."""
    chosen = choose(logits)
    weights = np.exp(logits - logits.max(2, keepdims=True))
    each = weights / weights.sum(2, keepdims=True)  # (S, N, K, B)
    mean = each.mean(0)
    entropy = _entropy(mean)
    information = np.maximum(entropy - _entropy(each).mean(0), np.float32(0))
    labels = elect(chosen, logits.shape[2])
    return SampledLabels(labels, mean.swapaxes(1, 2), entropy, information, chosen)


def _entropy(probabilities: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the entropy (..., B) f4 of probabilities (..., K, B)."""
    surprise = -np.log(np.maximum(probabilities, np.finfo(np.float32).tiny))
    entropy: NDArray[np.float32] = (probabilities * surprise).sum(-2)
    return entropy
