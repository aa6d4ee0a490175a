"""The picture of an annotated map: what has which class, and what its author forgot."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from salsa.annotation import Annotation, label_cells
from salsa.map_check import MapReport
from salsa.shapes import Shape
from semantic2d_dataset import plotting
from semantic2d_dataset.scene.geometry import transform
from semantic2d_dataset.scene.maps import OCCUPIED, SemanticMap
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, UNLABELLED, Taxonomy

FORGOTTEN_RGB = (255, 0, 190)
"""Of occupied cells without a class; no class is pink."""

_LONGER_EDGE = 10.0  # of the axes, inches
_SHORTEST_EDGE = 3.0
_BESIDE, _BELOW = 1.0, 1.5  # room for what stands beside and below the axes, inches
_LEGEND_WIDTH = 9.0  # inches
_RIM = 0.25  # dark below the lines, since some colours are close to white paper


def plot_annotated_map(
    scene: SemanticMap,
    annotation: Annotation,
    report: MapReport,
    *,
    taxonomy: Taxonomy = SEMANTIC2D,
) -> Figure:
    """Draw the cells of a map in class colours, those without a class in pink, and the shapes.

    Parameters
    ----------
    scene, annotation
        What was checked.
    report
        What `salsa.map_check.check_map` found: the counts in the legend.
    taxonomy
        Names and colours.
    """
    figure = Figure(layout="constrained")
    FigureCanvasAgg(figure)
    ax = figure.subplots()
    shown, forgotten = _as_shown(scene, annotation, taxonomy)
    plotting.plot_map(shown, ax=ax, taxonomy=_with_forgotten(taxonomy))
    x, y = scene.centres_of(np.argwhere(forgotten)).T  # seen however small a cell is
    ax.scatter(x, y, s=9, marker="s", color=_colour(FORGOTTEN_RGB), linewidths=0, zorder=3)
    for shape in annotation.shapes:
        _draw_outline(ax, scene, shape, taxonomy)
    _fit_to_map(figure, ax)
    figure.legend(
        handles=_legend(report, taxonomy), loc="outside lower center", ncols=4, frameon=False
    )
    return figure


def _as_shown(
    scene: SemanticMap, annotation: Annotation, taxonomy: Taxonomy
) -> tuple[SemanticMap, NDArray[np.bool_]]:
    """Return the map with cells of people and forgotten cells as if of a class, and the latter."""
    labelled = label_cells(scene, annotation.regions, taxonomy)
    forgotten = (labelled.occupancy == OCCUPIED) & (labelled.labels == UNLABELLED)
    person = taxonomy.id_of("Person")
    people = annotation.regions == person
    labels, occupancy = labelled.labels.copy(), labelled.occupancy.copy()
    labels[forgotten] = len(taxonomy)
    labels[people], occupancy[people] = person, OCCUPIED
    shown = replace(scene, occupancy=occupancy, labels=labels)
    return shown, forgotten


def _with_forgotten(taxonomy: Taxonomy) -> Taxonomy:
    return Taxonomy((*taxonomy.names, "(no class)"), (*taxonomy.colours, FORGOTTEN_RGB))


def _draw_outline(ax: Axes, scene: SemanticMap, shape: Shape, taxonomy: Taxonomy) -> None:
    pixels = _outline(shape)
    height = scene.occupancy.shape[0]
    in_grid = np.stack((pixels[:, 0], height - pixels[:, 1]), axis=-1) * scene.resolution
    x, y = transform(scene.origin.as_array(), in_grid).T
    colour = _colour(taxonomy.colours[shape.label])
    marker = "o" if shape.kind in ("point", "points") else ""
    line = "" if marker else "-"
    ax.plot(x, y, line, marker=marker, markersize=4, color=str(_RIM), linewidth=1.3, zorder=4)
    ax.plot(x, y, line, marker=marker, markersize=3, color=colour, linewidth=0.8, zorder=4)
    ax.annotate(
        str(shape.number), (x[0], y[0]), (2, 2), textcoords="offset points", fontsize=6, zorder=5
    )


def _outline(shape: Shape) -> NDArray[np.float64]:
    """Points (P, 2) of a shape's outline, pixels of the image."""
    points = np.array(shape.points)
    if shape.kind in ("polygon", "oriented_rectangle"):
        return np.vstack((points, points[:1]))
    if shape.kind == "circle":
        turn = np.linspace(0.0, 2 * math.pi, 73)
        radius = math.dist(points[0], points[1])
        return np.asarray(points[0] + radius * np.stack((np.cos(turn), np.sin(turn)), axis=-1))
    if shape.kind in ("rectangle", "mask"):
        x1, y1, x2, y2 = shape.bounds
        return np.array(((x1, y1), (x2, y1), (x2, y2), (x1, y2), (x1, y1)))
    return points


def _fit_to_map(figure: Figure, ax: Axes) -> None:
    """Give the figure the aspect of what the axes show."""
    (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    scale = _LONGER_EDGE / max(right - left, top - bottom)
    width, height = (max(_SHORTEST_EDGE, scale * edge) for edge in (right - left, top - bottom))
    figure.set_size_inches(max(width + _BESIDE, _LEGEND_WIDTH), height + _BELOW)


def _legend(report: MapReport, taxonomy: Taxonomy) -> list[Patch]:
    total = max(sum(report.classes.values()) + report.unlabelled, 1)
    handles = [
        _patch(f"{name} {count:,} ({100 * count / total:.1f} %)", taxonomy.colours[i])
        for i, (name, count) in enumerate(report.classes.items())
        if count
    ]
    share = 100 * report.unlabelled / total
    handles.append(_patch(f"no class {report.unlabelled:,} ({share:.1f} %)", FORGOTTEN_RGB))
    if report.people:
        person = taxonomy.id_of("Person")
        text = f"{taxonomy.names[person]} {report.people:,}, counts as free"
        handles.append(_patch(text, taxonomy.colours[person]))
    return handles


def _patch(text: str, rgb: tuple[int, int, int]) -> Patch:
    return Patch(facecolor=_colour(rgb), edgecolor=str(_RIM), linewidth=0.5, label=text)


def _colour(rgb: tuple[int, int, int]) -> tuple[float, float, float]:
    red, green, blue = rgb
    return red / 255, green / 255, blue / 255
