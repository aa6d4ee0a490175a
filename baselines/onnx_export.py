"""Trained models as ONNX files, which run without torch."""

from __future__ import annotations

import contextlib
import copy
import logging
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import onnxscript  # noqa: F401 - torch's exporter needs it, and says so less clearly
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from baselines.checkpoints import Checkpoint
from baselines.folding import fold_batch_norms
from baselines.inference import SAMPLES
from baselines.networks import SegmentationNetwork
from baselines.onnx_files import open_session, seal
from baselines.s3net import S3Net
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.writing import write_bytes_atomically

TOLERANCE = 1e-4
"""Largest difference from torch's logits, as a share of the largest of them (at least of 1)."""

_CHECKED_SCANS, _CHECKED_SAMPLES = 2, 3  # sizes of 0 and 1 would become constants of the graph


def export_onnx(checkpoint: Checkpoint, path: Path) -> float:
    """Write a model as one ONNX file, and what is needed to use it on scans.

    The graph takes standardised ``features`` (N, C, B) f4 and gives ``logits`` (S, N, K, B) f4.
    If the network has a latent, it also takes ``noise`` (S, 1, L) f4, of which every scan gets the
    same: standard normal for S samples, or zeros (1, 1, L) for the latent's mean. A scan is encoded
    once, however many its samples are. Without a latent, S is 1.

    Parameters
    ----------
    checkpoint
        A trained model.
    path
        The file to write; it appears when ONNX Runtime was found to give what torch gives.

    Returns
    -------
    float
        Largest difference of a logit from torch's, on random features.

    Raises
    ------
    InvalidInputError
        If ONNX Runtime gives other logits than torch.
    WriteError
        If the file cannot be written.
    """
    network = copy.deepcopy(checkpoint.network).cpu().eval()
    inputs = _example(network, checkpoint.lidar.beams)
    content = seal(_graph_of(network, inputs), _said(checkpoint))
    difference = _largest_difference(open_session(path, content, threads=1), network, inputs)
    write_bytes_atomically(Path(path), content)
    return difference


class _Sampler(nn.Module):
    """S3-Net, to features and the noise of S samples."""

    def __init__(self, network: S3Net) -> None:
        super().__init__()
        self.network = network

    def forward(self, features: Tensor, noise: Tensor) -> Tensor:
        mean, log_sd = self.network.encode(features)
        latents = mean + log_sd.exp() * noise[:, None]  # (S, N, 1, L)
        logits = self.network.decode(latents.flatten(0, 1), features.shape[2])
        return logits.reshape(*latents.shape[:2], *logits.shape[1:])


class _Plain(nn.Module):
    """A network without a latent, to features."""

    def __init__(self, network: SegmentationNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, features: Tensor) -> Tensor:
        return self.network.expected_logits(features).unsqueeze(0)


def _as_graph(network: SegmentationNetwork) -> nn.Module:
    return _Sampler(network) if isinstance(network, S3Net) else _Plain(network)


def _example(network: SegmentationNetwork, beams: int) -> dict[str, Tensor]:
    """Return random inputs of a graph, by name."""
    source = torch.Generator().manual_seed(0)
    shapes = {"features": (_CHECKED_SCANS, network.channels, beams)}
    if isinstance(network, S3Net):
        shapes["noise"] = (_CHECKED_SAMPLES, 1, network.positions(beams))
    return {name: torch.randn(shape, generator=source) for name, shape in shapes.items()}


def _graph_of(network: SegmentationNetwork, inputs: dict[str, Tensor]) -> onnx.ModelProto:
    graph = _as_graph(fold_batch_norms(network)).eval()
    for layer in graph.modules():
        if isinstance(layer, nn.ReLU):
            layer.inplace = (
                False  # what it writes into a slice would be scattered, at twice the time
            )
    free = {"features": {0: torch.export.Dim("scans")}, "noise": {0: torch.export.Dim("samples")}}
    with _quiet():
        program = torch.onnx.export(
            graph,
            kwargs=inputs,
            dynamo=True,
            input_names=list(inputs),
            output_names=["logits"],
            dynamic_shapes={name: free[name] for name in inputs},
            verbose=False,
        )
    model: onnx.ModelProto = program.model_proto  # type: ignore[union-attr]
    for node in model.graph.node:
        del node.metadata_props[:]  # paths on this machine
    onnx.checker.check_model(model)
    return model


def _said(checkpoint: Checkpoint) -> dict[str, object]:
    has_latent = isinstance(checkpoint.network, S3Net)
    return {
        "model": checkpoint.network.name,
        "samples": SAMPLES if has_latent else 1,
        **checkpoint.description.as_json(),
    }


def _largest_difference(
    session: onnxruntime.InferenceSession, network: SegmentationNetwork, inputs: dict[str, Tensor]
) -> float:
    with torch.inference_mode():
        expected: NDArray[np.float32] = _as_graph(network)(**inputs).numpy()
    feed = {name: tensor.numpy() for name, tensor in inputs.items()}
    found: NDArray[np.float32] = session.run(None, feed)[0]
    difference = float(np.abs(found - expected).max())
    allowed = TOLERANCE * max(1.0, float(np.abs(expected).max()))
    if not difference <= allowed:
        raise InvalidInputError(
            f"{network.title}: ONNX Runtime's logits are {difference:.2g} from torch's, and "
            f"{allowed:.2g} is allowed; nothing was written"
        )
    return difference


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep torch's remarks about its own exporter to itself."""
    logger = logging.getLogger("torch.onnx._internal.exporter._registration")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(before)
