"""Lists of scans that somebody found wrong: an index or a range a line, as text."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from semantic2d_dataset.errors import InvalidInputError

_SCANS = re.compile(r"(\d{1,18})(?:\s*-\s*(\d{1,18}))?", re.ASCII)


def read_lines(path: Path) -> Iterator[tuple[str, str]]:
    """Yield where each line of a list is, and what it says without its ``#`` comment.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    InvalidInputError
        If it is no text.
    """
    path = Path(path)
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as err:
        raise InvalidInputError(f"{path}: expected a text file in UTF-8: {err}") from err
    for number, line in enumerate(lines, start=1):
        said = line.partition("#")[0].strip()
        if said:
            yield f"{path}, line {number}", said


def parse_range(text: str, scans: int, where: str) -> tuple[int, int]:
    """Return the first and the last scan that an index or a range ``start-stop`` names.

    Parameters
    ----------
    text
        Such as ``12`` or ``12-30``.
    scans
        How many scans the sequence has.
    where
        The text stands, for the message.

    Raises
    ------
    InvalidInputError
        If it is neither, or names a scan that there is not.
    """
    match = _SCANS.fullmatch(text)
    if match is None:
        raise InvalidInputError(
            f"{where}: expected the index of a scan, such as 12, or a range, such as 12-30, "
            f"found {text[:60]!r}"
        )
    first, last = int(match[1]), int(match[2] or match[1])
    if last < first:
        raise InvalidInputError(f"{where}: expected a range from low to high, found {text!r}")
    if last >= scans:
        raise InvalidInputError(
            f"{where}: the sequence has {scans} scans, from 0 to {scans - 1}; found {text!r}"
        )
    return first, last


def format_ranges(scans: ArrayLike) -> list[str]:
    """Write indices as lines of a list.

    >>> format_ranges([7, 3, 4, 5])
    ['3-5', '7']
    """
    ordered = np.unique(np.asarray(scans, np.int64))
    if not ordered.size:
        return []
    runs = np.split(ordered, np.flatnonzero(np.diff(ordered) > 1) + 1)
    return [f"{run[0]}-{run[-1]}" if len(run) > 1 else str(run[0]) for run in runs]
