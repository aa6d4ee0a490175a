"""Lists of scans that belong to no split, written by somebody who has looked at them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.splits import NONE, SplitScheme

_LINE = re.compile(r"(?:(?P<id>\S+)\s+)?(?P<first>[0-9]+)(?:\s*-\s*(?P<last>[0-9]+))?")


def read_drops(path: Path, lengths: Mapping[str, int]) -> dict[str, NDArray[np.int64]]:
    """Read a list of scans: ``17``, ``20-45`` (both dropped too), a line each; ``#`` comments.

    The id of the sequence stands before the numbers where the recording has become several.

    Parameters
    ----------
    path
        A text file.
    lengths
        Number of scans of each sequence of the recording, by its id.

    Returns
    -------
    dict
        Indices (n,) i8 by sequence id.

    Raises
    ------
    InvalidInputError
        If a line is no such line, or names a scan or a sequence that does not exist.
    """
    found: dict[str, list[NDArray[np.int64]]] = {}
    text = path.read_text(encoding="utf-8-sig", errors="replace")
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split("#")[0].strip()
        if words:
            name, indices = _scans(words, f"{path}:{number}", lengths)
            found.setdefault(name, []).append(indices)
    return {name: np.unique(np.concatenate(parts)) for name, parts in found.items()}


def _scans(words: str, where: str, lengths: Mapping[str, int]) -> tuple[str, NDArray[np.int64]]:
    match = _LINE.fullmatch(words)
    if match is None:
        raise InvalidInputError(
            f"{where}: expected the index of a scan (17), or of the first and the last (20-45), "
            f"found {words!r}"
        )
    name = match["id"]
    if name is None and len(lengths) > 1:
        raise InvalidInputError(
            f"{where}: expected the sequence before the scan, one of {', '.join(lengths)}"
        )
    name = name or next(iter(lengths))
    if name not in lengths:
        raise InvalidInputError(
            f"{where}: no sequence {name} of this recording; it has {', '.join(lengths)}"
        )
    first = int(match["first"])
    last = int(match["last"] or first)
    if not first <= last < lengths[name]:
        raise InvalidInputError(
            f"{where}: {name} has {lengths[name]} scans, 0 to {lengths[name] - 1}; found {words!r}"
        )
    return name, np.arange(first, last + 1)


def without(scheme: SplitScheme, dropped: Mapping[str, NDArray[np.int64]]) -> SplitScheme:
    """Return a scheme whose splits leave scans out, given by their indices."""
    total = sum(map(len, dropped.values()))
    if not total:
        return scheme
    membership = {name: ids.copy() for name, ids in scheme.membership.items()}
    for name, indices in dropped.items():
        membership[name][indices] = NONE
    return SplitScheme(scheme.name, membership, f"{scheme.made_by}; {total} scans dropped")
