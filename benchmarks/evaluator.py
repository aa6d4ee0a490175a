"""Time the evaluator beside scikit-learn's confusion matrix and numpy's bincount.

Run with ``python benchmarks/evaluator.py``. All run in turn, each in a process of its own, on the
same labels; scikit-learn gets a slice, and its rate is that of the slice. No label is missing, so
that all do the same work and must give the same matrix. With ``--conditions``, scores by range,
incidence, border, people and motion, in one pass and one thread, stand beside the same counts by
numpy: bands by ``digitize`` and comparisons, one bincount of pairs for each condition.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np

CLASSES = 10
# shares of classes in the paper where it names them, the rest even
SHARES = (0.02, 0.08, 0.105, 0.05, 0.114, 0.05, 0.133, 0.05, 0.019, 0.379)
RUN = 12  # neighbouring beams that hit the same object
SLICE = 2_000_000
BEAMS = 1081
BUDGET_S = 1.5  # repetitions in one process; the best counts


def make_labels(points: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    objects = rng.choice(CLASSES, points // RUN + 1, p=SHARES).astype(np.uint8)
    truth = np.repeat(objects, RUN)[:points]
    wrong = rng.random(points, np.float32) < 0.2
    prediction = np.where(wrong, rng.integers(0, CLASSES, points, np.uint8), truth)
    return truth, prediction


def count_ours(truth: np.ndarray, prediction: np.ndarray) -> np.ndarray:
    from semantic2d_dataset.scoring.metrics import Evaluator

    evaluator = Evaluator().update(truth, prediction)
    evaluator.compute()
    return evaluator.confusion


def count_bincount(truth: np.ndarray, prediction: np.ndarray) -> np.ndarray:
    pairs = truth * np.uint8(CLASSES) + prediction  # below 100: u1 is bincount's best case
    return np.bincount(pairs, minlength=CLASSES**2).reshape(CLASSES, CLASSES)


def count_sklearn(truth: np.ndarray, prediction: np.ndarray) -> np.ndarray:
    from sklearn.metrics import confusion_matrix

    return confusion_matrix(truth, prediction, labels=range(CLASSES))


WAYS: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "ours": count_ours,
    "np.bincount": count_bincount,
    "sklearn": count_sklearn,
}


def make_ranges(points: int) -> np.ndarray:
    """Ranges (N, B) of as many whole scans of the Hokuyo as fit."""
    rng = np.random.default_rng(1)
    objects = rng.uniform(0.3, 20, points // RUN + 1).astype(np.float32)
    ranges = np.repeat(objects, RUN)[:points] + rng.normal(0, 0.01, points).astype(np.float32)
    return ranges[: points // BEAMS * BEAMS].reshape(-1, BEAMS)


def conditions_ours(truth: np.ndarray, prediction: np.ndarray, ranges: np.ndarray) -> list:
    from semantic2d_dataset.scene.lidars import HOKUYO_UTM_30LX_EW
    from semantic2d_dataset.scene.taxonomy import SEMANTIC2D
    from semantic2d_dataset.scoring.conditions import count_conditions

    counts = count_conditions(truth, prediction, ranges, HOKUYO_UTM_30LX_EW, SEMANTIC2D)
    return [counts[name].tolist() for name in ("range_m", "border", "people", "motion")]


def conditions_numpy(truth: np.ndarray, prediction: np.ndarray, ranges: np.ndarray) -> list:
    """Count a thousand scans at a time, or memory for bands would be what takes the time."""
    blocks = [
        _conditions_numpy(*(array[i : i + 1000] for array in (truth, prediction, ranges)))
        for i in range(0, len(truth), 1000)
    ]
    return [sum(parts).tolist() for parts in zip(*blocks, strict=True)]


def _conditions_numpy(truth: np.ndarray, prediction: np.ndarray, ranges: np.ndarray) -> list:
    from semantic2d_dataset.scene.geometry import incidence_angles
    from semantic2d_dataset.scene.lidars import HOKUYO_UTM_30LX_EW

    degrees = np.rad2deg(incidence_angles(ranges, HOKUYO_UTM_30LX_EW.angle_increment))
    border = np.zeros(truth.shape, bool)
    for offset in (1, 2):
        differ = truth[:, offset:] != truth[:, :-offset]
        border[:, offset:] |= differ
        border[:, :-offset] |= differ
    people = (truth == 4).any(axis=1, keepdims=True)
    bands = {
        "range_m": (np.digitize(ranges, (1, 2, 4, 8, 16)), 6),
        "border": (border, 2),
        "people": (np.broadcast_to(people, truth.shape), 2),
        "motion": (truth == 4, 2),
        "incidence_deg": (np.digitize(degrees, (30, 60, 75)), 5),
    }
    pairs = truth.astype(np.int64) * CLASSES + prediction
    shape = (-1, CLASSES, CLASSES)
    counts = [
        np.bincount((band * CLASSES**2 + pairs).ravel(), minlength=size * CLASSES**2).reshape(shape)
        for band, size in bands.values()
    ]
    return counts[:4]  # angles within a rounding error of a limit may fall on either side


CONDITIONS = {"conditions": conditions_ours, "numpy": conditions_numpy}


def measure_conditions(way: str, points: int) -> None:
    """Print the best rate in points/s, and the counts of a slice."""
    ranges = make_ranges(points)
    arrays = [labels[: ranges.size].reshape(ranges.shape) for labels in make_labels(points)]
    slices = [array[:500] for array in (*arrays, ranges)]
    counts = CONDITIONS[way](*slices)  # also warms up
    arrays, ranges = (
        (arrays, ranges) if way == "conditions" else ([a[:4000] for a in arrays], ranges[:4000])
    )
    seconds: list[float] = []
    while sum(seconds) < BUDGET_S:
        start = time.perf_counter()
        CONDITIONS[way](*arrays, ranges)
        seconds.append(time.perf_counter() - start)
    print(json.dumps({"rate": ranges.size / min(seconds), "matrix": counts}))


def measure(way: str, points: int) -> None:
    """Print the best rate in points/s, and the matrix of the slice."""
    truth, prediction = make_labels(points)
    matrix = WAYS[way](truth[:SLICE], prediction[:SLICE])  # also warms up
    if way == "sklearn":
        truth, prediction = truth[:SLICE], prediction[:SLICE]
    seconds: list[float] = []
    while sum(seconds) < BUDGET_S:
        start = time.perf_counter()
        WAYS[way](truth, prediction)
        seconds.append(time.perf_counter() - start)
    print(json.dumps({"rate": truth.size / min(seconds), "matrix": matrix.tolist()}))


def run(way: str, points: int) -> dict[str, object]:
    command = [sys.executable, __file__, "--points", str(points), "--way", way]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=40_600_000)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--conditions", action="store_true")
    parser.add_argument("--way", choices=[*WAYS, *CONDITIONS], help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.way:
        take = measure_conditions if options.way in CONDITIONS else measure
        take(options.way, options.points)
        return
    ways = CONDITIONS if options.conditions else WAYS
    print(f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}")
    rates: dict[str, list[float]] = {way: [] for way in ways}
    matrices = []
    for _ in range(options.rounds):
        for way in ways:
            found = run(way, options.points)
            rates[way].append(found["rate"])
            matrices.append(found["matrix"])
    if any(matrix != matrices[0] for matrix in matrices):
        sys.exit("the ways to count disagree")
    middle = {way: statistics.median(found) for way, found in rates.items()}
    for way, rate in middle.items():
        spread = " ".join(f"{one / 1e6:,.0f}" for one in rates[way])
        ratio = next(iter(middle.values())) / rate
        print(f"{way:12} {rate / 1e6:8,.1f} M points/s ({spread})   ours is {ratio:,.1f}x")


if __name__ == "__main__":
    main()
