"""How fast a network labels scans, and on which processor."""

from __future__ import annotations

import contextlib
import itertools
import platform
import statistics
import time
from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

from baselines.inference import infer
from baselines.networks import SegmentationNetwork
from baselines.steps import keep_freed_memory
from semantic2d_dataset.errors import InvalidInputError

_SECONDS = 1.0
_WARM_UP = 5
_CPU_INFO = Path("/proc/cpuinfo")


def frames_per_second(
    network: SegmentationNetwork,
    features: Tensor,
    *,
    threads: int = 1,
    samples: int | None = None,
) -> float:
    """Measure how many scans a second a network labels, one scan at a time.

    The clock runs from the standardised features of a scan in memory to its labels in memory,
    copies to and from a GPU included. Scans take turns for a second after some that warm up; the
    figure is that of the median scan.

    Parameters
    ----------
    network
        In evaluation mode, where it is to be measured.
    features
        (N, C, B) f4, standardised, on the CPU.
    threads
        Of torch on the CPU while measuring.
    samples
        Label by the majority of so many samples; where not given, by one pass that draws none.

    Raises
    ------
    InvalidInputError
        If there is no scan or no thread.
    """
    if not len(features) or threads < 1:
        raise InvalidInputError(
            f"expected at least one scan and thread, found {len(features)} and {threads}"
        )
    device = next(network.parameters()).device

    def label(scan: Tensor) -> None:
        on_device = scan[None].to(device)
        if samples is None:
            network.expected_logits(on_device).argmax(1).to(torch.uint8).numpy(force=True)
        else:
            infer(network, on_device, samples=samples)

    keep_freed_memory()
    with torch.inference_mode(), _threads(threads):
        scans = itertools.cycle(features)
        for _ in range(_WARM_UP):
            label(next(scans))
        end = time.perf_counter() + _SECONDS
        seconds: list[float] = []
        while not seconds or time.perf_counter() < end:
            start = time.perf_counter()
            label(next(scans))
            seconds.append(time.perf_counter() - start)
    return 1 / statistics.median(seconds)


def processor_name(device: str | torch.device = "cpu") -> str:
    """Return what the processor of a device calls itself."""
    where = torch.device(device)
    if where.type == "cuda":
        return str(torch.cuda.get_device_name(where))
    with contextlib.suppress(OSError):
        for line in _CPU_INFO.read_text(encoding="utf-8").splitlines():
            key, _, value = line.partition(":")
            if key.strip() == "model name" and value.strip():
                return value.strip()
    return platform.processor() or platform.machine() or "unknown"


@contextlib.contextmanager
def _threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
