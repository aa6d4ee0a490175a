"""People who stand: two round legs side by side, told from furniture by their shape.

Sizes are those of clothed lower legs with room for trousers and for a stance at ease.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Float = NDArray[np.float64]

RADIUS_M = (0.035, 0.095)  # of a leg
GAP_M = (0.15, 0.45)  # between the middles of two legs
ROUND_M = 0.02  # largest rms distance of its points from the circle
_FEWEST_POINTS = 4
_MEANS_STEPS = 8


@dataclass(frozen=True)
class Outline:
    """What was seen of one thing: points (P, 2) in m, each weighted (P,) by its hits."""

    points: Float
    weights: Float


def find_standing(outlines: list[Outline]) -> NDArray[np.bool_]:
    """Tell which outlines (K,) are legs of somebody who stands.

    Two outlines that are a leg each, side by side, are a person. So is one that falls into two
    parts, one of them a leg and the other as small as one: what is seen between legs blurs them.
    """
    pairs = [_is_pair(*_halves(outline)) for outline in outlines]
    standing = np.array(pairs, np.bool_)
    middles = np.array([_leg(outline) for outline in outlines]).reshape(-1, 2)
    legs = np.flatnonzero(np.isfinite(middles).all(axis=-1))
    if len(legs) > 1:
        tree = cKDTree(middles[legs])
        beside = tree.query_pairs(GAP_M[1], output_type="ndarray")
        gaps = np.hypot(*(middles[legs[beside[:, 0]]] - middles[legs[beside[:, 1]]]).T)
        standing[legs[beside[gaps >= GAP_M[0]]]] = True
    return standing


def fit_circle(points: Float, weights: Float) -> tuple[Float, float, float]:
    """Fit a circle to points (P, 2): algebraic least squares (Kasa 1976).

    Returns
    -------
    middle, radius, error
        (2,) m, m, and the weighted rms distance of the points from the circle, m.
    """
    share = weights / weights.sum()
    mean = share @ points
    p = points - mean
    root = np.sqrt(share)[:, None]
    design = np.column_stack((p, np.ones(len(p))))
    a, b, c = np.linalg.lstsq(design * root, (p**2).sum(axis=1) * root[:, 0], rcond=None)[0]
    middle = np.array((a, b)) / 2
    radius = float(np.sqrt(max(c + middle @ middle, 0.0)))
    errors = np.hypot(*(p - middle).T) - radius
    return mean + middle, radius, float(np.sqrt(share @ errors**2))


def principal_axis(outline: Outline) -> Float:
    """Return where the points lie along the longest direction of an outline, (P,) m from 0."""
    share = outline.weights / outline.weights.sum()
    p = outline.points - share @ outline.points
    _, axes = np.linalg.eigh((p * share[:, None]).T @ p)
    along: Float = p @ axes[:, -1]
    return along


def _leg(outline: Outline) -> Float:
    """Return the middle (2,) of an outline that is a leg, NaN of any other."""
    if len(outline.points) >= _FEWEST_POINTS:
        middle, radius, error = fit_circle(outline.points, outline.weights)
        if RADIUS_M[0] <= radius <= RADIUS_M[1] and error < ROUND_M:
            return middle
    return np.full(2, np.nan)


def _halves(outline: Outline) -> tuple[Outline, Outline]:
    """Divide an outline into the two parts that are most compact: two means."""
    first = principal_axis(outline) > 0
    for _ in range(_MEANS_STEPS):
        if first.all() or not first.any():
            break
        middles = [
            np.average(outline.points[part], axis=0, weights=outline.weights[part])
            for part in (first, ~first)
        ]
        near, far = (np.hypot(*(outline.points - middle).T) for middle in middles)
        if ((near < far) == first).all():
            break
        first = near < far
    return tuple(Outline(outline.points[part], outline.weights[part]) for part in (first, ~first))  # type: ignore[return-value]


def _is_pair(first: Outline, second: Outline) -> bool:
    if not (len(first.points) and len(second.points)):
        return False
    legs = _leg(first), _leg(second)
    middles = [
        leg if np.isfinite(leg).all() else _middle_of_small(part)
        for leg, part in zip(legs, (first, second), strict=True)
    ]
    gap = np.hypot(*(middles[0] - middles[1]))
    return bool(np.isfinite(legs).all(axis=-1).any() and GAP_M[0] <= gap <= GAP_M[1])


def _middle_of_small(outline: Outline) -> Float:
    """Return the middle (2,) of an outline no larger than a leg, NaN of any other."""
    if np.ptp(principal_axis(outline)) > 2 * RADIUS_M[1]:
        return np.full(2, np.nan)
    middle: Float = np.average(outline.points, axis=0, weights=outline.weights)
    return middle
