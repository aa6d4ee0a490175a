"""Scores of per-point labels: one confusion matrix, and what follows from it.

With TP, FP, FN and TN of a class counted over all scored points:

- ``iou`` = TP / (TP + FP + FN), the paper's equation for IoU;
- ``ca`` = TP / (TP + FN), recall: the CA that the paper's tables hold;
- ``ca_tn`` = (TP + TN) / all: the paper's printed equation for CA, which those tables cannot
  come from (a rare class would always be above 90 %).

A class that neither truth nor prediction holds has no IoU. A class that truth lacks has no CA
of either kind: the equation with TN would give it a high figure for never being there. What is
missing is None, is left out of the means, and how many classes were averaged is reported. The
background class is shown and never averaged.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Self

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, UNLABELLED, Taxonomy

EVALUATOR_VERSION = "1.0"
"""Changes whenever the same predictions could get another score."""

MEANS = {"mIoU": "iou", "mCA": "ca", "mCA_tn": "ca_tn"}
"""Every mean of a result, and the figure per class that it averages."""

RESULT_KEYS = (
    *MEANS,
    *("confusion", "points", "ignored", "classes_averaged"),
    # of `submission.score_predictions`
    *("per_lidar", "conditions", "intervals", "calibration", "samples", "submission"),
)
"""The keys of a result beside the names of the classes."""

_CHUNK = 1 << 22  # points that one thread counts at a time, in 1 to 4 ms
_BLOCK = 1 << 14  # points packed at a time: they stay in the first cache
_FEW = 1 << 15  # below this many points the tables of the packed way cost more than counting
_MOST_PACKED = 14  # classes that fit half a byte beside "not scored" and "no class"


class Evaluator:
    """Count labelled points against predicted ones, and score them.

    Parameters
    ----------
    taxonomy
        The C classes; its background enters no mean.

    Raises
    ------
    InvalidInputError
        If a class has the name of another key of the result.

    Examples
    --------
    >>> evaluator = Evaluator()
    >>> evaluator.update([[1, 1, 9]], [[1, 9, 9]]).compute()["Chair"]["iou"]
    0.5
    """

    def __init__(self, taxonomy: Taxonomy = SEMANTIC2D) -> None:
        taken = sorted(set(taxonomy.names) & set(RESULT_KEYS))
        if taken:
            raise InvalidInputError(f"no class can be called {', '.join(taken)}: rename it")
        self.taxonomy = taxonomy
        self.confusion: NDArray[np.int64] = np.zeros((len(taxonomy),) * 2, np.int64)
        self.ignored = 0

    def update(
        self, truth: ArrayLike, prediction: ArrayLike, valid: ArrayLike | None = None
    ) -> Self:
        """Count points.

        Parameters
        ----------
        truth
            Class ids of any shape and integer dtype (u1 is fastest); 255 is not scored.
        prediction
            Class ids of the same shape.
        valid
            Bool of the same shape, or None for all: points where it is False are not scored,
            whatever truth and prediction hold there.

        Returns
        -------
        Evaluator
            This one.

        Raises
        ------
        InvalidInputError
            If shapes or dtypes do not fit, or a scored point holds an id that is no class.
            Nothing of the call is counted then.
        """
        t, p, v = _check_arrays(truth, prediction, valid)
        classes = len(self.taxonomy)
        if t.dtype != np.uint8 or p.dtype != np.uint8:
            _refuse_wrong_ids(t, p, v, classes)  # so the cast changes only what is not scored
        bytes_t, bytes_p = (ids.astype(np.uint8, copy=False).ravel() for ids in (t, p))
        counted, ignored = _count(bytes_t, bytes_p, None if v is None else v.ravel(), classes)
        if counted.sum() + ignored != t.size:
            _refuse_wrong_ids(t, p, v, classes)
        self.confusion += counted
        self.ignored += ignored
        return self

    def merge(self, other: Evaluator) -> Self:
        """Add what another evaluator of the same taxonomy has counted, and return this one.

        Raises
        ------
        InvalidInputError
            If the taxonomies differ.
        """
        if other.taxonomy != self.taxonomy:
            raise InvalidInputError(
                f"cannot merge scores of different taxonomies: {', '.join(self.taxonomy.names)} "
                f"and {', '.join(other.taxonomy.names)}"
            )
        self.confusion += other.confusion
        self.ignored += other.ignored
        return self

    def compute(self) -> dict[str, Any]:
        """Return the scores of everything counted so far, as plain values for JSON.

        Returns
        -------
        dict
            ``mIoU``, ``mCA``, ``mCA_tn``: means over the classes that have the figure, the
            background left out, as fractions 0 to 1 (None where no class has it); by class
            name, background included, a dict of ``iou``, ``ca``, ``ca_tn`` (fractions, None
            where missing) and ``support`` (points that truth gives the class); ``confusion``,
            C lists of C counts, rows truth; ``points`` scored and points ``ignored``;
            ``classes_averaged``, how many classes entered each mean.
        """
        matrix = self.confusion
        total = int(matrix.sum())
        hits = np.diagonal(matrix).tolist()
        truths, predictions = matrix.sum(axis=1).tolist(), matrix.sum(axis=0).tolist()
        classes = {
            name: _class_scores(hits[c], truths[c], predictions[c], total)
            for c, name in enumerate(self.taxonomy.names)
        }
        scored = [classes[self.taxonomy.names[c]] for c in self.taxonomy.scored_ids]
        present = {
            mean: [figure for scores in scored if (figure := scores[key]) is not None]
            for mean, key in MEANS.items()
        }
        # as scikit-learn rounds it; `sum` rounds otherwise from Python 3.12 on
        means = {mean: float(np.mean(v)) if v else None for mean, v in present.items()}
        return {
            **means,
            **classes,
            "confusion": matrix.tolist(),
            "points": total,
            "ignored": self.ignored,
            "classes_averaged": {mean: len(values) for mean, values in present.items()},
        }


def class_names(result: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the class names of a result, in the order of their ids."""
    return tuple(
        key
        for key, value in result.items()
        if key not in RESULT_KEYS and isinstance(value, Mapping) and "iou" in value
    )


def format_table(result: Mapping[str, Any]) -> str:
    """Lay a result out as a text table: percent by class, means, and what was not scored."""
    names = class_names(result)
    width = max(len(name) for name in (*names, "Mean"))
    header = f"{'':{width}}  {'IoU':>7} {'CA':>7} {'CA_tn':>7} {'points':>12}"
    rows = [_table_row(name, result[name], width) for name in names]
    means = {key: result[mean] for mean, key in MEANS.items()}
    averaged = result["classes_averaged"]
    counts = ", ".join(f"{mean} {averaged[mean]}" for mean in MEANS)
    return "\n".join(
        (
            header,
            *rows,
            _table_row("Mean", {**means, "support": result["points"]}, width),
            f"In percent. Classes averaged: {counts}; the background never is.",
            "CA is recall, as in the published tables; CA_tn is the published equation.",
            f"Not scored (no return or no label): {result['ignored']:,} points.",
        )
    )


def percent(fraction: float | None) -> str:
    """Write a fraction as percent with two digits, or ``-`` where there is none."""
    return "-" if fraction is None else f"{100 * fraction:.2f}"


def _table_row(name: str, scores: Mapping[str, Any], width: int) -> str:
    figures = " ".join(f"{percent(scores[key]):>7}" for key in MEANS.values())
    return f"{name:{width}}  {figures} {scores['support']:>12,}"


def _class_scores(hits: int, truth: int, predicted: int, total: int) -> dict[str, float | None]:
    """Scores of one class from TP, TP + FN, TP + FP and all."""
    union = truth + predicted - hits
    return {
        "iou": hits / union if union else None,
        "ca": hits / truth if truth else None,
        "ca_tn": (total - union + hits) / total if truth else None,
        "support": truth,
    }


def _check_arrays(
    truth: ArrayLike, prediction: ArrayLike, valid: ArrayLike | None
) -> tuple[NDArray[np.integer], NDArray[np.integer], NDArray[np.bool_] | None]:
    t, p = np.asarray(truth), np.asarray(prediction)
    v = None if valid is None else np.asarray(valid)
    for name, array in (("truth", t), ("prediction", p)):
        if array.dtype.kind not in "iu":
            raise InvalidInputError(f"{name}: expected integer class ids, found {array.dtype}")
    if v is not None and v.dtype != np.bool_:
        raise InvalidInputError(f"valid: expected bool, found {v.dtype}")
    if t.shape != p.shape or (v is not None and v.shape != t.shape):
        shapes = f"truth {t.shape}, prediction {p.shape}"
        shapes += "" if v is None else f", valid {v.shape}"
        raise InvalidInputError(f"expected arrays of one shape, found {shapes}")
    return t, p, v


def _refuse_wrong_ids(
    truth: NDArray[np.integer],
    prediction: NDArray[np.integer],
    valid: NDArray[np.bool_] | None,
    classes: int,
) -> None:
    """Raise for the first scored point whose truth or prediction is no class."""
    scored = truth != UNLABELLED if valid is None else valid & (truth != UNLABELLED)
    for name, ids in (("truth", truth), ("prediction", prediction)):
        wrong = scored & ((ids < 0) | (ids >= classes))
        if wrong.any():
            where = tuple(int(i) for i in np.argwhere(wrong)[0])
            also = ", or 255 for no label" if name == "truth" else ""
            raise InvalidInputError(
                f"{name}{list(where)}: expected a class id 0 to {classes - 1}{also}, "
                f"found {int(ids[where])} (at {int(wrong.sum())} scored points in all)"
            )


def _count(
    truth: NDArray[np.uint8],
    prediction: NDArray[np.uint8],
    valid: NDArray[np.bool_] | None,
    classes: int,
) -> tuple[NDArray[np.int64], int]:
    """Count pairs of flat id arrays: confusion (C, C), and how many are not scored.

    Points with ids that are no class are in neither. Chunks go to plain threads (the kernels
    hold no interpreter lock): numba's own threads abort a process that forks later, as data
    loaders do.
    """
    packed = classes <= _MOST_PACKED and truth.size >= _FEW
    count = _count_packed if packed else _count_any

    def count_chunk(start: int) -> tuple[NDArray[np.int64], int]:
        part = slice(start, start + _CHUNK)
        scored = None if valid is None else valid[part]
        return count(truth[part], prediction[part], scored, classes)

    starts = range(0, max(truth.size, 1), _CHUNK)
    if len(starts) == 1:
        return count_chunk(0)
    with ThreadPoolExecutor(min(len(starts), os.cpu_count() or 1)) as pool:
        counts = list(pool.map(count_chunk, starts))
    return sum((part for part, _ in counts), np.zeros_like(counts[0][0])), sum(n for _, n in counts)


def _count_any(
    truth: NDArray[np.uint8],
    prediction: NDArray[np.uint8],
    valid: NDArray[np.bool_] | None,
    classes: int,
) -> tuple[NDArray[np.int64], int]:
    rows = truth if valid is None else np.where(valid, truth, np.uint8(UNLABELLED))
    pairs = (rows.astype(np.uint16) << 8) | prediction
    table = np.bincount(pairs, minlength=1 << 16).reshape(256, 256)
    return table[:classes, :classes], int(table[UNLABELLED].sum())


def _count_packed(
    truth: NDArray[np.uint8],
    prediction: NDArray[np.uint8],
    valid: NDArray[np.bool_] | None,
    classes: int,
) -> tuple[NDArray[np.int64], int]:
    neighbours = np.zeros((2, 1 << 16), np.uint32)
    last = np.zeros(256, np.int64)
    _count_neighbours(truth, prediction, valid, neighbours, last)
    both = neighbours.sum(axis=0, dtype=np.int64).reshape(256, 256)
    table = (both.sum(axis=0) + both.sum(axis=1) + last).reshape(16, 16)
    return table[1 : classes + 1, :classes], int(table[0].sum())


@numba.njit(cache=True, nogil=True)
def _count_neighbours(
    truth: NDArray[np.uint8],
    prediction: NDArray[np.uint8],
    valid: NDArray[np.bool_] | None,
    neighbours: NDArray[np.uint32],
    last: NDArray[np.int64],
) -> None:
    """Pack each point into a byte, and count bytes two at a time, as one 16 bit number.

    There are two histograms, in turn, so that equal numbers do not wait for each other's store.
    """
    keys = np.empty(_BLOCK, np.uint8)
    for start in range(0, truth.size, _BLOCK):
        size = min(_BLOCK, truth.size - start)
        stop = start + size
        scored = None if valid is None else valid[start:stop]
        _pack(truth[start:stop], prediction[start:stop], scored, keys[:size])
        two = keys[: size - size % 2].view(np.uint16)
        for i in range(two.size):
            neighbours[i & 1, two[i]] += np.uint32(1)
        if size % 2:
            last[keys[size - 1]] += 1


@numba.njit(cache=True, nogil=True)
def _pack(
    truth: NDArray[np.uint8],
    prediction: NDArray[np.uint8],
    valid: NDArray[np.bool_] | None,
    keys: NDArray[np.uint8],
) -> None:
    """Pack ids into 16 * row + column: row 0 not scored, else truth + 1; at most 15 each.

    Free of branches, so that the compiler handles 64 points at a time.
    """
    for i in range(keys.size):
        row = np.uint8(truth[i] + np.uint8(1))  # 255 becomes 0
        if valid is not None:
            row = row if valid[i] else np.uint8(0)
        row = min(row, np.uint8(15))
        keys[i] = np.uint8(row << np.uint8(4)) | min(prediction[i], np.uint8(15))
