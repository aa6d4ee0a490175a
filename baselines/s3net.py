"""S3-Net: a variational autoencoder from a scan's features to a class for every beam.

The architecture and the parameter names are those of the published code
(github.com/TempleRAIL/s3_net; paper, section on S3-Net), so that its weights load as they are.
"""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from baselines.networks import Latent, Prediction, SegmentationNetwork
from semantic2d_dataset.errors import InvalidInputError

_HIDDEN = 64
_RESIDUAL_HIDDEN = 32
_RESIDUAL_LAYERS = 2


class S3Net(SegmentationNetwork):
    """The published network for any number of features, beams and classes.

    Parameters
    ----------
    channels
        Features of a beam, C.
    classes
        Number of classes, K.
    """

    name: ClassVar[str] = "s3net"
    title: ClassVar[str] = "S3-Net"
    least_beams: ClassVar[int] = 4  # two halvings must leave one position

    def __init__(self, channels: int = 3, classes: int = 10) -> None:
        super().__init__(channels, classes)
        self._encoder = _VariationalEncoder(channels)
        self._decoder_z_mu = _Widen(1, _HIDDEN, 1)
        self._decoder = _Decoder(classes)

    def encode(self, features: Tensor) -> Latent:
        """Return the law of the latent of standardised features (N, C, B) f4.

        Raises
        ------
        InvalidInputError
            If the features have another shape.
        """
        self.check_features(features)
        return Latent(*(head.squeeze(2) for head in self._encoder(_as_image(features))))

    @staticmethod
    def positions(beams: int) -> int:
        """Return the number L of positions of the latent of scans of so many beams."""
        return beams // 2 // 2

    def decode(self, latent: Tensor, beams: int) -> Tensor:
        """Return the logits (N, K, B) of latents (N, 1, L) with L = B // 2 // 2.

        Raises
        ------
        InvalidInputError
            If the latents do not belong to scans of so many beams.
        """
        shape, positions = tuple(latent.shape), self.positions(beams)
        if len(shape) != 3 or shape[1:] != (1, positions):
            raise InvalidInputError(
                f"latent of {beams} beams: expected (N, 1, {positions}), found {shape}"
            )
        hidden = self._decoder_z_mu(_as_image(latent))
        logits: Tensor = self._decoder(hidden, beams).squeeze(2)
        return logits

    def forward(self, features: Tensor, latent: Tensor | None = None) -> Prediction:
        """Encode features (N, C, B), and decode `latent` (N, 1, L) or, without one, a sample."""
        law = self.encode(features)
        chosen = law.sample() if latent is None else latent
        return Prediction(self.decode(chosen, features.shape[2]), chosen, law)

    def expected_logits(self, features: Tensor) -> Tensor:
        """Decode the mean of the latent of features (N, C, B) to logits (N, K, B)."""
        return self.decode(self.encode(features).mean, features.shape[2])


def _as_image(x: Tensor) -> Tensor:
    """(N, C, L) to an image (N, C, 1, L) whose channels lie together in memory.

    The convolutions of this layout reach twice the speed of those over (N, C, L) on CPUs.
    """
    return x.unsqueeze(2).contiguous(memory_format=torch.channels_last)


class _Conv(nn.Conv1d):
    """A 1D convolution over images of height one."""

    def forward(self, input: Tensor) -> Tensor:  # noqa: A002 (torch's name)
        stride, padding = (1, int(self.stride[0])), (0, int(self.padding[0]))
        return functional.conv2d(input, _as_image(self.weight), self.bias, stride, padding)


class _ConvTranspose(nn.ConvTranspose1d):
    """A 1D transposed convolution over images of height one, to exactly a given width."""

    def forward(self, input: Tensor, output_size: list[int] | None = None) -> Tensor:  # noqa: A002
        stride, padding = (1, int(self.stride[0])), (0, int(self.padding[0]))
        width = 2 * input.shape[3] if output_size is None else output_size[0]
        if width > 2 * input.shape[3]:  # as output_padding=1, for which torch's kernel is slow
            input = functional.pad(input, (0, 1))  # noqa: A001
        grown = functional.conv_transpose2d(
            input, _as_image(self.weight), self.bias, stride, padding
        )
        return grown[..., :width]


class _Widen(nn.ConvTranspose1d):
    """A transposed convolution of one tap, which is a linear map at each position."""

    def forward(self, input: Tensor, output_size: list[int] | None = None) -> Tensor:  # noqa: A002, ARG002
        by_position = input.permute(0, 2, 3, 1)
        widened = functional.linear(by_position, self.weight[:, :, 0].t(), self.bias)
        return widened.permute(0, 3, 1, 2)


class _Residual(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self._block = nn.Sequential(
            nn.ReLU(),
            _Conv(_HIDDEN, _RESIDUAL_HIDDEN, 3, padding=1, bias=False),
            nn.BatchNorm2d(_RESIDUAL_HIDDEN),
            nn.ReLU(inplace=True),
            _Conv(_RESIDUAL_HIDDEN, _HIDDEN, 1, bias=False),
            nn.BatchNorm2d(_HIDDEN),
        )

    def forward(self, x: Tensor) -> Tensor:
        added: Tensor = x + self._block(x)
        return added


class _ResidualStack(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self._layers = nn.ModuleList(_Residual() for _ in range(_RESIDUAL_LAYERS))

    def forward(self, x: Tensor) -> Tensor:
        for layer in self._layers:
            x = layer(x)
        return functional.relu(x)


class _Encoder(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self._conv_1 = nn.Sequential(
            _Conv(channels, _HIDDEN // 2, 4, stride=2, padding=1),
            nn.BatchNorm2d(_HIDDEN // 2),
            nn.ReLU(inplace=True),
        )
        self._conv_2 = nn.Sequential(
            _Conv(_HIDDEN // 2, _HIDDEN, 4, stride=2, padding=1), nn.BatchNorm2d(_HIDDEN)
        )
        self._residual_stack = _ResidualStack()

    def forward(self, x: Tensor) -> Tensor:
        hidden: Tensor = self._residual_stack(self._conv_2(self._conv_1(x)))
        return hidden


class _VariationalEncoder(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self._encoder = _Encoder(channels)
        self._encoder_z_mu = _Conv(_HIDDEN, 1, 1)
        self._encoder_z_log_sd = _Conv(_HIDDEN, 1, 1)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        hidden = self._encoder(x)
        return self._encoder_z_mu(hidden), self._encoder_z_log_sd(hidden)


class _Decoder(nn.Module):
    def __init__(self, classes: int) -> None:
        super().__init__()
        self._residual_stack = _ResidualStack()
        self._conv_trans_2 = nn.Sequential(
            nn.ReLU(),
            _ConvTranspose(_HIDDEN, _HIDDEN // 2, 4, stride=2, padding=1),
            nn.BatchNorm2d(_HIDDEN // 2),
            nn.ReLU(inplace=True),
        )
        self._conv_trans_1 = nn.Sequential(
            _ConvTranspose(_HIDDEN // 2, _HIDDEN // 2, 4, stride=2, padding=1),
            nn.BatchNorm2d(_HIDDEN // 2),
            nn.ReLU(inplace=True),
            _Conv(_HIDDEN // 2, classes, 3, padding=1),
        )

    def forward(self, x: Tensor, beams: int) -> Tensor:
        half = _upsample(self._conv_trans_2, self._residual_stack(x), beams // 2)
        return _upsample(self._conv_trans_1, half, beams)


def _upsample(layers: nn.Sequential, x: Tensor, width: int) -> Tensor:
    """Apply layers, the transposed one to exactly `width` positions."""
    for layer in layers:
        x = layer(x, [width]) if isinstance(layer, _ConvTranspose) else layer(x)
    return x
