"""The geometric detectors by name: labelling a split with them, and scoring what they say."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from tqdm import tqdm

from baselines.leg_detector import PERSON, label_people
from baselines.line_detector import WALL, label_walls
from semantic2d_dataset.access.scan_source import ScanSource
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.taxonomy import Taxonomy
from semantic2d_dataset.scoring.submission import PredictionsWriter


@dataclass(frozen=True)
class Detector:
    """A detector of one thing.

    Parameters
    ----------
    method
        Its name in predictions files.
    predicts
        The class that it gives to what it finds; all else is background.
    truth
        The classes that it cannot tell apart: scored as one (paper, footnotes on the baselines).
    label
        Called with ranges (N, B), the lidar, and ``taxonomy``; returns labels (N, B) u1.
    """

    method: str
    predicts: str
    truth: tuple[str, ...]
    label: Callable[..., NDArray[np.uint8]]


DETECTORS = {
    "lines": Detector("Line extraction", WALL, (WALL, "Door", "Elevator"), label_walls),
    "legs": Detector("Leg detection", PERSON, (PERSON,), label_people),
}


def predict(detector: Detector, source: ScanSource, path: Path) -> int:
    """Label every scan of a source, and write a predictions file.

    Parameters
    ----------
    detector
        One of `DETECTORS`.
    source
        Scans of one lidar in one split.
    path
        The file to make.

    Returns
    -------
    int
        Number of scans labelled.

    Raises
    ------
    InvalidInputError
        If the data set lacks the class that the detector gives.
    WriteError
        If the file cannot be written.
    """
    manifest = source.data.manifest
    try:
        source.taxonomy.id_of(detector.predicts)
    except InvalidInputError as err:
        raise InvalidInputError(
            f"{manifest.name}: {detector.method} finds {detector.predicts} and nothing else: {err}"
        ) from err
    with (
        PredictionsWriter(
            path,
            dataset=manifest.name,
            dataset_version=manifest.version,
            scheme=source.scheme,
            split=source.split or "all",
            taxonomy=source.taxonomy,
            metadata={"method": detector.method, "features": "R", "parameters": 0},
        ) as writer,
        tqdm(total=len(source), desc="detecting", unit="scan", disable=None) as bar,
    ):
        for run in source.chunk_runs():
            fields, rows = source.fetch(np.arange(run.start, run.stop))
            names = [scan_id.rpartition("/") for scan_id in source.scan_ids[run.start : run.stop]]
            labels = detector.label(fields["ranges"][rows], source.lidar, taxonomy=source.taxonomy)
            writer.add(names[0][0], np.array([int(row) for _, _, row in names], np.int64), labels)
            bar.update(len(run))
    return len(source)


def merged_scores(
    confusion: ArrayLike, taxonomy: Taxonomy, classes: Sequence[str]
) -> dict[str, Any]:
    """Score classes as if they were one: a row of the paper's table for a detector.

    Parameters
    ----------
    confusion
        (K, K) counts of points, rows truth, of the K classes of the taxonomy.
    taxonomy
        Its classes.
    classes
        Names of those to merge; what the taxonomy lacks is left out. For a detector:
        `Detector.truth`.

    Returns
    -------
    dict
        ``ca`` = TP / (TP + FN) and ``iou`` = TP / (TP + FP + FN) of the merged class, fractions
        (None where there is nothing to divide by); ``support``, points that truth gives it; and
        ``classes``, the names that were merged.

    Raises
    ------
    InvalidInputError
        If the matrix is not of the taxonomy's size, or the taxonomy has none of the classes.
    """
    counts = np.asarray(confusion)
    if counts.shape != (len(taxonomy),) * 2:
        raise InvalidInputError(
            f"expected a confusion matrix of {len(taxonomy)} classes, found shape {counts.shape}"
        )
    ids = []
    for name in classes:
        with contextlib.suppress(InvalidInputError):
            ids.append(taxonomy.id_of(name))
    if not ids:
        raise InvalidInputError(
            f"none of the classes {', '.join(classes)} is in {', '.join(taxonomy.names)}"
        )
    hits = int(counts[np.ix_(ids, ids)].sum())
    support = int(counts[ids].sum())
    union = support + int(counts[:, ids].sum()) - hits
    return {
        "ca": hits / support if support else None,
        "iou": hits / union if union else None,
        "support": support,
        "classes": [taxonomy.names[i] for i in ids],
    }
