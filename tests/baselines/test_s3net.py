from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn import functional

from baselines.s3net import S3Net
from semantic2d_dataset.errors import InvalidInputError
from tests.baselines.generated import make_scans

REFERENCE = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "s3net_reference.npz"


def plain_forward(state: dict[str, torch.Tensor], x: torch.Tensor) -> torch.Tensor:
    """Logits from the latent's mean by plain 1D operations on published parameter names."""

    def conv(name: str, h: torch.Tensor, **options: int) -> torch.Tensor:
        return functional.conv1d(h, state[f"{name}.weight"], state.get(f"{name}.bias"), **options)

    def grow(name: str, h: torch.Tensor, **options: int) -> torch.Tensor:
        weight, bias = state[f"{name}.weight"], state[f"{name}.bias"]
        return functional.conv_transpose1d(h, weight, bias, **options)

    def norm(name: str, h: torch.Tensor) -> torch.Tensor:
        parts = ("running_mean", "running_var", "weight", "bias")
        return functional.batch_norm(h, *(state[f"{name}.{part}"] for part in parts))

    def stack(name: str, h: torch.Tensor) -> torch.Tensor:
        for i in range(2):
            block = f"{name}._layers.{i}._block"
            inner = norm(f"{block}.2", conv(f"{block}.1", h.relu(), padding=1))
            h = h + norm(f"{block}.5", conv(f"{block}.4", inner.relu()))
        return h.relu()

    beams = x.shape[2]
    e = "_encoder._encoder"
    h = norm(f"{e}._conv_1.1", conv(f"{e}._conv_1.0", x, stride=2, padding=1)).relu()
    h = norm(f"{e}._conv_2.1", conv(f"{e}._conv_2.0", h, stride=2, padding=1))
    mean = conv("_encoder._encoder_z_mu", stack(f"{e}._residual_stack", h))
    h = stack("_decoder._residual_stack", grow("_decoder_z_mu", mean))
    d, odd = "_decoder._conv_trans", {"stride": 2, "padding": 1}
    h = grow(f"{d}_2.1", h, output_padding=beams // 2 % 2, **odd)
    h = grow(f"{d}_1.0", norm(f"{d}_2.2", h).relu(), output_padding=beams % 2, **odd)
    return conv(f"{d}_1.3", norm(f"{d}_1.1", h).relu(), padding=1)


@pytest.fixture
def network() -> S3Net:
    torch.manual_seed(3)
    made = S3Net()
    with torch.no_grad():  # statistics that a forgotten batch norm would not survive
        for layer in made.modules():
            if isinstance(layer, nn.BatchNorm2d):
                layer.running_mean.normal_()
                layer.running_var.uniform_(0.5, 2.0)
    return made.eval()


def test_published_weights_give_the_published_outputs():
    if not REFERENCE.is_file():
        pytest.skip("../shared/data/s3net_reference.npz not present")
    with np.load(REFERENCE) as held:
        arrays = {name: torch.from_numpy(held[name].copy()) for name in held.files}
    state = {n.removeprefix("state/"): a for n, a in arrays.items() if n.startswith("state/")}
    network = S3Net()
    network.load_state_dict(state, strict=True)
    network.eval()
    features = torch.stack([arrays[name] for name in ("range", "intensity", "incidence")], 1)
    with torch.inference_mode():
        law = network.encode(features)
        logits = network(features, law.mean).logits
    for found, name in ((law.mean, "z_mu"), (law.log_sd, "z_log_sd"), (logits, "logits_mean")):
        torch.testing.assert_close(found, arrays[name], rtol=0, atol=1e-4)


@pytest.mark.parametrize("beams", [4, 5, 6, 7, 360, 726, 811, 1081, 1972])
def test_outputs_equal_plain_1d_operations_for_any_beam_count(network: S3Net, beams: int):
    features = make_scans(2, beams)[0]
    with torch.inference_mode():
        law = network.encode(features)
        logits = network(features, law.mean).logits
        expected = plain_forward(network.state_dict(), features)
    assert logits.shape == (2, 10, beams)
    torch.testing.assert_close(logits, expected, rtol=0, atol=1e-4)


@pytest.mark.parametrize(("channels", "classes"), [(1, 4), (5, 10)])
def test_any_number_of_features_and_classes(channels: int, classes: int):
    logits = S3Net(channels, classes)(torch.randn(2, channels, 40)).logits
    assert logits.shape == (2, classes, 40)


def test_a_latent_that_is_given_is_decoded_and_no_other_is_drawn(network: S3Net):
    features = make_scans(2, 40)[0]
    latent = torch.randn(2, 1, 10)
    first, second = network(features, latent), network(features, latent)
    assert first.latent is latent
    assert torch.equal(first.logits, second.logits)
    assert torch.equal(first.logits, network.decode(latent, 40))


def test_samples_follow_the_law_of_the_latent(network: S3Net):
    features = make_scans(1, 40)[0].expand(4000, -1, -1)
    with torch.inference_mode():
        law = network.encode(features)
        torch.manual_seed(0)
        drawn = law.sample()
    scores = (drawn - law.mean) / law.log_sd.exp()
    assert abs(scores.mean().item()) < 0.02
    assert abs(scores.std().item() - 1) < 0.02


@pytest.mark.parametrize("shape", [(3, 40), (1, 2, 40), (1, 3, 3)])
def test_features_of_another_shape_are_refused(network: S3Net, shape: tuple[int, ...]):
    with pytest.raises(InvalidInputError, match=r"expected \(N, 3, B\) with B >= 4"):
        network(torch.zeros(shape))


def test_a_latent_of_another_beam_count_is_refused(network: S3Net):
    with pytest.raises(InvalidInputError, match=r"expected \(N, 1, 10\), found \(1, 1, 11\)"):
        network.decode(torch.zeros(1, 1, 11), 40)
