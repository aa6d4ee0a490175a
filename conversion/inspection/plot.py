"""An inspection as one picture: the way, the rates, the beams, and a few scans."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure, SubFigure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Patch
from numpy.typing import NDArray

from conversion.inspection.findings import Inspection, Pictures, SampleScan, TopicReport
from conversion.inspection.scan_probe import SAMPLES
from conversion.inspection.scan_statistics import CELL_M, KINDS
from semantic2d_dataset.plotting import check_picture_name, save

Floats = NDArray[np.float64]

_WIDTH, _TOP, _ROW = 16.0, 4.8, 3.6  # inches
_MOST_SCANS, _MOST_WAYS, _MOST_LANES = 4, 4, 16
_LANE_BINS, _LANE_PERIODS, _LANE_HALF = 600, 10, 0.44
_USUAL = 0.9  # of the median rate: as often as usual
_MARGIN = 0.01
_STEADY = 60  # messages: fewer are drawn one by one
_BARS, _CELLS_PER_BAR = 120, (1, 2, 5, 10, 20, 50, 100)
_DPI = 110

# Blue is what is measured; the rest is why nothing is.
_KIND_COLOURS = ("#2f6f9f", "#d9dee3", "#f2a33a", "#d9534f", "#4a4a4a", "#8e6bbf", "#7fb069")
_WAY_COLOURS = ("#1b4f8a", "#d95f02", "#3a923a", "#9467bd")
_WAY_WIDTHS = (3.6, 2.4, 1.6, 1.0)
_POINT, _ROBOT, _FAINT = "#1b4f8a", "#d6007f", "0.45"


def draw_inspection(inspection: Inspection, out: Path) -> None:
    """Write one picture of an inspection.

    Above, the way by each source of poses, and the rates of the topics over time; below, for each
    of the first scan topics, what its beams hold by their bearing, the ranges, and a few scans.

    Parameters
    ----------
    inspection
        As `conversion.inspection.inspection.inspect_source` returns it.
    out
        The picture; the ending of its name chooses the format.

    Raises
    ------
    InvalidInputError
        As `semantic2d_dataset.plotting.check_picture_name` does.
    """
    check_picture_name(out)
    save(plot_inspection(inspection), out, dpi=_DPI)


def plot_inspection(inspection: Inspection) -> Figure:
    """Draw an inspection into a figure that no window knows."""
    pictures = inspection.pictures
    names = list(pictures.samples)[:_MOST_SCANS]
    heights = [_TOP, *(_ROW for _ in names)]
    figure = Figure((_WIDTH, sum(heights)), layout=ConstrainedLayoutEngine(h_pad=0.08, w_pad=0.08))
    FigureCanvasAgg(figure)
    figure.suptitle(_title(inspection), fontsize=12)
    rows = figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
    way, lanes = rows[0].subplots(1, 2, width_ratios=(1, 2))
    _draw_ways(way, inspection)
    _draw_lanes(lanes, inspection)
    for name, row in zip(names, rows[1:], strict=True):
        values = [value for s in inspection.scans if s.topic == name for value in s.recurring]
        codes = np.array([v.value_m for v in values if v.no_return], np.float32)
        _draw_topic(row, pictures, name, codes)
    return figure


def _title(inspection: Inspection) -> str:
    said = f"{Path(inspection.path).name}: {inspection.kind}"
    if inspection.duration_s is not None:
        said += f", {inspection.duration_s:.1f} s from {inspection.start}"
    return said


def _draw_ways(ax: Axes, inspection: Inspection) -> None:
    """Draw the way by each source, broad to slim, so that equal ones show.

    Those in another frame than the first's are dashed: they start elsewhere.
    """
    ax.set_title("Way by source of poses (dot: start, square: end)")
    ways = list(inspection.pictures.trajectories.items())[:_MOST_WAYS]
    if not ways:
        _say(ax, "no poses")
        return
    frames = {pose.name: pose.frame for pose in inspection.poses}
    first = frames.get(ways[0][0], "")
    for (name, way), colour, width in zip(
        ways, _WAY_COLOURS, _WAY_WIDTHS[-len(ways) :], strict=False
    ):
        frame = frames.get(name, "")
        style = "-" if frame == first else "--"
        label = name if name.startswith("tf ") or not frame else f"{name} in {frame}"
        ax.plot(way[:, 0], way[:, 1], style, color=colour, linewidth=width, label=label)
        known = way[np.isfinite(way).all(axis=1), :2]
        ax.plot(*known[0], "o", color=colour, markersize=7)
        ax.plot(*known[-1], "s", color=colour, markersize=7, markerfacecolor="white")
    _in_metres(ax)
    ax.set_aspect("equal", adjustable="datalim")
    ax.legend(fontsize=9, loc="upper left", bbox_to_anchor=(0, -0.14), frameon=False)


def _draw_lanes(ax: Axes, inspection: Inspection) -> None:
    """Draw a lane for each topic: dark where its messages come as fast as they usually do."""
    ax.set_title("Messages over time (dark: as often as usual)")
    reports = {topic.name: topic for topic in inspection.topics}
    rates = dict(list(inspection.pictures.rates.items())[:_MOST_LANES])
    if not rates or not inspection.duration_s:
        _say(ax, "no times")
        return
    end = inspection.duration_s
    for row, (name, lane) in enumerate(rates.items()):
        report = reports.get(name)
        if report is not None and report.messages >= _STEADY:
            least_s = _LANE_PERIODS * (report.period_s or 0.0)
            _draw_lane(ax, row, _per_bin(*lane, end, least_s), end)
        else:
            _draw_ticks(ax, row, lane)
    labels = [_lane_label(name, reports.get(name)) for name in rates]
    ax.set_yticks(range(len(rates)), labels, fontsize=9)
    ax.set_xlim(-_MARGIN * end, (1 + _MARGIN) * end)
    ax.set_ylim(len(rates) - 0.5, -0.5)
    ax.tick_params(axis="y", length=0)
    ax.set_xlabel("time (s)")
    ax.set_facecolor("0.96")


def _draw_lane(ax: Axes, row: int, rates: Floats, end: float) -> None:
    typical = np.median(rates[rates > 0])
    shares = np.ma.masked_equal(np.clip(rates / (_USUAL * typical), 0, 1), 0)
    extent = (0, end, row + _LANE_HALF, row - _LANE_HALF)
    picture = ax.imshow(shares[None], aspect="auto", extent=extent, interpolation="nearest")
    picture.set_cmap("Blues")
    picture.set_clim(-0.35, 1)


def _draw_ticks(ax: Axes, row: int, lane: tuple[Floats, Floats]) -> None:
    """Mark each of a few messages."""
    edges, rates = lane
    at = (edges[:-1] + edges[1:])[rates > 0] / 2
    ax.vlines(at, row - _LANE_HALF, row + _LANE_HALF, color=_WAY_COLOURS[0], linewidth=1.5)


def _per_bin(edges: Floats, rates: Floats, end: float, least_s: float) -> Floats:
    """Return rates (K,) in bins of the whole time, each long enough to hold some messages."""
    counts = np.concatenate(([0.0], np.cumsum(rates * np.diff(edges))))
    stops = np.minimum(edges, end)
    bins = int(np.clip(end / max(least_s, end / _LANE_BINS), 1, _LANE_BINS))
    grid = np.linspace(0, end, bins + 1)
    found: Floats = np.diff(np.interp(grid, stops, counts)) / (end / bins)
    return found


def _lane_label(name: str, report: TopicReport | None) -> str:
    if report is None or report.rate_hz is None:
        return name if report is None else f"{name}  ({report.messages})"
    return f"{name}  ({report.rate_hz:.3g} Hz)"


def _draw_topic(row: SubFigure, pictures: Pictures, name: str, codes: NDArray[np.float32]) -> None:
    """Draw what there is of a scan topic; ranges that are `codes` for no return are no points."""
    row.suptitle(name, fontsize=11, fontweight="bold", x=0.01, ha="left")
    axes = row.subplots(1, 2 + SAMPLES, width_ratios=(1.7, 1.1, *(1.0 for _ in range(SAMPLES))))
    _draw_beams(axes[0], pictures, name)
    _draw_ranges(axes[1], pictures, name)
    samples = pictures.samples[name]
    returns = [_returns(sample, codes) for sample in samples]
    reach = _reach(returns)
    for ax, sample, ranges in zip(axes[2:], samples, returns, strict=False):
        _draw_scan(ax, sample, ranges, reach)
    for ax in axes[2 + len(samples) :]:
        ax.set_axis_off()


def _draw_beams(ax: Axes, pictures: Pictures, name: str) -> None:
    """Stack what the beams hold, by their bearing."""
    ax.set_title("What beams hold, by bearing")
    if name not in pictures.by_beam:
        _say(ax, "no scans")
        return
    bearings, shares = pictures.by_beam[name]
    used = [k for k in range(len(KINDS)) if shares[:, k].any()]
    degrees = np.degrees(bearings)
    colours = [_KIND_COLOURS[k] for k in used]
    ax.stackplot(degrees, *(100 * shares[:, k] for k in used), colors=colours, linewidth=0)
    ax.set_xlim(degrees[0], degrees[-1])
    ax.set_ylim(0, 100)
    ax.set_xlabel("bearing in the lidar's frame (deg)")
    ax.set_ylabel("share of scans (%)")
    patches = [Patch(facecolor=_KIND_COLOURS[k], label=KINDS[k]) for k in used]
    _legend_below(ax, patches, columns=3)


def _draw_ranges(ax: Axes, pictures: Pictures, name: str) -> None:
    """Draw how often each range is measured, in cells that fit the farthest."""
    ax.set_title("Ranges of returns")
    counts = pictures.ranges[name]
    if not counts.any():
        _say(ax, "no returns")
        return
    below = np.cumsum(counts)
    last = int(np.searchsorted(below, 0.995 * below[-1])) + 1
    width = next((w for w in _CELLS_PER_BAR if last <= _BARS * w), _CELLS_PER_BAR[-1])
    cells = -(-last // width)
    starts = np.arange(cells) * width
    binned = np.add.reduceat(counts[: cells * width], starts)
    edges = np.append(starts, cells * width) * CELL_M
    ax.stairs(100 * binned / below[-1], edges, fill=True, color=_KIND_COLOURS[0])
    ax.set_xlim(0, edges[-1])
    ax.set_xlabel("range (m)")
    ax.set_ylabel(f"returns per {width * CELL_M:g} m (%)")


def _returns(sample: SampleScan, codes: NDArray[np.float32]) -> Floats:
    """Return the ranges (B,) that are returns, NaN for the others."""
    r = sample.ranges.astype(np.float64)
    within = (r > 0) & (r >= sample.range_min) & (r < sample.range_max)
    return np.where(within & ~np.isin(sample.ranges, codes), r, np.nan)


def _reach(returns: list[Floats]) -> float:
    """Return how far almost all returns of some scans reach, m."""
    found = np.concatenate([np.zeros(0), *(r[np.isfinite(r)] for r in returns)])
    return float(np.quantile(found, 0.98)) * 1.08 if found.size else 1.0


def _draw_scan(ax: Axes, sample: SampleScan, ranges: Floats, reach: float) -> None:
    x, y = ranges * np.cos(sample.bearings), ranges * np.sin(sample.bearings)
    ax.set_title(f"scan at {sample.at_s:.1f} s")
    ax.scatter(x, y, s=4, color=_POINT, linewidths=0)
    ax.plot(0, 0, marker=">", color=_ROBOT, markersize=8)
    _in_metres(ax)
    ax.set_aspect("equal", adjustable="box")
    ax.set_xlim(-reach, reach)
    ax.set_ylim(-reach, reach)
    ax.locator_params(nbins=5)


def _in_metres(ax: Axes) -> None:
    ax.set_xlabel("x (m)")
    ax.set_ylabel("y (m)")
    ax.grid(color="0.9", linewidth=0.6)
    ax.set_axisbelow(True)


def _legend_below(ax: Axes, handles: list[Patch], *, columns: int) -> None:
    legend = ax.legend(
        handles=handles, fontsize=8, ncols=columns, frameon=False, loc="upper center"
    )
    legend.set_bbox_to_anchor((0.5, -0.2))


def _say(ax: Axes, text: str) -> None:
    ax.text(0.5, 0.5, text, ha="center", va="center", color=_FAINT, transform=ax.transAxes)
    ax.set_xticks([])
    ax.set_yticks([])
