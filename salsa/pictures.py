"""Pictures of what SALSA made, to judge it by eye."""

from __future__ import annotations

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
from semantic2d_dataset.scene.taxonomy import UNLABELLED, Taxonomy

Colours = NDArray[np.uint8]

_BLOCK = 512  # scans
_PIXELS = 3  # a cell
_SLATE = (150, 172, 205)
_MARGIN_M = 1.0  # around the map's occupied cells


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
        canvas = _paint(reader, scene)
        taxonomy = reader.header.taxonomy
    _save(canvas, scene, taxonomy, picture)


def _paint(reader: SequenceReader, scene: SemanticMap) -> Colours:
    """Paint map and points on a canvas of several pixels a cell; row 0 is the smallest y."""
    taxonomy = reader.header.taxonomy
    canvas = np.repeat(np.repeat(_background(scene), _PIXELS, axis=0), _PIXELS, axis=1)
    for start in range(0, len(reader), _BLOCK):
        batch = reader.batch(start, start + _BLOCK)
        labelled = batch.valid & (reader.read("scans/labels", start, start + _BLOCK) != UNLABELLED)
        points = to_base(to_points(batch.ranges, batch.lidar.bearings), batch.lidar.base_T_lidar)
        to_grid = compose(invert(scene.origin.as_array()), batch.poses)
        xy = transform(to_grid, points)[labelled]
        column, row = np.floor(xy.T / scene.resolution * _PIXELS).astype(np.int64)
        inside = (row >= 0) & (row < canvas.shape[0]) & (column >= 0) & (column < canvas.shape[1])
        labels = batch.labels[labelled][inside] if batch.labels is not None else []
        canvas[row[inside], column[inside]] = taxonomy.palette[labels]
    return canvas


def _background(scene: SemanticMap) -> Colours:
    """Pale map: free white, unknown bluish, occupied slate, which no class is near to."""
    colours = np.full((*scene.occupancy.shape, 3), (232, 238, 244), np.uint8)
    colours[scene.occupancy == FREE] = 255
    colours[scene.occupancy == OCCUPIED] = _SLATE
    return colours


def _save(canvas: Colours, scene: SemanticMap, taxonomy: Taxonomy, picture: Path) -> None:
    rows, columns = np.nonzero(scene.occupancy == OCCUPIED)
    cells = np.array((columns.min(), columns.max() + 1, rows.min(), rows.max() + 1))
    left, right, bottom, top = cells * scene.resolution + _MARGIN_M * np.array((-1, 1, -1, 1))
    height, width = np.array(canvas.shape[:2]) * scene.resolution / _PIXELS
    figure = Figure(figsize=(12, 2 + 10 * (top - bottom) / (right - left)), layout="constrained")
    FigureCanvasAgg(figure)
    ax = figure.add_subplot()
    ax.imshow(canvas, origin="lower", extent=(0, width, 0, height), interpolation="nearest")
    ax.set(xlim=(left, right), ylim=(bottom, top), xlabel="m", ylabel="m", facecolor="0.97")
    rgb = np.array(taxonomy.colours) / 255
    handles = [
        Patch(facecolor=tuple(colour), edgecolor="0.25", label=name)
        for name, colour in zip(taxonomy.names, rgb, strict=True)
    ]
    handles.append(Patch(facecolor="#{:02x}{:02x}{:02x}".format(*_SLATE), label="map"))
    figure.legend(handles=handles, loc="outside upper center", ncols=6, frameon=False)
    plotting.save(figure, picture, dpi=110)
