"""Whether probabilities mean what they say: reliability, and errors against entropy.

A point is a labelled beam with a return, of any class: the background counts too, because a
robot meets it like the rest. Its confidence is the highest of its class probabilities, its
prediction the class that has it. Figures, all over points:

- ``ece``, the expected calibration error: mean over the confidence bins, weighted by their points,
  of the distance between mean confidence and accuracy (Guo et al., ICML 2017, equation 3);
- ``mce``: the largest such distance (equation 5 there), whatever the bin holds;
- ``aurc``: the mean share of errors among the points kept, over all shares kept when the points of
  the highest entropy are dropped first (Geifman et al., ICLR 2019). 0 is perfect, and the share
  of all errors is what dropping at random gives.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Self

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, UNLABELLED, Taxonomy

BINS = 15
"""Bins of equal width that figures are usually given for (Guo et al.)."""

_FINE = 64  # parts of an entropy bin, for the order of points by entropy
_UNIT = 1 << 30  # sums are integers in such parts of one, so that no order rounds them otherwise
_SUM_TOLERANCE = 0.02  # of probabilities in half precision
_POINTS, _HITS, _SUM = range(3)


class Calibration:
    """Count confidences and entropies against hits, and say how far they can be trusted.

    Parameters
    ----------
    taxonomy
        The K classes.
    bins
        Bins of equal width, of confidence from 0 to 1 and of entropy from 0 to log K nats; a
        value between two belongs to the upper one.

    Raises
    ------
    InvalidInputError
        If there is no bin.

    Examples
    --------
    >>> from semantic2d_dataset.scene.taxonomy import SEMANTIC2D
    >>> probabilities = np.eye(10, dtype=np.float32)[[[1, 9]]]  # certain: a chair, a wall
    >>> Calibration().update([[1, 4]], probabilities).compute()["ece"]
    0.5
    """

    def __init__(self, taxonomy: Taxonomy = SEMANTIC2D, *, bins: int = BINS) -> None:
        if bins < 1:
            raise InvalidInputError(f"bins: expected at least 1, found {bins}")
        self.taxonomy = taxonomy
        self.bins = bins
        self.ignored = 0
        # points, hits, and the sum of the value in parts of `_UNIT`, by bin
        self.by_confidence: NDArray[np.int64] = np.zeros((bins, 3), np.int64)
        self.by_entropy: NDArray[np.int64] = np.zeros((bins * _FINE, 3), np.int64)

    def update(
        self,
        truth: ArrayLike,
        probabilities: NDArray[np.floating],
        valid: ArrayLike | None = None,
    ) -> Self:
        """Count points.

        Parameters
        ----------
        truth
            (N, B) class ids of integer dtype, or of any other shape; 255 is not counted.
        probabilities
            (N, B, K) f2 or f4, the probability of every class: that shape and one axis more.
        valid
            Bool of the shape of `truth`, or None for all: beams without a return are not counted.

        Returns
        -------
        Calibration
            This one.

        Raises
        ------
        InvalidInputError
            If shapes or dtypes do not fit, a counted point holds an id that is no class, or its
            probabilities are not numbers from 0 to 1 that add up to 1. Nothing of the call is
            counted then.
        """
        t, p = np.asarray(truth), np.asarray(probabilities)
        counted = _counted(t, p, valid, len(self.taxonomy))
        confidence, entropy = np.zeros_like(self.by_confidence), np.zeros_like(self.by_entropy)
        first = _count(
            t[counted].astype(np.int64),
            p[counted].astype(np.float32, copy=False),
            confidence,
            entropy,
        )
        if first >= 0:
            where = np.argwhere(counted)[first].tolist()
            raise InvalidInputError(
                f"probabilities{where}: expected numbers from 0 to 1 that add up to 1, "
                f"found {p[tuple(where)].tolist()}"
            )
        self.by_confidence += confidence
        self.by_entropy += entropy
        self.ignored += t.size - int(counted.sum())
        return self

    def merge(self, other: Calibration) -> Self:
        """Add what another of the same taxonomy and bins has counted, and return this one.

        Raises
        ------
        InvalidInputError
            If taxonomies or bins differ.
        """
        if (other.taxonomy, other.bins) != (self.taxonomy, self.bins):
            raise InvalidInputError("cannot merge calibrations of different taxonomies or bins")
        self.by_confidence += other.by_confidence
        self.by_entropy += other.by_entropy
        self.ignored += other.ignored
        return self

    def compute(self) -> dict[str, Any]:
        """Return the figures of everything counted so far, as plain values for JSON.

        Returns
        -------
        dict
            ``points`` and ``ignored``; ``accuracy``, mean ``confidence`` and mean ``entropy``
            (nats); ``ece``, ``mce`` and ``aurc``; ``confidence_bins``, each with its limits
            ``low`` and ``high``, ``points``, mean ``confidence`` and ``accuracy``; and
            ``entropy_bins`` with ``low``, ``high``, ``points``, mean ``entropy`` and ``error``,
            the share of wrong points. A figure of no point is None.
        """
        points, hits, total = _columns(self.by_confidence)
        entropy_points, entropy_hits, entropy_total = _columns(
            self.by_entropy.reshape(self.bins, _FINE, 3).sum(axis=1)
        )
        count = int(points.sum())
        gaps = np.abs(total - hits)[points > 0]
        entropy_errors = entropy_points - entropy_hits
        return {
            "points": count,
            "ignored": self.ignored,
            "accuracy": _share(hits.sum(), count),
            "confidence": _share(total.sum(), count),
            "entropy": _share(entropy_total.sum(), count),
            "ece": _share(gaps.sum(), count),
            "mce": float((gaps / points[points > 0]).max()) if count else None,
            "aurc": self._area_under_risk() if count else None,
            "confidence_bins": _table(1.0, points, confidence=total, accuracy=hits),
            "entropy_bins": _table(
                math.log(len(self.taxonomy)),
                entropy_points,
                entropy=entropy_total,
                error=entropy_errors,
            ),
        }

    def _area_under_risk(self) -> float:
        """Mean error among the points kept, over all shares kept, surest points first.

        Within a fine bin, errors are taken to be spread evenly.
        """
        points, hits, _ = _columns(self.by_entropy)
        kept, wrong = (np.concatenate(((0.0,), np.cumsum(c))) for c in (points, points - hits))
        slopes = np.divide(points - hits, points, out=np.zeros_like(points), where=points > 0)
        # the integral of (wrong + slope * (x - kept)) / x over each bin
        rest = wrong[:-1] - slopes * kept[:-1]
        ratio = np.divide(kept[1:], kept[:-1], out=np.ones_like(points), where=kept[:-1] > 0)
        return float((rest * np.log(ratio) + slopes * points).sum() / kept[-1])


def are_probabilities(values: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Tell which rows (..., K) of class probabilities are numbers from 0 to 1 that add up to 1.

    This is what `Calibration.update` accepts.
    """
    rows = values.reshape(-1, values.shape[-1]).astype(np.float32, copy=False)
    found = np.empty(len(rows), np.bool_)
    _check_rows(rows, found)
    return found.reshape(values.shape[:-1])


def _columns(
    table: NDArray[np.int64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Points, hits and sums of a table of bins."""
    columns = table.astype(np.float64)
    return columns[:, _POINTS], columns[:, _HITS], columns[:, _SUM] / _UNIT


def _share(part: float, count: int) -> float | None:
    return float(part) / count if count else None


def _table(
    highest: float, points: NDArray[np.float64], **sums: NDArray[np.float64]
) -> list[dict[str, float | int | None]]:
    """Lay bins out from 0 to the highest value, sums as means over their points."""
    edges = np.linspace(0.0, highest, len(points) + 1).tolist()
    return [
        {"low": edges[i], "high": edges[i + 1], "points": int(n)}
        | {name: _share(total[i], int(n)) for name, total in sums.items()}
        for i, n in enumerate(points)
    ]


def _counted(
    truth: NDArray[Any],
    probabilities: NDArray[Any],
    valid: ArrayLike | None,
    classes: int,
) -> NDArray[np.bool_]:
    """Check everything but the values of probabilities; tell which points count."""
    v = np.ones(truth.shape, np.bool_) if valid is None else np.asarray(valid)
    expected: Mapping[str, tuple[NDArray[Any], str, tuple[int, ...]]] = {
        "truth": (truth, "iu", truth.shape),
        "probabilities": (probabilities, "f", (*truth.shape, classes)),
        "valid": (v, "b", truth.shape),
    }
    for name, (array, kinds, shape) in expected.items():
        if array.dtype.kind not in kinds or array.shape != shape:
            kind = {"iu": "integer class ids", "f": "floats", "b": "bool"}[kinds]
            raise InvalidInputError(
                f"{name}: expected {kind} of shape {shape}, found {array.dtype} of {array.shape}"
            )
    counted: NDArray[np.bool_] = v & (truth != UNLABELLED)
    wrong = counted & ((truth < 0) | (truth >= classes))
    if wrong.any():
        where = np.argwhere(wrong)[0].tolist()
        raise InvalidInputError(
            f"truth{where}: expected a class id 0 to {classes - 1}, or 255 for no label, "
            f"found {int(truth[tuple(where)])}"
        )
    return counted


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _count(
    truth: NDArray[np.int64],
    probabilities: NDArray[np.float32],
    confidence: NDArray[np.int64],
    entropy: NDArray[np.int64],
) -> int:
    """Sort points (P,) by their probabilities (P, K) into both tables of bins.

    Returns the first point whose probabilities are none, or -1.
    """
    classes = probabilities.shape[1]
    most = np.log(np.float64(classes))
    for i in range(len(truth)):
        best, total, spread = 0, 0.0, 0.0
        for k in range(classes):
            p = np.float64(probabilities[i, k])
            if not 0.0 <= p <= 1.0:  # also NaN
                return i
            total += p
            if p > 0.0:
                spread -= p * np.log(p)
            if p > probabilities[i, best]:
                best = k
        if abs(total - 1.0) > _SUM_TOLERANCE:
            return i
        hit = int(best == truth[i])
        _add(confidence, np.float64(probabilities[i, best]), 1.0, hit)
        _add(entropy, min(spread, most), most, hit)
    return -1


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _check_rows(rows: NDArray[np.float32], found: NDArray[np.bool_]) -> None:
    for i in range(len(rows)):
        total, outside = 0.0, 0
        for k in range(rows.shape[1]):
            p = np.float64(rows[i, k])
            outside += not 0.0 <= p <= 1.0  # also NaN
            total += p
        found[i] = outside == 0 and abs(total - 1.0) <= _SUM_TOLERANCE


@numba.njit(error_model="numpy")
def _add(table: NDArray[np.int64], value: float, highest: float, hit: int) -> None:
    row = min(int(value / highest * len(table)), len(table) - 1)
    table[row, _POINTS] += 1
    table[row, _HITS] += hit
    table[row, _SUM] += int(value * _UNIT + 0.5)
