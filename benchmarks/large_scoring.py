"""Score predictions of about 43 M points from files: alone, by two processes, and in four parts.

Run with ``python benchmarks/large_scoring.py FOLDER``; the data set is that of `large_dataset.py`,
and is made where FOLDER is not there. Every step is a process of its own, whose wall time and
largest memory are printed; the results of all ways must be the same bytes.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from large_dataset import COMMAND, RECORDINGS, SCANS, measure

PARTS = 4


def main() -> None:
    """Measure every way."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scans", type=int, default=SCANS, help="in each recording")
    parsed = parser.parse_args()
    data, work = parsed.folder, Path(f"{parsed.folder}.scores")
    work.mkdir(exist_ok=True)
    predictions, where = work / "predictions.h5", ("--data", data)
    print("| step | s | MiB | |\n|---|---|---|---|")
    if not data.exists():
        how = ("--lidar", "hokuyo", "--recordings", RECORDINGS, "--scans", parsed.scans)
        measure("make", [*COMMAND, "simulate", data, *how])
    if not predictions.exists():
        sanity = ("leaderboard", "sanity", "perfect", "--out", predictions)
        measure("predictions", [*COMMAND, *sanity, *where])
    measure("validate", [*COMMAND, "submission", "validate", predictions, *where])
    score, outs = (*COMMAND, "score", predictions, *where), []
    for name, more in (("alone", ()), ("two", ("--jobs", 2))):
        outs.append(work / f"{name}.json")
        measure(f"score, {name}", [*score, *more, "--out", outs[-1]])
    parts = [work / f"part-{k}.json" for k in range(1, PARTS + 1)]
    for k, part in enumerate(parts, start=1):
        words = ("score-part", predictions, f"{k}/{PARTS}", part)
        measure(f"part {k} of {PARTS}", [*COMMAND, *words, *where])
    outs.append(work / "merged.json")
    measure("merge", [*COMMAND, "score-merge", *parts, "--out", outs[-1]])
    if len({out.read_bytes() for out in outs}) > 1:
        sys.exit(f"{work}: the results are not the same bytes")
    print("all results are the same bytes")


if __name__ == "__main__":
    main()
