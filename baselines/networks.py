"""What every network of the baselines takes and gives."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from semantic2d_dataset.errors import InvalidInputError


class Latent(NamedTuple):
    """A Gaussian for each of the L positions of a scan.

    ``mean`` and ``log_sd`` are (N, 1, L) f4.
    """

    mean: Tensor
    log_sd: Tensor

    def sample(self) -> Tensor:
        """Draw one latent (N, 1, L) from torch's random state."""
        return self.mean + self.log_sd.exp() * torch.randn_like(self.mean)


class Prediction(NamedTuple):
    """What one pass gives: ``logits`` (N, K, B), the ``latent`` decoded (N, 1, L), and its law.

    A network that draws nothing has neither latent nor law.
    """

    logits: Tensor
    latent: Tensor | None = None
    law: Latent | None = None


class SegmentationNetwork(nn.Module):
    """A network from standardised features of scans to a class for every beam.

    Parameters
    ----------
    channels
        Features of a beam, C.
    classes
        Number of classes, K.
    """

    name: ClassVar[str]  # on the command line and in checkpoints
    title: ClassVar[str]  # in tables
    least_beams: ClassVar[int]

    def __init__(self, channels: int, classes: int) -> None:
        super().__init__()
        self.channels = channels
        self.classes = classes

    @abstractmethod
    def forward(self, features: Tensor) -> Prediction:
        """Return the prediction for features (N, C, B) f4; a stochastic one draws a latent."""

    @abstractmethod
    def expected_logits(self, features: Tensor) -> Tensor:
        """Return the logits (N, K, B) of features (N, C, B) f4 without drawing anything."""

    def check_features(self, features: Tensor) -> None:
        """Raise InvalidInputError if features have not the shape (N, C, B)."""
        shape = tuple(features.shape)
        if len(shape) != 3 or shape[1] != self.channels or shape[2] < self.least_beams:
            raise InvalidInputError(
                f"features: expected (N, {self.channels}, B) with B >= {self.least_beams}, "
                f"found {shape}"
            )
