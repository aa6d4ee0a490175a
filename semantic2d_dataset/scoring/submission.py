"""Predictions as a submission: one validator for users and scorer, and the score."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from semantic2d_dataset.errors import (
    CorruptFileError,
    InvalidInputError,
    Semantic2DError,
    SubmissionError,
)
from semantic2d_dataset.format.manifest import Manifest
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.format.splits import SplitScheme
from semantic2d_dataset.scene.taxonomy import Taxonomy
from semantic2d_dataset.scoring.metrics import EVALUATOR_VERSION, Evaluator, format_table, percent
from semantic2d_dataset.scoring.predictions import (
    PredictionsReader,
    PredictionsWriter,
    metadata_problems,
)

__all__ = [
    "PredictionsReader",
    "PredictionsWriter",
    "ScoredDataset",
    "format_score",
    "result_to_json",
    "score_predictions",
    "validate",
]

_BLOCK = 1024  # scans scored at a time


class ScoredDataset(Protocol):
    """What scoring needs of a data set; `access.registry.open_dataset` returns one."""

    @property
    def manifest(self) -> Manifest:
        """Name, version and sequences."""

    def scheme(self, name: str) -> SplitScheme:
        """Return which scan is in which split."""

    def reader(self, sequence_id: str) -> SequenceReader:
        """Open a sequence."""


def validate(
    predictions: PredictionsReader | Path,
    dataset: ScoredDataset,
    *,
    scheme: str | None = None,
    split: str | None = None,
) -> list[str]:
    """List every reason why predictions cannot be scored; the scorer asks this function.

    A file must hold every scan of the split exactly once, for each lidar that it predicts at
    all: models are often made for one lidar.

    Parameters
    ----------
    predictions
        The file.
    dataset
        The data set that they are for.
    scheme, split
        What to score, where the file does not say; where it does, they must agree.

    Returns
    -------
    list of str
        One line for each problem, with its sequence and scan; empty when all is well.

    Raises
    ------
    FileNotFoundError, CorruptFileError, UnsafeFileError, FormatVersionError
        If the file cannot be opened safely, or is damaged.
    """
    if not isinstance(predictions, PredictionsReader):
        with PredictionsReader(predictions) as reader:
            return validate(reader, dataset, scheme=scheme, split=split)
    problems = _identity_problems(predictions, dataset.manifest, scheme, split)
    problems += _metadata_of(predictions)
    try:
        task = _task_of(predictions, dataset, scheme, split)
    except Semantic2DError as err:
        return [*problems, str(err)]
    if predictions.taxonomy_digest != task.taxonomy.digest:
        problems.append(
            f"taxonomy: expected digest {task.taxonomy.digest}, "
            f"found {predictions.taxonomy_digest or 'none'}; use the class ids of the data set"
        )
    for name in sorted(set(predictions.sequence_ids) - set(task.scans)):
        problems.append(f"{name}: the split has no scan of this sequence; leave it out")
    for name, indices in tqdm(task.scans.items(), "validating", unit="sequence", disable=None):
        beams = dataset.reader(name).lidar.beams
        problems += _sequence_problems(predictions, name, indices, beams, len(task.taxonomy))
    return problems


def score_predictions(
    path: Path, dataset: ScoredDataset, *, scheme: str | None = None, split: str | None = None
) -> dict[str, Any]:
    """Validate predictions, and score them block by block.

    Parameters
    ----------
    path
        The predictions file.
    dataset
        The data set that they are for.
    scheme, split
        What to score, where the file does not say; where it does, they must agree.

    Returns
    -------
    dict
        As `Evaluator.compute`, and ``per_lidar`` with the same by lidar name, and
        ``submission``: dataset, dataset_version, scheme, split, lidars, number of scans,
        metadata, ``digests`` (SHA-256 of predictions file, split scheme and taxonomy) and
        evaluator_version.

    Raises
    ------
    SubmissionError
        With all problems, if there is one.
    InvalidInputError
        If a sequence of the data set has no labels to score against.
    FileNotFoundError, CorruptFileError, UnsafeFileError, FormatVersionError
        If the file cannot be opened safely, or is damaged.
    """
    with PredictionsReader(path) as predictions:
        problems = validate(predictions, dataset, scheme=scheme, split=split)
        if problems:
            raise SubmissionError(path, problems)
        task = _task_of(predictions, dataset, scheme, split)
        per_lidar = _score_lidars(predictions, dataset, task)
        submission = _describe(predictions, dataset, task)
    total = Evaluator(task.taxonomy)
    for evaluator in per_lidar.values():
        total.merge(evaluator)
    lidars = {name: per_lidar[name].compute() for name in task.lidars}
    return total.compute() | {"per_lidar": lidars, "submission": submission}


def format_score(result: Mapping[str, Any]) -> str:
    """Lay a result of `score_predictions` out as text: what was scored, by class, by lidar."""
    said = result["submission"]
    what = f"{said['dataset']} {said['dataset_version']}, split {said['split']} of {said['scheme']}"
    lidars = (
        f"{name}: mIoU {percent(scores['mIoU'])}, mCA {percent(scores['mCA'])}"
        for name, scores in result["per_lidar"].items()
    )
    title = f"{said['metadata']['method']} on {what}: {said['scans']:,} scans"
    return "\n".join((title, "", format_table(result), "", *lidars))


def result_to_json(result: Mapping[str, Any]) -> str:
    """Return a result as JSON text with a final line break."""
    return json.dumps(result, indent=2, allow_nan=False, ensure_ascii=False) + "\n"


@dataclass(frozen=True)
class _Task:
    """What is scored: scan indices, ascending, by sequence id; lidars; and the classes."""

    scheme: SplitScheme
    split: str
    scans: Mapping[str, NDArray[np.int64]]
    lidars: tuple[str, ...]
    taxonomy: Taxonomy


def _task_of(
    predictions: PredictionsReader, dataset: ScoredDataset, scheme: str | None, split: str | None
) -> _Task:
    """Find the scans to score: all of the split by the lidars that the predictions are about."""
    scheme, split = scheme or predictions.scheme, _canonical(split or predictions.split)
    found = dataset.scheme(scheme)
    lidar_of = {entry.id: entry.lidar for entry in dataset.manifest.sequences}
    lidars = {lidar_of[name] for name in predictions.sequence_ids if name in lidar_of}
    scans = {
        name: indices
        for name in sorted(found.membership)
        if lidar_of.get(name) in lidars and (indices := found.scans_of(name, split)).size
    }
    if not scans:
        raise InvalidInputError(
            f"the file predicts no sequence that has scans in split {split!r} of scheme {scheme!r}"
        )
    taxonomies = {dataset.reader(name).header.taxonomy for name in scans}
    if len(taxonomies) != 1:
        raise InvalidInputError(
            f"{dataset.manifest.name}: its sequences use {len(taxonomies)} taxonomies; "
            "only sequences with the same classes can be scored together"
        )
    used = tuple(sorted({lidar_of[name] for name in scans}))
    return _Task(found, split, scans, used, taxonomies.pop())


def _score_lidars(
    predictions: PredictionsReader, dataset: ScoredDataset, task: _Task
) -> dict[str, Evaluator]:
    evaluators = {lidar: Evaluator(task.taxonomy) for lidar in task.lidars}
    total = sum(map(len, task.scans.values()))
    with tqdm(total=total, desc="scoring", unit="scan", disable=None) as bar:
        for name, indices in task.scans.items():
            truth = dataset.reader(name)
            evaluator = evaluators[truth.lidar.name]
            for scans in _score_sequence(evaluator, truth, predictions, name, indices):
                bar.update(scans)
    return evaluators


def _describe(
    predictions: PredictionsReader, dataset: ScoredDataset, task: _Task
) -> dict[str, Any]:
    """Say what was scored against what, so that a result can be checked and compared."""
    with predictions.path.open("rb") as stream:
        file_digest = hashlib.file_digest(stream, "sha256").hexdigest()
    return {
        "dataset": dataset.manifest.name,
        "dataset_version": dataset.manifest.version,
        "scheme": task.scheme.name,
        "split": task.split,
        "lidars": list(task.lidars),
        "scans": sum(map(len, task.scans.values())),
        "metadata": predictions.metadata,
        "digests": {
            "predictions": file_digest,
            "split": task.scheme.digest,
            "taxonomy": task.taxonomy.digest,
        },
        "evaluator_version": EVALUATOR_VERSION,
    }


def _metadata_of(predictions: PredictionsReader) -> list[str]:
    try:
        return metadata_problems(predictions.metadata)
    except CorruptFileError as err:
        return [str(err)]


def _identity_problems(
    predictions: PredictionsReader, manifest: Manifest, scheme: str | None, split: str | None
) -> list[str]:
    """Compare what the file says it predicts with what is scored."""
    said = predictions
    versions = [v.split(".")[:2] for v in (manifest.version, said.dataset_version)]
    expected = (
        ("dataset", manifest.name, said.dataset, manifest.name == said.dataset),
        # a PATCH changes only the packaging
        ("dataset_version", manifest.version, said.dataset_version, versions[0] == versions[1]),
        ("scheme", scheme, said.scheme, scheme in (None, said.scheme)),
        ("split", split, said.split, split is None or _canonical(split) == _canonical(said.split)),
    )
    advice = {
        "dataset_version": "; a new MAJOR or MINOR has other scans or splits: score against the "
        "version that was predicted (--data FOLDER), or predict again"
    }
    return [
        f"{name}: expected {want!r}, the file says {found!r}{advice.get(name, '')}"
        for name, want, found, same in expected
        if found and not same
    ]


def _canonical(split: str) -> str:
    return "val" if split == "dev" else split


def _sequence_problems(
    predictions: PredictionsReader,
    name: str,
    indices: NDArray[np.int64],
    beams: int,
    classes: int,
) -> list[str]:
    if not (predictions.has(name, "scan_index") and predictions.has(name, "labels")):
        return [f"{name}: missing; expected scan_index and labels of {len(indices)} scans"]
    given = predictions.read(name, "scan_index")
    problems = _index_problems(name, given, indices)
    wanted = {
        "labels": (len(given), beams),
        "probabilities": (len(given), beams, classes),
        "samples": (None, len(given), beams),
    }
    for part, shape in wanted.items():
        if not predictions.has(name, part):
            continue
        found = predictions.shape(name, part)
        if any(want not in (None, length) for want, length in zip(shape, found, strict=True)):
            text = ", ".join("any" if n is None else str(n) for n in shape)
            problems.append(f"{name}: {part}: expected shape ({text}), found {found}")
        else:
            problems += _value_problems(predictions, name, part, given, classes)
    return problems


def _index_problems(name: str, given: NDArray[np.int64], indices: NDArray[np.int64]) -> list[str]:
    unique, counts = np.unique(given, return_counts=True)
    kinds = {
        "missing": np.setdiff1d(indices, unique),
        "not in the split": np.setdiff1d(unique, indices),
        "given more than once": unique[counts > 1],
    }
    return [
        f"{name}/{scans[0]}: scan {kind} ({scans.size} such in this sequence)"
        for kind, scans in kinds.items()
        if scans.size
    ]


def _value_problems(
    predictions: PredictionsReader,
    name: str,
    part: str,
    given: NDArray[np.int64],
    classes: int,
) -> list[str]:
    """Find values outside their domain; name the first, count all."""
    first, count, row = "", 0, 0
    for block in predictions.blocks(name, part):
        # NaN is not within 0 to 1
        wrong = ~((block >= 0) & (block <= 1)) if part == "probabilities" else block >= classes
        if wrong.any() and not first:
            where = np.argwhere(wrong)[0]
            scan = given[where[1] if part == "samples" else row + where[0]]
            beam = where[2] if part == "samples" else where[1]
            first = f"{name}/{scan}: {part}: beam {beam} holds {block[tuple(where)]}"
        count += int(wrong.sum())
        row += len(block)
    domain = "0 to 1" if part == "probabilities" else f"a class id 0 to {classes - 1}"
    return [f"{first}, expected {domain} ({count} such in this sequence)"] if count else []


def _score_sequence(
    evaluator: Evaluator,
    truth: SequenceReader,
    predictions: PredictionsReader,
    name: str,
    indices: NDArray[np.int64],
) -> Iterator[int]:
    """Score a sequence in blocks of ascending scan index; yield how many scans each had."""
    if "scans/labels" not in truth:
        raise InvalidInputError(f"{name}: has no labels to score against; label it first")
    order = np.argsort(predictions.read(name, "scan_index"))
    for start in range(0, len(indices), _BLOCK):
        wanted, rows = indices[start : start + _BLOCK], order[start : start + _BLOCK]
        labels = _gather(truth.read, "scans/labels", wanted)
        ranges = _gather(truth.read, "scans/ranges", wanted)
        predicted = _gather(partial(predictions.read, name), "labels", rows)
        evaluator.update(labels, predicted, truth.lidar.has_return(ranges))
        yield len(wanted)


def _gather(
    read: Callable[[str, int, int], NDArray[Any]], part: str, rows: NDArray[np.int64]
) -> NDArray[Any]:
    """Read rows in one run of whole chunks, then pick: HDF5 is slow at single rows."""
    low, high = int(rows.min()), int(rows.max()) + 1
    return read(part, low, high)[rows - low]
