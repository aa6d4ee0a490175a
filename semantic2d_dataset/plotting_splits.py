"""Pictures of split schemes: who is where in time, and how near test lies to train.

The colours differ in lightness as well as in hue, so that they can be told apart by everybody.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter
from numpy.typing import NDArray

from semantic2d_dataset.format.leakage import NEAR_M, NEAR_S, Audit, Nearness
from semantic2d_dataset.format.leakage_report import percent, verdict
from semantic2d_dataset.format.splits import NONE, TEST, TRAIN, VAL
from semantic2d_dataset.plotting import new_empty_figure

_COLOURS = {TRAIN: "#9ecae1", VAL: "#f28e00", TEST: "#3b0f70", NONE: "#f0f0f0"}
_NAMES = {TRAIN: "train", VAL: "val", TEST: "test", NONE: "no split"}
_LEAST = 0.01
"""Left end of the axes, s and m; what is nearer is drawn there."""

_MOST_NAMES = 12
_MOST_BORDERED = 24
_ROW_INCHES = 2.9
_LINE = 145


def plot_audits(audits: Sequence[Audit]) -> Figure:
    """Draw a row for each scheme: timelines, and the distances of test and val scans to train.

    Left, a line for each sequence in the colour of the split that its scans are in, over the time
    of its recording. Right, the share of scans that have a train scan as near as that in time
    (same recording) and in pose (same environment).

    Parameters
    ----------
    audits
        As `audit_schemes` returns them.
    """
    figure = new_empty_figure(13.0, 0.5 + _ROW_INCHES * max(len(audits), 1))
    rows = np.atleast_1d(np.asarray(figure.subfigures(max(len(audits), 1), 1), object))
    limits = [_limit(audits, "time_s", 100.0), _limit(audits, "pose_m", 10.0)]
    for row, audit in zip(rows, audits, strict=False):
        _draw_row(row, audit, limits)
    figure.legend(
        handles=[
            Patch(facecolor=_COLOURS[i], edgecolor="0.4", linewidth=0.5, label=_NAMES[i])
            for i in _NAMES
        ],
        loc="outside upper right",
        ncols=4,
        frameon=False,
    )
    return figure


def _draw_row(row: SubFigure, audit: Audit, limits: Sequence[float]) -> None:
    said = audit.of("test").summarise()
    row.suptitle(
        textwrap.fill(f"{audit.scheme.name}: {verdict(said)}", _LINE),
        x=0.01,
        ha="left",
        fontsize=10,
        weight="bold",
    )
    strip, time, pose = row.subplots(1, 3, width_ratios=(1.5, 1, 1))
    _draw_timelines(strip, audit.timelines)
    within = percent(said["within_1_s"])
    _draw_shares(time, audit, "time_s", limits[0], NEAR_S)
    time.set_title(f"test within 1 s of train: {within}", fontsize=9)
    time.set_xlabel("Nearest train scan (s)")
    time.set_ylabel("Scans (%)")
    seen = percent(said["within_25_cm_15_deg"])
    _draw_shares(pose, audit, "pose_m", limits[1], NEAR_M)
    pose.set_title(f"test within 0.25 m and 15° of train: {seen}", fontsize=9)
    pose.set_xlabel("Nearest train pose (m, 15° as 0.25 m)")


def _draw_timelines(ax: Axes, timelines: Mapping[str, NDArray[np.uint8]]) -> None:
    names = sorted(timelines)
    picture = np.full((max(len(names), 1), 1, 4), 1.0)
    if names:
        ids = np.stack([timelines[name] for name in names])
        palette = np.zeros((256, 3), np.uint8)
        for i, colour in _COLOURS.items():
            palette[i] = [int(colour[k : k + 2], 16) for k in (1, 3, 5)]
        picture = palette[ids]
    ax.imshow(
        picture,
        aspect="auto",
        interpolation="nearest",
        extent=(0, 100, len(picture), 0),
    )
    ax.set_yticks(*_ticks(names), fontsize=7)
    ax.tick_params(axis="y", length=0)
    ax.hlines(_borders(names), 0, 100, color="white", linewidth=1.5 if len(names) < 100 else 0.3)
    ax.set_xlabel("Part of the recording (%)")
    ax.set_title(f"{len(names)} sequences, a line each", fontsize=9)


def _ticks(names: Sequence[str]) -> tuple[list[float], list[str]]:
    """Name every sequence, or every environment where those are too many, or none."""
    if len(names) <= _MOST_NAMES:
        return [i + 0.5 for i in range(len(names))], [_shortened(name) for name in names]
    places: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        places.setdefault(name.split("--", 1)[0], []).append(i)
    if len(places) > _MOST_NAMES:
        return [], []
    middles = [(rows[0] + rows[-1] + 1) / 2 for rows in places.values()]
    return middles, [_shortened(place) for place in places]


def _borders(names: Sequence[str]) -> list[int]:
    """Return the rows at which another recording starts, or environment where rows are thin."""
    parts = -1 if len(names) <= _MOST_BORDERED else -2
    starts = [name.split("--")[:parts] for name in names]
    return [i for i in range(1, len(names)) if starts[i] != starts[i - 1]]


def _shortened(text: str, most: int = 34) -> str:
    return text if len(text) <= most else f"{text[: most // 2]}…{text[-most // 2 + 1 :]}"


def _limit(audits: Sequence[Audit], field: str, least: float) -> float:
    """Return the right end of an axis that all schemes share."""
    found = [least]
    for audit in audits:
        for split in audit.nearness:
            values = getattr(audit.of(split), field)
            found += values[np.isfinite(values)].max(initial=0.0, keepdims=True).tolist()
    return 1.3 * max(found)


def _draw_shares(ax: Axes, audit: Audit, field: str, most: float, mark: float) -> None:
    """Draw how many percent of the scans of a split have a train scan within a distance."""
    drawn = False
    for split, i, width in (("val", VAL, 1.5), ("test", TEST, 2.2)):
        values = _known(audit.of(split), field)
        if np.isfinite(values).any():
            x, y = _cumulative(values, most)
            ax.step(x, y, where="post", color=_COLOURS[i], linewidth=width, label=split)
            drawn = True
    ax.set_xscale("log")
    ax.set_xlim(_LEAST, most)
    ax.set_ylim(-3, 103)
    ax.set_yticks(range(0, 101, 25))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.axvline(mark, color="0.4", linestyle="--", linewidth=1, zorder=1)
    ax.spines[["top", "right"]].set_visible(False)
    if not drawn:
        ax.text(
            0.5,
            0.5,
            _why_nothing(audit, field),
            transform=ax.transAxes,
            ha="center",
            va="center",
            fontsize=9,
            color="0.3",
            backgroundcolor="white",
        )


def _why_nothing(audit: Audit, field: str) -> str:
    values = _known(audit.of("test"), field)
    if not values.size:
        return "no test scan" + (" with a pose" if field == "pose_m" else "")
    where = "recording" if field == "time_s" else "environment"
    return f"no train scan in any\n{where} of a test scan"


def _known(nearness: Nearness, field: str) -> NDArray[np.float32]:
    values: NDArray[np.float32] = getattr(nearness, field)
    known: NDArray[np.float32] = values[~np.isnan(values)]
    return known


def _cumulative(values: NDArray[np.float32], most: float) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return a curve of a thousand points at most, in percent of all values."""
    x = np.geomspace(_LEAST, most, 1000)
    counts = np.searchsorted(np.sort(values), x, side="right")
    return x, 100 * counts / len(values)
