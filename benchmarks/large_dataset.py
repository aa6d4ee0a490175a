"""Make, verify, audit and load a data set of 200,000 generated Hokuyo scans.

Run with ``python benchmarks/large_dataset.py FOLDER``; about a gigabyte is written to FOLDER, which
must not exist, and stays there: run it again to measure all but the making. Every step is a
process of its own, whose wall time and largest memory are printed. The first batch is that of a
process that starts cold: files dropped from the page cache, Python and PyTorch imported.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

COMMAND = (sys.executable, "-m", "semantic2d_dataset.cli")
RECORDINGS, SCANS = 4, 8_400  # in each of six environments: 201,600 scans

FIRST_BATCH = """
import sys
from semantic2d_dataset import load_dataset
scans = load_dataset(sys.argv[1], lidar="hokuyo", features="RIA", in_memory=False)
print(next(iter(scans.loader(256, shuffle=True)))["features"].shape)
"""

EPOCH = """
import sys, time
from semantic2d_dataset import load_dataset
scans = load_dataset(sys.argv[1], lidar="hokuyo", features="RIA", in_memory=sys.argv[2] == "memory")
loader = scans.loader(256, shuffle=True)
next(iter(loader))
start = time.perf_counter()
seen = sum(len(batch["features"]) for batch in loader)
print(f"{seen} scans, {seen / (time.perf_counter() - start):.0f} scans/s")
"""

TABLE = """
import sys
from semantic2d_dataset import open_dataset, scan_table
print(scan_table(open_dataset(sys.argv[1])).shape)
"""

ARRAYS = """
import sys
from semantic2d_dataset import dask_arrays, open_dataset
arrays = dask_arrays(open_dataset(sys.argv[1]), "hokuyo")
print(float((arrays["labels"] == 4).mean().compute(scheduler="threads")))
"""


def forget(folder: Path) -> None:
    """Drop the files of a folder from the page cache, so that they are read from the disk."""
    os.sync()
    for path in folder.rglob("*.h5"):
        with path.open("rb") as stream:
            os.posix_fadvise(stream.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def measure(name: str, words: Sequence[object]) -> None:
    """Run a command, and print how long it took and the largest memory of one of its processes."""
    code = (
        "import json, resource, subprocess, sys\n"
        "done = subprocess.run(sys.argv[1:], capture_output=True, text=True)\n"
        "most = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss\n"
        "print(json.dumps([done.returncode, most, done.stdout[-2000:], done.stderr[-2000:]]))"
    )
    start = time.perf_counter()
    out = subprocess.run(
        [sys.executable, "-c", code, *map(str, words)], check=True, capture_output=True, text=True
    ).stdout
    took = time.perf_counter() - start
    status, kib, said, errors = json.loads(out)
    if status:
        sys.exit(f"{name}: exit status {status}\n{said}{errors}")
    last = said.strip().splitlines()[-1][:90]
    print(f"| {name} | {took:.1f} | {kib / 1024:.0f} | {last} |", flush=True)


def main() -> None:
    """Measure every step."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scans", type=int, default=SCANS, help="in each recording")
    parsed = parser.parse_args()
    folder = parsed.folder
    print(f"{platform.platform()}, {os.cpu_count()} processors, {_memory_gib():.0f} GiB")
    print("| step | s | MiB | |\n|---|---|---|---|")
    if not folder.exists():
        how = ("--lidar", "hokuyo", "--recordings", RECORDINGS, "--scans", parsed.scans)
        measure("make", [*COMMAND, "simulate", folder, *how])
    measure("verify", [*COMMAND, "verify", folder])
    measure("verify --full", [*COMMAND, "verify", folder, "--full"])
    measure("splits audit", [*COMMAND, "splits", "audit", folder, "--out", f"{folder}.audit.png"])
    python = (sys.executable, "-c")
    forget(folder)
    measure("first batch, cold", [*python, FIRST_BATCH, folder])
    measure("first batch, warm", [*python, FIRST_BATCH, folder])
    measure("an epoch, streaming", [*python, EPOCH, folder, "stream"])
    measure("an epoch, in memory", [*python, EPOCH, folder, "memory"])
    measure("scan_table", [*python, TABLE, folder])
    measure("dask_arrays, one mean", [*python, ARRAYS, folder])


def _memory_gib() -> float:
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30


if __name__ == "__main__":
    main()
