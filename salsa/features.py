"""Stable features: the points of a scan that lie on lines (paper, SALSA, step 1)."""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


def points_near_lines(
    points: Float,
    segments: NDArray[np.float32],
    offsets: NDArray[np.int64],
    *,
    distance: float = 0.3,
    margin: float = 1.0,
) -> NDArray[np.bool_]:
    """Tell which points lie near a segment of their scan: the paper's stable features.

    Parameters
    ----------
    points
        (N, B, 2) f8 in m, lidar frame; NaN is near nothing.
    segments, offsets
        As `semantic2d_dataset.scene.lines.extract_lines` returns them.
    distance, margin
        Largest distance from the segment's infinite line and from its box, m. (Published: 0.3, 1.)

    Returns
    -------
    (N, B) bool.
    """
    near = np.zeros(points.shape[:2], np.bool_)
    _mark_near(points, segments, offsets, distance, margin, near)
    return near


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _mark_near(
    points: Float,
    segments: NDArray[np.float32],
    offsets: NDArray[np.int64],
    distance: float,
    margin: float,
    near: NDArray[np.bool_],
) -> None:
    for n in numba.prange(points.shape[0]):
        for m in range(offsets[n], offsets[n + 1]):
            x1, y1, x2, y2 = segments[m]
            length = math.sqrt((x2 - x1) ** 2 + (y2 - y1) ** 2)
            if not length > 0:
                continue
            nx, ny = (y1 - y2) / length, (x2 - x1) / length
            for k in range(points.shape[1]):
                x, y = points[n, k, 0], points[n, k, 1]
                inside = (
                    min(x1, x2) - margin <= x <= max(x1, x2) + margin
                    and min(y1, y2) - margin <= y <= max(y1, y2) + margin
                    and abs((x - x1) * nx + (y - y1) * ny) <= distance
                )
                near[n, k] = near[n, k] or inside
