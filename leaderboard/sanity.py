"""Predictions that every board should show: what knowing nothing gives, and what is perfect."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from semantic2d_dataset.access.registry import OpenDataset
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.scene.taxonomy import UNLABELLED, Taxonomy
from semantic2d_dataset.scoring.predictions import PredictionsWriter

MAJORITY, PERFECT = "majority", "perfect"
METHODS = {MAJORITY: "Majority class", PERFECT: "Perfect"}

_BLOCK = 1024  # scans read at a time

_Labels = NDArray[np.uint8]


def predict_sanity(
    kind: str, data: OpenDataset, out: Path, *, lidar: str, scheme: str, split: str
) -> None:
    """Write predictions that no method made.

    Parameters
    ----------
    kind
        ``majority``: everywhere the class, background left out, that the scheme's train split
        holds most of. ``perfect``: the truth, and the background where there is none.
    data
        The data set.
    out
        The predictions file.
    lidar, scheme, split
        What to predict.

    Raises
    ------
    InvalidInputError
        If the kind is unknown, or there is nothing to predict or to count.
    """
    if kind not in METHODS:
        raise InvalidInputError(f"{kind!r}: expected one of {', '.join(METHODS)}")
    entries = data.sequences(lidar)
    taxonomy = data.reader(entries[0].id).header.taxonomy
    if kind == MAJORITY:
        common = _most_common(data, lidar, scheme, taxonomy)
        label: Callable[[_Labels], _Labels] = lambda truth: np.full_like(truth, common)  # noqa: E731
    else:
        background = np.uint8(taxonomy.background_id)
        label = lambda truth: np.where(truth == UNLABELLED, background, truth)  # noqa: E731
    metadata = {"method": METHODS[kind], "parameters": 0}
    with PredictionsWriter(
        out,
        dataset=data.manifest.name,
        dataset_version=data.manifest.version,
        scheme=scheme,
        split=split,
        taxonomy=taxonomy,
        metadata=metadata,
    ) as writer:
        for sequence_id, indices, _, truth in _labels_of(data, lidar, scheme, split):
            writer.add(sequence_id, indices, label(truth))


def _most_common(data: OpenDataset, lidar: str, scheme: str, taxonomy: Taxonomy) -> int:
    """Return the class that most labelled points of the train split have."""
    counts = np.zeros(256, np.int64)
    for _, _, valid, truth in _labels_of(data, lidar, scheme, "train"):
        counts += np.bincount(truth[valid], minlength=256)
    scored = list(taxonomy.scored_ids)
    if not counts[scored].any():
        raise InvalidInputError(
            f"{data.manifest.name}: the train split of scheme {scheme} holds no labelled point"
        )
    return scored[int(counts[scored].argmax())]


def _labels_of(
    data: OpenDataset, lidar: str, scheme: str, split: str
) -> Iterator[tuple[str, NDArray[np.int64], NDArray[np.bool_], _Labels]]:
    """Yield sequence id, scan indices (n,), returns (n, B) and labels (n, B) in blocks."""
    division = data.scheme(scheme)
    for entry in tqdm(data.sequences(lidar), "reading", unit="sequence", disable=None, leave=False):
        if entry.id not in division.membership:
            continue
        indices = division.scans_of(entry.id, split)
        with data.reader(entry.id) as reader:
            for start in range(0, len(indices), _BLOCK):
                part = indices[start : start + _BLOCK]
                yield entry.id, part, *_read(reader, part)


def _read(reader: SequenceReader, indices: NDArray[np.int64]) -> tuple[NDArray[np.bool_], _Labels]:
    """Read one run of scans, and pick: HDF5 is slow at single rows."""
    low, high = int(indices[0]), int(indices[-1]) + 1
    batch = reader.batch(low, high)
    if batch.labels is None:
        raise InvalidInputError(f"{reader.path}: has no labels")
    return batch.valid[indices - low], batch.labels[indices - low]
