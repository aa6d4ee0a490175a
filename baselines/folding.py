"""Batch norms folded into the convolutions before them."""

from __future__ import annotations

import copy
from itertools import pairwise
from typing import TypeVar

from torch import nn
from torch.nn.modules.batchnorm import _BatchNorm
from torch.nn.modules.conv import _ConvNd
from torch.nn.utils.fusion import fuse_conv_bn_weights

_Network = TypeVar("_Network", bound=nn.Module)


def fold_batch_norms(network: _Network) -> _Network:
    """Return a copy for inference, without the batch norms that follow a convolution.

    A batch norm in evaluation mode scales and shifts each channel, which the weights and the bias
    of the convolution before it can do as well. Neighbours in an `nn.Sequential` are folded; a
    batch norm that stands elsewhere, or keeps no running statistics, stays; so does one after a
    transposed convolution in groups.

    Parameters
    ----------
    network
        Any network; it is left as it is.

    Returns
    -------
    nn.Module
        In evaluation mode, with `nn.Identity` in the place of what was folded.
    """
    folded = copy.deepcopy(network).eval()
    for block in folded.modules():
        if isinstance(block, nn.Sequential):
            for i, (conv, norm) in enumerate(pairwise(list(block))):
                if isinstance(conv, _ConvNd) and isinstance(norm, _BatchNorm):
                    block[i + 1] = _fold(conv, norm)
    return folded


def _fold(conv: _ConvNd, norm: _BatchNorm) -> nn.Module:
    """Let `conv` do what `norm` does, and return what is left of that."""
    rows_are_inputs = conv.transposed and conv.groups > 1
    if norm.running_mean is None or norm.running_var is None or rows_are_inputs:
        return norm
    conv.weight, conv.bias = fuse_conv_bn_weights(
        conv.weight,
        conv.bias,
        norm.running_mean,
        norm.running_var,
        norm.eps,
        norm.weight,
        norm.bias,
        transpose=conv.transposed,
    )
    return nn.Identity()
