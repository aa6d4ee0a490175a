"""Score leg detection on a real recording, and time both geometric detectors.

    python benchmarks/leg_detection.py FOLDER

FOLDER holds ``leg_tracker_benchmarks/general_tracking_moving_1.bag.zip``. Recall and precision
are those of detections within half a metre of an annotated person, one to one, in the scans that
have an annotation. Not everybody in sight is annotated, so the precision is a lower bound.

Then lines (classic and joint fit) and legs label simulated scans of the Hokuyo on one core, each
beside a plain implementation in numpy and Python, in turn, each in a process of its own. The
plain ones are those of ``lines.py`` and of the tests, which hold the fast leg detection to it.
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
from collections.abc import Callable
from pathlib import Path

import numpy as np

PROJECT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(PROJECT))

from baselines.leg_detector import PATTERNS, LegParameters, detect_legs, label_people  # noqa: E402
from baselines.line_detector import ON_LINE_M, label_walls  # noqa: E402
from benchmarks.lines import LIDAR, lines_of, make_scans  # noqa: E402
from semantic2d_dataset.scene.geometry import to_points  # noqa: E402
from semantic2d_dataset.scene.lines import FAST, PUBLISHED  # noqa: E402
from tests.baselines.annotated_people import (  # noqa: E402
    AnnotatedPeople,
    find_matches,
    read_people,
)
from tests.baselines.plain_legs import people_of  # noqa: E402

SCANS = 960
SLICE = 240  # scans that the plain ones get
BUDGET_S = 1.5  # repetitions in one process; the best counts
SETTINGS = {
    "published: legs 0.10 to 0.20 m, single 0.10 to 0.40 m": LegParameters(),
    "first author's code: legs 0.05 to 0.25 m, single 0.10 to 0.50 m": LegParameters(
        min_leg_m=0.05, max_leg_m=0.25, max_gap_m=0.35, max_together_m=0.5
    ),
    "ankles: legs 0.05 to 0.20 m, single 0.05 to 0.40 m (not published)": LegParameters(
        min_leg_m=0.05, min_together_m=0.05
    ),
}
NEAR_M = 4.0


def score(people: AnnotatedPeople) -> None:
    """Print how well the annotated people are found."""
    beside = people.nearest_return()
    annotated = np.unique(people.scan).size
    print(f"{len(people.scan)} annotations in {annotated} of {len(people.ranges)} scans")
    print(
        f"they lie {np.median(beside):.3f} m (median) and {beside.max():.3f} m (at most) from a "
        f"return of their scan; {percent(people.nearest_return(later=-1) < 0.3)} and "
        f"{percent(people.nearest_return(later=1) < 0.3)} lie within 0.3 m of one of the scan "
        "before or after"
    )
    for name, parameters in SETTINGS.items():
        found = detect_legs(
            people.ranges,
            people.bearings,
            parameters,
            range_min=people.range_min,
            range_max=people.range_max,
        )
        matched, detections = find_matches(found, people)
        near = people.distances < NEAR_M
        kinds = np.bincount(found.patterns, minlength=len(PATTERNS))
        print(
            f"{name}\n  recall {percent(matched)} of all ({matched.sum()}), "
            f"{percent(matched[near])} of {near.sum()} nearer than {NEAR_M:g} m, "
            f"{percent(matched[~near])} farther; precision at least "
            f"{100 * matched.sum() / detections:.1f} % of {detections}"
        )
        print(
            "  in all scans: " + ", ".join(f"{n} {k}" for n, k in zip(kinds, PATTERNS, strict=True))
        )


def percent(which: np.ndarray) -> str:
    return f"{100 * which.mean():.1f} %"


def walls_plainly(scans: np.ndarray) -> None:
    for ranges, points in zip(scans, to_points(scans, LIDAR.bearings), strict=True):
        on_line = np.zeros(LIDAR.beams, bool)
        for first, last in lines_of(ranges, LIDAR.bearings):
            length = np.hypot(*(last - first))
            c, s = (last - first) / length
            x, y = (points - first).T
            beyond = np.abs(x * c + y * s - length / 2) - length / 2
            on_line |= (np.abs(y * c - x * s) <= ON_LINE_M) & (beyond <= ON_LINE_M)


def people_plainly(scans: np.ndarray) -> None:
    limits = (LIDAR.range_min, LIDAR.range_max)
    for ranges in scans:
        on_leg = np.zeros(LIDAR.beams, bool)
        for person in people_of(ranges, LIDAR.bearings, LegParameters(), *limits):
            for first, last in person.legs:
                on_leg[first : last + 1] = True


WAYS: dict[str, tuple[Callable[[np.ndarray], object], int]] = {
    "lines, joint fit": (lambda scans: label_walls(scans, LIDAR, FAST), SCANS),
    "lines, published": (lambda scans: label_walls(scans, LIDAR, PUBLISHED), SCANS),
    "lines, plain": (walls_plainly, SLICE),
    "legs": (lambda scans: label_people(scans, LIDAR), SCANS),
    "legs, plain": (people_plainly, SLICE),
}


def measure(way: str, path: Path) -> None:
    """Print the best rate in scans/s on one core."""
    import numba

    numba.set_num_threads(1)
    label, count = WAYS[way]
    scans = np.load(path, allow_pickle=False)[:count]
    label(scans)  # compiles, or reads what was compiled
    seconds: list[float] = []
    while sum(seconds) < BUDGET_S:
        start = time.perf_counter()
        label(scans)
        seconds.append(time.perf_counter() - start)
    print(json.dumps(len(scans) / min(seconds)))


def run(way: str, path: Path) -> float:
    command = [sys.executable, __file__, "--way", way, "--file", path]
    one = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    done = subprocess.run(
        command, check=True, capture_output=True, text=True, env={**os.environ, **one}
    )
    return float(json.loads(done.stdout))


def compare(path: Path, rounds: int) -> None:
    found = [{way: run(way, path) for way in WAYS} for _ in range(rounds)]
    for way in WAYS:
        rates = [one[way] for one in found]
        plain = f"{way.split(',')[0]}, plain"
        ratio = statistics.median(one[way] / one[plain] for one in found)
        print(
            f"{way:17} {statistics.median(rates):8,.0f} scans/s "
            f"({min(rates):,.0f} to {max(rates):,.0f})"
            + (f", {ratio:,.0f}x the plain one" if way != plain else "")
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", help="what holds the recording")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--way", choices=WAYS, help=argparse.SUPPRESS)
    parser.add_argument("--file", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.way:
        measure(options.way, options.file)
        return
    with tempfile.TemporaryDirectory() as folder:
        if options.folder:
            score(read_people(options.folder, Path(folder)))
        print(f"{platform.machine()}, one core of {os.cpu_count()}, {LIDAR.beams} beams")
        path = Path(folder) / "scans.npy"
        np.save(path, make_scans(SCANS))
        compare(path, options.rounds)


if __name__ == "__main__":
    main()
