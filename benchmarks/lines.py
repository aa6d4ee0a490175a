"""Time line extraction, classic and joint fit, beside a plain one in numpy.

Run with ``python benchmarks/lines.py``. The three run in turn, each in a process of its own, on
the same simulated scans of the Hokuyo (1081 beams, six floor plans, with people), on one core and
on two. The plain one is written below: it splits at gaps, then at the farthest point from the
chord, and fits each piece by weighted least squares, scan by scan; on two cores it gets two
processes, whose start is not counted. It neither drops outliers nor joins pieces again.
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
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

from semantic2d_dataset.scene.lidars import HOKUYO_UTM_30LX_EW as LIDAR
from semantic2d_dataset.scene.lines import FAST, PUBLISHED, LineParameters, extract_lines

RANGE_MIN = 0.6  # m, as the release was labelled
SCANS = 960
SLICE = 240  # scans that the plain one gets
BUDGET_S = 1.5  # repetitions in one process; the best counts


def make_scans(count: int) -> np.ndarray:
    from semantic2d_dataset.simulation.plans import PLANS
    from semantic2d_dataset.simulation.recording import simulate_recording
    from semantic2d_dataset.simulation.worlds import draw_world

    each = -(-count // len(PLANS))
    drives = [
        simulate_recording(draw_world(plan, 1), LIDAR, seed=1, scans=each).batch.ranges
        for plan in PLANS
    ]
    mixed = np.stack(drives, axis=1)  # (each, plans, B): a slice holds all plans
    return mixed.reshape(-1, LIDAR.beams)[:count]


def ours(parameters: LineParameters) -> Callable[[np.ndarray], int]:
    def extract(scans: np.ndarray) -> int:
        limits = {"range_min": RANGE_MIN, "range_max": LIDAR.range_max}
        return len(extract_lines(scans, LIDAR.bearings, parameters, **limits)[0])

    return extract


def extract_plainly(scans: np.ndarray) -> int:
    return sum(len(lines_of(ranges, LIDAR.bearings)) for ranges in scans)


def lines_of(ranges: np.ndarray, bearings: np.ndarray) -> list[np.ndarray]:
    """Segments (2, 2) of one scan."""
    used = (ranges >= RANGE_MIN) & (ranges < LIDAR.range_max)
    r, phi = ranges[used].astype(float), bearings[used]
    points = r[:, None] * np.stack((np.cos(phi), np.sin(phi)), axis=-1)
    steps = np.hypot(*np.diff(points, axis=0).T)
    cuts = np.flatnonzero(steps > PUBLISHED.max_line_gap) + 1
    pieces = [piece for part in np.split(points, cuts) for piece in straight_pieces(part)]
    lengths = (np.hypot(*(piece[-1] - piece[0])) for piece in pieces)
    return [
        fit(piece)
        for piece, length in zip(pieces, lengths, strict=True)
        if length >= PUBLISHED.min_line_length
    ]


def straight_pieces(points: np.ndarray) -> Iterator[np.ndarray]:
    if len(points) < PUBLISHED.min_line_points:
        return
    off = np.abs((points - points[0]) @ normal_of(points[-1] - points[0]))
    worst = int(off.argmax())
    if off[worst] < PUBLISHED.min_split_dist:
        yield points
    else:
        yield from straight_pieces(points[:worst])
        yield from straight_pieces(points[worst:])


def normal_of(along: np.ndarray) -> np.ndarray:
    return np.array((-along[1], along[0])) / max(np.hypot(*along), 1e-12)


def fit(points: np.ndarray) -> np.ndarray:
    """Weighted least squares: a range's error shows across the line by the cosine of incidence."""
    cosine = points @ normal_of(points[-1] - points[0]) / np.hypot(*points.T)
    weights = 1.0 / np.maximum(cosine**2, 1e-6)
    middle = weights @ points / weights.sum()
    there = points - middle
    along = np.linalg.eigh((weights[:, None] * there).T @ there)[1][:, 1]
    return middle + np.outer(there[[0, -1]] @ along, along)


WAYS: dict[str, Callable[[np.ndarray], int]] = {
    "joint": ours(FAST),
    "classic": ours(PUBLISHED),
    "plain numpy": extract_plainly,
}


def measure(way: str, scans: np.ndarray, cores: int) -> None:
    """Print the best rate in scans/s, and the segments found per scan."""
    if way == "plain numpy":
        scans = scans[:SLICE]
        with ProcessPoolExecutor(cores) as pool:
            parts = np.array_split(scans, cores)
            repeat(lambda: sum(pool.map(extract_plainly, parts)), len(scans))
    else:
        import numba

        numba.set_num_threads(cores)
        repeat(lambda: WAYS[way](scans), len(scans))


def repeat(extract: Callable[[], int], scans: int) -> None:
    segments = extract()  # also warms up
    seconds: list[float] = []
    while sum(seconds) < BUDGET_S:
        start = time.perf_counter()
        extract()
        seconds.append(time.perf_counter() - start)
    print(json.dumps({"rate": scans / min(seconds), "segments": segments / scans}))


def run(way: str, path: Path, cores: int) -> dict[str, float]:
    command = [sys.executable, __file__, "--way", way, "--file", path, "--cores", str(cores)]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--scans", type=int, default=SCANS)
    parser.add_argument("--way", choices=WAYS, help=argparse.SUPPRESS)
    parser.add_argument("--file", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--cores", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.way:
        measure(options.way, np.load(options.file, allow_pickle=False), options.cores)
        return
    print(f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scans.npy"
        np.save(path, make_scans(options.scans))
        for cores in sorted({1, min(2, os.cpu_count() or 1)}):
            report(path, cores, options.rounds)


def report(path: Path, cores: int, rounds: int) -> None:
    found = [{way: run(way, path, cores) for way in WAYS} for _ in range(rounds)]
    rates = {way: [one[way]["rate"] for one in found] for way in WAYS}
    middle = {way: statistics.median(rates[way]) for way in WAYS}
    print(f"{cores} core{'s' * (cores > 1)}")
    for way in WAYS:
        spread = f"{min(rates[way]):,.0f} to {max(rates[way]):,.0f}"
        ratios = ", ".join(
            f"{middle[way] / middle[other]:,.1f}x {other}"
            for other in WAYS
            if middle[other] < middle[way]
        )
        print(
            f"  {way:12} {middle[way]:8,.0f} scans/s ({spread}), "
            f"{found[0][way]['segments']:.1f} segments a scan  {ratios}"
        )


if __name__ == "__main__":
    main()
