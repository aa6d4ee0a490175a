"""Time the evaluator beside scikit-learn's confusion matrix and numpy's bincount.

Run with ``python benchmarks/evaluator.py``. The three run in turn, each in a process of its own,
on the same labels; scikit-learn gets a slice, and its rate is that of the slice. No label is
missing, so that all three do the same work and must give the same matrix.
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
    parser.add_argument("--way", choices=WAYS, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.way:
        measure(options.way, options.points)
        return
    print(f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}")
    rates: dict[str, list[float]] = {way: [] for way in WAYS}
    matrices = []
    for _ in range(options.rounds):
        for way in WAYS:
            found = run(way, options.points)
            rates[way].append(found["rate"])
            matrices.append(found["matrix"])
    if any(matrix != matrices[0] for matrix in matrices):
        sys.exit("the ways to count disagree")
    middle = {way: statistics.median(found) for way, found in rates.items()}
    for way, rate in middle.items():
        spread = " ".join(f"{one / 1e6:,.0f}" for one in rates[way])
        ratio = middle["ours"] / rate
        print(f"{way:12} {rate / 1e6:8,.1f} M points/s ({spread})   ours is {ratio:,.1f}x")


if __name__ == "__main__":
    main()
