"""Sample scans as paths to draw: what is true beside what was predicted."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.access.registry import OpenDataset
from semantic2d_dataset.scene.geometry import to_points
from semantic2d_dataset.scene.scans import Scan
from semantic2d_dataset.scene.taxonomy import UNLABELLED, Taxonomy
from semantic2d_dataset.scoring.predictions import PredictionsReader

SIDE = 1000
"""Side of the square that paths are drawn in."""

_MARGIN = 30
_SHARE_SHOWN = 98  # percent of the points that the square must hold: stray returns lie far off


@dataclass(frozen=True)
class Sample:
    """One scan.

    Parameters
    ----------
    id
        ``<sequence>/<index>``.
    right
        Share of its scored points that are right, None where none is scored.
    truth, prediction
        By class id, the SVG path of its points; `UNLABELLED` has those without a label.
    """

    id: str
    right: float | None
    truth: dict[int, str]
    prediction: dict[int, str]


def draw_samples(path: Path, data: OpenDataset, lidar: str, count: int = 4) -> Iterator[Sample]:
    """Yield scans of a predictions file, spread evenly over it.

    Parameters
    ----------
    path
        Predictions that were verified.
    data
        Their data set.
    lidar
        Whose scans to draw.
    count
        How many, where there are as many.
    """
    with PredictionsReader(path) as reader:
        ids = [name for name in reader.sequence_ids if name.endswith(f"--{lidar}")]
        sizes = [reader.shape(name, "scan_index")[0] for name in ids]
        starts = np.cumsum([0, *sizes])
        last = max(int(starts[-1]) - 1, 0)
        places = np.unique(np.linspace(0, last, count + 2)[1:-1].astype(int))
        for place in places.tolist() if ids else []:
            number = int(np.searchsorted(starts, place, side="right")) - 1
            name, row = ids[number], place - int(starts[number])
            index = int(reader.read(name, "scan_index", row, row + 1)[0])
            labels = reader.read(name, "labels", row, row + 1)[0]
            with data.reader(name) as sequence:
                scan = sequence.batch(index, index + 1)[0]
                yield _draw(f"{name}/{index}", scan, labels, sequence.header.taxonomy)


def _draw(scan_id: str, scan: Scan, labels: NDArray[np.uint8], taxonomy: Taxonomy) -> Sample:
    shown = scan.valid
    truth = np.full_like(labels, UNLABELLED) if scan.labels is None else scan.labels
    scored = shown & (truth != UNLABELLED)
    right = float((labels == truth)[scored].mean()) if scored.any() else None
    places = _place(to_points(scan.ranges, scan.lidar.bearings)[shown])
    return Sample(
        scan_id,
        right,
        _paths(places, truth[shown], taxonomy),
        _paths(places, labels[shown], taxonomy),
    )


def _place(points: NDArray[np.floating]) -> NDArray[np.int64]:
    """Put points (n, 2), m, into the square (n, 2), forward up; far ones lie outside."""
    if not len(points):
        return np.zeros((0, 2), np.int64)
    right_up = np.stack((-points[:, 1], -points[:, 0]), axis=1)
    tail = (100 - _SHARE_SHOWN) / 2
    low, high = np.percentile(np.vstack((right_up, (0, 0))), (tail, 100 - tail), axis=0)
    scale = (SIDE - 2 * _MARGIN) / max(float((high - low).max()), 1.0)
    middle = (low + high) / 2
    placed: NDArray[np.int64] = np.rint((right_up - middle) * scale + SIDE / 2).astype(np.int64)
    return placed


def _paths(
    places: NDArray[np.int64], labels: NDArray[np.uint8], taxonomy: Taxonomy
) -> dict[int, str]:
    """Write the points of every class as one path of dots."""
    inside = ((places >= 0) & (places <= SIDE)).all(axis=1)
    return {
        label: "".join(f"M{x} {y}h0" for x, y in places[inside & (labels == label)].tolist())
        for label in (UNLABELLED, *range(len(taxonomy)))
        if (inside & (labels == label)).any()
    }
