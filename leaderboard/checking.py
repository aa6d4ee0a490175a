"""Checking entries: their form, their seals, their figures, and the predictions behind them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tqdm import tqdm

from leaderboard.at_hand import AtHand
from leaderboard.entries import (
    PUBLISHED,
    Entry,
    file_name,
    list_entries,
    read_entry,
    seals_of,
)
from leaderboard.figures import Problem, differences, find_inconsistencies
from leaderboard.published import published_entry
from leaderboard.rescoring import score_again
from leaderboard.seeds import find_slips_of_seeds
from leaderboard.twins import find_same_counts, find_same_files
from semantic2d_dataset.access.registry import OpenDataset
from semantic2d_dataset.errors import Semantic2DError

VERIFIED, UNVERIFIED, AS_PUBLISHED, WRONG = "verified", "unverified", "as published", "wrong"


@dataclass(frozen=True)
class Checked:
    """One entry after its check.

    Parameters
    ----------
    path
        Its file.
    entry
        What it says; None if it is no entry at all.
    status
        ``verified`` (scored again from its predictions, those of every seed), ``unverified``,
        ``as published`` or ``wrong``.
    reason
        Why it is unverified, in words.
    problems
        Every field that is wrong.
    notes
        What a maintainer should look at; nothing that is wrong by itself.
    predictions, dataset
        What it was verified with; of several seeds, the predictions that are shown.
    """

    path: Path
    entry: Entry | None
    status: str
    reason: str = ""
    problems: tuple[Problem, ...] = ()
    notes: tuple[str, ...] = ()
    predictions: Path | None = None
    dataset: OpenDataset | None = None


def check_entries(folder: Path, at_hand: AtHand) -> list[Checked]:
    """Check every entry of a folder.

    Raises
    ------
    InvalidInputError
        If it is no folder.
    """
    paths = tqdm(list_entries(folder), "checking", unit="entry", disable=None, leave=False)
    return _mark_twins([check_entry(path, at_hand) for path in paths])


def check_entry(path: Path, at_hand: AtHand) -> Checked:
    """Check an entry; nothing that is wrong with it raises.

    Parameters
    ----------
    path
        Its file.
    at_hand
        What to check it against.
    """
    try:
        entry = read_entry(path)
    except Semantic2DError as err:
        what = str(err).removeprefix(f"{path}: ")
        return Checked(path, None, WRONG, problems=(("the file", what),))
    problems = list(_find_slips(entry))
    if entry.kind == PUBLISHED:
        status = WRONG if problems else AS_PUBLISHED
        return Checked(path, entry, status, problems=tuple(problems))
    problems += find_inconsistencies(entry.said, entry.taxonomy)
    if entry.runs:
        problems += find_slips_of_seeds(entry.said, entry.taxonomy)
    track = entry.said["track"]
    dataset = at_hand.dataset(track["dataset"], track["dataset_version"])
    if dataset is not None:
        problems += _compare_dataset(entry, dataset)
    file, reason, wrong = score_again(entry, dataset, at_hand)
    problems = _unique([*problems, *wrong])
    if problems:
        return Checked(path, entry, WRONG, reason, tuple(problems))
    if file is None:
        return Checked(path, entry, UNVERIFIED, reason, dataset=dataset)
    return Checked(path, entry, VERIFIED, predictions=file, dataset=dataset)


def format_check(checked: Iterable[Checked]) -> str:
    """Lay checks out as text: one line for each entry, and one for each wrong field."""
    lines = []
    for each in checked:
        what = f"{each.status}: {each.reason}" if each.reason else each.status
        lines.append(f"{each.path.name}: {what}")
        lines += [f"  - {field_path}: {problem}" for field_path, problem in each.problems]
        lines += [f"  note: {note}" for note in each.notes]
    return "\n".join(lines)


def _find_slips(entry: Entry) -> Iterator[Problem]:
    """Yield what differs from the seals, from the file's name and from the published table."""
    said = entry.said
    parts = {name: value for name, value in said.items() if name != "seals"}
    for path, problem in differences(said["seals"], seals_of(parts), ""):
        what = "is not what its seal says" if problem.startswith("expected ") else problem
        yield path.removeprefix("."), f"{what}: it was edited since the entry was made"
    if entry.path.name != file_name(said):
        yield "file name", f"expected {file_name(said)}"
    if entry.kind == PUBLISHED:
        yield from _compare_published(said)


def _compare_published(said: Mapping[str, Any]) -> Iterator[Problem]:
    expected = published_entry(said["metadata"]["method"], said["metadata"].get("features"))
    if expected is None:
        yield "metadata.method", "no row of the published table"
        return
    for name in sorted({*expected, *said} - {"seals"}):
        yield from differences(expected.get(name), said.get(name), name)


def _compare_dataset(entry: Entry, dataset: OpenDataset) -> Iterator[Problem]:
    """Compare digests with the data set's own."""
    said, track = entry.said, entry.said["track"]
    try:
        scheme = dataset.scheme(track["scheme"])
    except Semantic2DError as err:
        yield "track.scheme", str(err)
        return
    if said["digests"]["split"] != scheme.digest:
        yield "digests.split", f"expected {scheme.digest}, that of the data set"
    of_lidars = [e for e in dataset.manifest.sequences if e.lidar in track["lidars"]]
    unknown = sorted({*track["lidars"]} - {e.lidar for e in of_lidars})
    if unknown:
        yield "track.lidars", f"the data set has none called {', '.join(unknown)}"
        return
    scans = sum(
        len(scheme.scans_of(e.id, track["split"])) for e in of_lidars if e.id in scheme.membership
    )
    if track.get("scans") != scans:
        yield "track.scans", f"expected {scans}, as in the data set, found {track.get('scans')}"
    digest = dataset.reader(of_lidars[0].id).header.taxonomy.digest
    if said["digests"]["taxonomy"] != digest:
        yield "digests.taxonomy", f"expected {digest}, that of the data set"


def _mark_twins(checked: list[Checked]) -> list[Checked]:
    """Refuse the same predictions under two names, and note those that are nearly the same."""
    there = [each.entry for each in checked if each.entry is not None]
    sound = [each.entry for each in checked if each.entry is not None and each.status != WRONG]
    files, (counts, notes) = find_same_files(there), find_same_counts(sound)
    found = []
    for each in checked:
        twins = _unique([*counts.get(each.path, ()), *files.get(each.path, ())])
        noted = replace(each, notes=tuple(notes.get(each.path, ())))
        wrong = replace(noted, status=WRONG, problems=(*each.problems, *twins))
        found.append(wrong if twins else noted)
    return found


def _unique(problems: Iterable[Problem]) -> list[Problem]:
    """Keep one problem for each field, the last: what follows from predictions says most."""
    return sorted(dict(problems).items())
