"""What a recording says of each place: how long something was there, and how long nothing was.

A beam that ends in a cell says that something stands there, one that goes on beyond it that
nothing does. Both are counted in looks of a second, so that neither the rate of the lidar nor the
distance weighs: what stays is hit from begin to end of a look, and where people walk, a foot that
rests is gone before the look is over and the lidar sees through in the next.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Self

import numba
import numpy as np
from numpy.typing import NDArray

from salsa.fields import MapField
from salsa.residuals import beams_of
from semantic2d_dataset.scene.geometry import compose, invert
from semantic2d_dataset.scene.scans import ScanBatch

Float = NDArray[np.float64]
Counts = NDArray[np.int32]

CELL_M = 0.05
"""Finer maps are counted in cells of about this size: a leg is seen as several of them."""

LOOK_S = 1.0
"""How long a look takes: a foot of somebody who walks rests for half of it or less."""

_HELD_SHARE = 0.7  # of a look, between its first and its last hit
_STEP = 0.7  # of a cell, along a beam
_SHORT_M = 0.2  # before its end, where a beam no longer says that nothing is there
_STRIDE_RAD = math.radians(0.5)  # beams nearer to each other pass through the same cells


@dataclass(frozen=True)
class Evidence:
    """Counts for the K cells of a coarse grid that any beam met.

    Parameters
    ----------
    cells
        (K,) i8 flat indices, increasing.
    hits
        (K,) i4 beams that ended in the cell.
    met, held, passed
        (K,) i4 looks in which a beam ended in it, in which beams did from begin to end, and in
        whose first scan one passed through it.
    offsets
        (K, 2) f8 sum of where in the cell the beams ended: x, y from its middle, in cells.
    """

    cells: NDArray[np.int64]
    hits: Counts
    met: Counts
    held: Counts
    passed: Counts
    offsets: Float


def coarse(field: MapField) -> tuple[int, tuple[int, int]]:
    """Return how many cells of the map an edge of a coarse cell has, and how many these are."""
    ratio = max(round(CELL_M / field.resolution), 1)
    rows, columns = field.distance_m.shape
    return ratio, (-(-rows // ratio), -(-columns // ratio))


def look_length(stamps_ns: NDArray[np.int64]) -> float:
    """Return how long a look takes, s: a second, or four scans (N,) of a slow lidar."""
    periods = np.diff(stamps_ns / 1e9)
    return max(LOOK_S, 4 * float(np.median(periods)) if len(periods) else 0.0)


def gather(
    batch: ScanBatch,
    poses: Float,
    accepted: NDArray[np.bool_],
    field: MapField,
    *,
    look_s: float = LOOK_S,
) -> Evidence:
    """Count what N scans in the order of time met; poses (N, 3) are those of the base.

    Only scans that are accepted (N,) count.
    """
    ratio, shape = coarse(field)
    beams = beams_of(batch, batch.valid & accepted[:, None])
    in_grid = compose(invert(field.origin.as_array()), poses)
    looks = (batch.stamps_ns - batch.stamps_ns[:1]) / (1e9 * look_s)
    counts = np.zeros((6, *shape), np.int32)
    sums = np.zeros((3, *shape))
    stride = max(round(_STRIDE_RAD / batch.lidar.angle_increment), 1)
    _count(*beams, in_grid, looks, field.resolution * ratio, stride, counts, sums)
    hits, met, held, _, passed, _ = counts
    cells = np.flatnonzero((hits > 0) | (passed > 0))
    at = np.unravel_index(cells, shape)
    offsets = np.stack((sums[0][at], sums[1][at]), axis=-1)
    return Evidence(cells, hits[at], met[at], held[at], passed[at], offsets)


class Ledger:
    """Adds evidence up, block after block; memory is that of the coarse grid.

    Parameters
    ----------
    shape
        Rows and columns of the coarse grid.
    look_s
        How long a look takes, s.
    """

    def __init__(self, shape: tuple[int, int], look_s: float = LOOK_S) -> None:
        self.look_s = look_s
        self.hits = np.zeros(shape, np.int64)
        self.met = np.zeros(shape, np.int32)
        self.held = np.zeros(shape, np.int32)
        self.passed = np.zeros(shape, np.int32)
        self.offsets = np.zeros((*shape, 2))

    def add(self, found: Evidence) -> Self:
        """Add what a block of scans met."""
        at = np.unravel_index(found.cells, self.hits.shape)
        for field in fields(Evidence)[1:]:
            getattr(self, field.name)[at] += getattr(found, field.name)
        return self


@numba.njit(cache=True)
def _count(
    ranges: NDArray[np.float32],
    use: NDArray[np.bool_],
    directions: Float,
    offset: Float,
    poses: Float,
    looks: Float,
    cell_m: float,
    stride: int,
    counts: Counts,
    sums: Float,
) -> None:
    """Add to what is known of each cell; `looks` (N,) is the time in looks.

    `counts` (6, H, W): hits, looks met, looks held, the last look met (its negative number where
    it is held), looks passed, the last of them. `sums` (3, H, W): offsets x and y, and when the
    last look met was first hit.
    """
    hits, met, held, met_last, passed, passed_last = counts
    sum_x, sum_y, since = sums
    rows, columns = hits.shape
    before = 0
    for n in range(ranges.shape[0]):
        if not use[n].any():
            continue
        cos, sin = np.cos(poses[n, 2]) / cell_m, np.sin(poses[n, 2]) / cell_m
        x0 = poses[n, 0] / cell_m + cos * offset[0] - sin * offset[1]
        y0 = poses[n, 1] / cell_m + sin * offset[0] + cos * offset[1]
        look = int(looks[n]) + 1
        first = look != before
        before = look
        for k in range(ranges.shape[1]):
            if not use[n, k]:
                continue
            dx = cos * directions[k, 0] - sin * directions[k, 1]  # cells a metre
            dy = sin * directions[k, 0] + cos * directions[k, 1]
            r = np.float64(ranges[n, k])
            x, y = x0 + r * dx, y0 + r * dy
            column, row = int(np.floor(x)), int(np.floor(y))
            if 0 <= row < rows and 0 <= column < columns:
                hits[row, column] += 1
                sum_x[row, column] += x - column - 0.5
                sum_y[row, column] += y - row - 0.5
                last = met_last[row, column]
                if abs(last) != look:
                    met_last[row, column] = look
                    met[row, column] += 1
                    since[row, column] = looks[n]
                elif last == look and looks[n] - since[row, column] >= _HELD_SHARE:
                    met_last[row, column] = -look
                    held[row, column] += 1
            if first and k % stride == 0:
                way = (r - _SHORT_M) / cell_m  # cells
                _pass_through(x0, y0, dx * cell_m, dy * cell_m, way, look, passed, passed_last)


@numba.njit(cache=True)
def _pass_through(
    x: float,
    y: float,
    dx: float,
    dy: float,
    way: float,
    look: int,
    passed: Counts,
    passed_last: Counts,
) -> None:
    """Count a look for the cells on a beam; start, direction and way are in cells."""
    for step in range(int(way / _STEP)):
        column = int(np.floor(x + step * _STEP * dx))
        row = int(np.floor(y + step * _STEP * dy))
        inside = 0 <= row < passed.shape[0] and 0 <= column < passed.shape[1]
        if inside and passed_last[row, column] != look:
            passed_last[row, column] = look
            passed[row, column] += 1
