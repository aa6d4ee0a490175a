"""Every file below a folder, converted or refused: what came out of it, and what it cost.

    python benchmarks/recordings.py FOLDER [-- OPTIONS OF CONVERT]

Each is given to ``semantic2d convert`` in a process of its own, as a user would. Zip archives
that hold one bag are also unpacked into a temporary folder and tried.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Iterator, Sequence
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

COMMAND = "from semantic2d_dataset.cli import main; main()"


class Run(NamedTuple):
    """What a conversion printed, how long it took, and the largest peak of its processes."""

    status: int
    out: str
    err: str
    seconds: float
    peak_mb: float


def find_inputs(folder: Path, scratch: Path) -> Iterator[tuple[str, Path]]:
    """Yield every file with its name, ROS 2 folders as one, and bags out of their zip archives."""
    bags = {path.parent for path in folder.rglob("metadata.yaml")}
    for path in sorted({*bags, *(p for p in folder.rglob("*") if p.is_file())}):
        name = path.relative_to(folder).as_posix()
        yield name, path
        if path.suffix == ".zip":
            with zipfile.ZipFile(path) as archive:
                for member in archive.namelist():
                    target = scratch / Path(member).name
                    target.write_bytes(archive.read(member))
                    yield f"{name}, unpacked", target


def convert(path: Path, out: Path, options: Sequence[str]) -> Run:
    """Convert in a process of its own; memory is that of the process and of its writers."""
    with get_context("spawn").Pool(1) as pool:
        return pool.apply(_convert, (path, out, options))


def _convert(path: Path, out: Path, options: Sequence[str]) -> Run:
    words = ["convert", str(path), "--out", str(out), "--json", *options]
    started = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", COMMAND, *words], capture_output=True, text=True, check=False
    )
    seconds = time.perf_counter() - started
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    return Run(done.returncode, done.stdout, done.stderr, seconds, peak)


def row(name: str, run: Run) -> str:
    """Write one line of the table."""
    if run.status:
        said = next(line for line in run.err.splitlines() if line.startswith("error: "))
        reason = said.removeprefix("error: ").split(": ", 1)[-1]
        return (
            f"| {name} | refused: {reason[:150]} | | | | {run.seconds:.1f} s | {run.peak_mb:.0f} |"
        )
    sequences = [each for outcome in json.loads(run.out) for each in outcome["sequences"]]
    scans_in = sum(each["scans_in"] for each in sequences)
    scans_out = sum(each["scans_out"] for each in sequences)
    poses = sum(each["scans_with_pose"] for each in sequences)
    source = sequences[0]["pose_source"]
    return (
        f"| {name} | {len(sequences)} | {scans_in} | {scans_out} | {poses} ({source}) | "
        f"{run.seconds:.1f} s | {run.peak_mb:.0f} |"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("options", nargs="*")
    given = parser.parse_args()
    print("| input | sequences | scans in | scans out | with a pose | time | peak MB |")
    print("|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as scratch:
        for number, (name, path) in enumerate(find_inputs(given.folder, Path(scratch))):
            print(row(name, convert(path, Path(scratch) / f"out{number}", given.options)))


if __name__ == "__main__":
    main()
