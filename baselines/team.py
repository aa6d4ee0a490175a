"""The processes that train one model together, as torchrun starts them."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor, distributed, nn
from torch.nn.parallel import DistributedDataParallel


@dataclass(frozen=True)
class Team:
    """How many processes train, and which of them this one is.

    Parameters
    ----------
    rank
        From 0; the first one validates and writes.
    size
        Number of processes; 1 for a training without torchrun.
    """

    rank: int = 0
    size: int = 1

    def share(self, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return this process's scans of a batch: every `size`-th one, from its rank on."""
        return {name: values[self.rank :: self.size] for name, values in batch.items()}

    def wrap(self, network: nn.Module) -> nn.Module:
        """Return a network whose gradients are averaged over the team by the backward pass."""
        return DistributedDataParallel(network) if self.size > 1 else network

    def tell(self, value: float, device: torch.device) -> float:
        """Return the value that the first process gave."""
        if self.size == 1:
            return value
        told = torch.tensor(value, dtype=torch.float64, device=device)
        distributed.broadcast(told, src=0)
        return told.item()


@contextmanager
def join_team(device: torch.device) -> Iterator[Team]:
    """Join the processes that torchrun started, over NCCL on GPUs and Gloo on CPUs.

    Without torchrun, the team is this process alone. Each process takes the GPU of its local rank.
    """
    size = int(os.environ.get("WORLD_SIZE", "1"))
    if size == 1:
        yield Team()
        return
    if device.type == "cuda":
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
    distributed.init_process_group("nccl" if device.type == "cuda" else "gloo")
    try:
        yield Team(distributed.get_rank(), size)
    finally:
        distributed.destroy_process_group()
