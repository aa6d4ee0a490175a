"""How well, and how fast, the scans of a sequence are laid onto a map.

    python benchmarks/salsa_alignment.py SEQUENCE.h5 --map MAP.yaml [--annotation LABELS.json]
    python benchmarks/salsa_alignment.py SIMULATED.h5 --exact

Prints, by thirds of the recording, the median share of points within 10 cm of an occupied cell
before and after alignment, by all points and by line features only, and scans per second. With
`--exact` the sequence's own map is used, and its refined poses are the truth.
"""

from __future__ import annotations

import argparse
import os
import platform
import time
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np

from salsa.alignment import align, measure
from salsa.annotation import annotate_map
from salsa.fields import map_field
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.scene.maps import read_map

REPEATS = 5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sequence", type=Path)
    parser.add_argument("--map", type=Path)
    parser.add_argument("--annotation", type=Path)
    parser.add_argument("--exact", action="store_true")
    given = parser.parse_args()
    with SequenceReader(given.sequence) as reader:
        batch = replace(reader.batch(), poses=reader.read("poses/initial"))
        truth = reader.read("poses/refined") if given.exact else None
        scene = reader.read_map() if given.map is None else read_map(given.map)
    if given.annotation:
        scene = annotate_map(given.map, given.annotation)
    field = map_field(scene)
    known = np.isfinite(batch.poses).all(axis=-1)
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores")
    print(f"{given.sequence.name}: {len(batch)} scans, {known.sum()} with a pose")
    report("before", measure(batch, batch.poses, field).inlier_ratio[known])
    for points in ("all", "lines"):
        found = align(batch, field, points=points)
        report(f"after, {points}", found.inlier_ratio[known])
        print(f"  accepted {found.accepted[known].mean():.1%}")
        if truth is not None:
            report_errors(found.poses[known], truth[known])
        for threads in sorted({1, numba.config.NUMBA_NUM_THREADS}):
            speed = len(batch) / fastest(batch, field, points, threads)
            print(f"  {speed:,.0f} scans/s on {threads} thread(s)")


def report(what: str, near: np.ndarray) -> None:
    thirds = " ".join(f"{np.median(part):6.1%}" for part in np.array_split(near, 3))
    print(f"{what:<14} near the map: {np.median(near):6.1%}; by thirds {thirds}")


def report_errors(poses: np.ndarray, truth: np.ndarray) -> None:
    metres = np.hypot(*(poses - truth)[:, :2].T)
    degrees = np.rad2deg(np.abs((poses - truth)[:, 2] + np.pi) % (2 * np.pi) - np.pi)
    print(f"  error {100 * np.median(metres):.2f} cm, {np.median(np.abs(degrees)):.3f} degrees")


def fastest(batch, field, points: str, threads: int) -> float:
    numba.set_num_threads(threads)
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        align(batch, field, points=points)
        times.append(time.perf_counter() - start)
    return min(times)


if __name__ == "__main__":
    main()
