from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import nn

from baselines.architectures import build_network
from baselines.checkpoints import load_checkpoint
from baselines.configs import TrainingConfig
from baselines.inference import infer
from baselines.s3net import S3Net
from baselines.training import train, validate
from baselines.unet import UNet
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.lidars import HOKUYO_UTM_30LX_EW, RPLIDAR_S2, WLR_716, LidarSpec
from tests.baselines.generated import ToyScans, make_scans
from tests.generators import SMALL_LIDAR

SPINNING = LidarSpec("spinning", "Spinning", 360, 0.0, 0.0174532925, 0.1, 12.0)


def make_network(**options: object) -> UNet:
    """A network whose norms are those of a trained one."""
    torch.manual_seed(3)
    network = UNet(**options)
    with torch.no_grad():
        for layer in network.modules():
            if isinstance(layer, nn.BatchNorm2d):
                layer.weight.uniform_(0.5, 1.5)
                layer.bias.normal_(std=0.2)
                layer.running_mean.normal_(std=0.2)
                layer.running_var.uniform_(0.5, 2.0)
    return network.eval()


def multiplications(network: nn.Module, beams: int) -> int:
    """Multiplications of the convolutions in one pass over one scan."""
    count = 0

    def add(layer: nn.Module, given: tuple, found: torch.Tensor) -> None:
        nonlocal count
        grows = isinstance(layer, nn.ConvTranspose1d)
        positions = (given[0] if grows else found).shape[3]
        count += positions * layer.weight.numel()

    for layer in network.modules():
        if isinstance(layer, nn.Conv1d | nn.Conv2d | nn.ConvTranspose1d):
            layer.register_forward_hook(add)
    with torch.inference_mode():
        network.eval().expected_logits(torch.zeros(1, network.channels, beams))
    return count


@pytest.mark.parametrize("circular", [False, True])
@pytest.mark.parametrize("beams", [33, 34, 63, 360, 726, 811, 1081, 1972])
def test_every_beam_of_any_count_gets_logits(beams: int, circular):
    features = make_scans(2, beams)[0]
    network = make_network(circular=circular)
    with torch.inference_mode():
        prediction = network(features)
    assert prediction.logits.shape == (2, 10, beams)
    assert prediction.logits.isfinite().all()
    assert prediction.latent is prediction.law is None


@pytest.mark.parametrize(("channels", "classes"), [(1, 4), (5, 10)])
def test_any_number_of_features_and_classes(channels: int, classes: int):
    logits = UNet(channels, classes)(torch.randn(2, channels, 40)).logits
    assert logits.shape == (2, classes, 40)


@pytest.mark.parametrize("shape", [(3, 40), (1, 2, 40), (1, 3, 32)])
def test_features_of_another_shape_are_refused(shape: tuple[int, ...]):
    with pytest.raises(InvalidInputError, match=r"expected \(N, 3, B\) with B >= 33"):
        UNet()(torch.zeros(shape))


def test_a_lidar_of_too_few_beams_is_refused():
    with pytest.raises(InvalidInputError, match="unet needs at least 33 beams, and small has 32"):
        build_network("unet", 3, 10, replace(SMALL_LIDAR, beams=32))


def test_a_pass_takes_no_more_multiplications_than_one_of_s3net():
    assert multiplications(UNet(), 1081) < multiplications(S3Net(), 1081) < 17e6


@pytest.mark.parametrize(
    ("lidar", "expected"),
    [(HOKUYO_UTM_30LX_EW, False), (WLR_716, False), (RPLIDAR_S2, True), (SPINNING, True)],
)
def test_only_a_lidar_that_sees_all_around_is_a_ring(lidar: LidarSpec, expected):
    assert build_network("unet", 3, 10, lidar).circular is expected


def test_a_ring_that_is_turned_gives_logits_that_are_turned():
    features = make_scans(2, 352)[0]
    network = make_network(circular=True)
    with torch.inference_mode():
        turned = network.expected_logits(features.roll(48, 2))
        expected = network.expected_logits(features).roll(48, 2)
    torch.testing.assert_close(turned, expected, rtol=0, atol=1e-4)


@pytest.mark.parametrize("beams", [360, 1972])  # neither is a multiple of 16
def test_the_last_beam_sees_the_first_one_in_a_ring_only(beams: int):
    for circular in (True, False):
        features = make_scans(1, beams)[0].requires_grad_()
        make_network(circular=circular)(features).logits[0, :, -1].sum().backward()
        assert bool(features.grad[0, :, 0].any()) is circular


def test_a_beam_sees_a_wide_part_of_the_scan():
    features = make_scans(1, 1081)[0].requires_grad_()
    make_network()(features).logits[0, :, 540].sum().backward()
    seen = features.grad[0].abs().sum(0).nonzero()
    assert seen.max() - seen.min() > 200  # beams, 50 degrees of the Hokuyo


def test_labels_do_not_depend_on_what_else_is_in_the_batch():
    features = make_scans(3, 61)[0]
    network = make_network()
    together, alone = infer(network, features), infer(network, features[1:2])
    assert together.samples.shape == (1, 3, 61)
    assert (together.labels[1] == alone.labels[0]).all()


def test_training_learns_what_can_be_learnt_and_keeps_it(tmp_path: Path):
    config = TrainingConfig(
        model="unet", epochs=8, batch_size=8, learning_rate=5e-3, schedule="one-cycle"
    )
    val = ToyScans(16, seed=1)
    result = train(config, ToyScans(64), val, tmp_path)
    assert result.best_miou > 0.6
    network = load_checkpoint(tmp_path).network
    assert isinstance(network, UNet)
    assert validate(network, val) == result.best_miou
