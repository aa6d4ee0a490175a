"""Scores of a geometric detector on a split, as the paper's table gives them."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np

from baselines.detectors import Detector, merged_scores
from baselines.speed import processor_name
from semantic2d_dataset.access.features import targets_of
from semantic2d_dataset.access.scan_source import ScanSource
from semantic2d_dataset.scoring.metrics import Evaluator
from semantic2d_dataset.scoring.published import ALL, METRICS, ClassFigures

_TIMED_SCANS = 64


@dataclass(frozen=True)
class DetectorScores:
    """How good and how fast a detector is.

    Parameters
    ----------
    figures
        By metric, the figure of the merged class for each class that it cannot tell apart, and
        for their mean, as in the paper; without a spread, because nothing is drawn.
    result
        What `Evaluator.compute` says of its labels.
    speed
        Scans a second, one at a time (``one_pass``), and the ``processor``.
    """

    figures: Mapping[str, ClassFigures]
    result: Mapping[str, Any]
    speed: Mapping[str, Any]


def score_detector(detector: Detector, source: ScanSource) -> DetectorScores:
    """Score a detector on the labelled scans of a source.

    Raises
    ------
    InvalidInputError
        If the data set lacks the class that the detector gives.
    """
    evaluator = Evaluator(source.taxonomy)
    for run in source.chunk_runs():
        fields, rows = source.fetch(np.arange(run.start, run.stop))
        truth, valid = targets_of(fields["ranges"], fields["labels"], source.lidar, rows)
        labels = detector.label(fields["ranges"][rows], source.lidar, taxonomy=source.taxonomy)
        evaluator.update(truth, labels, valid)
    merged = merged_scores(evaluator.confusion, source.taxonomy, detector.truth)
    names = (ALL, *merged["classes"])
    figures = {
        metric: {} if merged[key] is None else dict.fromkeys(names, (merged[key], None))
        for metric, key in zip(METRICS, ("ca", "iou"), strict=True)
    }
    speed = {"one_pass": _frames_per_second(detector, source), "processor": processor_name()}
    return DetectorScores(figures, evaluator.compute(), speed)


def _frames_per_second(detector: Detector, source: ScanSource) -> float:
    """Time scans one by one, from ranges to labels, and take the median one."""
    fields, rows = source.fetch(np.arange(min(_TIMED_SCANS, len(source))))
    seconds = []
    for row in rows:
        started = time.perf_counter()
        detector.label(fields["ranges"][row][None], source.lidar, taxonomy=source.taxonomy)
        seconds.append(time.perf_counter() - started)
    return 1 / median(seconds)
