"""Entries whose predictions are those of another: the same files, the same counts, or nearly so."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

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


def find_same_counts(entries: Sequence[Entry]) -> dict[Path, list[Problem]]:
    """Find scored entries that are equal in every count: one file, described in two ways.

    Parameters
    ----------
    entries
        Of sound form, with figures that follow from their counts.

    Returns
    -------
    dict
        As `find_same_files`.
    """
    found: dict[Path, list[Problem]] = {}
    for own, other, share in _compared(entries):
        if share == 0:
            what = f"these predictions score what those of {other.entry.path.name} do, in every "
            found.setdefault(own.entry.path, []).append((own.field, f"{what}count"))
    return found


def find_nearly_same_counts(entries: Sequence[Entry]) -> dict[Path, list[str]]:
    """Note scored entries whose counts are nearly those of another.

    Parameters
    ----------
    entries
        As for `find_same_counts`.

    Returns
    -------
    dict
        By file of the entry, in words.
    """
    found: dict[Path, list[str]] = {}
    for own, other, share in _compared(entries):
        if 0 < share < NEARLY:
            found.setdefault(own.entry.path, []).append(
                f"its counts are those of {other.entry.path.name} but for {100 * share:.2g} % of "
                "the points; is one made from the other?"
            )
    return found


def _compared(entries: Sequence[Entry]) -> Iterator[tuple[_Counted, _Counted, float]]:
    """Yield predictions of two entries on one task, and the share of points that differ at least.

    Points that change their predicted class move from one count to another.
    """
    groups: dict[str, list[_Counted]] = {}
    for entry in entries:
        if entry.kind == SCORED:
            said = entry.said
            task = json.dumps([said["track"], said["digests"]["split"], said["evaluator_version"]])
            groups.setdefault(task, []).extend(_counted(entry))
    for group in groups.values():
        for own, other in itertools.permutations(group, 2):
            if own.entry.path != other.entry.path:
                moved = np.abs(own.confusion - other.confusion).sum() / 2
                yield own, other, float(moved / max(1, own.confusion.sum()))


def _counted(entry: Entry) -> Iterator[_Counted]:
    for source in entry.sources:
        scores = entry.said["result"] if source.run is None else source.run
        tables = [scores["per_lidar"][name]["confusion"] for name in sorted(scores["per_lidar"])]
        yield _Counted(entry, source.field, np.array(tables, np.int64))
