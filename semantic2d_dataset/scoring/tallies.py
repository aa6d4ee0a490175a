"""What is counted of one sequence: all that any figure of a result is computed from.

Counts are integers, so that sequences may be counted anywhere and in any order; a result is
computed from all tallies of a split, ordered by sequence.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.scene.taxonomy import UNLABELLED
from semantic2d_dataset.scoring.calibration import Calibration
from semantic2d_dataset.scoring.conditions import ByCondition, count_conditions
from semantic2d_dataset.scoring.metrics import Evaluator
from semantic2d_dataset.scoring.predictions import PredictionsReader
from semantic2d_dataset.scoring.validation import ScoredDataset

WINDOW_NS = 10_000_000_000
"""Length of a block: scans nearer in time are too alike to count as independent."""

_BLOCK = 1024  # scans read at a time

_Key = TypeVar("_Key")

Window = tuple[str, int]
"""A recording, and the number of a window in time: all lidars of a recording share it."""


@dataclass(frozen=True, eq=False)
class Tally:
    """The counts of one sequence.

    Parameters
    ----------
    sequence_id, environment, lidar
        Which.
    evaluator
        All of its points.
    windows
        Confusion (C, C) i8 by window.
    conditions
        By condition, (bands, C, C) i8.
    samples
        An evaluator for each sample; empty where the file has none.
    calibration
        None where the file has no probabilities.
    """

    sequence_id: str
    environment: str
    lidar: str
    evaluator: Evaluator
    windows: dict[Window, NDArray[np.int64]]
    conditions: ByCondition
    samples: tuple[Evaluator, ...]
    calibration: Calibration | None


def count_sequence(
    path: Path, dataset: ScoredDataset, item: tuple[str, NDArray[np.int64]]
) -> Tally:
    """Count the predictions of one sequence, block by block.

    Parameters
    ----------
    path
        A valid predictions file.
    dataset
        The data set that it is for.
    item
        Sequence id, and the indices (n,) i8 of its scans, ascending.

    Raises
    ------
    InvalidInputError
        If the sequence has no labels to score against.
    """
    name, indices = item
    with PredictionsReader(path) as predictions, dataset.reader(name) as truth:
        if "scans/labels" not in truth:
            raise InvalidInputError(f"{name}: has no labels to score against; label it first")
        order = np.argsort(predictions.read(name, "scan_index"))
        header = truth.header
        tally = Tally(
            sequence_id=name,
            environment=header.environment,
            lidar=header.lidar.name,
            evaluator=Evaluator(header.taxonomy),
            windows={},
            conditions={},
            samples=_samples_of(predictions, truth, name),
            calibration=Calibration(header.taxonomy)
            if predictions.has(name, "probabilities")
            else None,
        )
        scored = []
        for start in range(0, len(indices), _BLOCK):
            part = slice(start, start + _BLOCK)
            predicted = gather(partial(predictions.read, name), "labels", order[part])
            scored.append(_count_block(tally, truth, indices[part], predicted))
        if tally.samples or tally.calibration is not None:
            in_file = np.concatenate(scored)[np.argsort(order)]  # (n, B), a byte a beam
            _count_uncertainty(tally, predictions, in_file)
    return tally


def merge_tallies(tallies: Iterable[Tally]) -> tuple[Tally, ...]:
    """Order tallies by sequence, whatever order or machine they come from.

    Raises
    ------
    InvalidInputError
        If a sequence comes twice.
    """
    merged = sorted(tallies, key=lambda tally: tally.sequence_id)
    for one, other in itertools.pairwise(merged):
        if one.sequence_id == other.sequence_id:
            raise InvalidInputError(f"{one.sequence_id}: counted twice")
    return tuple(merged)


def gather(
    read: Callable[[str, int, int], NDArray[Any]], part: str, rows: NDArray[np.int64]
) -> NDArray[Any]:
    """Read rows in one run of whole chunks, then pick: HDF5 is slow at single rows."""
    low, high = int(rows.min()), int(rows.max()) + 1
    return read(part, low, high)[rows - low]


def windows_of(truth: SequenceReader, indices: NDArray[np.int64]) -> list[tuple[Window, slice]]:
    """Divide scans, by ascending index, into the windows in time that they fall into.

    Returns
    -------
    list
        Windows, and which of the given scans are theirs.
    """
    numbers = gather(truth.read, "scans/stamps_ns", indices) // WINDOW_NS
    borders = [0, *(np.flatnonzero(np.diff(numbers)) + 1).tolist(), len(numbers)]
    recording = f"{truth.header.environment}--{truth.header.recording}"
    return [((recording, int(numbers[a])), slice(a, b)) for a, b in itertools.pairwise(borders)]


def _samples_of(
    predictions: PredictionsReader, truth: SequenceReader, name: str
) -> tuple[Evaluator, ...]:
    count = predictions.shape(name, "samples")[0] if predictions.has(name, "samples") else 0
    return tuple(Evaluator(truth.header.taxonomy) for _ in range(count))


def _count_block(
    tally: Tally,
    truth: SequenceReader,
    indices: NDArray[np.int64],
    predicted: NDArray[np.uint8],
) -> NDArray[np.uint8]:
    """Count scans; return their true labels, 255 where a beam is not scored."""
    labels = gather(truth.read, "scans/labels", indices)
    ranges = gather(truth.read, "scans/ranges", indices)
    scored = np.where(truth.lidar.has_return(ranges), labels, np.uint8(UNLABELLED))
    taxonomy = tally.evaluator.taxonomy
    for window, rows in windows_of(truth, indices):
        part = Evaluator(taxonomy).update(scored[rows], predicted[rows])
        tally.evaluator.merge(part)
        _add(tally.windows, window, part.confusion)
    counted = count_conditions(scored, predicted, ranges, truth.lidar, taxonomy)
    for name, counts in counted.items():
        _add(tally.conditions, name, counts)
    return scored


def _add(totals: dict[_Key, NDArray[np.int64]], key: _Key, counts: NDArray[np.int64]) -> None:
    totals[key] = totals[key] + counts if key in totals else counts


def _count_uncertainty(
    tally: Tally, predictions: PredictionsReader, scored: NDArray[np.uint8]
) -> None:
    """Count samples and probabilities of scans whose true labels (n, B) come in file order."""
    name = tally.sequence_id
    if tally.samples:
        drawn = (sample for block in predictions.blocks(name, "samples") for sample in block)
        for evaluator, sample in zip(tally.samples, drawn, strict=True):
            evaluator.update(scored, sample)
    if tally.calibration is not None:
        start = 0
        for block in predictions.blocks(name, "probabilities"):
            tally.calibration.update(scored[start : start + len(block)], block)
            start += len(block)
