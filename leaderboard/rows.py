"""What the pages show of checked entries: tracks, their rows in order, and figures with limits."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from leaderboard.checking import VERIFIED, Checked
from leaderboard.entries import PUBLISHED, SANITY, SCORED, Entry, Track, features_of
from leaderboard.published import doubtful_means
from leaderboard.seeds import names_of_runs
from semantic2d_dataset.format.sequence import slug
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, Taxonomy
from semantic2d_dataset.scoring.published import ALL

METRICS = ("iou", "ca")
TITLES = {"iou": "IoU", "ca": "CA"}

UNRANKED_SCHEMES = ("frame",)
"""Schemes whose test scans lie 50 ms from train scans: to compare with published figures only."""


@dataclass(frozen=True)
class Figure:
    """A fraction 0 to 1, None where there is none, with what is known of its spread.

    Parameters
    ----------
    value
        The figure.
    low, high
        Limits of its confidence interval, or None.
    std
        Standard deviation over seeds or samples of the model, or None.
    """

    value: float | None
    low: float | None = None
    high: float | None = None
    std: float | None = None

    @property
    def limits(self) -> tuple[float, float] | None:
        """What a whisker spans: the interval, or else one standard deviation to both sides."""
        if self.low is not None and self.high is not None:
            return self.low, self.high
        if self.value is None or self.std is None:
            return None
        return max(0.0, self.value - self.std), min(1.0, self.value + self.std)


@dataclass(frozen=True)
class Scores:
    """Figures of an entry on one lidar: means, and by metric and class.

    Parameters
    ----------
    mIoU, mCA
        The means.
    classes
        By metric and name of the class.
    over
        What standard deviations are over, in words; empty where there are none.
    """

    mIoU: Figure
    mCA: Figure
    classes: Mapping[str, Mapping[str, Figure]]
    over: str = ""

    def figure(self, metric: str, name: str | None = None) -> Figure:
        """Return the figure of a class, or the mean of the metric where none is named."""
        if name is not None:
            return self.classes[metric][name]
        return self.mIoU if metric == "iou" else self.mCA


@dataclass(frozen=True)
class Run:
    """One of several trainings: its name, what the entry says of it, and whether it is shown."""

    name: str
    said: Mapping[str, Any]
    shown: bool


@dataclass(frozen=True)
class Row:
    """One entry in a track; only verified scores have a place, see `is_ranked`."""

    checked: Checked
    scores: Scores
    place: int | None = None

    @property
    def entry(self) -> Entry:
        """The entry."""
        return entry_of(self.checked)

    @property
    def badges(self) -> tuple[str, ...]:
        """What to say of the row beside its name."""
        kind = ("sanity",) if self.entry.kind == SANITY else ()
        seeds = (self.scores.over,) if self.entry.runs else ()
        return (*kind, *seeds, self.checked.status)

    @property
    def page(self) -> str:
        """Where the method's page is, from the folder of pages."""
        return page_of(self.checked)


@dataclass(frozen=True)
class TrackTable:
    """One track with its rows, best first."""

    track: Track
    id: str
    title: str
    taxonomy: Taxonomy
    rows: tuple[Row, ...]

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes that enter a mean."""
        return tuple(self.taxonomy.names[c] for c in self.taxonomy.scored_ids)

    def best(self, metric: str, name: str | None = None) -> float | None:
        """Return the best figure of the ranked rows: of a class, or the mean if none is named."""
        ranked = [row.scores for row in self.rows if row.place is not None]
        figures = [scores.figure(metric, name).value for scores in ranked]
        return max((figure for figure in figures if figure is not None), default=None)


def entry_of(checked: Checked) -> Entry:
    """Return the entry of a check that found one."""
    if checked.entry is None:
        raise TypeError(f"{checked.path}: no entry")  # a fault of ours: wrong ones are not shown
    return checked.entry


def page_of(checked: Checked) -> str:
    """Return the path of an entry's page in the folder of pages."""
    return f"methods/{checked.path.stem}.html"


def make_tables(checked: Iterable[Checked]) -> list[TrackTable]:
    """Group entries by track; published figures have tracks of their own, which come last.

    Rows are ordered by mIoU, and those without one come last.
    """
    groups: dict[Track, list[Row]] = {}
    for each in checked:
        entry = entry_of(each)
        for track in entry.tracks():
            groups.setdefault(track, []).append(Row(each, scores_of(entry, track.lidar)))
    order = sorted(groups, key=lambda track: (not track.evaluator_version, track))
    ids: dict[str, int] = {}
    tables = []
    for track in order:
        name = slug(
            f"{track.dataset} {track.dataset_version} {track.scheme} {track.split} {track.lidar}"
        )
        ids[name] = ids.get(name, 0) + 1
        same = f"{name}-{ids[name]}" if ids[name] > 1 else name
        rows = _ranked(track, groups[track])
        taxonomy = _taxonomy_of(rows[0].entry)
        tables.append(TrackTable(track, same, _title(track), taxonomy, rows))
    return tables


def scores_of(entry: Entry, lidar: str) -> Scores:
    """Return what an entry scores on a lidar; of several seeds, their means."""
    if entry.kind == PUBLISHED:
        return _published_scores(entry.said["figures"])
    if entry.runs:
        return _mean_scores(entry.said["seeds"]["spread"]["per_lidar"][lidar])
    return shown_scores(entry, lidar)


def shown_scores(entry: Entry, lidar: str) -> Scores:
    """Return what the predictions score that are shown in full: of several seeds, of one."""
    scores = entry.said["result"]["per_lidar"][lidar]
    limits = scores.get("intervals") or {"classes": {}}
    by_class = limits["classes"]
    return Scores(
        _with_limits(scores["mIoU"], limits.get("mIoU")),
        _with_limits(scores["mCA"], limits.get("mCA")),
        {
            "iou": {
                name: _with_limits(scores[name]["iou"], by_class.get(name))
                for name in entry.taxonomy.names
            },
            "ca": {name: Figure(scores[name]["ca"]) for name in entry.taxonomy.names},
        },
    )


def runs_of(entry: Entry) -> list[Run]:
    """Return the trainings of an entry; none where there is one only."""
    names = names_of_runs(entry.runs)
    return [
        Run(name, run, run["predictions"] == entry.digest)
        for name, run in zip(names, entry.runs, strict=True)
    ]


def doubts(entry: Entry) -> list[str]:
    """Return what to know of a published row whose printed mean is not that of its classes."""
    if entry.kind != PUBLISHED:
        return []
    figures = entry.said["figures"]
    return [
        f"The mean {metric} of the paper, {100 * figures[metric][ALL][0]:.2f} %, is not that of "
        f"its own classes, {100 * mean:.2f} %."
        for metric, mean in doubtful_means(figures).items()
    ]


def facts_of(entry: Entry) -> list[tuple[str, str]]:
    """Return what an entry says of its method, as names and plain text."""
    metadata = entry.said["metadata"]
    track = metadata.get("track") if isinstance(metadata.get("track"), Mapping) else {}
    said = {
        "Authors": _joined(metadata.get("authors")),
        "Paper": metadata.get("paper"),
        "Code": metadata.get("code"),
        "Features": features_of(metadata),
        "Training data": track.get("training_data") or metadata.get("training_data"),
        "Other data": track.get("other_data"),
        "Parameters": _counted(metadata.get("parameters")),
        "Scans per second": metadata.get("scans_per_second"),
        "Measured": metadata.get("scans_per_second_measured"),
        "Hardware": metadata.get("hardware"),
        "Seeds": None if entry.runs else _joined(metadata.get("seeds")),  # listed by themselves
    }
    return [(name, str(value)) for name, value in said.items() if value not in (None, "")]


def is_ranked(track: Track, checked: Checked) -> bool:
    """Tell whether a row has a place: nobody's word is enough, and leaking splits are not."""
    is_scored = entry_of(checked).kind == SCORED and checked.status == VERIFIED
    return is_scored and track.scheme not in UNRANKED_SCHEMES


def _ranked(track: Track, rows: Iterable[Row]) -> tuple[Row, ...]:
    def order(row: Row) -> tuple[bool, float, str]:
        value = row.scores.mIoU.value
        return value is None, -(value or 0.0), row.entry.method

    place, found = 0, []
    for row in sorted(rows, key=order):
        if is_ranked(track, row.checked):
            place += 1
            found.append(Row(row.checked, row.scores, place))
        else:
            found.append(row)
    return tuple(found)


def _taxonomy_of(entry: Entry) -> Taxonomy:
    return SEMANTIC2D if entry.kind == PUBLISHED else entry.taxonomy


def _title(track: Track) -> str:
    version = track.dataset_version.replace("-", " ")
    return f"{track.dataset} {version}, {track.split} of {track.scheme}, {track.lidar}"


def _published_scores(figures: Mapping[str, Mapping[str, Any]]) -> Scores:
    def read(metric: str, name: str) -> Figure:
        value, std = figures[metric].get(name, (None, None))
        return Figure(value, std=std)

    classes = {
        metric: {name: read(TITLES[metric], name) for name in SEMANTIC2D.names}
        for metric in METRICS
    }
    return Scores(read("IoU", ALL), read("CA", ALL), classes, over="samples")


def _mean_scores(said: Mapping[str, Any]) -> Scores:
    def read(spread: Mapping[str, float] | None) -> Figure:
        return Figure(None) if spread is None else Figure(spread["mean"], std=spread["std"])

    classes = {
        metric: {name: read(of[metric]) for name, of in said["classes"].items()}
        for metric in METRICS
    }
    return Scores(read(said["mIoU"]), read(said["mCA"]), classes, over=f"{said['count']} seeds")


def _with_limits(value: float | None, limits: Any) -> Figure:
    if isinstance(limits, list) and len(limits) == 2:
        return Figure(value, float(limits[0]), float(limits[1]))
    return Figure(value)


def _joined(value: Any) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value or "")


def _counted(value: Any) -> str:
    return f"{value:,}" if isinstance(value, int) else ""
