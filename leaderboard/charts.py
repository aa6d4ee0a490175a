"""Geometry of the charts on the pages: where bars, curves and their labels go, in SVG units."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from leaderboard.rows import Figure, Scores

WIDTH, HEIGHT = 640, 260
_LEFT, _RIGHT, _TOP, _BOTTOM = 68, 34, 16, 60

CONDITIONS = {
    "range_m": "Range, m",
    "incidence_deg": "Angle of incidence, degrees",
    "environment": "Environment",
    "people": "People in the scan",
    "border": "At the border of classes",
    "motion": "What can move",
}
"""Titles of the conditions that are shown, in their order."""

_ORDERED = ("range_m", "incidence_deg")  # their bands are drawn as curves
_BY_TRUTH = ("motion",)  # a band holds some classes only: IoU would count what it cannot hold


@dataclass(frozen=True)
class Bar:
    """One class: its bar for IoU with an interval, and a mark for CA; x in percent of the width."""

    name: str
    iou: Figure
    ca: Figure


@dataclass(frozen=True)
class Curve:
    """A line through points (x, y) in SVG units; it breaks where a figure is missing."""

    name: str
    path: str
    points: tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Chart:
    """Curves over bands or over a number from 0 to 1, with their labels along x."""

    title: str
    curves: tuple[Curve, ...]
    ticks: tuple[tuple[float, str], ...]


@dataclass(frozen=True)
class Condition:
    """What a method scores in every band of a condition, and a chart where bands have an order."""

    title: str
    bands: tuple[str, ...]
    points: tuple[int, ...]
    means: Mapping[str, tuple[float | None, ...]]
    classes: Mapping[str, tuple[float | None, ...]]
    chart: Chart | None


def class_bars(scores: Scores, names: Sequence[str]) -> list[Bar]:
    """Return the bars of a method's classes."""
    return [Bar(name, scores.classes["iou"][name], scores.classes["ca"][name]) for name in names]


def conditions_of(result: Mapping[str, Any], names: Sequence[str]) -> list[Condition]:
    """Return the conditions that a result tells of, as `scoring.conditions` describes them."""
    said = result.get("conditions") or {}
    return [
        _condition(name, title, said[name], names)
        for name, title in CONDITIONS.items()
        if said.get(name)
    ]


def reliability_of(result: Mapping[str, Any]) -> Chart | None:
    """Return accuracy against confidence, None where a result has no probabilities."""
    calibration = result.get("calibration")
    if not calibration:
        return None
    bins = [(each["confidence"], each["accuracy"]) for each in calibration["confidence_bins"]]
    points = [(_x(sure), _y(right)) for sure, right in bins if None not in (sure, right)]
    diagonal = [(_x(0.0), _y(0.0)), (_x(1.0), _y(1.0))]
    ticks = tuple((_x(tenths / 10), f"{10 * tenths} %") for tenths in range(0, 11, 2))
    curves = (_curve("Perfect", diagonal), _curve("Measured", points))
    return Chart("Accuracy by confidence", curves, ticks)


def grid() -> list[tuple[float, str]]:
    """Return the heights of the horizontal lines with their labels."""
    return [(_y(quarter / 4), f"{25 * quarter} %") for quarter in range(5)]


def _condition(
    name: str, title: str, bands: Mapping[str, Mapping[str, Any]], names: Sequence[str]
) -> Condition:
    shown = ("mCA",) if name in _BY_TRUTH else ("mIoU", "mCA")
    key, metric = ("ca", "CA") if name in _BY_TRUTH else ("iou", "IoU")
    means = {mean: tuple(band[mean] for band in bands.values()) for mean in shown}
    return Condition(
        title,
        tuple(bands),
        tuple(band["points"] for band in bands.values()),
        means,
        {f"{n} {metric}": tuple(band[key].get(n) for band in bands.values()) for n in names},
        _chart(title, tuple(bands), means) if name in _ORDERED else None,
    )


def _chart(title: str, bands: Sequence[str], means: Mapping[str, Sequence[float | None]]) -> Chart:
    places = [_x((i + 0.5) / len(bands)) for i in range(len(bands))]
    curves = tuple(
        _curve(name, [(x, None if v is None else _y(v)) for x, v in zip(places, of, strict=True)])
        for name, of in means.items()
    )
    return Chart(title, curves, tuple(zip(places, bands, strict=True)))


def _curve(name: str, points: Sequence[tuple[float, float | None]]) -> Curve:
    there = [(x, y) for x, y in points if y is not None]
    path, pen = "", "M"
    for x, y in points:
        path += "" if y is None else f"{pen}{x:g} {y:g}"
        pen = "M" if y is None else "L"
    return Curve(name, path, tuple(there))


def _x(share: float) -> float:
    return round(_LEFT + share * (WIDTH - _LEFT - _RIGHT), 1)


def _y(share: float) -> float:
    return round(HEIGHT - _BOTTOM - share * (HEIGHT - _TOP - _BOTTOM), 1)
