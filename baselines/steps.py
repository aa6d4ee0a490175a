"""One step of training, made quick on CPUs."""

from __future__ import annotations

import contextlib
import ctypes
import sys
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from baselines.losses import loss_terms
from baselines.networks import Latent, Prediction

_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4  # malloc.h
_BATCH_NORM_MOMENTUM = 0.1  # torch's default, which the published network uses


def step(
    network: nn.Module,
    optimiser: torch.optim.Optimizer,
    batch: Mapping[str, Tensor],
    class_weights: Tensor,
    *,
    betas: Sequence[float],
    micro_batch: int | None = None,
    bf16: bool = False,
) -> dict[str, float]:
    """Take one step of the optimiser, and return the loss and its terms.

    Parameters
    ----------
    network, optimiser
        Changed in place. A `DistributedDataParallel` network averages gradients over its team.
    batch
        ``features`` (N, C, B) f4 and ``target`` (N, B) i8, 255 left out.
    class_weights
        (K,) f4.
    betas
        Weights of the three terms.
    micro_batch
        Scans that go through the network at a time, their gradients averaged; None takes all.
        Batch norms and Lovasz-softmax see one micro-batch each. For a batch of 1,024 Hokuyo scans,
        loss and gradient changed by 0.6 and 2.9 % in parts of 32, and by 0.1 and 1.5 % in parts of
        128, where merely drawing other latents changes the gradient by 2.0 %.
    bf16
        Let convolutions compute with 16 bits; weights, losses and sums keep 32. In the same batch,
        loss and gradient changed by 0.01 and 1.1 %.
    """
    scans = len(batch["features"])
    sums: dict[str, float] = {}
    optimiser.zero_grad(set_to_none=True)
    split = (torch.split(batch[name], micro_batch or scans) for name in ("features", "target"))
    parts = list(zip(*split, strict=True))
    for features, target in parts:
        with _averaged_once(network, last=features is parts[-1][0]):
            terms = loss_terms(_predict(network, features, bf16=bf16), target, class_weights)
            share = len(features) / scans
            loss = terms.total(betas)
            torch.autograd.backward(share * loss)
        for name, value in {"loss": loss, **terms._asdict()}.items():
            sums[name] = sums.get(name, 0.0) + share * value.item()
    optimiser.step()
    return sums


def _averaged_once(network: nn.Module, *, last: bool) -> AbstractContextManager[None]:
    """Let a team average the sum of the micro-batches' gradients, and not each of them."""
    if isinstance(network, DistributedDataParallel) and not last:
        return network.no_sync()
    return contextlib.nullcontext()


def _predict(network: nn.Module, features: Tensor, *, bf16: bool) -> Prediction:
    if not bf16:
        return Prediction(*network(features))
    with torch.autocast(features.device.type, torch.bfloat16):
        logits, latent, law = network(features)
    if latent is None:
        return Prediction(logits.float())
    return Prediction(logits.float(), latent.float(), Latent(*(part.float() for part in law)))


def momentum_of_micro_batches(
    network: nn.Module, batch_size: float, micro_batch: int | None
) -> None:
    """Let batch norms forget as much in the micro-batches of a batch as they would in one.

    `batch_size` is that of the scans of one process, which a team shares unevenly.
    """
    parts = max(1.0, batch_size / (micro_batch or batch_size))
    for layer in network.modules():
        if isinstance(layer, nn.BatchNorm2d):
            layer.momentum = 1 - (1 - _BATCH_NORM_MOMENTUM) ** (1 / parts)


def freeze_norms(network: nn.Module) -> None:
    """Let batch norms of a network in training use their running statistics, and keep them."""
    for layer in network.modules():
        if isinstance(layer, nn.modules.batchnorm._BatchNorm):  # noqa: SLF001 - of every dimension
            layer.eval()


def keep_freed_memory() -> None:
    """Tell glibc to reuse the memory of a step in the next one.

    By default it hands large blocks back to the kernel at once and gets fresh pages for the next
    tensor, which takes most of the time of a step. The process keeps its peak of memory then.
    """
    if sys.platform != "linux":
        return
    with contextlib.suppress(OSError, AttributeError):  # another C library
        libc = ctypes.CDLL(None)
        libc.mallopt(_M_MMAP_MAX, 0)
        libc.mallopt(_M_TRIM_THRESHOLD, 2**31 - 1)
