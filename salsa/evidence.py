"""What a recording says of each place: how long something was there, and how long nothing was.

A beam that ends in a cell says that something stands there, one that goes on beyond it that
nothing does. Both are counted in seconds, so that neither the rate of the lidar nor the distance
weighs: what stays is hit whenever it is looked at, and where people walk the lidar mostly sees
through.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Self

import numba
import numpy as np
from numpy.typing import NDArray

from salsa.fields import MapField
from salsa.registration import beams_of
from semantic2d_dataset.scene.geometry import compose, invert
from semantic2d_dataset.scene.scans import ScanBatch

Float = NDArray[np.float64]
Counts = NDArray[np.int32]

CELL_M = 0.05
"""Finer maps are counted in cells of about this size: a leg is seen as several of them."""

_SECOND_NS = 1_000_000_000
_STEP = 0.7  # of a cell, along a beam
_SHORT_M = 0.2  # before its end, where a beam no longer says that nothing is there
_STRIDE_RAD = math.radians(0.5)  # beams nearer to each other see through the same cells


@dataclass(frozen=True)
class Evidence:
    """Counts for the K cells of a coarse grid that any beam met.

    Parameters
    ----------
    cells
        (K,) i8 flat indices, increasing.
    hits
        (K,) i4 beams that ended in the cell.
    seconds, passes
        (K,) i4 seconds in which a beam ended in it, and in which one passed through.
    offsets
        (K, 2) f8 sum of where in the cell the beams ended: x, y from its middle, in cells.
    """

    cells: NDArray[np.int64]
    hits: Counts
    seconds: Counts
    passes: Counts
    offsets: Float


def coarse(field: MapField) -> tuple[int, tuple[int, int]]:
    """Return how many cells of the map an edge of a coarse cell has, and how many these are."""
    ratio = max(round(CELL_M / field.resolution), 1)
    rows, columns = field.distance_m.shape
    return ratio, (-(-rows // ratio), -(-columns // ratio))


def gather(
    batch: ScanBatch, poses: Float, accepted: NDArray[np.bool_], field: MapField
) -> Evidence:
    """Count what N scans in the order of time met; poses (N, 3) are those of the base.

    Only scans that are accepted (N,) count. Of each second, all scans say where something is, and
    the first one where nothing is.
    """
    ratio, shape = coarse(field)
    beams = beams_of(batch, batch.valid & accepted[:, None])
    in_grid = compose(invert(field.origin.as_array()), poses)
    seconds = batch.stamps_ns // _SECOND_NS
    counts = np.zeros((5, *shape), np.int32)
    offsets = np.zeros((*shape, 2))
    relative = (seconds - seconds[:1] + 1).astype(np.int32)
    stride = max(round(_STRIDE_RAD / batch.lidar.angle_increment), 1)
    _count(*beams, in_grid, relative, field.resolution * ratio, stride, counts, offsets)
    hits, held, _, passed, _ = counts
    cells = np.flatnonzero((hits > 0) | (passed > 0))
    at = np.unravel_index(cells, shape)
    return Evidence(cells, hits[at], held[at], passed[at], offsets[at])


class Ledger:
    """Adds evidence up, block after block; memory is that of the coarse grid.

    Parameters
    ----------
    shape
        Rows and columns of the coarse grid.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self.hits = np.zeros(shape, np.int64)
        self.seconds = np.zeros(shape, np.int32)
        self.passes = np.zeros(shape, np.int32)
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
    seconds: Counts,
    cell_m: float,
    stride: int,
    counts: Counts,
    offsets: Float,
) -> None:
    """Add to counts (5, H, W): hits, seconds hit, last of these, seconds passed, last of these."""
    hits, held, held_last, passed, passed_last = counts
    rows, columns = hits.shape
    before = 0
    for n in range(ranges.shape[0]):
        if not use[n].any():
            continue
        cos, sin = np.cos(poses[n, 2]) / cell_m, np.sin(poses[n, 2]) / cell_m
        x0 = poses[n, 0] / cell_m + cos * offset[0] - sin * offset[1]
        y0 = poses[n, 1] / cell_m + sin * offset[0] + cos * offset[1]
        looks_through = seconds[n] != before
        before = seconds[n]
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
                offsets[row, column, 0] += x - column - 0.5
                offsets[row, column, 1] += y - row - 0.5
                if held_last[row, column] != seconds[n]:
                    held_last[row, column] = seconds[n]
                    held[row, column] += 1
            if looks_through and k % stride == 0:
                for step in range(int((r - _SHORT_M) / (_STEP * cell_m))):
                    along = step * _STEP * cell_m
                    column, row = int(np.floor(x0 + along * dx)), int(np.floor(y0 + along * dy))
                    inside = 0 <= row < rows and 0 <= column < columns
                    if inside and passed_last[row, column] != seconds[n]:
                        passed_last[row, column] = seconds[n]
                        passed[row, column] += 1
