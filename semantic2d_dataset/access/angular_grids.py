"""Scans of any lidar at the bearings of one grid, every value as it was measured."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.access.bearings import NO_BEAM, level_mount, nearest_of
from semantic2d_dataset.access.registry import OpenDataset
from semantic2d_dataset.access.scan_source import ScanSource
from semantic2d_dataset.access.transforms import sees_all_around
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.scene.lidars import LidarSpec
from semantic2d_dataset.scene.taxonomy import UNLABELLED

_UNSEEN = {"ranges": np.nan, "intensities": 0.0, "labels": UNLABELLED}


@dataclass(frozen=True)
class AngularGrid:
    """Bearings that scans of several lidars are brought to, in the directions of the base.

    Parameters
    ----------
    beams
        How many.
    angle_min
        The first bearing, rad, from the base's x axis; they run counter-clockwise.
    angle_increment
        The step between them, rad.
    """

    beams: int
    angle_min: float
    angle_increment: float

    def spec_of(self, lidar: LidarSpec) -> LidarSpec:
        """Return a lidar as if it had the grid's beams: where it stands, turned to the base.

        Raises
        ------
        InvalidInputError
            If the grid's numbers make no lidar.
        """
        mount = (*lidar.base_T_lidar[:3], 0.0, 0.0, 0.0)
        return replace(
            lidar,
            beams=self.beams,
            angle_min=self.angle_min,
            angle_increment=self.angle_increment,
            base_T_lidar=mount,
        )


def common_grid(
    lidars: Sequence[LidarSpec], field: Literal["intersection", "union"] = "intersection"
) -> AngularGrid:
    """Return the grid of several lidars, with the step of the coarsest: no beam is used twice.

    Parameters
    ----------
    lidars
        At least one.
    field
        ``intersection``: the bearings that each lidar sees; ``union``: those that any sees.

    Raises
    ------
    InvalidInputError
        If the lidars see no bearing in common, or one is not mounted level.
    """
    step = max(lidar.angle_increment for lidar in lidars)
    arcs = [_arc_of(lidar) for lidar in lidars if not sees_all_around(lidar)]
    if not arcs or (field == "union" and len(arcs) < len(lidars)):
        return _circle(step)
    first = arcs[0][0]
    centres = np.array([first + math.remainder(centre - first, 2 * math.pi) for centre, _ in arcs])
    halves = np.array([half for _, half in arcs])
    if field == "union":
        low, high = (centres - halves).min(), (centres + halves).max()
    else:
        low, high = (centres - halves).max(), (centres + halves).min()
    if high - low > 2 * math.pi - step:
        return _circle(step)
    beams = math.floor((high - low) / step + 1e-3) + 1
    if beams < 2:
        names = ", ".join(lidar.name for lidar in lidars)
        raise InvalidInputError(f"{names}: see no bearing in common; take field='union'")
    middle = math.remainder((low + high) / 2, 2 * math.pi)
    return AngularGrid(beams, middle - step * (beams - 1) / 2, step)


class GridSource(ScanSource):
    """Scans that are read at the bearings of a grid; `lidar` has the grid's beams.

    Each of the grid's beams holds what the lidar's beam nearest in bearing measured, its label
    too. Where the lidar does not look, ranges are NaN, intensities 0 and labels 255.

    Parameters
    ----------
    data
        An open data set.
    grid
        The bearings.
    in_memory, options
        As for `ScanSource`.

    Raises
    ------
    InvalidInputError
        If the lidar is not mounted level, besides what `ScanSource` raises.
    """

    def __init__(
        self, data: OpenDataset, *, grid: AngularGrid, in_memory: bool | None = None, **options: Any
    ) -> None:
        super().__init__(data, in_memory=False, **options)
        measured, self.lidar = self.lidar, grid.spec_of(self.lidar)
        self._nearest = nearest_of(self.lidar, measured)
        self._keep(in_memory=in_memory)

    def _read(
        self, reader: SequenceReader, name: str, start: int, stop: int | None
    ) -> NDArray[Any]:
        values = super()._read(reader, name, start, stop)
        if name not in _UNSEEN:
            return values
        found = np.take(values, np.maximum(self._nearest, 0), axis=1)
        found[:, self._nearest == NO_BEAM] = _UNSEEN[name]
        return found


def _arc_of(lidar: LidarSpec) -> tuple[float, float]:
    """Return the middle of a field of view in the base, and half its width, rad."""
    rotation, _ = level_mount(lidar)
    middle = (lidar.bearings[0] + lidar.bearings[-1]) / 2
    x, y = rotation @ (math.cos(middle), math.sin(middle))
    return math.atan2(y, x), float(lidar.bearings[-1] - middle)


def _circle(step: float) -> AngularGrid:
    beams = math.floor(2 * math.pi / step + 1e-3)
    return AngularGrid(beams, -math.pi, 2 * math.pi / beams)
