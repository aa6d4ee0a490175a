"""A folder that is filled aside, and takes the place of another when it is whole.

Every process fills a folder of its own, so that two never work in the same, with locks or
without. What a process leaves is taken over by the next: by renaming, which only one can do.
"""

from __future__ import annotations

import contextlib
import glob
import os
import shutil
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Self

from semantic2d_dataset.errors import WriteError
from semantic2d_dataset.format.writing import partial_name, stale_partials

_IDLE_S = 1800
"""When a folder that another machine fills counts as left; no step writes nothing for so long."""

_SWAPS = 20
_REMOVED = "removed"
_DATA = "data"
"""Where it is, the folder is not published yet."""


class Staging:
    """A folder to fill, as a context manager: what is not published is kept for the next run.

    ``data`` gets the final name; ``work`` is for what leads there, and goes when that is done.

    Parameters
    ----------
    target
        The final name.
    """

    def __init__(self, target: Path) -> None:
        self.target = target
        self._resting = target.with_name(f".{target.name}.resume")
        self.path = partial_name(target)
        self.data, self.work = self.path / _DATA, self.path / "work"

    def __enter__(self) -> Self:
        tidy(self.target)
        for left in sorted(left_of(self.target), key=size_of, reverse=True):
            with contextlib.suppress(OSError):  # another process was faster
                if self.path.exists():
                    _remove(left, self.target)
                else:
                    left.rename(self.path)
        for folder in (self.data, self.work):
            folder.mkdir(parents=True, exist_ok=True)
        return self

    def __exit__(self, *_: object) -> None:
        if self.data.is_dir() and any(path.is_file() for path in self.path.rglob("*")):
            with contextlib.suppress(OSError):  # of two processes one leaves its work
                self.path.rename(self._resting)
        self._drop()

    def publish(self, is_there: Callable[[], bool]) -> None:
        """Give the folder its final name; what had it goes when the new one is in its place.

        Parameters
        ----------
        is_there
            Tells whether a faster process has put the same there.

        Raises
        ------
        WriteError
            If it cannot be renamed.
        """
        for partial in self.data.rglob(".*.partial"):
            partial.unlink(missing_ok=True)
        for _ in range(_SWAPS):
            try:
                self.data.rename(self.target)
            except OSError as err:
                if not self.target.is_dir():
                    raise WriteError(
                        f"{self.target}: {(err.strerror or str(err)).lower()}"
                    ) from err
            if self.data.exists() and not is_there():
                self._swap()
                continue
            self._drop()
            return
        raise WriteError(f"{self.target}: other processes replace it again and again; try later")

    def _swap(self) -> None:
        """Put it into the place of another folder; killed in between, the next run does it."""
        aside = _trash_name(self.target)
        with contextlib.suppress(FileNotFoundError):
            self.target.rename(aside)
        with contextlib.suppress(OSError):  # another process was faster: once more
            self.data.rename(self.target)
        shutil.rmtree(aside, ignore_errors=True)

    def _drop(self) -> None:
        with contextlib.suppress(FileNotFoundError):
            _remove(self.path, self.target)


def left_of(target: Path) -> list[Path]:
    """Return folders of runs that ended before they were published."""
    resting = target.with_name(f".{target.name}.resume")
    here = f".{target.name}.{socket.gethostname()}-"
    elsewhere = [
        path
        for path in target.parent.glob(f".{glob.escape(target.name)}.*.partial")
        if not path.name.startswith((here, f".{target.name}.{_REMOVED}."))
        and _idle_s(path) > _IDLE_S
    ]
    return ([resting] if resting.is_dir() else []) + stale_partials(target) + elsewhere


def discard(folder: Path, target: Path) -> int:
    """Remove a folder at once, whatever is killed, and return how many bytes that freed."""
    size = size_of(folder)
    _remove(folder, target)
    return size


def tidy(target: Path) -> None:
    """Remove what processes that were killed had published or begun to remove."""
    for left in stale_partials(target.with_name(f"{target.name}.{_REMOVED}")):
        shutil.rmtree(left, ignore_errors=True)
    for left in left_of(target):
        if not (left / _DATA).is_dir():
            with contextlib.suppress(FileNotFoundError):
                _remove(left, target)


def link(source: Path, target: Path) -> None:
    """Give a file a second name, or copy it where that cannot be."""
    target.parent.mkdir(parents=True, exist_ok=True)
    target.unlink(missing_ok=True)
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def size_of(folder: Path) -> int:
    """Return the bytes of all files of a folder, or of a file."""
    files = [folder] if folder.is_file() else folder.rglob("*")
    total = 0
    for path in files:
        with contextlib.suppress(OSError):
            total += path.lstat().st_size if path.is_file() else 0
    return total


def _remove(folder: Path, target: Path) -> None:
    aside = _trash_name(target)
    folder.rename(aside)
    shutil.rmtree(aside, ignore_errors=True)


def _trash_name(target: Path) -> Path:
    return partial_name(target.with_name(f"{target.name}.{_REMOVED}"))


def _idle_s(folder: Path) -> float:
    newest = 0.0
    for path in (folder, *folder.rglob("*")):
        with contextlib.suppress(OSError):
            newest = max(newest, path.stat().st_mtime)
    return time.time() - newest
