"""Pictures of segmentation results, what is published hatched and grey beside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from baselines.tables import Row
from semantic2d_dataset.scoring.published import ALL

_OURS = ("#1f4e79", "#3f8fc4", "#9cc3e6", "#e8963e", "#d6007f", "#6b8e23")
_PUBLISHED = {"color": "0.88", "hatch": "///", "edgecolor": "0.5", "linewidth": 0.5}
_AS_PUBLISHED = "as published, other data"


def plot_features(ours: Mapping[str, Row], published: Mapping[str, Row]) -> Figure:
    """Draw the mIoU of each combination of features, with what was published of it.

    Parameters
    ----------
    ours, published
        Rows by what to call their features; published ones without a row of ours are left out.
    """
    figure, ax = _new_figure(max(6.0, 1.0 + 0.75 * len(ours)))
    at = np.arange(len(ours))
    for rows, offset, label, style in (
        (ours, -0.2, "ours", {"color": _OURS[0]}),
        (published, 0.2, _AS_PUBLISHED, _PUBLISHED),
    ):
        figures = [rows[name].figures["IoU"].get(ALL) if name in rows else None for name in ours]
        _draw_bars(ax, at + offset, 0.38, figures, label=label, **style)
    ax.set_xticks(at, list(ours), rotation=30, ha="right", rotation_mode="anchor")
    ax.set_ylabel("mIoU (%)")
    ax.set_ylim(bottom=0)
    figure.legend(loc="outside upper center", ncols=2, frameon=False)
    return figure


def plot_classes(rows: Sequence[Row], classes: Sequence[str]) -> Figure:
    """Draw the IoU of each class, a bar for each method that has it.

    Parameters
    ----------
    rows
        Methods; colours repeat after six.
    classes
        In this order.
    """
    figure, ax = _new_figure(12.0)
    at, width = np.arange(len(classes)), 0.84 / len(rows)
    for n, row in enumerate(rows):
        style = _PUBLISHED if row.published else {"color": _OURS[n % len(_OURS)]}
        label = f"{row.method}, {_AS_PUBLISHED}" if row.published else row.method
        figures = [row.figures["IoU"].get(name) for name in classes]
        offset = (n - (len(rows) - 1) / 2) * width
        _draw_bars(ax, at + offset, 0.92 * width, figures, label=label, **style)
    ax.set_xticks(at, classes)
    ax.set_ylabel("IoU (%)")
    ax.set_ylim(bottom=0)
    figure.legend(loc="outside upper center", ncols=3, frameon=False)
    return figure


def _draw_bars(
    ax: Axes,
    at: NDArray[np.floating[Any]],
    width: float,
    figures: Sequence[tuple[float, float | None] | None],
    **style: Any,
) -> None:
    """Draw means in percent with their spread, and nothing where there is no figure."""
    heights, spreads = np.transpose(
        [
            (np.nan, np.nan) if f is None else (f[0], np.nan if f[1] is None else f[1])
            for f in figures
        ]
    )
    lines = {"ecolor": "0.25", "elinewidth": 0.8, "capsize": 2}
    ax.bar(at, 100 * heights, width, yerr=100 * spreads, error_kw=lines, **style)


def _new_figure(width: float) -> tuple[Figure, Axes]:
    figure = Figure((width, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    ax = figure.subplots()
    ax.margins(x=0.02)
    ax.spines[["top", "right"]].set_visible(False)
    return figure, ax
