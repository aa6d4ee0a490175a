"""Time our loader beside a plain Dataset that reads one .npy file for each field and scan.

Run with ``python benchmarks/loader.py``. The ways run in turn, each in a process of its own, on
the Hokuyo's train split of semantic2d-mini: batch 256, shuffled, features R, I, A standardised.
Both deliver the same numbers, which is checked. More ways of ours do more: balanced classes, and
four past scans with each scan, their features too, which make five scans of one.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from semantic2d_dataset import History, load_dataset
from semantic2d_dataset.access.torch_datasets import LidarDataset

BATCH = 256
BUDGET_S = 4.0
WAYS = ("in memory", "streaming", "balanced", "history", "streamed history", "npy")


def load(*, in_memory: bool, history: History | None = None) -> LidarDataset:
    return load_dataset(
        "semantic2d-mini",
        lidar="hokuyo",
        split="train",
        features="RIA",
        in_memory=in_memory,
        history=history,
    )


class NpyDataset(Dataset):
    """What a training script would do with the published layout; numpy, no Python loop."""

    def __init__(self, folder: Path) -> None:
        said = json.loads((folder / "said.json").read_text())
        self.folder, self.count, self.step = folder, said["count"], said["angle_increment"]
        self.mean = np.array(said["mean"], np.float32)[:, None]
        self.std = np.array(said["std"], np.float32)[:, None]

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, i: int) -> tuple[torch.Tensor, torch.Tensor]:
        r, intensity, label = (
            np.load(self.folder / field / f"{i:07d}.npy") for field in ("scans", "int", "label")
        )
        far = np.append(r[1:], r[-2])
        d = np.sqrt(r**2 + far**2 - 2 * r * far * np.cos(self.step))
        with np.errstate(all="ignore"):
            cosine = np.clip((d**2 + r**2 - far**2) / (2 * d * r), -1, 1)
            incidence = np.nan_to_num(np.abs(np.pi / 2 - np.arccos(cosine)))
        features = (np.stack((r, intensity, incidence)).astype(np.float32) - self.mean) / self.std
        return torch.from_numpy(features), torch.from_numpy(label.astype(np.int64))


def write_npy(folder: Path) -> None:
    """Write the split in the published layout: zeros stand for no return."""
    dataset = load(in_memory=True)
    fields, rows = dataset.source.fetch(np.arange(len(dataset)))
    ranges = np.where(dataset.lidar.has_return(fields["ranges"]), fields["ranges"], 0)
    for name in ("scans", "int", "label"):
        (folder / name).mkdir()
    for i in rows:
        np.save(folder / "scans" / f"{i:07d}.npy", ranges[i].astype(np.float64))
        known = np.where(ranges[i] > 0, fields["intensities"][i], 0)
        np.save(folder / "int" / f"{i:07d}.npy", known.astype(np.float64))
        np.save(folder / "label" / f"{i:07d}.npy", fields["labels"][i].astype(np.float64))
    said = {
        "count": len(dataset),
        "angle_increment": dataset.lidar.angle_increment,
        "mean": dataset.statistics.mean,
        "std": dataset.statistics.std,
    }
    (folder / "said.json").write_text(json.dumps(said))


def loader_of(way: str, folder: Path) -> DataLoader:
    if way == "npy":
        return DataLoader(NpyDataset(folder), batch_size=BATCH, shuffle=True)
    history = History(4, compensate="ranges") if "history" in way else None
    data = load(in_memory=not way.startswith("stream"), history=history)
    return data.loader(BATCH, shuffle=True, balance=0.5 if way == "balanced" else 0.0)


def measure(way: str, folder: Path) -> None:
    """Print samples/s over whole epochs; the first warms the file cache and the compiler."""
    loader = loader_of(way, folder)
    seconds, samples = 0.0, 0
    for epoch in range(1000):
        start = time.perf_counter()
        count = sum(len(b["label"]) if isinstance(b, dict) else len(b[1]) for b in loader)
        if epoch:
            seconds, samples = seconds + time.perf_counter() - start, samples + count
        if seconds > BUDGET_S:
            break
    print(json.dumps(samples / seconds))


def check_same(folder: Path) -> None:
    """Compare every feature of a few scans between ours and the plain Dataset."""
    ours, plain = load(in_memory=False), NpyDataset(folder)
    for i in range(0, len(ours), 97):
        valid = ours[i]["valid"]
        difference = (ours[i]["features"] - plain[i][0])[:, valid].abs()
        # arccos in the plain one loses digits near grazing angles: look at the median
        if difference.median() > 1e-4 or not torch.equal(ours[i]["label"], plain[i][1]):
            sys.exit(f"scan {i} differs")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--way", choices=WAYS, help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.way:
        measure(options.way, options.folder)
        return
    print(f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_npy(folder)
        check_same(folder)
        rates: dict[str, list[float]] = {way: [] for way in WAYS}
        for _ in range(options.rounds):
            for way in WAYS:
                command = [sys.executable, __file__, "--way", way, "--folder", name]
                done = subprocess.run(command, check=True, capture_output=True, text=True)
                rates[way].append(json.loads(done.stdout))
    middle = {way: statistics.median(found) for way, found in rates.items()}
    for way, rate in middle.items():
        spread = " ".join(f"{one:,.0f}" for one in rates[way])
        print(f"{way:16} {rate:10,.0f} samples/s ({spread})   {rate / middle['npy']:.1f}x of npy")


if __name__ == "__main__":
    main()
