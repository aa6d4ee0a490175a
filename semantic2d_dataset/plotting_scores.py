"""Pictures of scores: confusion, figures by class and by condition, calibration.

Every function takes a part of a result and returns a matplotlib `Figure` that no window knows;
`plotting.save` writes it. Figures are in percent.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from semantic2d_dataset.plotting import new_empty_figure
from semantic2d_dataset.scoring.conditions import figure_of
from semantic2d_dataset.scoring.metrics import class_names, percent

CONDITIONS = {
    "range_m": "Range",
    "incidence_deg": "Angle of incidence",
    "border": "Another class within two beams",
    "environment": "Environment",
    "people": "A person in the scan",
    "motion": "Can move by itself",
}
"""Titles of the conditions of a result, in the order in which they are shown."""

_UNITS = {"range_m": " m", "incidence_deg": "°"}
_WORDS = {
    "border": {"inside": "no", "border": "yes"},
    "people": {"none in the scan": "no", "in the scan": "yes"},
    "motion": {"static": "no", "moving": "yes: people"},
}
_EDGE = "0.25"
_IOU, _CA, _PALE = "#1f6fb2", "#b3470f", "#9cc3e6"
_ROW = 0.34  # inches of a bar with its gap


def band_label(condition: str, band: str) -> str:
    """Write a band of a condition for a reader: ``2 to 4 m``, ``16 m and more``."""
    unit = _UNITS.get(condition)
    if unit is None or not band[0].isdigit():
        return _WORDS.get(condition, {}).get(band, band)
    if band.endswith("+"):
        return f"{band[:-1]}{unit} and more"
    return f"{band.replace('-', ' to ')}{unit}"


def plot_confusion(result: Mapping[str, Any]) -> Figure:
    """Draw the confusion matrix of a result, every row as percent of its true points.

    Parameters
    ----------
    result
        As `Evaluator.compute` returns it.
    """
    names, matrix = class_names(result), np.asarray(result["confusion"], np.float64)
    support = matrix.sum(axis=1, keepdims=True)
    shares = 100 * np.divide(matrix, support, out=np.full_like(matrix, np.nan), where=support > 0)
    figure = new_empty_figure(8.6, 7.4)
    ax = figure.subplots()
    picture = ax.imshow(np.nan_to_num(shares), cmap="Blues", vmin=0, vmax=100)
    for (row, column), share in np.ndenumerate(shares):
        text = "-" if np.isnan(share) else f"{share:.1f}"
        colour = "white" if share > 55 else "0.65" if not matrix[row, column] else "black"
        ax.text(column, row, text, ha="center", va="center", fontsize=8, color=colour)
    ax.set_xticks(range(len(names)), names, rotation=40, ha="right", rotation_mode="anchor")
    rows = [f"{name} ({int(n):,})" for name, n in zip(names, support[:, 0], strict=True)]
    ax.set_yticks(range(len(names)), rows)
    ax.set_xlabel("Predicted class")
    ax.set_ylabel("True class (points)")
    figure.colorbar(picture, ax=ax, label="Share of the true class (%)", shrink=0.8)
    return figure


def plot_class_bars(result: Mapping[str, Any]) -> Figure:
    """Draw IoU of every class as a bar and CA as a dot; the legend has their means.

    Parameters
    ----------
    result
        As `Evaluator.compute` returns it; intervals of IoU are drawn where it has ``intervals``.
    """
    names = class_names(result)
    figure = new_empty_figure(6.4, 1.3 + _ROW * len(names))
    ax = figure.subplots()
    at = np.arange(len(names))
    ious, cas = ([result[name][key] for name in names] for key in ("iou", "ca"))
    ax.barh(at, _percents(ious), 0.66, color=_IOU, label=f"IoU (mean {percent(result['mIoU'])} %)")
    label = f"CA (mean {percent(result['mCA'])} %)"
    shown = np.array([ca is not None for ca in cas], bool)
    ax.plot(
        _percents(cas)[shown],
        at[shown],
        "o",
        color=_CA,
        markeredgecolor="white",
        markersize=8,
        label=label,
    )
    for y in (y for y, iou in enumerate(ious) if iou is None):
        ax.text(1, y, "none", va="center", fontsize=9)
    _draw_intervals(ax, result.get("intervals"), names)
    ax.set_yticks(at, names, parse_math=False)
    _across_percent(ax)
    figure.legend(loc="outside upper center", ncols=3, frameon=False)
    return figure


def plot_condition(result: Mapping[str, Any], condition: str) -> Figure:
    """Draw the mean of every band of a condition, with its points and how many classes it averages.

    Parameters
    ----------
    result
        As `submission.score_predictions` returns it.
    condition
        A key of its ``conditions``; a dashed line is the mean of all points.
    """
    mean, bands = figure_of(condition), result["conditions"][condition]
    figure = new_empty_figure(5.4, 1.15 + _ROW * len(bands))
    ax = figure.subplots()
    at = np.arange(len(bands))
    values = [band[mean] for band in bands.values()]
    bars = ax.barh(at, _percents(values), 0.66, color=_IOU)
    if result[mean] is not None:
        ax.axvline(100 * result[mean], color=_EDGE, linestyle="--", linewidth=1)
    texts = ["none" if value is None else f"{100 * value:.1f}" for value in values]
    behind = {"facecolor": "white", "edgecolor": "none", "pad": 0.6}  # the line stays off figures
    ax.bar_label(bars, texts, padding=3, fontsize=9, bbox=behind)
    ax.set_yticks(at, [band_label(condition, band) for band in bands], parse_math=False)
    _across_percent(ax, room=14)
    ax.set_xlabel(f"{mean} (%)")
    ax.set_ylim(len(bands) - 0.5, -1.4)  # a row for the heading of the second column
    column = ax.secondary_yaxis("right")
    points = [f"{band['points']:,} ({band['classes_averaged'][mean]})" for band in bands.values()]
    column.set_yticks([-1, *at], ["points (classes)", *points], fontsize=9)
    column.tick_params(length=0)
    column.spines["right"].set_visible(False)
    return figure


def plot_reliability(calibration: Mapping[str, Any]) -> Figure:
    """Draw accuracy against confidence, and the share of errors against entropy.

    Below each are the points of its bins. Confidence that can be trusted has its bars end on the
    diagonal; entropy that tells errors has bars that rise.

    Parameters
    ----------
    calibration
        As `Calibration.compute` returns it.
    """
    figure = new_empty_figure(11.0, 5.6)
    axes = figure.subplots(2, 2, sharex="col", height_ratios=(3, 1))
    reliability, errors = axes.T
    _draw_bins(reliability, calibration["confidence_bins"], "accuracy")
    reliability[0].plot((0, 1), (0, 100), color=_EDGE, linestyle="--", linewidth=1, zorder=3)
    reliability[0].set_title(
        f"Expected calibration error {percent(calibration['ece'])} %, largest "
        f"{percent(calibration['mce'])} %",
        fontsize=10,
    )
    reliability[0].set_ylabel("Accuracy (%)")
    reliability[1].set_xlabel("Confidence")
    reliability[1].set_ylabel("Points (%)")
    _draw_bins(errors, calibration["entropy_bins"], "error")
    errors[0].set_title(
        f"Area under risk and coverage {percent(calibration['aurc'])} %", fontsize=10
    )
    errors[0].set_ylabel("Wrong points (%)")
    errors[1].set_xlabel("Entropy (nats)")
    return figure


def _percents(fractions: Sequence[float | None]) -> NDArray[np.float64]:
    """Percent of fractions, 0 where there is none."""
    return 100 * np.array([fraction or 0.0 for fraction in fractions], np.float64)


def _draw_intervals(ax: Axes, said: Mapping[str, Any] | None, names: Sequence[str]) -> None:
    """Draw the intervals of IoU as whiskers; they need not hold the IoU itself."""
    if said is None:
        return
    limits = {y: said["classes"][name] for y, name in enumerate(names) if said["classes"][name]}
    if not limits:
        return
    low, high = 100 * np.array(list(limits.values())).T
    at = np.fromiter(limits, np.float64)
    ax.hlines(
        at, low, high, color="black", linewidth=1.5, label=f"{100 * said['level']:g} % interval"
    )
    for ends in (low, high):
        ax.plot(ends, at, "|", color="black", markersize=8, markeredgewidth=1.5)


def _across_percent(ax: Axes, *, room: float = 1) -> None:
    """Let percent run to the right, with room behind 100, and the first row be on top."""
    ax.invert_yaxis()
    ax.set_xlim(0, 100 + room)
    ax.set_xticks(range(0, 101, 25))
    ax.set_xlabel("Percent")
    ax.grid(axis="x", color="0.88")
    ax.set_axisbelow(True)
    ax.tick_params(axis="y", length=0)
    ax.spines[["top", "right"]].set_visible(False)


def _draw_bins(axes: Sequence[Axes], bins: Sequence[Mapping[str, Any]], figure: str) -> None:
    """Draw a figure of bins in percent, and below it the share of points that each holds."""
    low = [row["low"] for row in bins]
    widths = [row["high"] - row["low"] for row in bins]
    total = max(sum(row["points"] for row in bins), 1)
    heights = [100 * (row[figure] or 0.0) for row in bins]
    shares = [100 * row["points"] / total for row in bins]
    for ax, values, colour in zip(axes, (heights, shares), (_IOU, _PALE), strict=True):
        ax.bar(low, values, widths, align="edge", color=colour, edgecolor="white", linewidth=0.8)
        ax.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylim(0, 100)
    axes[0].set_xlim(0, bins[-1]["high"])
