"""Unmapped things that stay: told from people by how long they are seen at one place."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from salsa.fields import MapField
from salsa.registration import base_points, beams_of
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.geometry import compose, invert
from semantic2d_dataset.scene.scans import ScanBatch

Float = NDArray[np.float64]

_SECOND_NS = 1_000_000_000


@dataclass(frozen=True)
class Persistence:
    """When something in free space is a thing and not a person.

    People who stand still for as long are taken for things too: the pass is for recordings in
    which nobody does, or places that hold much that the map does not.

    Parameters
    ----------
    min_seconds
        In more than this many seconds, together, the cell was hit.
    min_hits
        More points than this fell into the cell.
    """

    min_seconds: int = 20
    min_hits: int = 150

    def __post_init__(self) -> None:
        if self.min_seconds < 1 or self.min_hits < 1:
            raise InvalidInputError(f"persistence limits must be above 0, found {self}")


class HitCounter:
    """Count, per cell of a map, the points in free space and the seconds in which they fell.

    Memory is that of the map, however long the recording.

    Parameters
    ----------
    field
        The map.
    object_m
        Points this near to an object belong to it, m.
    """

    def __init__(self, field: MapField, object_m: float) -> None:
        self.field = field
        self._open = field.free & (field.distance_m > object_m)
        self._hits = np.zeros(field.free.shape, np.int32)
        self._seconds = np.zeros(field.free.shape, np.int32)
        self._last = np.full(field.free.shape, np.iinfo(np.int64).min)

    def add(self, batch: ScanBatch, poses: Float, accepted: NDArray[np.bool_]) -> None:
        """Count the points of the accepted scans; poses (N, 3) are those of the base."""
        _count(
            *beams_of(batch, batch.valid & accepted[:, None]),
            compose(invert(self.field.origin.as_array()), poses),
            batch.stamps_ns // _SECOND_NS,
            self.field.resolution,
            self._open,
            self._hits,
            self._seconds,
            self._last,
        )

    def without_static(self, persistence: Persistence) -> tuple[MapField, int]:
        """Return the field with places of persistent things not free, and how many cells they are.

        The cells around them are taken too: the edges of things are hit less often.
        """
        static = (self._hits > persistence.min_hits) & (self._seconds > persistence.min_seconds)
        around = ndimage.binary_dilation(static, np.ones((3, 3), np.bool_))
        return replace(self.field, free=self.field.free & ~around), int(static.sum())


@numba.njit(cache=True)
def _count(
    ranges: NDArray[np.float32],
    use: NDArray[np.bool_],
    directions: Float,
    offset: Float,
    poses: Float,
    seconds: NDArray[np.int64],
    resolution: float,
    is_open: NDArray[np.bool_],
    hits: NDArray[np.int32],
    hit_seconds: NDArray[np.int32],
    last: NDArray[np.int64],
) -> None:
    rows, columns = is_open.shape
    for n in range(ranges.shape[0]):
        points = base_points(ranges[n], use[n], directions, offset)
        c, s = np.cos(poses[n, 2]), np.sin(poses[n, 2])
        for x, y in points:
            column = int(np.floor((poses[n, 0] + c * x - s * y) / resolution))
            row = int(np.floor((poses[n, 1] + s * x + c * y) / resolution))
            if not (0 <= row < rows and 0 <= column < columns and is_open[row, column]):
                continue
            hits[row, column] += 1
            if last[row, column] != seconds[n]:
                last[row, column] = seconds[n]
                hit_seconds[row, column] += 1
