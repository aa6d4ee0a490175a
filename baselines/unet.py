"""A 1D U-Net: what lies far around a beam is brought back to the resolution of the beams.

Its blocks are those of ConvNeXt (Liu et al. 2022): a wide kernel in each channel, then two layers
at each position. The norms are batch norms, which fold into the convolution before them.
"""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from baselines.networks import Prediction, SegmentationNetwork

# Chosen by the validation mIoU on semantic2d-mini at no more multiplications than S3-Net's.
_STEM = 16  # channels of a beam
_WIDTHS = (24, 32, 48, 64)  # channels after each halving
_KERNEL = 7
_EXPANSION = 2


class UNet(SegmentationNetwork):
    """The network for any number of features, beams and classes.

    Parameters
    ----------
    channels
        Features of a beam, C.
    classes
        Number of classes, K.
    circular
        The last beam lies beside the first one. Scans are made a multiple of 16 long; where they
        are not, the ring repeats up to 15 beams there.
    """

    name: ClassVar[str] = "unet"
    title: ClassVar[str] = "1D U-Net"
    # four halvings must leave as many positions as a kernel takes from the other end of a ring
    least_beams: ClassVar[int] = (_KERNEL // 2 - 1) * 2 ** len(_WIDTHS) + 1

    def __init__(self, channels: int = 3, classes: int = 10, *, circular: bool = False) -> None:
        super().__init__(channels, classes)
        self.circular = circular
        outer = (_STEM, *_WIDTHS[:-1])
        steps = list(zip(outer, _WIDTHS, strict=True))
        self._stem = nn.Sequential(
            self._conv(channels, _STEM, 5), nn.BatchNorm2d(_STEM), nn.ReLU(inplace=True)
        )
        self._down = nn.ModuleList(
            nn.Sequential(_halving(above, width), self._block(width)) for above, width in steps
        )
        self._bottom = self._block(_WIDTHS[-1])
        self._up = nn.ModuleList(_Doubling(width, above) for above, width in steps)
        self._merged = nn.ModuleList(
            nn.Identity() if width == _STEM else self._block(width) for width in outer
        )
        self._head = self._conv(_STEM, classes, 3)

    def forward(self, features: Tensor) -> Prediction:
        """Return the logits (N, K, B) of standardised features (N, C, B) f4; nothing is drawn.

        Raises
        ------
        InvalidInputError
            If the features have another shape.
        """
        self.check_features(features)
        x = self._stem(self._as_image(features))
        skips = []
        for down in self._down:
            skips.append(x)
            x = down(x)
        x = self._bottom(x)
        for up, merged in zip(reversed(self._up), reversed(self._merged), strict=True):
            x = merged(up(x) + skips.pop())
        return Prediction(self._head(x).squeeze(2)[..., : features.shape[2]])

    def expected_logits(self, features: Tensor) -> Tensor:
        """Return the logits (N, K, B) of features (N, C, B) f4."""
        return self.forward(features).logits

    def _as_image(self, features: Tensor) -> Tensor:
        """(N, C, B) to (N, C, 1, W), W a multiple of 16, with channels together in memory.

        Convolutions in each channel take a third of the time in this layout on CPUs.
        """
        spare = -features.shape[2] % 2 ** len(_WIDTHS)
        mode = "circular" if self.circular else "constant"
        padded = functional.pad(features, (0, spare), mode=mode) if spare else features
        return padded.unsqueeze(2).contiguous(memory_format=torch.channels_last)

    def _conv(self, inner: int, outer: int, taps: int, *, groups: int = 1) -> nn.Conv2d:
        return nn.Conv2d(
            inner,
            outer,
            (1, taps),
            padding=(0, taps // 2),
            groups=groups,
            padding_mode="circular" if self.circular else "zeros",
        )

    def _block(self, width: int) -> nn.Module:
        return _Residual(
            self._conv(width, width, _KERNEL, groups=width),
            nn.BatchNorm2d(width),
            nn.Conv2d(width, _EXPANSION * width, 1),
            nn.ReLU(inplace=True),
            nn.Conv2d(_EXPANSION * width, width, 1),
            norm=nn.BatchNorm2d(width),
        )


class _Residual(nn.Module):
    """Adds to its input what layers make of it."""

    def __init__(self, *layers: nn.Module, norm: nn.BatchNorm2d) -> None:
        super().__init__()
        nn.init.zeros_(norm.weight)  # training starts from a shallow network
        self._layers = nn.Sequential(*layers, norm)

    def forward(self, x: Tensor) -> Tensor:
        added: Tensor = x + self._layers(x)
        return added


def _halving(inner: int, outer: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inner, outer, (1, 2), (1, 2)), nn.BatchNorm2d(outer))


class _Doubling(nn.Module):
    """Makes two positions of one: of the first and the second half of the new channels."""

    def __init__(self, inner: int, outer: int) -> None:
        super().__init__()
        self._layers = nn.Sequential(nn.Conv2d(inner, 2 * outer, 1), nn.BatchNorm2d(2 * outer))

    def forward(self, x: Tensor) -> Tensor:
        by_position: Tensor = self._layers(x).permute(0, 2, 3, 1)  # (N, 1, L, 2 C)
        n, height, positions, both = by_position.shape
        apart = by_position.reshape(n, height, 2 * positions, both // 2)  # free in this layout
        return apart.permute(0, 3, 1, 2)
