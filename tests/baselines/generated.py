"""Small labelled scans that a network can learn, without files."""

from __future__ import annotations

import numpy as np
import torch
from torch import nn
from torch.utils.data import DataLoader, TensorDataset

from baselines.checkpoints import Checkpoint
from baselines.s3net import S3Net
from semantic2d_dataset.access.features import Statistics, channel_count
from semantic2d_dataset.scene.lidars import LidarSpec
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D

LIDAR = LidarSpec("toy", "Toy", 61, -1.5, 0.05, 0.1, 30.0)


def make_scans(scans: int, beams: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Features (N, 3, B) and labels (N, B): runs of beams whose features tell their class."""
    rng = np.random.default_rng(seed)
    runs = (rng.random((scans, beams)) < 0.1).cumsum(1)
    labels = np.take_along_axis(rng.integers(0, 10, (scans, beams)), runs, axis=1)
    noise = rng.normal(scale=0.2, size=(3, scans, beams))
    features = np.stack((labels / 5 - 1, np.sin(labels), np.cos(labels))) + noise
    return (
        torch.from_numpy(features.transpose(1, 0, 2).astype(np.float32)),
        torch.from_numpy(labels),
    )


def stir_batch_norms(network: nn.Module) -> nn.Module:
    """Give batch norms statistics and weights that none survives who forgets one of them."""
    torch.manual_seed(3)
    with torch.no_grad():
        for layer in network.modules():
            if isinstance(layer, nn.modules.batchnorm._BatchNorm):
                for tensor in (*layer.parameters(), *layer.buffers()):
                    if tensor.is_floating_point():
                        tensor.uniform_(0.2, 1.8)
    return network


def make_network(channels: int = 3) -> S3Net:
    """An S3-Net in evaluation mode whose batch norms do something."""
    torch.manual_seed(3)
    network = stir_batch_norms(S3Net(channels))
    with torch.no_grad():
        for name, weights in network.named_parameters():
            if name.endswith(("z_mu.weight", "_conv_trans_1.3.weight")):
                weights.mul_(20)  # scans and latents give other labels
    return network.eval()


def make_checkpoint(lidar: LidarSpec, features: str = "RIA") -> Checkpoint:
    """A model of those scans, with statistics that matter."""
    channels = channel_count(features)
    statistics = Statistics((3.0, 1500.0, 0.6)[:channels], (4.0, 900.0, 0.5)[:channels])
    network = make_network(channels)
    return Checkpoint(network, features, statistics, lidar, SEMANTIC2D, {"name": "generated"})


class ToyScans:
    """A data set in memory with what training asks for."""

    lidar = LIDAR
    taxonomy = SEMANTIC2D
    statistics = Statistics((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))

    def __init__(self, scans: int, seed: int = 0) -> None:
        self.features, self.labels = make_scans(scans, LIDAR.beams, seed)
        self.valid = torch.ones_like(self.labels, dtype=torch.bool)
        self.batches_until_interrupt: int | None = None

    @property
    def class_counts(self) -> np.ndarray:
        return np.bincount(self.labels.flatten(), minlength=10)

    def __len__(self) -> int:
        return len(self.labels)

    def loader(self, batch_size: int, *, shuffle: bool, seed: int) -> DataLoader:
        return DataLoader(
            TensorDataset(self.features, self.labels, self.valid),
            batch_size,
            shuffle=shuffle,
            generator=torch.Generator().manual_seed(seed),
            collate_fn=self.collate,
        )

    def collate(self, items: list) -> dict[str, torch.Tensor]:
        if self.batches_until_interrupt is not None:
            self.batches_until_interrupt -= 1
            if self.batches_until_interrupt < 0:
                raise KeyboardInterrupt
        columns = zip(*items, strict=True)
        return dict(zip(("features", "label", "valid"), map(torch.stack, columns), strict=True))
