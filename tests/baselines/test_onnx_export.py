from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from torch import Tensor, nn

from baselines.checkpoints import Checkpoint
from baselines.networks import Prediction, SegmentationNetwork
from baselines.onnx_export import export_onnx
from baselines.onnx_files import open_session
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.lidars import RPLIDAR_S2, WLR_716
from tests.baselines.generated import make_checkpoint
from tests.conftest import PROJECT
from tests.generators import SMALL_LIDAR


class Plain(SegmentationNetwork):
    """A network without a latent."""

    name: ClassVar[str] = "plain"
    title: ClassVar[str] = "Plain"
    least_beams: ClassVar[int] = 1

    def __init__(self, channels: int = 3) -> None:
        super().__init__(channels, 10)
        self.layer = nn.Conv1d(channels, 10, 5, padding=2)
        self.norm = nn.BatchNorm1d(10)

    def forward(self, features: Tensor) -> Prediction:
        return Prediction(self.expected_logits(features))

    def expected_logits(self, features: Tensor) -> Tensor:
        return self.norm(self.layer(features))


def run(path: Path, **inputs: Tensor) -> np.ndarray:
    session = open_session(path, path.read_bytes(), threads=1)
    return session.run(None, {name: tensor.numpy() for name, tensor in inputs.items()})[0]


def check_every_path(checkpoint: Checkpoint, path: Path) -> None:
    """Samples, the mean and several scans at once give what torch gives."""
    network, beams = checkpoint.network, checkpoint.lidar.beams
    torch.manual_seed(1)
    features, noise = torch.randn(3, 3, beams), torch.randn(5, 1, beams // 2 // 2)
    with torch.inference_mode():
        law = network.encode(features)
        drawn = [network.decode(law.mean + law.log_sd.exp() * one, beams) for one in noise]
        expected, mean = torch.stack(drawn).numpy(), network.expected_logits(features).numpy()
    found = run(path, features=features, noise=noise)
    assert np.ptp(expected, axis=(0, 1)).mean() > 0.05  # samples and scans are not all the same
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)
    single = run(path, features=features[:1], noise=torch.zeros(1, 1, beams // 2 // 2))
    np.testing.assert_allclose(single, mean[None, :1], rtol=1e-4, atol=1e-4)


def test_a_small_model_gives_the_logits_of_torch(small_checkpoint: Checkpoint, small_onnx: Path):
    check_every_path(small_checkpoint, small_onnx)


@pytest.mark.parametrize("lidar", [WLR_716, RPLIDAR_S2], ids=lambda lidar: lidar.name)
def test_other_numbers_of_beams_give_the_logits_of_torch(lidar, tmp_path: Path):
    checkpoint = make_checkpoint(lidar)
    path = tmp_path / "model.onnx"
    assert export_onnx(checkpoint, path) < 1e-4
    check_every_path(checkpoint, path)


def test_a_network_without_a_latent_takes_features_only(tmp_path: Path):
    network = Plain().eval()
    path = tmp_path / "model.onnx"
    export_onnx(replace(make_checkpoint(SMALL_LIDAR), network=network), path)
    features = torch.randn(4, 3, 37)
    with torch.inference_mode():
        expected = network.expected_logits(features).numpy()
    np.testing.assert_allclose(run(path, features=features)[0], expected, rtol=1e-4, atol=1e-4)


def test_the_file_is_valid_onnx_and_says_what_a_robot_needs(small_onnx: Path, small_checkpoint):
    onnx.checker.check_model(str(small_onnx), full_check=True)
    model = onnx.load(small_onnx)
    said = json.loads({p.key: p.value for p in model.metadata_props}["semantic2d"])
    assert (said["format"], said["model"], said["samples"]) == ("semantic2d-onnx", "s3net", 32)
    assert (said["features"], said["lidar"]["beams"]) == ("RIA", 37)
    assert tuple(said["statistics"]["mean"]) == small_checkpoint.statistics.mean
    assert said["taxonomy"]["names"][4] == "Person"
    assert said["dataset"] == {"name": "generated"}


def test_batch_norms_are_folded_and_no_path_of_this_machine_is_told(small_onnx: Path):
    kinds = {node.op_type for node in onnx.load(small_onnx).graph.node}
    assert "Conv" in kinds
    assert not {"BatchNormalization", "ScatterND"} & kinds
    content = small_onnx.read_bytes()
    for place in (str(PROJECT), str(Path(torch.__file__).parent)):  # where code of it lies
        assert place.encode() not in content


def test_the_network_that_is_exported_stays_as_it_is(small_checkpoint: Checkpoint, small_onnx):
    layers = list(small_checkpoint.network.modules())
    assert sum(isinstance(layer, nn.BatchNorm2d) for layer in layers) == 12
    assert any(layer.inplace for layer in layers if isinstance(layer, nn.ReLU))


def test_a_graph_that_gives_other_logits_is_not_written(tmp_path: Path, monkeypatch):
    checkpoint = replace(make_checkpoint(SMALL_LIDAR), network=Plain().eval())
    path = tmp_path / "model.onnx"
    monkeypatch.setattr("baselines.onnx_export.fold_batch_norms", lambda _: Plain().eval())
    with pytest.raises(InvalidInputError, match=r"from torch's.*nothing was written"):
        export_onnx(checkpoint, path)
    assert list(tmp_path.iterdir()) == []


def test_any_other_runtime_reads_the_file(small_onnx: Path):
    session = onnxruntime.InferenceSession(str(small_onnx), providers=["CPUExecutionProvider"])
    shapes = {one.name: one.shape for one in session.get_inputs()}
    assert shapes == {"features": ["scans", 3, 37], "noise": ["samples", 1, 9]}
    assert session.get_outputs()[0].name == "logits"
