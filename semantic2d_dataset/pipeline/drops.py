"""Lists of scans that belong to no split, written by somebody who has looked at them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.drop_lists import parse_range, read_lines
from semantic2d_dataset.format.splits import NONE, SplitScheme


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
    for where, text in read_lines(path):
        name, scans = _divide(text, where, lengths)
        first, last = parse_range(scans, lengths[name], where)
        found.setdefault(name, []).append(np.arange(first, last + 1))
    return {name: np.unique(np.concatenate(parts)) for name, parts in found.items()}


def _divide(text: str, where: str, lengths: Mapping[str, int]) -> tuple[str, str]:
    """Return the sequence that a line is about, and the scans of it."""
    word, *rest = text.split(maxsplit=1)
    if rest and (word in lengths or not word[0].isdigit()):
        if word not in lengths:
            raise InvalidInputError(
                f"{where}: no sequence {word} of this recording; it has {', '.join(lengths)}"
            )
        return word, rest[0]
    if len(lengths) != 1:
        raise InvalidInputError(
            f"{where}: expected the sequence before the scan, one of {', '.join(lengths)}"
        )
    return next(iter(lengths)), text


def without(scheme: SplitScheme, dropped: Mapping[str, NDArray[np.int64]]) -> SplitScheme:
    """Return a scheme whose splits leave scans out, given by their indices."""
    total = sum(map(len, dropped.values()))
    if not total:
        return scheme
    membership = {name: ids.copy() for name, ids in scheme.membership.items()}
    for name, indices in dropped.items():
        membership[name][indices] = NONE
    return SplitScheme(scheme.name, membership, f"{scheme.made_by}; {total} scans dropped")
