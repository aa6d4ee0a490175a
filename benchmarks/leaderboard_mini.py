"""Make the board on semantic2d-mini: sanity rows, and every trained model of a folder.

Run with ``python benchmarks/leaderboard_mini.py --runs RUNS --out FOLDER``. RUNS holds folders that
training left, named ``<model>-<features>-<lidar>-seed<n>`` as ``semantic2d baseline reproduce``
names them; those that differ in their seed only are one entry. FOLDER gets ``predictions/`` and
``site/``; entries go to ``--entries``. What is there already is kept, so that it can be run again;
delete it after a change.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from itertools import groupby
from pathlib import Path

DETECTORS = ("lines", "legs")
SANITY = ("majority", "perfect")


def semantic2d(*words: object) -> None:
    command = [sys.executable, "-m", "semantic2d_dataset.cli", *map(str, words)]
    subprocess.run(command, check=True, env={"OMP_NUM_THREADS": "1"} | os.environ)


def predict(runs: Path, folder: Path, scheme: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    models = sorted(run for run in runs.glob("*-seed*") if (run / "model.json").exists())
    for kind in SANITY:
        if not (folder / f"{kind}.h5").exists():
            out = folder / f"{kind}.h5"
            semantic2d("leaderboard", "sanity", kind, "--out", out, "--scheme", scheme)
    for run in (*DETECTORS, *models):
        out = folder / f"{Path(run).name}.h5"
        if not out.exists():
            more = () if run in DETECTORS else ("--probabilities",)
            semantic2d("baseline", "predict", run, "--out", out, "--scheme", scheme, *more)


def without_seed(path: Path) -> str:
    return path.stem.rpartition("-seed")[0] or path.stem


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--entries", type=Path, default=Path("leaderboard/entries"))
    parser.add_argument("--scheme", default="block")
    said = parser.parse_args()
    predictions = said.out / "predictions"
    predict(said.runs, predictions, said.scheme)
    said.entries.mkdir(parents=True, exist_ok=True)
    semantic2d("leaderboard", "published", "--entries", said.entries)
    files = sorted(predictions.glob("*.h5"), key=without_seed)
    for name, seeds in groupby(files, key=without_seed):
        more = ("--sanity",) if name in (*SANITY, *DETECTORS) else ()
        semantic2d("leaderboard", "add", *seeds, "--entries", said.entries, "--force", *more)
    at_hand = ("--entries", said.entries, "--predictions", predictions)
    semantic2d("leaderboard", "check", "--strict", *at_hand)
    semantic2d("leaderboard", "build", said.out / "site", *at_hand)


if __name__ == "__main__":
    main()
