"""Walls by geometry: a beam that ends on an extracted line segment is Wall, all else background.

The segments are those of Pfister's weighted line fit (`semantic2d_dataset.scene.lines`). Nothing
is learned, and classes that are all straight cannot be told apart: doors and elevators are Wall
too, and so are the fronts of tables and cupboards.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.geometry import beam_directions
from semantic2d_dataset.scene.lidars import LidarSpec
from semantic2d_dataset.scene.lines import PUBLISHED, LineParameters, extract_lines
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, Taxonomy

Float = NDArray[np.float64]

WALL = "Wall"

ON_LINE_M = 0.06
"""Largest distance of a beam's end from a segment: three of the ranges' standard deviations
(`LineParameters.range_std_dev`), which is the published `outlier_dist` too."""

RANGE_MIN_M = 0.6
"""Nearer returns make no line: the limit that the release's own segments were extracted with."""


def label_walls(
    ranges: ArrayLike,
    lidar: LidarSpec,
    parameters: LineParameters = PUBLISHED,
    *,
    taxonomy: Taxonomy = SEMANTIC2D,
    on_line_m: float = ON_LINE_M,
    range_min_m: float = RANGE_MIN_M,
) -> NDArray[np.uint8]:
    """Label the beams that end on a line of their scan Wall, and the others background.

    Parameters
    ----------
    ranges
        (N, B) in m, as measured.
    lidar
        The sensor, B beams.
    parameters
        Settings of the extraction: `PUBLISHED`, `FAST` or others.
    taxonomy
        Where the ids come from.
    on_line_m
        Largest distance from a segment, sideways and beyond its ends, m.
    range_min_m
        Returns nearer than this, m, make no line; they may lie on one all the same.

    Returns
    -------
    (N, B) u1 class ids.

    Raises
    ------
    InvalidInputError
        If the ranges do not have the lidar's beams, the distance is not above 0, or the taxonomy
        has no Wall.
    """
    r = np.ascontiguousarray(ranges, np.float32)
    if r.ndim != 2 or r.shape[1] != lidar.beams:
        raise InvalidInputError(f"expected ranges (N, {lidar.beams}), found {r.shape}")
    if not (math.isfinite(on_line_m) and on_line_m > 0):
        raise InvalidInputError(f"on_line_m: expected a distance above 0, found {on_line_m}")
    wall = taxonomy.id_of(WALL)
    segments, offsets = extract_lines(
        r,
        lidar.bearings,
        parameters,
        range_min=max(range_min_m, lidar.range_min),
        range_max=lidar.range_max,
    )
    labels = np.full(r.shape, taxonomy.background_id, np.uint8)
    directions = beam_directions(lidar.bearings)
    limits = (float(lidar.range_min), float(lidar.range_max))
    _mark_on_lines(r, directions, limits, segments, offsets, on_line_m, np.uint8(wall), labels)
    return labels


@numba.njit(cache=True, parallel=True)
def _mark_on_lines(
    ranges: NDArray[np.float32],
    directions: Float,
    limits: tuple[float, float],
    segments: NDArray[np.float32],
    offsets: NDArray[np.int64],
    on_line_m: float,
    wall: np.uint8,
    labels: NDArray[np.uint8],
) -> None:
    for n in numba.prange(len(ranges)):
        x, y = _place(ranges[n], directions, limits)
        for s in range(offsets[n], offsets[n + 1]):
            _mark_on_line(x, y, segments[s], on_line_m, wall, labels[n])


@numba.njit(cache=True)
def _place(
    ranges: NDArray[np.float32], directions: Float, limits: tuple[float, float]
) -> tuple[Float, Float]:
    """Return where beams end, m; NaN, which is near nothing, without a return."""
    x, y = np.empty(len(ranges)), np.empty(len(ranges))
    for k in range(len(ranges)):
        r = np.float64(ranges[k])
        if not (r > 0 and limits[0] <= r < limits[1]):
            r = np.float64(np.nan)
        x[k], y[k] = r * directions[k, 0], r * directions[k, 1]
    return x, y


@numba.njit(cache=True)
def _mark_on_line(
    x: Float,
    y: Float,
    segment: NDArray[np.float32],
    on_line_m: float,
    wall: np.uint8,
    labels: NDArray[np.uint8],
) -> None:
    """Label the beams that end near a segment; free of branches, to handle many at a time."""
    x1, y1 = np.float64(segment[0]), np.float64(segment[1])
    dx, dy = segment[2] - x1, segment[3] - y1
    length = math.hypot(dx, dy)
    c, s = dx / length, dy / length
    for k in range(len(x)):
        along = (x[k] - x1) * c + (y[k] - y1) * s
        across = (y[k] - y1) * c - (x[k] - x1) * s
        near = (abs(across) <= on_line_m) & (-on_line_m <= along) & (along <= length + on_line_m)
        labels[k] = wall if near else labels[k]
