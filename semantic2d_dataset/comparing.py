"""A picture of a comparison: differences by class and by range, and where two methods differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import Patch

from semantic2d_dataset.scene.maps import OCCUPIED
from semantic2d_dataset.scoring.comparison import CELL_M, Comparison, Place

_MAPS = 3
_COLOURS = "#b35806", "#542788"  # the ends of PuOr: colour-blind readers tell them apart
_FEWEST = 10  # points in a cell that is drawn
_NAME = 40  # characters of a method's name


def plot_comparison(found: Comparison) -> Figure:
    """Draw differences by class and by range, and the maps where the two differ most.

    Parameters
    ----------
    found
        As `compare_predictions` returns it.
    """
    places = [place for place in found.places if len(place.cells)][:_MAPS]
    figure = Figure((12.5, 10.5 if places else 5.0), layout="constrained")
    FigureCanvasAgg(figure)
    parts = figure.subfigures(1 + bool(places), 1, squeeze=False)[:, 0]
    by_class, by_range = parts[0].subplots(1, 2, width_ratios=(1.3, 1))
    _draw_classes(by_class, found)
    _draw_ranges(by_range, found)
    if places:
        _draw_places(parts[1], places)
        if len(found.places) > len(places):
            parts[1].suptitle(f"The {len(places)} places where they differ most", fontsize=11)
    patches = [
        Patch(color=colour, label=f"{letter}: {_short(name)}")
        for letter, colour, name in zip("AB", _COLOURS, found.names, strict=True)
    ]
    figure.legend(
        handles=patches,
        loc="outside upper center",
        ncols=2,
        frameon=False,
        title=_what_for(found.task),
    )
    return figure


def _draw_classes(ax: Axes, found: Comparison) -> None:
    """Draw the difference of every score, with its interval, in percentage points."""
    said = found.scores
    rows = [("mIoU", said["mIoU"]), ("mCA", said["mCA"]), *said["classes"].items()]
    ax.axvline(0, color="0.25", linewidth=1)
    for at, (_, row) in enumerate(rows):
        if row["difference"] is None:
            ax.text(0, at, " none ", va="center", fontsize=8, color="0.4")
            continue
        value = 100 * row["difference"]
        colour = _COLOURS[int(value > 0)]
        ax.plot(value, at, "o", color=colour, markersize=8 if at < 2 else 6)
        if row["interval"] is not None:
            low, high = (100 * limit for limit in row["interval"])
            ax.plot((low, high), (at, at), color=colour, linewidth=2.5 if at < 2 else 1.5)
    ax.axhline(1.5, color="0.8", linewidth=1)
    names = [name if at < 2 else f"{name} IoU" for at, (name, _) in enumerate(rows)]
    ax.set_yticks(range(len(rows)), names)
    ax.invert_yaxis()
    level = f"{said['level']:.0%} interval"
    ax.set_xlabel(f"A is better  ←  B - A (percentage points), {level}  →  B is better")
    ax.set_title("By class", fontsize=11)
    ax.spines[["top", "right"]].set_visible(False)


def _draw_ranges(ax: Axes, found: Comparison) -> None:
    bands: dict[str, Any] = dict(found.conditions["range_m"])
    at = np.arange(len(bands))
    for key, offset, colour in zip("ab", (-0.2, 0.2), _COLOURS, strict=True):
        heights = [100 * row[key] for row in bands.values()]
        bars = ax.bar(at + offset, heights, 0.38, color=colour)
        ax.bar_label(bars, [f"{height:.0f}" for height in heights], padding=2, fontsize=8)
    ax.set_xticks(at, bands)
    ax.set_ylim(0, 109)
    ax.set_xlabel("Range (m)")
    ax.set_ylabel("mIoU (%)")
    ax.set_title("By range", fontsize=11)
    ax.spines[["top", "right"]].set_visible(False)


def _draw_places(figure: SubFigure, places: Sequence[Place]) -> None:
    """Draw the share of points that only one of the two has right, over the walls."""
    axes = figure.subplots(1, len(places), squeeze=False)[0]
    for ax, place in zip(axes, places, strict=True):
        points = place.counts.sum(axis=1)
        shown = points >= _FEWEST
        share = 100 * (place.counts[:, 2] - place.counts[:, 1])[shown] / points[shown]
        x, y = ((place.cells[shown] + 0.5) * CELL_M).T
        if place.scene is not None:
            walls = place.scene.centres_of(np.argwhere(place.scene.occupancy == OCCUPIED))
            ax.scatter(*walls.T, s=0.5, color="0.55", linewidths=0)
        ax.set_facecolor("0.9")  # white cells are those where none is better
        style: dict[str, Any] = {"marker": "s", "linewidths": 0, "cmap": "PuOr"}
        picture = ax.scatter(x, y, s=9, c=share, vmin=-50, vmax=50, **style)
        ax.set_aspect("equal")
        ax.set_title(place.environment, fontsize=11)
        ax.set_xlabel("x (m)")
    axes[0].set_ylabel("y (m)")
    label = "Only B right minus only A right (% of the points of a cell)"
    figure.colorbar(picture, ax=axes, location="bottom", shrink=0.5, label=label)


def _what_for(task: Mapping[str, Any]) -> str:
    lidars = ", ".join(task["lidars"])
    what = f"{task['dataset']} {task['dataset_version']}"
    return f"{_short(what)}, split {task['split']} of {task['scheme']}, {_short(lidars)}"


def _short(name: str) -> str:
    """Make a name from a file safe to draw: no mathematics, no end of the picture."""
    text = name if len(name) <= _NAME else f"{name[: _NAME - 15]} ... {name[-15:]}"
    return text.replace("$", "\\$")
