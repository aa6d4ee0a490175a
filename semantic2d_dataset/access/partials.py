"""The part of a file that has arrived, kept for the next run.

Every process writes to a name of its own, so that two never write to the same file, with locks
or without. What a process leaves is taken over by the next: by renaming, which only one can do.
"""

from __future__ import annotations

import contextlib
import glob
import os
import shutil
import socket
import time
from pathlib import Path
from typing import Self

from semantic2d_dataset.format.writing import partial_name, stale_partials

_IDLE_S = 1800
"""When a part that another machine writes counts as left; no download pauses so long."""


class Partial:
    """What has arrived of one file, as a context manager: what is not published is kept.

    Parameters
    ----------
    target
        The final name.
    checksum
        Of the whole file; parts of other contents are not taken over.
    """

    def __init__(self, target: Path, checksum: str) -> None:
        self._target = target
        self._base = target.with_name(f"{target.name}.{checksum.partition(':')[2][:12]}")
        self._resting = target.with_name(f".{self._base.name}.resume")
        self.path = partial_name(self._base)

    def __enter__(self) -> Self:
        for left in sorted(self._left() + self._abandoned(), key=_size_of, reverse=True):
            if _size_of(self.path):
                left.unlink(missing_ok=True)  # shorter, so of no use
            else:
                self._take_over(left)
        self.path.touch()
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(FileNotFoundError):
            if self.size:
                self.path.replace(self._resting)
            else:
                self.path.unlink()

    @property
    def size(self) -> int:
        """Bytes that have arrived."""
        return _size_of(self.path)

    def kept_bytes(self) -> int:
        """Return how many bytes of earlier runs need no room again; copying needs it."""
        return max(map(_size_of, self._left()), default=0)

    def publish(self) -> None:
        """Give what has arrived the final name.

        Raises
        ------
        FileNotFoundError
            If it was taken away.
        """
        with self.path.open("rb+") as stream:
            os.fsync(stream.fileno())
        self.path.replace(self._target)

    def _left(self) -> list[Path]:
        resting = [self._resting] if self._resting.is_file() else []
        return resting + stale_partials(self._base)

    def _abandoned(self) -> list[Path]:
        """Return parts of other machines that have not grown for long."""
        here = f".{self._base.name}.{socket.gethostname()}-"
        found = self._base.parent.glob(f".{glob.escape(self._base.name)}.*.partial")
        return [p for p in found if not p.name.startswith(here) and _idle_s(p) > _IDLE_S]

    def _take_over(self, left: Path) -> None:
        with contextlib.suppress(FileNotFoundError):
            if left in self._abandoned():
                # copied: should its process wake up, it must not write into ours
                shutil.copyfile(left, self.path)
                left.unlink()
            else:
                left.rename(self.path)


def _size_of(path: Path) -> int:
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return 0


def _idle_s(path: Path) -> float:
    try:
        return time.time() - path.stat().st_mtime
    except FileNotFoundError:
        return 0.0
