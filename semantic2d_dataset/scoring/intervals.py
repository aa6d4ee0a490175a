"""How far a score could be off, and whether two submissions differ: resampled blocks of time.

Scans 50 ms apart see the same things, so that points and scans are no independent draws. Blocks
of 10 s of a recording, with all lidars, are resampled instead:

- an interval holds the middle 95 % of the scores of samples of as many blocks, drawn with
  replacement (percentile bootstrap over blocks: Efron and Tibshirani 1993, chapters 8 and 13);
- two submissions are compared on the same drawn blocks; the p-value is that of a permutation
  test which swaps the two in every block with probability one half: the share of swaps whose
  scores lie at least as far apart as those found.

Few blocks (below about 20) make intervals too narrow; a result says how many there were.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.taxonomy import Taxonomy
from semantic2d_dataset.scoring.tallies import WINDOW_NS, Tally, Window

DRAWS = 2000
LEVEL = 0.95

_AT_ONCE = 250  # draws
_SCORES = ("mIoU", "mCA")
Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Blocks:
    """Confusion (n, C, C) i8 of every block of time, in the order of the blocks."""

    windows: tuple[Window, ...]
    confusion: NDArray[np.int64]
    taxonomy: Taxonomy


def blocks_of(tallies: Iterable[Tally]) -> Blocks:
    """Add up, over lidars, what was counted in each block of time."""
    found: dict[Window, NDArray[np.int64]] = {}
    taxonomy = None
    for tally in tallies:
        taxonomy = tally.evaluator.taxonomy
        for window, confusion in tally.windows.items():
            found[window] = found[window] + confusion if window in found else confusion
    if taxonomy is None:
        raise InvalidInputError("expected at least one sequence, found none")
    windows = tuple(sorted(found))
    return Blocks(windows, np.stack([found[window] for window in windows]), taxonomy)


def intervals(blocks: Blocks, *, draws: int = DRAWS, seed: int = 0) -> dict[str, Any]:
    """Return confidence intervals of the scores of a submission.

    Parameters
    ----------
    blocks
        What was counted, by block.
    draws, seed
        How many samples of blocks, and their seed.

    Returns
    -------
    dict
        ``level``, ``draws``, ``seed``, number of ``blocks`` and their length ``block_s``;
        ``mIoU`` and ``mCA``: low and high, fractions; in ``classes`` those of each IoU. None
        where a score is missing, or there are fewer than two blocks.
    """
    drawn = _score_draws(blocks, _weights(len(blocks.windows), draws, seed))
    return _about(blocks, draws, seed) | _by_score(drawn, blocks)


def compare_blocks(a: Blocks, b: Blocks, *, draws: int = DRAWS, seed: int = 0) -> dict[str, Any]:
    """Compare two submissions on the same blocks.

    Returns
    -------
    dict
        As `intervals` says; each score is a dict of ``a``, ``b``, their ``difference`` (b - a),
        its ``interval`` (low, high) and the ``p`` value, fractions, None where there is none.

    Raises
    ------
    InvalidInputError
        If the blocks are not the same.
    """
    same = [len(part.confusion[0]) for part in (a, b)]
    if a.windows != b.windows or same[0] != same[1] or a.taxonomy != b.taxonomy:
        raise InvalidInputError("only submissions for the same scans and classes can be compared")
    if not (a.confusion.sum(axis=2) == b.confusion.sum(axis=2)).all():
        raise InvalidInputError("the two submissions were scored against different labels")
    weights = _weights(len(a.windows), draws, seed)
    drawn = _score_draws(b, weights) - _score_draws(a, weights)
    swapped = _swapped_differences(a, b, draws, seed)
    totals = [_scores(part.confusion.sum(axis=0)[None], part.taxonomy)[0] for part in (a, b)]
    rows = [
        _compare(own, other, drawn[:, i], swapped[:, i], enough=len(a.windows) > 1)
        for i, (own, other) in enumerate(zip(*totals, strict=True))
    ]
    return _about(a, draws, seed) | _named(rows, a.taxonomy)


def _weights(blocks: int, draws: int, seed: int) -> NDArray[np.int64]:
    """How often each block is drawn, (draws, blocks)."""
    rng = np.random.default_rng(seed)
    return rng.multinomial(blocks, np.full(blocks, 1 / blocks), draws)


def _score_draws(blocks: Blocks, weights: NDArray[np.int64]) -> Float:
    """Scores (draws, 2 + C) of weighted sums of blocks: of integers, so exact in any order."""
    flat = blocks.confusion.reshape(len(blocks.windows), -1).astype(np.float64)
    shape = blocks.confusion.shape[1:]
    parts = (weights[i : i + _AT_ONCE] for i in range(0, len(weights), _AT_ONCE))
    return np.concatenate(
        [_scores((part @ flat).reshape(-1, *shape), blocks.taxonomy) for part in parts]
    )


def _swapped_differences(a: Blocks, b: Blocks, draws: int, seed: int) -> Float:
    """Differences (draws, 2 + C) of the scores of two submissions that swap blocks."""
    swaps = np.random.default_rng((seed, 1)).integers(0, 2, (draws, len(a.windows)))
    one = _score_swapped(a, b, swaps)
    return _score_swapped(b, a, swaps) - one


def _score_swapped(own: Blocks, other: Blocks, swaps: NDArray[np.int64]) -> Float:
    both = np.concatenate((own.confusion, other.confusion))
    windows = (*own.windows, *other.windows)
    return _score_draws(
        Blocks(windows, both, own.taxonomy), np.concatenate((1 - swaps, swaps), axis=1)
    )


def _scores(confusion: NDArray[Any], taxonomy: Taxonomy) -> Float:
    """mIoU, mCA and the IoU of every class, (D, 2 + C), NaN where missing, of (D, C, C)."""
    counts = np.asarray(confusion, np.float64)
    hits = np.diagonal(counts, axis1=1, axis2=2)
    truths, predictions = counts.sum(axis=2), counts.sum(axis=1)
    iou, ca = _ratio(hits, truths + predictions - hits), _ratio(hits, truths)
    scored = list(taxonomy.scored_ids)
    means = np.stack([_mean(figures[:, scored]) for figures in (iou, ca)], axis=1)
    return np.concatenate((means, iou), axis=1)


def _ratio(part: Float, whole: Float) -> Float:
    return np.divide(part, whole, out=np.full_like(part, np.nan), where=whole > 0)


def _mean(figures: Float) -> Float:
    """Mean over those that are there, (D,) of (D, n)."""
    return _ratio(np.nansum(figures, axis=1), np.isfinite(figures).sum(axis=1).astype(np.float64))


def _by_score(drawn: Float, blocks: Blocks) -> dict[str, Any]:
    enough = len(blocks.windows) > 1
    return _named([_limits(column) if enough else None for column in drawn.T], blocks.taxonomy)


def _named(rows: list[Any], taxonomy: Taxonomy) -> dict[str, Any]:
    count = len(_SCORES)
    means = dict(zip(_SCORES, rows[:count], strict=True))
    return means | {"classes": dict(zip(taxonomy.names, rows[count:], strict=True))}


def _limits(drawn: Float) -> list[float] | None:
    there = drawn[np.isfinite(drawn)]
    if not there.size:
        return None
    return np.quantile(there, ((1 - LEVEL) / 2, (1 + LEVEL) / 2)).tolist()  # type: ignore[no-any-return]


def _compare(
    a: float, b: float, drawn: Float, swapped: Float, *, enough: bool
) -> Mapping[str, Any]:
    found = b - a
    if not np.isfinite(found):
        a_or_none, b_or_none = (None if np.isnan(value) else float(value) for value in (a, b))
        return {"a": a_or_none, "b": b_or_none, "difference": None, "interval": None, "p": None}
    farther = np.abs(swapped[np.isfinite(swapped)]) >= abs(found) - 1e-12
    return {
        "a": float(a),
        "b": float(b),
        "difference": float(found),
        "interval": _limits(drawn) if enough else None,
        # the labelling that was found is one of those that could have been
        "p": float((1 + farther.sum()) / (1 + farther.size)) if enough else None,
    }


def _about(blocks: Blocks, draws: int, seed: int) -> dict[str, Any]:
    return {
        "level": LEVEL,
        "draws": draws,
        "seed": seed,
        "blocks": len(blocks.windows),
        "block_s": WINDOW_NS / 1e9,
    }
