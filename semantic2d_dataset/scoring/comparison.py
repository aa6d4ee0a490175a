"""Two submissions for the same scans: which is better, how surely, and where they differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.executors import Executor, Serial
from semantic2d_dataset.scene.geometry import to_base, to_points, transform
from semantic2d_dataset.scene.maps import SemanticMap
from semantic2d_dataset.scene.taxonomy import UNLABELLED
from semantic2d_dataset.scoring.conditions import BANDS, figure_of, summarise
from semantic2d_dataset.scoring.intervals import blocks_of, compare_blocks
from semantic2d_dataset.scoring.metrics import percent
from semantic2d_dataset.scoring.predictions import PredictionsReader
from semantic2d_dataset.scoring.submission import count_predictions
from semantic2d_dataset.scoring.tallies import Tally, gather
from semantic2d_dataset.scoring.validation import ScoredDataset, Task, task_of

CELL_M = 0.25
"""Side of the cells of a map in which outcomes are counted."""

OUTCOMES = ("both", "only_a", "only_b", "neither")

_BLOCK = 256  # scans
_MEANS = ("mIoU", "mCA")


@dataclass(frozen=True)
class Place:
    """Where two submissions are right and wrong in one environment.

    Parameters
    ----------
    environment
        Its name.
    outcomes
        (4,) i8, all scored points by `OUTCOMES`.
    cells
        (n, 2) i8, column and row of cells of `CELL_M` in the map frame.
    counts
        (n, 4) i8, scored points in them by `OUTCOMES`; scans without a pose are in none.
    scene
        The map, None where there is none.
    """

    environment: str
    outcomes: NDArray[np.int64]
    cells: NDArray[np.int64]
    counts: NDArray[np.int64]
    scene: SemanticMap | None


@dataclass(frozen=True)
class Comparison:
    """What `compare_predictions` found.

    Parameters
    ----------
    names
        What the two submissions call their methods, with the names of their files where they
        call them alike.
    scores
        As `intervals.compare_blocks` returns them.
    conditions
        By condition and band: `conditions.figure_of` of ``a`` and ``b``, their ``difference``,
        and ``points``.
    outcomes
        Scored points by `OUTCOMES`: who is right.
    places
        By environment, the one where most points tell the two apart first.
    task
        What was compared: dataset, version, scheme, split, lidars.
    """

    names: tuple[str, str]
    scores: Mapping[str, Any]
    conditions: Mapping[str, Mapping[str, Mapping[str, Any]]]
    outcomes: Mapping[str, int]
    places: tuple[Place, ...]
    task: Mapping[str, Any]

    def as_dict(self) -> dict[str, Any]:
        """Return all but the places as plain values for JSON."""
        return {
            "task": dict(self.task),
            "a": self.names[0],
            "b": self.names[1],
            "scores": dict(self.scores),
            "conditions": self.conditions,
            "right": dict(self.outcomes),
        }


def compare_predictions(
    a: Path, b: Path, dataset: ScoredDataset, *, executor: Executor | None = None
) -> Comparison:
    """Compare two submissions beam by beam.

    Parameters
    ----------
    a, b
        Predictions files for the same split by the same lidars.
    dataset
        The data set that they are for.
    executor
        Where sequences are counted; this process if not given.

    Raises
    ------
    SubmissionError
        If one of them cannot be scored.
    InvalidInputError
        If they are for different scans.
    FileNotFoundError, CorruptFileError, UnsafeFileError, FormatVersionError
        If a file cannot be opened safely, or is damaged.
    """
    runner = executor or Serial()
    task, names = _common_task(Path(a), Path(b), dataset)
    tallies = [count_predictions(path, dataset, executor=runner).tallies for path in (a, b)]
    differ = partial(_differ, Path(a), Path(b), dataset)
    found = runner.map(differ, task.scans.items())
    bar = tqdm(found, "comparing", len(task.scans), unit="sequence", disable=None, leave=False)
    places = _merge_places(list(bar))
    total = np.sum([place.outcomes for place in places], axis=0)
    return Comparison(
        names=names,
        scores=compare_blocks(*map(blocks_of, tallies)),
        conditions=_compare_conditions(*tallies),
        outcomes=dict(zip(OUTCOMES, total.tolist(), strict=True)),
        places=places,
        task={
            "dataset": dataset.manifest.name,
            "dataset_version": dataset.manifest.version,
            "scheme": task.scheme.name,
            "split": task.split,
            "lidars": list(task.lidars),
        },
    )


def format_comparison(found: Comparison) -> str:
    """Lay a comparison out as text, in percent."""
    said, task = found.scores, found.task
    rows = {name: said[name] for name in _MEANS} | dict(said["classes"])
    width = max(map(len, rows))
    lines = [
        f"{name:{width}}  {percent(row['a']):>7} {percent(row['b']):>7} "
        f"{_points(row['difference']):>7}  {_range(row['interval']):>16}"
        + (f"  {row['p']:.4f}" if name in _MEANS and row["p"] is not None else "")
        for name, row in rows.items()
    ]
    total = sum(found.outcomes.values())
    right = ", ".join(
        f"{name.replace('_', ' ')} {percent(count / total if total else None)}"
        for name, count in found.outcomes.items()
    )
    bands = (
        f"{name}: B - A in {figure_of(name)} "
        + ", ".join(f"{band} {_points(row['difference'])}" for band, row in of.items())
        for name, of in found.conditions.items()
    )
    on = (
        f"on {task['dataset']} {task['dataset_version']}, split {task['split']} of "
        f"{task['scheme']}, {', '.join(task['lidars'])}"
    )
    interval = f"{said['level']:.0%} interval"
    return "\n".join(
        (
            f"A: {found.names[0]}",
            f"B: {found.names[1]}",
            on,
            "",
            f"{'':{width}}  {'A':>7} {'B':>7} {'B - A':>7}  {interval:>16}  p",
            *lines,
            f"Means, then IoU by class. Blocks of {said['block_s']:g} s: {said['blocks']}.",
            "",
            f"Right: {right}.",
            *bands,
        )
    )


def _common_task(a: Path, b: Path, dataset: ScoredDataset) -> tuple[Task, tuple[str, str]]:
    tasks, names = [], []
    for path in (a, b):
        with PredictionsReader(path) as reader:
            tasks.append(task_of(reader, dataset))
            said = reader.metadata
        method = said.get("method") if isinstance(said, dict) else None
        names.append(method if isinstance(method, str) else Path(path).stem)
    said_of = [(task.scheme.name, task.split, ", ".join(task.lidars)) for task in tasks]
    for what, one, other in zip(("scheme", "split", "lidars"), *said_of, strict=True):
        if one != other:
            raise InvalidInputError(
                f"{b}: {what} {other}, but {one} in {a}; only submissions for the same scans can "
                "be compared"
            )
    if names[0] == names[1]:
        names = [f"{name} ({path})" for name, path in zip(names, _told_apart(a, b), strict=True)]
    return tasks[0], (names[0], names[1])


def _told_apart(a: Path, b: Path) -> tuple[str, str]:
    """Name two files by as little of their paths as tells them apart."""
    return (a.name, b.name) if a.name != b.name else (str(a), str(b))


def _differ(a: Path, b: Path, dataset: ScoredDataset, item: tuple[str, NDArray[np.int64]]) -> Place:
    """Count who is right, by cell of the map, in one sequence."""
    name, indices = item
    total: NDArray[np.int64] = np.zeros(len(OUTCOMES), np.int64)
    cells, counts = [], []
    with PredictionsReader(a) as one, PredictionsReader(b) as other, dataset.reader(name) as truth:
        orders = [np.argsort(reader.read(name, "scan_index")) for reader in (one, other)]
        for start in range(0, len(indices), _BLOCK):
            rows = slice(start, start + _BLOCK)
            low = int(indices[rows][0])
            batch = truth.batch(low, int(indices[rows][-1]) + 1)
            scans = indices[rows] - low
            true = gather(truth.read, "scans/labels", indices[rows])
            wrong = [
                gather(partial(reader.read, name), "labels", order[rows]) != true
                for reader, order in zip((one, other), orders, strict=True)
            ]
            outcome = 2 * wrong[0] + wrong[1]  # both, only a, only b, neither
            scored = batch.valid[scans] & (true != UNLABELLED)
            total += np.bincount(outcome[scored], minlength=len(OUTCOMES))
            points = to_base(
                to_points(batch.ranges[scans], truth.lidar.bearings), truth.lidar.base_T_lidar
            )
            points = transform(batch.poses[scans], points)
            known = scored & np.isfinite(points).all(axis=-1)
            found = _count_cells(points[known], outcome[known])
            cells.append(found[0])
            counts.append(found[1])
        place, scene = truth.header.environment, truth.read_map()
    return Place(place, total, *_add_cells(cells, counts), scene)


def _count_cells(
    points: NDArray[np.float64], outcome: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Cells (n, 2) that points (P, 2) fall into, and counts (n, 4) of their outcomes."""
    cells, of = np.unique(np.floor(points / CELL_M).astype(np.int64), axis=0, return_inverse=True)
    kinds = len(OUTCOMES)
    keys = kinds * of.reshape(-1) + outcome
    return cells, np.bincount(keys, minlength=kinds * len(cells)).reshape(-1, kinds)


def _add_cells(
    cells: Sequence[NDArray[np.int64]], counts: Sequence[NDArray[np.int64]]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    together, of = np.unique(np.concatenate(cells), axis=0, return_inverse=True)
    total = np.zeros((len(together), 4), np.int64)
    np.add.at(total, of.reshape(-1), np.concatenate(counts))
    return together, total


def _merge_places(found: Sequence[Place]) -> tuple[Place, ...]:
    merged = []
    for name in sorted({place.environment for place in found}):
        here = [place for place in found if place.environment == name]
        cells = _add_cells([p.cells for p in here], [p.counts for p in here])
        scene = next((p.scene for p in here if p.scene is not None), None)
        outcomes = np.sum([p.outcomes for p in here], axis=0)
        merged.append(Place(name, outcomes, *cells, scene))
    return tuple(sorted(merged, key=lambda place: -int(place.outcomes[1:3].sum())))


def _compare_conditions(a: Sequence[Tally], b: Sequence[Tally]) -> dict[str, Any]:
    taxonomy = a[0].evaluator.taxonomy
    said: dict[str, Any] = {}
    for name, bands in BANDS.items():
        both = [np.sum([tally.conditions[name] for tally in part], axis=0) for part in (a, b)]
        said[name] = {}
        for band, *matrices in zip(bands, *both, strict=True):
            one, other = (summarise(matrix, taxonomy) for matrix in matrices)
            figures = one[figure_of(name)], other[figure_of(name)]
            if None not in figures:
                said[name][band] = {
                    "a": figures[0],
                    "b": figures[1],
                    "difference": figures[1] - figures[0],
                    "points": one["points"],
                }
    return said


def _points(difference: float | None) -> str:
    """Write a difference of fractions in percentage points, with its sign."""
    return "-" if difference is None else f"{100 * difference:+.2f}"


def _range(limits: Sequence[float] | None) -> str:
    return "-" if limits is None else f"{100 * limits[0]:+.2f} to {100 * limits[1]:+.2f}"
