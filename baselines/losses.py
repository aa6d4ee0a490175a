"""What S3-Net minimises: cross-entropy, Lovasz-softmax and the divergence of its latent.

Every function leaves targets of 255 out. Beams without a return are given that target in
training as in scoring: their range is unknown, so a class for them would be learnt from the
feature value 0, which the score never sees.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from baselines.networks import Prediction
from semantic2d_dataset.scene.taxonomy import UNLABELLED

# Median frequency of each class over the Hokuyo training set, ids 0..9, as in the published
# code (github.com/TempleRAIL/s3_net).
HOKUYO_CLASS_WEIGHTS = (
    2.514399,
    1.4917144,
    0.51608694,
    0.659483,
    1.0900991,
    1.6461798,
    0.32852992,
    1.5633508,
    0.9236576,
    0.10251398,
)

_BINS = 1024


class LossTerms(NamedTuple):
    """The terms of the loss before they are weighted, each a scalar."""

    cross_entropy: Tensor
    lovasz: Tensor
    divergence: Tensor

    def total(self, betas: Sequence[float]) -> Tensor:
        """Return the sum weighted by three betas (paper, equation of the loss)."""
        first, second, third = betas
        return first * self.cross_entropy + second * self.lovasz + third * self.divergence


def loss_terms(prediction: Prediction, target: Tensor, class_weights: Tensor) -> LossTerms:
    """Return the three terms for one batch.

    Parameters
    ----------
    prediction
        What the network gave, with logits (N, K, B) f4.
    target
        (N, B) i8 class ids, 255 left out.
    class_weights
        (K,) f4.
    """
    logits, labels = labelled_points(prediction.logits, target)
    log_probabilities = logits.log_softmax(0)
    return LossTerms(
        weighted_cross_entropy(log_probabilities, labels, class_weights) / target.shape[0],
        lovasz_softmax(log_probabilities.exp(), labels, class_weights),
        latent_divergence(prediction),
    )


def labelled_points(logits: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Return the logits (K, P) and class ids (P,) of the P beams whose target is not 255."""
    kept = (target != UNLABELLED).flatten().nonzero().squeeze(1)
    by_point = logits.permute(0, 2, 1).reshape(-1, logits.shape[1])  # free: classes lie together
    points = by_point.index_select(0, kept).t().contiguous()  # softmax is 8 times faster this way
    return points, target.flatten().index_select(0, kept)


def weighted_cross_entropy(
    log_probabilities: Tensor, labels: Tensor, class_weights: Tensor
) -> Tensor:
    """Return the class-weighted cross-entropy summed over the points.

    Parameters
    ----------
    log_probabilities
        (K, P) f4.
    labels
        (P,) i8 class ids.
    class_weights
        (K,) f4.
    """
    own = log_probabilities.gather(0, labels[None])[0]
    return -torch.dot(own, class_weights.index_select(0, labels))


def lovasz_softmax(
    probabilities: Tensor, labels: Tensor, class_weights: Tensor, *, bins: int = _BINS
) -> Tensor:
    """Return the Lovasz-softmax losses of the classes that occur, weighted and summed.

    The Lovasz extension of the Jaccard loss (Berman et al. 2018, equation 9) weights the sorted
    errors of a class. Here errors are counted into bins instead of sorted: each keeps its value,
    and its weight is the mean over the foreground, or background, errors of its bin.

    Parameters
    ----------
    probabilities
        (K, P) f4, summing to 1 over the classes.
    labels
        (P,) i8 class ids.
    class_weights
        (K,) f4.
    bins
        How finely errors are told apart; 1,024 keep the gradient within 1 % of the exact one.
    """
    with torch.no_grad():
        slopes = _lovasz_slopes(probabilities, labels, class_weights, bins)
        # the error of the labelled class is 1 - p: the slopes there are negative
        constant = -slopes.gather(0, labels[None]).sum()
    return torch.dot(probabilities.flatten(), slopes.flatten()) + constant


def _lovasz_slopes(
    probabilities: Tensor, labels: Tensor, class_weights: Tensor, bins: int
) -> Tensor:
    """Return the slope of the loss with each probability, (K, P) f4."""
    classes = len(probabilities)
    own = labels[None]
    first_bin = torch.arange(classes, device=labels.device, dtype=torch.int32) * bins
    errors = probabilities.scatter(0, own, 1 - probabilities.gather(0, own))
    places = (errors * bins).int().clamp_(max=bins - 1).add_(first_bin[:, None])
    own_places = places.gather(0, own)
    everything = torch.bincount(places.flatten(), minlength=classes * bins)
    foreground = torch.bincount(own_places.flatten(), minlength=classes * bins)
    up, down = _bin_weights(
        foreground.view(classes, bins), (everything - foreground).view(classes, bins)
    )
    slopes = (down * class_weights[:, None]).flatten().index_select(0, places.flatten())
    own_slopes = (up * -class_weights[:, None]).flatten().index_select(0, own_places.flatten())
    return slopes.view_as(probabilities).scatter_(0, own, own_slopes[None])


def _bin_weights(foreground: Tensor, background: Tensor) -> tuple[Tensor, Tensor]:
    """Return the weights of foreground and background errors by class and bin, (K, bins) f4 each.

    With G points of the class, f foreground and b background errors above a bin that holds F and
    N, the Jaccard loss 1 - (G - f) / (G + b) grows from bin to bin. Its growth is shared out as
    the mean of the two orders "foreground first" and "background first", so that the weights of
    a class sum to the whole loss however errors fall into bins.
    """
    F, N = foreground.double(), background.double()
    f, b = (counts.flip(1).cumsum(1).flip(1) - counts for counts in (F, N))
    G = F.sum(1, keepdim=True)
    before, after = (G + b).clamp_(min=1), (G + b + N).clamp_(min=1)
    up = 0.5 * (1 / before + 1 / after)
    down = (G - f - 0.5 * F) / (before * after)
    occurs = G > 0
    return (up * occurs).float(), (down * occurs).float()


def latent_divergence(prediction: Prediction) -> Tensor:
    """Return log q(z|x) - log p(z) of the latents decoded, summed over positions, mean over N.

    One sample of the Kullback-Leibler divergence from the standard normal prior p; 0 for a
    network without a latent.
    """
    z = prediction.latent
    if z is None or prediction.law is None:
        return prediction.logits.new_zeros(())
    mean, log_sd = prediction.law
    log_ratio = 0.5 * (z.square() - ((z - mean) / log_sd.exp()).square()) - log_sd
    return log_ratio.sum() / z.shape[0]


def median_frequency_weights(counts: ArrayLike) -> Tensor:
    """Return the median share of the classes divided by each one's share, (K,) f4.

    Classes that never occur weigh nothing, and do not enter the median.
    """
    seen = torch.as_tensor(np.asarray(counts, np.float64))
    occurring = seen[seen > 0]
    if len(occurring) == 0:
        return torch.zeros(len(seen))
    median = occurring.quantile(0.5)
    return torch.where(seen > 0, median / seen.clamp(min=1), 0.0).float()
