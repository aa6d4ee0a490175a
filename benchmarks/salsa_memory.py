"""Memory and use of the cores of ``semantic2d salsa label`` on a long recording.

    python benchmarks/salsa_memory.py [--scans 200000] [--folder FOLDER]

A simulated drive of 2,000 Hokuyo scans is written over and over into one sequence, its stamps
going on, and labelled by the command in a process of its own. Memory is the largest at one time
of the command, and of it and the process that writes for it together (resident pages, sampled).
Processor time over the clock's says whether both cores were used.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from semantic2d_dataset.format.sequence import SequenceHeader, SequenceWriter
from semantic2d_dataset.scene.lidars import find_lidar
from semantic2d_dataset.scene.maps import SemanticMap, write_map
from semantic2d_dataset.simulation.recording import SimulatedRecording, simulate_recording
from semantic2d_dataset.simulation.worlds import draw_world

DRIVE_SCANS = 2000
BYTES_A_SCAN = 16_000  # of both sequences, generously
PERIOD_S = 0.02  # of the sampling
PAGE = resource.getpagesize()


class Cost(NamedTuple):
    """What a command took."""

    wall_s: float
    processor_s: float
    command_mb: float
    together_mb: float


def write_recording(path: Path, drive: SimulatedRecording, scans: int) -> None:
    batch = drive.batch
    span = batch.stamps_ns[-1] + 50_000_000 - batch.stamps_ns[0]
    header = SequenceHeader("simulated", "long-drive", batch.lidar)
    with SequenceWriter(path, header) as writer:
        for again, start in enumerate(range(0, scans, len(batch))):
            rows = slice(0, min(len(batch), scans - start))
            writer.append(
                {
                    "scans/ranges": batch.ranges[rows],
                    "scans/intensities": batch.intensities[rows],
                    "scans/stamps_ns": batch.stamps_ns[rows] + again * span,
                    "poses/initial": drive.initial_poses[rows],
                    "commands/velocity": drive.velocity[rows],
                }
            )


def write_annotated_map(folder: Path, scene: SemanticMap) -> tuple[Path, Path]:
    map_yaml, annotation = folder / "map.yaml", folder / "label.png"
    write_map(map_yaml, scene)
    Image.fromarray(np.ascontiguousarray(scene.labels[::-1])).save(annotation)
    return map_yaml, annotation


def run(words: list[str]) -> Cost:
    """Run a command of the package, and watch it."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    alone, together = 0.0, 0.0
    command = [sys.executable, "-m", "semantic2d_dataset.cli", *words]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        while process.poll() is None:
            own = resident_mb(process.pid)
            alone = max(alone, own)
            together = max(together, own + sum(map(resident_mb, children(process.pid))))
            time.sleep(PERIOD_S)
    if process.returncode:
        sys.exit(f"semantic2d {' '.join(words)} ended with {process.returncode}")
    wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    processor = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Cost(wall, processor, alone, together)


def resident_mb(pid: int) -> float:
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * PAGE / 1e6
    except (OSError, IndexError):  # it has just ended
        return 0.0


def children(pid: int) -> list[int]:
    """Return all processes below one, as the kernel lists them for each of its threads."""
    found: list[int] = []
    for listed in Path(f"/proc/{pid}/task").glob("*/children"):
        try:
            found += map(int, listed.read_text().split())
        except OSError:
            continue
    return found + [below for child in found for below in children(child)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scans", type=int, default=200_000)
    parser.add_argument("--plan", default="lobby")
    parser.add_argument("--seed", type=int, default=101)
    parser.add_argument("--folder", type=Path, help="where to write; the system's own by default")
    parser.add_argument("--static-after", type=int, help="as for the command")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=options.folder) as scratch:
        folder = Path(scratch)
        needed, free = options.scans * BYTES_A_SCAN, shutil.disk_usage(folder).free
        if free < needed:
            sys.exit(f"{folder}: {needed / 1e9:.1f} GB are needed, {free / 1e9:.1f} GB are free")
        world = draw_world(options.plan, options.seed)
        lidar = find_lidar("hokuyo")
        scans = min(options.scans, DRIVE_SCANS)
        drive = simulate_recording(world, lidar, seed=options.seed, scans=scans)
        source, out = folder / "long.h5", folder / "labelled.h5"
        write_recording(source, drive, options.scans)
        map_yaml, annotation = write_annotated_map(folder, drive.scene_map)
        words = ["salsa", "label", str(source), "--map", str(map_yaml)]
        words += ["--annotation", str(annotation), "--out", str(out), "--json"]
        if options.static_after is not None:
            words += ["--static-after", str(options.static_after)]
        cost = run(words)
        sizes = [path.stat().st_size / 1e6 for path in (source, out)]
    print("| scans | source MB | labelled MB | s | scans/s | processor s | cores busy "
          "| peak MB, command | peak MB, with its writer |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|---|")
    print(
        f"| {options.scans:,} | {sizes[0]:,.0f} | {sizes[1]:,.0f} | {cost.wall_s:,.1f} "
        f"| {options.scans / cost.wall_s:,.0f} | {cost.processor_s:,.1f} "
        f"| {cost.processor_s / cost.wall_s:.2f} of {os.cpu_count()} "
        f"| {cost.command_mb:,.0f} | {cost.together_mb:,.0f} |"
    )


if __name__ == "__main__":
    main()
