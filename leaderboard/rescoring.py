"""Scoring the predictions behind an entry again, and comparing them with what it says."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from leaderboard.at_hand import AtHand
from leaderboard.entries import Entry, Source
from leaderboard.figures import Problem, differences
from leaderboard.seeds import run_of
from semantic2d_dataset.access.registry import OpenDataset
from semantic2d_dataset.errors import Semantic2DError, SubmissionError
from semantic2d_dataset.scoring.metrics import EVALUATOR_VERSION
from semantic2d_dataset.scoring.spreads import shared_metadata
from semantic2d_dataset.scoring.submission import score_predictions

_TRACK = ("dataset", "dataset_version", "scheme", "split", "lidars", "scans")


def score_again(
    entry: Entry, dataset: OpenDataset | None, at_hand: AtHand
) -> tuple[Path | None, str, list[Problem]]:
    """Score the predictions of an entry again, those of every seed.

    Parameters
    ----------
    entry
        The entry, not one that was only published.
    dataset
        Its data set, None where that is not at hand.
    at_hand
        Where predictions are.

    Returns
    -------
    file
        The predictions that are shown; None where not all could be scored.
    reason
        Why not, in words.
    problems
        What differs.
    """
    said, track = entry.said, entry.said["track"]
    if said["evaluator_version"] != EVALUATOR_VERSION:
        newer = f"scored by evaluator {said['evaluator_version']}, here is {EVALUATOR_VERSION}"
        return None, f"{newer}: add it again", []
    if dataset is None:
        return None, f"{track['dataset']} {track['dataset_version']} is not at hand", []
    found = [(source, at_hand.file(source.digest)) for source in entry.sources]
    missing = [source for source, file in found if file is None]
    strangers = [(source, _strangers(entry, source, at_hand)) for source in missing]
    problems = [
        (source.field, f"{path.name} scores this, and its SHA-256 is {digest}")
        for source, there in strangers
        for digest, path in there.items()
        if _has_counts(entry, source, path, dataset)
    ]
    for source, file in found:
        if file is not None:
            problems += _score_one(entry, source, file, dataset)
    if missing:
        names = sorted({path.name for _, there in strangers for path in there.values()})
        return None, _say_missing(len(found) - len(missing), len(found), names), problems
    return at_hand.file(entry.digest), "", problems


def _say_missing(there: int, count: int, strangers: Sequence[str]) -> str:
    what = f"{there} of {count} predictions are at hand"
    what = "its predictions are not at hand" if count == 1 else what
    also = f" ({strangers[0]} says the same of itself, and is another file)" if strangers else ""
    return what + also


def _strangers(entry: Entry, source: Source, at_hand: AtHand) -> dict[str, Path]:
    """Return, by digest, files that say they are what is missing, and are no part of the entry."""
    own = {each.digest for each in entry.sources}
    namesakes = at_hand.namesakes(entry.said, source.seeds)
    return {digest: path for digest, path in namesakes.items() if digest not in own}


def _has_counts(entry: Entry, source: Source, file: Path, dataset: OpenDataset) -> bool:
    """Tell whether a file has the counts of an entry: else it is another training of the method."""
    track, said = entry.said["track"], entry.said["result"] if source.run is None else source.run
    try:
        found = score_predictions(file, dataset, scheme=track["scheme"], split=track["split"])
    except Semantic2DError:
        return False
    one, other = (
        {lidar: scores["confusion"] for lidar, scores in each["per_lidar"].items()}
        for each in (found, said)
    )
    return one == other


def _score_one(entry: Entry, source: Source, file: Path, dataset: OpenDataset) -> Iterator[Problem]:
    track = entry.said["track"]
    try:
        found = score_predictions(file, dataset, scheme=track["scheme"], split=track["split"])
    except SubmissionError as err:
        yield source.field, f"{file.name}: {err.problems[0]}"
        return
    except Semantic2DError as err:
        yield source.field, str(err)
        return
    said, submission = entry.said, found["submission"]
    yield from differences({name: submission[name] for name in _TRACK}, track, "track")
    if source.digest == entry.digest:
        yield from _compare_result(said, found)
    else:
        expected, there = (shared_metadata(m["metadata"]) for m in (submission, said))
        yield from differences(expected, there, "metadata")
    if source.run is not None:
        path = source.field.removesuffix(".predictions")
        yield from differences(run_of(found, source.url), source.run, path)


def _compare_result(said: Mapping[str, Any], found: Mapping[str, Any]) -> Iterator[Problem]:
    for name in ("metadata", "digests"):
        yield from differences(found["submission"][name], said[name], name)
    result = {name: value for name, value in found.items() if name != "submission"}
    yield from differences(result, said["result"], "result")
