from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from baselines.losses import (
    HOKUYO_CLASS_WEIGHTS,
    labelled_points,
    latent_divergence,
    loss_terms,
    lovasz_softmax,
    median_frequency_weights,
    weighted_cross_entropy,
)
from baselines.networks import Latent, Prediction

WEIGHTS = torch.tensor(HOKUYO_CLASS_WEIGHTS)


def exact_lovasz(
    probabilities: torch.Tensor, labels: torch.Tensor, weights: torch.Tensor
) -> torch.Tensor:
    """Berman et al. 2018, algorithm 1: sort the errors, take the gradient of the Jaccard loss."""
    total = torch.zeros(())
    for c in labels.unique().tolist():
        foreground = (labels == c).float()
        errors, order = (foreground - probabilities[c]).abs().sort(descending=True)
        hits = foreground[order].cumsum(0)
        misses = (1 - foreground[order]).cumsum(0)
        jaccard = 1 - (hits[-1] - hits) / (hits[-1] + misses)
        slopes = torch.diff(jaccard, prepend=torch.zeros(1))
        total = total + weights[c] * (errors * slopes).sum()
    return total


def points(count: int, sharpness: float, classes: int = 10) -> tuple[torch.Tensor, torch.Tensor]:
    torch.manual_seed(0)
    labels = torch.randint(0, classes, (count,))
    logits = torch.randn(classes, count)
    logits[labels, torch.arange(count)] += 1.0
    return (logits * sharpness).requires_grad_(), labels


@pytest.mark.parametrize("sharpness", [0.1, 1.0, 3.0, 6.0])
def test_lovasz_is_within_one_percent_of_the_sorted_one(sharpness: float):
    logits, labels = points(20_000, sharpness)
    ours, exact = (
        loss(logits.softmax(0), labels, WEIGHTS) for loss in (lovasz_softmax, exact_lovasz)
    )
    assert ours.item() == pytest.approx(exact.item(), rel=1e-3)
    found, wanted = (torch.autograd.grad(loss, logits)[0] for loss in (ours, exact))
    assert (found - wanted).norm() < 0.01 * wanted.norm()


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**31), st.integers(2, 5), st.integers(1, 60))
def test_lovasz_equals_the_sorted_one_where_bins_hold_single_errors(seed, classes, count):
    torch.manual_seed(seed)
    labels = torch.randint(0, classes, (count,))
    probabilities = torch.rand(classes, count).softmax(0)
    weights = torch.rand(classes)
    ours = lovasz_softmax(probabilities, labels, weights, bins=1 << 20)
    torch.testing.assert_close(ours, exact_lovasz(probabilities, labels, weights))


def test_lovasz_of_certain_labels_is_the_jaccard_loss():
    labels = torch.tensor([0, 0, 0, 1, 1, 2])
    predicted = torch.tensor([0, 0, 1, 1, 1, 1])
    certain = torch.nn.functional.one_hot(predicted, 4).t().float()
    loss = lovasz_softmax(certain, labels, torch.ones(4))
    assert loss.item() == pytest.approx((1 - 2 / 3) + (1 - 2 / 4) + (1 - 0), abs=1e-6)


def test_a_class_that_no_label_has_adds_no_lovasz_loss():
    labels = torch.zeros(5, dtype=torch.long)
    probabilities = torch.full((2, 5), 0.5)
    only_first, both = torch.tensor([1.0, 0.0]), torch.tensor([1.0, 9.0])
    first, second = (lovasz_softmax(probabilities, labels, w) for w in (only_first, both))
    assert first == second > 0


def test_cross_entropy_is_the_weighted_sum_of_negative_log_likelihoods():
    logits, labels = points(50, 1.0)
    expected = sum(-WEIGHTS[y] * logits.softmax(0)[y, i].log() for i, y in enumerate(labels))
    ours = weighted_cross_entropy(logits.log_softmax(0), labels, WEIGHTS)
    torch.testing.assert_close(ours, expected)


def test_divergence_is_the_mean_log_ratio_of_posterior_and_prior():
    mean, log_sd, z = torch.randn(3, 2, 1, 7)
    posterior = torch.distributions.Normal(mean, log_sd.exp())
    prior = torch.distributions.Normal(0.0, 1.0)
    expected = (posterior.log_prob(z) - prior.log_prob(z)).sum((1, 2)).mean()
    ours = latent_divergence(Prediction(torch.empty(0), z, Latent(mean, log_sd)))
    torch.testing.assert_close(ours, expected)


def prediction_of(logits: torch.Tensor) -> Prediction:
    law = Latent(torch.zeros(len(logits), 1, 5), torch.zeros(len(logits), 1, 5))
    return Prediction(logits, torch.ones(len(logits), 1, 5), law)


def test_the_sum_of_cross_entropy_is_divided_by_the_scans_of_the_batch():
    logits = torch.randn(3, 10, 20)
    target = torch.randint(0, 10, (3, 20))
    once = loss_terms(prediction_of(logits), target, WEIGHTS)
    twice = loss_terms(prediction_of(logits.repeat(2, 1, 1)), target.repeat(2, 1), WEIGHTS)
    for first, second in zip(once, twice, strict=True):
        torch.testing.assert_close(first, second, rtol=1e-3, atol=0)


def test_ignored_beams_change_no_loss_and_get_no_gradient():
    logits = torch.randn(2, 10, 30, requires_grad=True)
    target = torch.randint(0, 10, (2, 30))
    target[:, ::3] = 255
    loss = loss_terms(prediction_of(logits), target, WEIGHTS).total((1, 1, 0.01))
    (gradient,) = torch.autograd.grad(loss, logits)
    changed = torch.where((target == 255)[:, None], 7 * torch.randn(2, 10, 30), logits)
    again = loss_terms(prediction_of(changed), target, WEIGHTS).total((1, 1, 0.01))
    assert torch.equal(again, loss)
    assert not gradient[:, :, ::3].any()
    assert gradient[:, :, 1::3].any()


def test_a_batch_without_any_label_has_a_finite_loss():
    target = torch.full((2, 30), 255)
    loss = loss_terms(prediction_of(torch.randn(2, 10, 30)), target, WEIGHTS)
    assert (loss.cross_entropy, loss.lovasz) == (0, 0)


def test_labelled_points_keep_logits_and_labels_together():
    target = torch.tensor([[3, 255, 1], [255, 255, 0]])
    logits = torch.arange(12.0).view(2, 2, 3)
    kept, labels = labelled_points(logits, target)
    assert labels.tolist() == [3, 1, 0]
    assert kept.tolist() == [[0, 2, 8], [3, 5, 11]]


def test_median_frequency_weights_are_the_median_over_each_share():
    weights = median_frequency_weights(np.array([10, 0, 20, 40]))
    assert weights.tolist() == [2.0, 0.0, 1.0, 0.5]


def test_no_counts_at_all_give_no_weights():
    assert median_frequency_weights(np.zeros(3)).tolist() == [0, 0, 0]
