"""Locks that save work: what must be right without them is right by renaming."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout
from tqdm import tqdm


@contextlib.contextmanager
def alone(target: Path) -> Iterator[None]:
    """Wait for other processes that make a file or folder, where there are locks.

    Parameters
    ----------
    target
        What is made; the lock lies beside it under a hidden name, in a folder that is made.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(target.with_name(f".{target.name}.lock"))
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError, NotImplementedError):  # where there are no locks
            try:
                lock.acquire(timeout=0)
            except Timeout:
                tqdm.write(f"{target}: another process is at work; waiting", file=sys.stderr)
                lock.acquire()
            stack.callback(lock.release)
        yield
