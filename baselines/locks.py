"""Folders that one process writes to."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from semantic2d_dataset.errors import InvalidInputError


@contextlib.contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Make a folder where it is missing, and keep other processes from working in it.

    Raises
    ------
    InvalidInputError
        If another process works there.
    """
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(folder / ".lock", timeout=0):
            yield
    except Timeout as err:
        raise InvalidInputError(
            f"{folder}: another process works here; wait for it, or choose another folder"
        ) from err
