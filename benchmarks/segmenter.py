"""One scan at a time on one thread: an exported S3-Net against plain eager PyTorch.

Each way runs in a process of its own, ours and the plain one in turn:

    python benchmarks/segmenter.py [--rounds 5] [--threads 1]

Plain is the published architecture as one would write it with Conv1d, from features to labels; by
32 samples it runs the whole network on a batch of 32 copies of the scan, and votes. Ours takes
ranges and intensities, so its features are in its time, except where it says otherwise.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

SAMPLES, SECONDS = 32, 2.0
WAYS = (
    ("plain a scan", "segmenter a scan", "segmenter a scan, features not in its time"),
    ("plain 32 samples", "segmenter 32 samples"),
)


def export(path: Path) -> None:
    from baselines.checkpoints import Checkpoint
    from baselines.onnx_export import export_onnx
    from baselines.s3net import S3Net
    from semantic2d_dataset.access.features import Statistics
    from semantic2d_dataset.scene.lidars import HOKUYO_UTM_30LX_EW
    from semantic2d_dataset.scene.taxonomy import SEMANTIC2D

    statistics_ = Statistics((3.0, 2000.0, 0.7), (4.0, 1000.0, 0.5))
    parts = ("RIA", statistics_, HOKUYO_UTM_30LX_EW, SEMANTIC2D)
    export_onnx(Checkpoint(S3Net().eval(), *parts), path)


def plain(samples: int, threads: int) -> Callable[[], object]:
    import torch
    from s3net_training import BEAMS, PlainS3Net

    torch.set_num_threads(threads)
    network, features = PlainS3Net().eval(), torch.randn(1, 3, BEAMS)

    @torch.inference_mode()
    def label() -> torch.Tensor:
        if samples == 1:
            return network(features)[0].argmax(1)
        return network(features.expand(samples, -1, -1))[0].argmax(1).mode(0).values

    return label


def ours(model: Path, samples: int, threads: int, *, with_features: bool) -> Callable[[], object]:
    from baselines.sampled_labels import choose, elect
    from baselines.segmenter import Segmenter

    segmenter = Segmenter(model, samples=samples, threads=threads)
    rng = np.random.default_rng(0)
    beams = segmenter.description.lidar.beams
    ranges, intensities = rng.uniform(0.2, 20, beams), rng.uniform(0, 4000, beams)
    scan = (ranges.astype(np.float32), intensities.astype(np.float32))
    if with_features:
        return lambda: segmenter(*scan)
    (features,) = segmenter._features(scan[0][None], scan[1])  # noqa: SLF001
    return lambda: elect(choose(np.concatenate(segmenter._run(features))), 10)  # noqa: SLF001


def measure(way: str, model: Path, threads: int) -> float:
    """Scans per second, by the median of the calls of two seconds."""
    samples = SAMPLES if "32" in way else 1
    if way.startswith("plain"):
        label = plain(samples, threads)
    else:
        label = ours(model, samples, threads, with_features="not" not in way)
    for _ in range(10):
        label()
    seconds: list[float] = []
    while sum(seconds) < SECONDS:
        start = time.perf_counter()
        label()
        seconds.append(time.perf_counter() - start)
    return 1 / statistics.median(seconds)


def compare(ways: tuple[str, ...], rounds: int, options: list[str]) -> None:
    rates: dict[str, list[float]] = {way: [] for way in ways}
    for _ in range(rounds):
        for way, found in rates.items():
            command = [sys.executable, __file__, "--way", way, *options]
            found.append(float(subprocess.run(command, check=True, capture_output=True).stdout))
    for way, found in rates.items():
        ratios = [ours / plain for ours, plain in zip(found, rates[ways[0]], strict=True)]
        print(
            f"{way}: {statistics.median(found):.0f} scans/s, "
            f"{statistics.median(ratios):.1f} times the plain one",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--way")
    parser.add_argument("--model", type=Path)
    given = parser.parse_args()
    if given.way:
        print(measure(given.way, given.model, given.threads))
        return
    with tempfile.TemporaryDirectory() as folder:
        model = Path(folder) / "model.onnx"
        export(model)
        options = ["--threads", str(given.threads), "--model", str(model)]
        for ways in WAYS:
            compare(ways, given.rounds, options)


if __name__ == "__main__":
    main()
