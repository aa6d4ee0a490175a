"""Predictions as a submission: validated, counted sequence by sequence, and scored."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from semantic2d_dataset.errors import SubmissionError
from semantic2d_dataset.executors import Executor, Serial
from semantic2d_dataset.scene.taxonomy import Taxonomy
from semantic2d_dataset.scoring.calibration import Calibration
from semantic2d_dataset.scoring.conditions import BANDS, describe_bands, figure_of
from semantic2d_dataset.scoring.counts import Counts, merge_counts
from semantic2d_dataset.scoring.intervals import blocks_of, intervals
from semantic2d_dataset.scoring.metrics import EVALUATOR_VERSION, Evaluator, format_table, percent
from semantic2d_dataset.scoring.predictions import PredictionsReader, PredictionsWriter
from semantic2d_dataset.scoring.spreads import spread
from semantic2d_dataset.scoring.tallies import Tally, count_sequence, merge_tallies
from semantic2d_dataset.scoring.validation import ScoredDataset, Task, task_of, validate

__all__ = [
    "PredictionsReader",
    "PredictionsWriter",
    "ScoredDataset",
    "count_predictions",
    "format_score",
    "format_spread",
    "result_to_json",
    "score_counts",
    "score_predictions",
    "validate",
]


def score_predictions(
    path: Path,
    dataset: ScoredDataset,
    *,
    scheme: str | None = None,
    split: str | None = None,
    executor: Executor | None = None,
) -> dict[str, Any]:
    """Validate predictions, and score them sequence by sequence.

    The result does not depend on where or in which order sequences are counted.

    Parameters
    ----------
    path
        The predictions file.
    dataset
        The data set that they are for.
    scheme, split
        What to score, where the file does not say; where it does, they must agree.
    executor
        Where sequences are checked and counted; this process if not given.

    Returns
    -------
    dict
        As `Evaluator.compute`, with ``intervals``, see there; ``per_lidar`` with the same by
        lidar name; ``conditions``, by condition and band what `conditions.summarise` returns;
        ``calibration`` where there are probabilities, as `Calibration.compute`; ``samples``
        where there are samples, as `spreads.spread`; and ``submission``: dataset,
        dataset_version, scheme, split, lidars, number of scans, metadata, ``digests`` (SHA-256
        of predictions file, split scheme and taxonomy) and evaluator_version.

    Raises
    ------
    SubmissionError
        With all problems, if there is one.
    InvalidInputError
        If a sequence of the data set has no labels to score against.
    FileNotFoundError, CorruptFileError, UnsafeFileError, FormatVersionError
        If the file cannot be opened safely, or is damaged.
    """
    return score_counts(
        [count_predictions(path, dataset, scheme=scheme, split=split, executor=executor)]
    )


def score_counts(parts: Iterable[Counts]) -> dict[str, Any]:
    """Compute scores from the counts of all parts of a submission.

    Returns
    -------
    dict
        As `score_predictions`: the same, however the parts were shared.

    Raises
    ------
    InvalidInputError
        If the parts are of different submissions, or a sequence comes twice or not at all.
    """
    counts = merge_counts(parts)
    return _scores_of(counts.tallies, counts.taxonomy) | {"submission": dict(counts.submission)}


def count_predictions(
    path: Path,
    dataset: ScoredDataset,
    *,
    scheme: str | None = None,
    split: str | None = None,
    part: tuple[int, int] = (1, 1),
    executor: Executor | None = None,
) -> Counts:
    """Validate predictions, and count them: all that their scores are computed from.

    Parameters and errors are those of `score_predictions`, and

    Parameters
    ----------
    part
        Which part of the sequences to check and count, see `Task.share`: the others are for
        other machines.
    """
    path, runner = Path(path), executor or Serial()
    with PredictionsReader(path) as predictions:
        problems = validate(
            predictions, dataset, scheme=scheme, split=split, part=part, executor=runner
        )
        if problems:
            raise SubmissionError(path, problems)
        task = task_of(predictions, dataset, scheme, split)
        submission = _describe(predictions, dataset, task)
    share = task.share(part)
    counted = runner.map(partial(count_sequence, path, dataset), share.items(), in_order=False)
    bar = tqdm(counted, "scoring", len(share), unit="sequence", disable=None, leave=False)
    return Counts(submission, task.taxonomy, tuple(task.scans), merge_tallies(bar))


def format_score(result: Mapping[str, Any]) -> str:
    """Lay a result of `score_predictions` out as text: what was scored, by class, by condition."""
    said = result["submission"]
    what = f"{said['dataset']} {said['dataset_version']}, split {said['split']} of {said['scheme']}"
    title = f"{said['metadata']['method']} on {what}: {said['scans']:,} scans"
    lidars = (
        f"{name}: mIoU {percent(scores['mIoU'])}, mCA {percent(scores['mCA'])}"
        for name, scores in result["per_lidar"].items()
    )
    conditions = (
        f"{name}: {figure_of(name)} "
        + ", ".join(f"{band} {percent(scores[figure_of(name)])}" for band, scores in of.items())
        for name, of in result["conditions"].items()
    )
    return "\n".join(
        (
            title,
            "",
            format_table(result),
            *_format_intervals(result["intervals"]),
            *_format_uncertainty(result),
            "",
            *conditions,
            "",
            *lidars,
        )
    )


def format_spread(said: Mapping[str, Any]) -> str:
    """Lay mean and standard deviation out as text, in percent."""
    width = max(map(len, said["classes"]))
    rows = {name: (one["iou"], one["ca"]) for name, one in said["classes"].items()}
    rows["Mean"] = said["mIoU"], said["mCA"]
    lines = (
        f"{name:{width}}  {_plus_minus(iou):>14} {_plus_minus(ca):>14}"
        for name, (iou, ca) in rows.items()
    )
    return "\n".join((f"{'':{width}}  {'IoU':>14} {'CA':>14}", *lines))


def result_to_json(result: Mapping[str, Any]) -> str:
    """Return a result as JSON text with a final line break."""
    return json.dumps(result, indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def _scores_of(tallies: Sequence[Tally], taxonomy: Taxonomy) -> dict[str, Any]:
    lidars = sorted({tally.lidar for tally in tallies})
    return (
        _scores_with_intervals(tallies, taxonomy)
        | {
            "per_lidar": {
                lidar: _scores_with_intervals([t for t in tallies if t.lidar == lidar], taxonomy)
                for lidar in lidars
            },
            "conditions": _by_environment(tallies, taxonomy) | _by_band(tallies, taxonomy),
        }
        | _uncertainty_of(tallies, taxonomy)
    )


def _scores_with_intervals(tallies: Sequence[Tally], taxonomy: Taxonomy) -> dict[str, Any]:
    total = Evaluator(taxonomy)
    for tally in tallies:
        total.merge(tally.evaluator)
    return total.compute() | {"intervals": intervals(blocks_of(tallies))}


def _by_environment(tallies: Sequence[Tally], taxonomy: Taxonomy) -> dict[str, Any]:
    places = tuple(sorted({tally.environment for tally in tallies}))
    counts = [
        sum(t.evaluator.confusion for t in tallies if t.environment == place) for place in places
    ]
    return describe_bands({"environment": np.stack(counts)}, taxonomy, {"environment": places})


def _by_band(tallies: Sequence[Tally], taxonomy: Taxonomy) -> dict[str, Any]:
    counts = {name: np.sum([tally.conditions[name] for tally in tallies], axis=0) for name in BANDS}
    return describe_bands(counts, taxonomy)


def _uncertainty_of(tallies: Sequence[Tally], taxonomy: Taxonomy) -> dict[str, Any]:
    said: dict[str, Any] = {}
    if all(tally.calibration is not None for tally in tallies):
        calibration = Calibration(taxonomy)
        for tally in tallies:
            if tally.calibration is not None:
                calibration.merge(tally.calibration)
        said["calibration"] = calibration.compute()
    samples = min(len(tally.samples) for tally in tallies)
    if samples:
        merged = [Evaluator(taxonomy) for _ in range(samples)]
        for tally in tallies:
            for evaluator, own in zip(merged, tally.samples, strict=True):
                evaluator.merge(own)
        said["samples"] = spread([evaluator.compute() for evaluator in merged])
    return said


def _format_intervals(said: Mapping[str, Any]) -> list[str]:
    if said["mIoU"] is None:
        return []
    limits = ", ".join(
        f"{name} {percent(said[name][0])} to {percent(said[name][1])}"
        for name in ("mIoU", "mCA")
        if said[name]
    )
    about = f"{said['blocks']} blocks of {said['block_s']:g} s"
    return [f"{said['level']:.0%} confidence: {limits} ({about})."]


def _format_uncertainty(result: Mapping[str, Any]) -> list[str]:
    lines = []
    if "samples" in result:
        said = result["samples"]
        lines.append(
            f"Over {said['count']} samples: mIoU {_plus_minus(said['mIoU'])}, "
            f"mCA {_plus_minus(said['mCA'])}."
        )
    if "calibration" in result:
        said = result["calibration"]
        lines.append(
            f"Calibration error: expected {percent(said['ece'])}, largest {percent(said['mce'])}; "
            f"area under risk and coverage {percent(said['aurc'])}."
        )
    return lines


def _plus_minus(said: Mapping[str, float] | None) -> str:
    return "-" if said is None else f"{percent(said['mean'])} ± {percent(said['std'])}"


def _describe(predictions: PredictionsReader, dataset: ScoredDataset, task: Task) -> dict[str, Any]:
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
