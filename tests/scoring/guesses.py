"""Predictions with everything that a file can hold, made at random."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from semantic2d_dataset.access.registry import OpenDataset
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D
from semantic2d_dataset.scoring.submission import PredictionsWriter

SAMPLES = 3


def guesses(data: OpenDataset, name: str) -> tuple[Any, ...]:
    """Indices, labels, probabilities and samples of the test scans of a sequence."""
    indices = data.scheme("block").scans_of(name, "test")
    truth = data.reader(name).read("scans/labels")[indices]
    rng = np.random.default_rng(len(name))
    labels = np.where(rng.random(truth.shape) < 0.4, rng.integers(0, 10, truth.shape), truth % 10)
    samples = np.where(rng.random((SAMPLES, *truth.shape)) < 0.2, 9, labels).astype(np.uint8)
    raw = rng.random((*truth.shape, 10)) + 3 * np.eye(10)[labels]
    probabilities = (raw / raw.sum(axis=-1, keepdims=True)).astype(np.float16)
    return indices, labels.astype(np.uint8), probabilities, samples


def write_guesses(path: Path, data: OpenDataset, *, method: str = "guess") -> Path:
    """Write predictions of the test split, scans in any order."""
    with PredictionsWriter(
        path,
        dataset=data.manifest.name,
        dataset_version="1.0.0",
        scheme="block",
        split="test",
        taxonomy=SEMANTIC2D,
        metadata={"method": method},
    ) as writer:
        for entry in data.manifest.sequences:
            indices, labels, probabilities, samples = guesses(data, entry.id)
            order = np.random.default_rng(1).permutation(len(indices))
            writer.add(
                entry.id, indices[order], labels[order], probabilities[order], samples[:, order]
            )
    return path
