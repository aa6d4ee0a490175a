"""Pictures of what SALSA made, to judge it by eye."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from semantic2d_dataset import plotting
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.scene.geometry import compose, invert, to_base, to_points, transform
from semantic2d_dataset.scene.maps import FREE, OCCUPIED, SemanticMap
from semantic2d_dataset.scene.scans import ScanBatch
from semantic2d_dataset.scene.taxonomy import UNLABELLED, Taxonomy

Colours = NDArray[np.uint8]

SLATE = (150, 172, 205)
"""Colour of the map's occupied cells, which no class is near to."""

_BLOCK = 512  # scans
_PIXELS = 3  # a cell
_MARGIN_M = 1.0  # around the map's occupied cells
_UNKNOWN_RGB = (232, 238, 244)


def plot_labelled_sequence(path: Path, picture: Path) -> None:
    """Draw the map and all points of a labelled sequence over it, in the colours of the classes.

    Parameters
    ----------
    path
        A sequence that `salsa.sequences.label_sequence` wrote.
    picture
        The PNG file to write.

    Raises
    ------
    InvalidInputError
        If the sequence has no map or no labels.
    """
    with SequenceReader(path) as reader:
        scene = reader.read_map()
        if scene is None or "scans/labels" not in reader:
            raise InvalidInputError(f"{path}: has no map and labels to draw; label it first")
        taxonomy = reader.header.taxonomy
        sheet = Sheet.over(scene, whole=True, pixels=_PIXELS)
        canvas = sheet.background(scene)
        for start in range(0, len(reader), _BLOCK):
            sheet.paint(canvas, reader.batch(start, start + _BLOCK), scene, taxonomy)
    _save(canvas, scene, taxonomy, picture)


@dataclass(frozen=True)
class Sheet:
    """A canvas over a part of a map, some pixels a cell or some cells a pixel.

    Row 0 is the smallest y; axes are those of the map's grid, whose corner is at x 0, y 0.

    Parameters
    ----------
    left, bottom
        The first column and row of the map that it shows.
    columns, rows
        How many cells it shows.
    pixels
        Pixels along the edge of a cell; 1 where `cells` is above 1.
    cells
        Cells along the edge of a pixel.
    resolution
        Edge of a cell, m.
    """

    left: int
    bottom: int
    columns: int
    rows: int
    pixels: int
    cells: int
    resolution: float

    @classmethod
    def over(
        cls,
        scene: SemanticMap,
        *,
        whole: bool = False,
        pixels: int = 1,
        max_pixels: int | None = None,
    ) -> Sheet:
        """Lay a sheet over a map.

        Parameters
        ----------
        scene
            The map.
        whole
            Show every cell, not only the box of the occupied ones with a margin.
        pixels
            Pixels along the edge of a cell.
        max_pixels
            Longest edge of the canvas: fewer pixels, then several cells a pixel keep to it.
        """
        rows, columns = scene.occupancy.shape
        (bottom, top), (left, right) = (0, rows), (0, columns)
        if not whole:
            margin = round(_MARGIN_M / scene.resolution)
            (bottom, top), (left, right) = (
                (max(low - margin, 0), min(high + margin, size))
                for (low, high), size in zip(_occupied_box(scene), (rows, columns), strict=True)
            )
        longest = max(right - left, top - bottom)
        if max_pixels is not None:
            pixels = max(1, min(pixels, max_pixels // longest))
        cells = 1 if max_pixels is None or longest <= max_pixels else -(-longest // max_pixels)
        return cls(left, bottom, right - left, top - bottom, pixels, cells, scene.resolution)

    @property
    def pixels_per_m(self) -> float:
        """How many pixels a metre has."""
        return self.pixels / (self.cells * self.resolution)

    @property
    def corner_m(self) -> tuple[float, float]:
        """Return x and y of the lower left corner in the grid."""
        return self.left * self.resolution, self.bottom * self.resolution

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the canvas."""
        height, width = -(-self.rows // self.cells), -(-self.columns // self.cells)
        return height * self.pixels, width * self.pixels

    def background(self, scene: SemanticMap) -> Colours:
        """Pale map: free white, unknown bluish, occupied slate."""
        occupied = self.any_of(scene.occupancy == OCCUPIED)
        colours = np.full((*occupied.shape, 3), _UNKNOWN_RGB, np.uint8)
        colours[self.any_of(scene.occupancy == FREE)] = 255
        colours[occupied] = SLATE
        return colours

    def any_of(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Bring a mask of cells (H, W) onto the canvas: a pixel is true where any cell of it is."""
        shown = mask[self.bottom : self.bottom + self.rows, self.left : self.left + self.columns]
        if self.cells > 1:
            for axis in (0, 1):
                starts = np.arange(0, shown.shape[axis], self.cells)
                shown = np.logical_or.reduceat(shown, starts, axis=axis)
        return np.asarray(np.repeat(np.repeat(shown, self.pixels, axis=0), self.pixels, axis=1))

    def paint(
        self, canvas: Colours, batch: ScanBatch, scene: SemanticMap, taxonomy: Taxonomy
    ) -> None:
        """Paint the labelled points of scans onto a canvas in the colours of the classes."""
        if batch.labels is None:
            return
        shown = batch.valid & (batch.labels != UNLABELLED)
        shown &= np.isfinite(batch.poses).all(axis=-1, keepdims=True)
        xy = points_in_grid(batch, scene)[shown]
        column, row = np.floor((xy - self.corner_m).T * self.pixels_per_m).astype(np.int64)
        inside = (row >= 0) & (row < canvas.shape[0]) & (column >= 0) & (column < canvas.shape[1])
        canvas[row[inside], column[inside]] = taxonomy.palette[batch.labels[shown][inside]]


def points_in_grid(batch: ScanBatch, scene: SemanticMap) -> NDArray[np.float64]:
    """Return the beam endpoints of scans (N, B, 2) in m, in the frame of the map's grid."""
    points = to_base(to_points(batch.ranges, batch.lidar.bearings), batch.lidar.base_T_lidar)
    return transform(compose(invert(scene.origin.as_array()), batch.poses), points)


def _occupied_box(scene: SemanticMap) -> tuple[tuple[int, int], tuple[int, int]]:
    """Rows and columns from the first occupied cell to behind the last; all where none is."""
    occupied = scene.occupancy == OCCUPIED
    if not occupied.any():
        return (0, occupied.shape[0]), (0, occupied.shape[1])
    rows, columns = np.flatnonzero(occupied.any(axis=1)), np.flatnonzero(occupied.any(axis=0))
    return (int(rows[0]), int(rows[-1]) + 1), (int(columns[0]), int(columns[-1]) + 1)


def _save(canvas: Colours, scene: SemanticMap, taxonomy: Taxonomy, picture: Path) -> None:
    cells = np.array(_occupied_box(scene))
    bottom, top, left, right = (cells * scene.resolution + _MARGIN_M * np.array((-1, 1))).reshape(
        -1
    )
    height, width = np.array(canvas.shape[:2]) * scene.resolution / _PIXELS
    figure = Figure(figsize=(12, 2 + 10 * (top - bottom) / (right - left)), layout="constrained")
    FigureCanvasAgg(figure)
    ax = figure.add_subplot()
    x, y, yaw = scene.origin.as_array().tolist()
    if yaw:  # the grid lies askew in the map frame: metres are from its corner
        x, y = 0.0, 0.0
    extent = (x, x + width, y, y + height)
    ax.imshow(canvas, origin="lower", extent=extent, interpolation="nearest")
    ax.set(xlim=(x + left, x + right), ylim=(y + bottom, y + top), facecolor="0.97")
    ax.set(xlabel="x (m)", ylabel="y (m)")
    rgb = np.array(taxonomy.colours) / 255
    handles = [
        Patch(facecolor=tuple(colour), edgecolor="0.25", label=name)
        for name, colour in zip(taxonomy.names, rgb, strict=True)
    ]
    handles.append(Patch(facecolor="#{:02x}{:02x}{:02x}".format(*SLATE), label="map"))
    figure.legend(handles=handles, loc="outside upper center", ncols=6, frameon=False)
    plotting.save(figure, picture, dpi=110)
