"""A Dask cluster of two workers on loopback."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.conftest import PROJECT


@contextmanager
def cluster(
    folder: Path, *, nanny: bool = False
) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """A scheduler and two workers, as their command lines start them.

    A nanny starts a worker again that died.
    """
    dask = Path(sys.executable).with_name("dask")
    # functions of tests travel by name
    known = os.environ | {"PYTHONPATH": str(PROJECT)}
    log = folder / "scheduler.log"
    started = []
    try:
        with log.open("wb") as stream:
            words = ["scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
            started.append(subprocess.Popen([dask, *words], stderr=stream, cwd=folder, env=known))
        address = wait_for_address(log)
        for n in range(2):
            (folder / f"worker{n}").mkdir()
            words = [
                "worker",
                address,
                "--nthreads",
                "1",
                "--no-dashboard",
                *(() if nanny else ("--no-nanny",)),
            ]
            started.append(
                subprocess.Popen(
                    [dask, *words],
                    cwd=folder / f"worker{n}",
                    stderr=subprocess.DEVNULL,
                    env=known,
                )
            )
        yield address, started[1:]
    finally:
        for process in started:
            process.kill()
            process.wait()


def wait_for_address(log: Path) -> str:
    until = time.monotonic() + 60
    while time.monotonic() < until:
        found = re.search(r"tcp://127\.0\.0\.1:\d+", log.read_text())
        if found:
            return found[0]
        time.sleep(0.1)
    raise TimeoutError(log.read_text())
