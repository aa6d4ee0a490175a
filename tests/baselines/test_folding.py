from __future__ import annotations

import pytest
import torch
from torch import nn

from baselines.folding import fold_batch_norms
from tests.baselines.generated import make_network, make_scans, stir_batch_norms


def norms_of(network: nn.Module) -> list[nn.Module]:
    return [m for m in network.modules() if isinstance(m, (nn.BatchNorm1d, nn.BatchNorm2d))]


@pytest.mark.parametrize("beams", [61, 811])
def test_s3net_without_batch_norms_gives_the_same_logits(beams: int):
    network = make_network()
    folded = fold_batch_norms(network)
    features, _ = make_scans(3, beams)
    with torch.inference_mode():
        expected, found = network.expected_logits(features), folded.expected_logits(features)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)
    assert len(norms_of(network)) == 12
    assert norms_of(folded) == []


def same(*layers: nn.Module) -> nn.Sequential:
    return stir_batch_norms(nn.Sequential(*layers)).eval()


@pytest.mark.parametrize(
    "network",
    [
        same(nn.Conv1d(4, 6, 3, bias=False), nn.BatchNorm1d(6), nn.ReLU()),
        same(nn.Conv1d(4, 6, 3, groups=2), nn.BatchNorm1d(6, affine=False)),
        same(nn.ConvTranspose1d(4, 6, 4, stride=2, bias=False), nn.BatchNorm1d(6)),
        same(nn.ReLU(), nn.Sequential(nn.Conv1d(4, 6, 1), nn.BatchNorm1d(6)), nn.ReLU()),
    ],
)
def test_any_convolution_takes_in_the_batch_norm_behind_it(network: nn.Sequential):
    x = torch.randn(2, 4, 9)
    folded = fold_batch_norms(network)
    torch.testing.assert_close(folded(x), network(x), rtol=1e-4, atol=1e-4)
    assert norms_of(folded) == []


@pytest.mark.parametrize(
    "network",
    [
        same(nn.BatchNorm1d(4), nn.Conv1d(4, 6, 3)),
        same(nn.Conv1d(4, 6, 3), nn.ReLU(), nn.BatchNorm1d(6)),
        same(nn.Conv1d(4, 6, 3), nn.BatchNorm1d(6, track_running_stats=False)),
        same(nn.ConvTranspose1d(4, 6, 3, groups=2), nn.BatchNorm1d(6)),
    ],
)
def test_a_batch_norm_that_cannot_be_folded_stays(network: nn.Sequential):
    x = torch.randn(2, 4, 9)
    folded = fold_batch_norms(network)
    torch.testing.assert_close(folded(x), network(x))
    assert len(norms_of(folded)) == 1
