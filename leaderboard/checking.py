"""Checking entries: their form, their seals, their figures, and the predictions behind them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from tqdm import tqdm

from leaderboard.entries import (
    PUBLISHED,
    Entry,
    file_digest,
    file_name,
    list_entries,
    name_of,
    read_entry,
    seals_of,
)
from leaderboard.figures import Problem, differences, find_inconsistencies
from leaderboard.published import published_entry
from semantic2d_dataset.access.registry import OpenDataset, open_dataset
from semantic2d_dataset.errors import Semantic2DError, SubmissionError
from semantic2d_dataset.scoring.metrics import EVALUATOR_VERSION
from semantic2d_dataset.scoring.predictions import PredictionsReader
from semantic2d_dataset.scoring.submission import score_predictions

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
        ``verified`` (scored again from its predictions), ``unverified``, ``as published`` or
        ``wrong``.
    reason
        Why it is unverified, in words.
    problems
        Every field that is wrong.
    predictions, dataset
        What it was verified with.
    """

    path: Path
    entry: Entry | None
    status: str
    reason: str = ""
    problems: tuple[Problem, ...] = ()
    predictions: Path | None = None
    dataset: OpenDataset | None = None


@dataclass
class AtHand:
    """Data sets and predictions that entries can be checked against.

    Parameters
    ----------
    data
        Names or folders of data sets; known ones on this machine are found by themselves.
    predictions
        Folder of predictions files, whatever their names, or None.
    """

    data: Sequence[str] = ()
    predictions: Path | None = None
    _opened: dict[tuple[str, str], OpenDataset | None] = field(default_factory=dict)
    _files: dict[str, Path] | None = None

    def __post_init__(self) -> None:
        for name in self.data:
            found = open_dataset(name)
            self._opened[found.manifest.name, found.manifest.version] = found

    def dataset(self, name: str, version: str) -> OpenDataset | None:
        """Return a data set of that name and version, None where it is not at hand."""
        if (name, version) not in self._opened:
            try:
                found = open_dataset(name)
            except (Semantic2DError, OSError):
                self._opened[name, version] = None
            else:
                same = (found.manifest.name, found.manifest.version) == (name, version)
                self._opened[name, version] = found if same else None
        return self._opened[name, version]

    def file(self, digest: str) -> Path | None:
        """Return the predictions file of that SHA-256, None where it is not at hand."""
        return self._by_digest().get(digest)

    def namesakes(self, said: Mapping[str, Any]) -> list[Path]:
        """Return predictions files that say they are of an entry's method and track."""
        return [path for path in self._by_digest().values() if _is_of(path, said)]

    def _by_digest(self) -> dict[str, Path]:
        if self._files is None:
            found = sorted(self.predictions.rglob("*.h5")) if self.predictions else []
            bar = tqdm(found, desc="hashing predictions", unit="file", disable=None, leave=False)
            self._files = {file_digest(path): path for path in bar}
        return self._files


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
    track = entry.said["track"]
    dataset = at_hand.dataset(track["dataset"], track["dataset_version"])
    if dataset is not None:
        problems += _compare_dataset(entry, dataset)
    file, reason, wrong = _score_again(entry, dataset, at_hand)
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


def _score_again(
    entry: Entry, dataset: OpenDataset | None, at_hand: AtHand
) -> tuple[Path | None, str, list[Problem]]:
    """Score the predictions again; return their file, why that was not done, and what differs."""
    said, track = entry.said, entry.said["track"]
    if said["evaluator_version"] != EVALUATOR_VERSION:
        newer = f"scored by evaluator {said['evaluator_version']}, here is {EVALUATOR_VERSION}"
        return None, f"{newer}: add it again", []
    if dataset is None:
        what = f"{track['dataset']} {track['dataset_version']}"
        return None, f"{what} is not at hand", []
    file = at_hand.file(entry.digest)
    if file is None:
        namesakes = at_hand.namesakes(said)
        wrong = [
            ("digests.predictions", f"{path.name} is of this method, and its SHA-256 is another")
            for path in namesakes[:1]
        ]
        return None, "its predictions are not at hand", wrong
    try:
        found = score_predictions(file, dataset, scheme=track["scheme"], split=track["split"])
    except SubmissionError as err:
        return None, "", [("digests.predictions", f"{file.name}: {err.problems[0]}")]
    except Semantic2DError as err:
        return None, "", [("digests.predictions", str(err))]
    return file, "", list(_compare_result(said, found))


def _compare_result(said: Mapping[str, Any], found: Mapping[str, Any]) -> Iterator[Problem]:
    submission = found["submission"]
    names = ("dataset", "dataset_version", "scheme", "split", "lidars", "scans")
    yield from differences({n: submission[n] for n in names}, said["track"], "track")
    for name in ("metadata", "digests"):
        yield from differences(submission[name], said[name], name)
    result = {name: value for name, value in found.items() if name != "submission"}
    yield from differences(result, said["result"], "result")


def _mark_twins(checked: list[Checked]) -> list[Checked]:
    """Refuse the same predictions under two names: which is the impostor cannot be told."""
    holders: dict[str, list[Path]] = {}
    for each in checked:
        if each.entry is not None and each.entry.digest:
            holders.setdefault(each.entry.digest, []).append(each.path)
    found = []
    for each in checked:
        holding = holders.get(each.entry.digest, []) if each.entry is not None else []
        others = [path.name for path in holding if path != each.path]
        if others:
            problem = ("digests.predictions", f"these predictions are also those of {others[0]}")
            problems = (*each.problems, problem)
            found.append(replace(each, status=WRONG, problems=problems))
        else:
            found.append(each)
    return found


def _unique(problems: Iterable[Problem]) -> list[Problem]:
    """Keep one problem for each field, the last: what follows from predictions says most."""
    return sorted(dict(problems).items())


def _is_of(path: Path, said: Mapping[str, Any]) -> bool:
    """Tell whether predictions say that they are of an entry's method and track."""
    try:
        with PredictionsReader(path) as reader:
            metadata, split = reader.metadata, "val" if reader.split == "dev" else reader.split
            here = (reader.dataset, reader.dataset_version, reader.scheme, split)
            lidars = {name.rsplit("--", 1)[-1] for name in reader.sequence_ids}
        track = said["track"]
        there = tuple(track[n] for n in ("dataset", "dataset_version", "scheme", "split"))
        same = here == there and lidars == {*track["lidars"]}
        return same and name_of(metadata) == name_of(said["metadata"])
    except (Semantic2DError, OSError, KeyError, TypeError):
        return False
