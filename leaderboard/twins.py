"""Entries whose predictions are those of another: the same files, the same counts, or nearly so."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leaderboard.entries import SCORED, Entry
from leaderboard.figures import Problem

NEARLY = 0.01
"""Share of the points below which two methods count as nearly the same.

The two on semantic2d-mini that are most alike, one network with and without one of its features,
differ by 0.035.
"""


@dataclass(frozen=True, eq=False)
class _Counted:
    """Predictions of an entry: the field that names them, and their confusion (L, C, C) i8."""

    entry: Entry
    field: str
    confusion: NDArray[np.int64]


def find_same_files(entries: Sequence[Entry]) -> dict[Path, list[Problem]]:
    """Find entries with the same predictions file: which is the impostor cannot be told.

    Returns
    -------
    dict
        By file of the entry, the fields that are those of another, and what is wrong.
    """
    holders: dict[str, list[Path]] = {}
    for entry in entries:
        for digest in {source.digest for source in entry.sources}:
            holders.setdefault(digest, []).append(entry.path)
    found: dict[Path, list[Problem]] = {}
    for entry in entries:
        for source in entry.sources:
            for other in [path for path in holders[source.digest] if path != entry.path][:1]:
                what = f"these predictions are also those of {other.name}"
                found.setdefault(entry.path, []).append((source.field, what))
    return found


def find_same_counts(
    entries: Sequence[Entry],
) -> tuple[dict[Path, list[Problem]], dict[Path, list[str]]]:
    """Find scored entries that are equal in every count: one file, described in two ways.

    Parameters
    ----------
    entries
        Of sound form, with figures that follow from their counts.

    Returns
    -------
    same
        As `find_same_files`.
    nearly
        By file of the entry, in words, those whose counts are nearly those of another.
    """
    same: dict[Path, list[Problem]] = {}
    nearly: dict[Path, list[str]] = {}
    for own, other, share in _compared(entries):
        name = other.entry.path.name
        if share == 0:
            what = f"these predictions score what those of {name} do, in every count"
            same.setdefault(own.entry.path, []).append((own.field, what))
        elif share < NEARLY:
            what = f"its counts are those of {name} but for {100 * share:.2g} % of the points"
            nearly.setdefault(own.entry.path, []).append(f"{what}; is one made from the other?")
    return same, nearly


def _compared(entries: Sequence[Entry]) -> Iterator[tuple[_Counted, _Counted, float]]:
    """Yield predictions of two entries on one task, and the share of points that differ at least.

    Points that change their predicted class move from one count to another.
    """
    groups: dict[Any, list[_Counted]] = {}
    for entry in entries:
        if entry.kind == SCORED:
            groups.setdefault(tuple(entry.tracks()), []).extend(_counted(entry))
    for group in groups.values():
        for one, other in itertools.combinations(group, 2):
            if one.entry.path != other.entry.path:
                moved = np.abs(one.confusion - other.confusion).sum() / 2
                share = float(moved / max(1, one.confusion.sum()))
                yield one, other, share
                yield other, one, share


def _counted(entry: Entry) -> Iterator[_Counted]:
    for source in entry.sources:
        scores = entry.said["result"] if source.run is None else source.run
        tables = [scores["per_lidar"][name]["confusion"] for name in sorted(scores["per_lidar"])]
        yield _Counted(entry, source.field, np.array(tables, np.int64))
