"""Making entries: predictions scored by the one scorer, with all that the score rests on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from leaderboard.entries import (
    FORMAT,
    FORMAT_VERSION,
    SCORED,
    file_name,
    name_of,
    read_entry,
    schema_problems,
    seal,
    to_json,
)
from leaderboard.seeds import summarise
from semantic2d_dataset.errors import InvalidInputError, Semantic2DError
from semantic2d_dataset.format.writing import write_text_atomically
from semantic2d_dataset.scoring.submission import ScoredDataset, score_predictions


def make_entry(
    predictions: Path,
    dataset: ScoredDataset,
    *,
    kind: str = SCORED,
    url: str | None = None,
    scheme: str | None = None,
    split: str | None = None,
) -> dict[str, Any]:
    """Score predictions, and return the entry that says so.

    Parameters
    ----------
    predictions
        The predictions file.
    dataset
        The data set that they are for.
    kind
        ``scored``, or ``sanity`` for a row that is there to be compared with and not ranked.
    url
        Where others get the predictions (https), or None.
    scheme, split
        What to score, where the file does not say.

    Raises
    ------
    SubmissionError
        If the predictions cannot be scored.
    InvalidInputError
        If what they say of themselves has no place in an entry.
    """
    result = score_predictions(predictions, dataset, scheme=scheme, split=split)
    return entry_of(result, dataset, kind=kind, url=url, where=Path(predictions))


def make_entry_of_seeds(
    predictions: Sequence[Path],
    dataset: ScoredDataset,
    *,
    urls: Sequence[str] = (),
    scheme: str | None = None,
    split: str | None = None,
) -> dict[str, Any]:
    """Score predictions of several trainings of one method, and return the one entry of them.

    Parameters
    ----------
    predictions
        Two predictions files or more; the entry does not depend on their order.
    dataset
        The data set that they are for.
    urls
        Where others get each of them (https), in the same order; empty if nowhere.
    scheme, split
        What to score, where the files do not say.

    Raises
    ------
    SubmissionError
        If predictions cannot be scored.
    InvalidInputError
        If they are not trainings of one method on one task, two are the same, or what they say of
        themselves has no place in an entry.
    """
    results = [score_predictions(p, dataset, scheme=scheme, split=split) for p in predictions]
    shown, seeds = summarise(results, urls)
    where = Path(predictions[0])
    return entry_of(shown, dataset, kind=SCORED, url=None, where=where, seeds=seeds)


def entry_of(
    result: Mapping[str, Any],
    dataset: ScoredDataset,
    *,
    kind: str,
    url: str | None,
    where: Path,
    seeds: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Turn a result of `score_predictions` into an entry; `where` is for messages."""
    said = result["submission"]
    sequence = next(
        entry.id for entry in dataset.manifest.sequences if entry.lidar in said["lidars"]
    )
    taxonomy = dataset.reader(sequence).header.taxonomy
    names = ("dataset", "dataset_version", "scheme", "split", "lidars", "scans")
    entry = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "kind": kind,
        "track": {name: said[name] for name in names},
        "metadata": said["metadata"],
        "digests": said["digests"],
        "evaluator_version": said["evaluator_version"],
        "taxonomy": taxonomy.as_dict(),
        "result": {name: value for name, value in result.items() if name != "submission"},
    }
    if url is not None:
        entry["predictions_url"] = url
    if seeds is not None:
        entry["seeds"] = seeds
    entry = seal(entry)
    problems = schema_problems(entry)
    if problems:
        lines = "".join(f"\n  - {path}: {what}" for path, what in problems)
        raise InvalidInputError(f"{where}: has no place on the board:{lines}")
    return entry


def add_entry(entry: Mapping[str, Any], folder: Path, *, force: bool = False) -> Path:
    """Write an entry into the folder of the board.

    Parameters
    ----------
    entry
        What `make_entry` returned.
    folder
        The folder of entries.
    force
        Replace an earlier entry of the same method and authors.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    InvalidInputError
        If another method's entry has that name, or one of this method is there without `force`.
    """
    folder = Path(folder)
    path = folder / file_name(entry)
    if path.exists():
        _refuse_theft(entry, path)
        if not force:
            raise InvalidInputError(
                f"{path}: this method has an entry already; replace it with --force"
            )
    write_text_atomically(path, to_json(entry))
    return path


def _refuse_theft(entry: Mapping[str, Any], path: Path) -> None:
    """Raise if a file holds the entry of another method, or one that cannot be read."""
    try:
        there = read_entry(path).said
    except Semantic2DError as err:
        raise InvalidInputError(f"{path}: is in the way, and is no entry: {err}") from err
    mine, theirs = ((e["kind"], name_of(e["metadata"]), _authors(e)) for e in (entry, there))
    if mine != theirs:
        raise InvalidInputError(
            f"{path}: holds the entry of {name_of(there['metadata'])!r} "
            f"by {', '.join(_authors(there)) or 'nobody named'}; give your method another name"
        )


def _authors(entry: Mapping[str, Any]) -> tuple[str, ...]:
    authors = entry["metadata"].get("authors", ())
    return tuple(map(str, authors)) if isinstance(authors, list) else ()
