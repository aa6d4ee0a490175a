"""The rows of the published table as entries: shown as published, never ranked."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from leaderboard.entries import FORMAT, FORMAT_VERSION, PUBLISHED, seal
from semantic2d_dataset.scoring.published import (
    ALL,
    METRICS,
    PublishedRow,
    published_segmentation,
)

_DATASET, _DOI = "semantic2d", "10.5281/zenodo.18350696"
_LAST_PLACE = 0.0001  # of the figures that the paper prints


def published_entries() -> Iterator[dict[str, Any]]:
    """Yield an entry for every row of the paper's table, in its order."""
    for row in published_segmentation().rows:
        yield _entry_of(row)


def published_entry(method: str, features: str | None) -> dict[str, Any] | None:
    """Return the entry of one row, None where the paper has none."""
    row = published_segmentation().find(method, features)
    return None if row is None else _entry_of(row)


def doubtful_means(figures: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """Return, by metric, the mean of a row's classes where the printed mean is another.

    Two places are printed: the mean of rounded figures is off by at most half a last place, and
    the printed mean by as much again.
    """
    found = {}
    for metric in METRICS:
        classes = [mean for name, (mean, _) in figures[metric].items() if name != ALL]
        mean = sum(classes) / len(classes)
        if abs(mean - figures[metric][ALL][0]) > _LAST_PLACE + 1e-9:
            found[metric] = mean
    return found


def _entry_of(row: PublishedRow) -> dict[str, Any]:
    table = published_segmentation()
    metadata: dict[str, Any] = {
        "method": row.method,
        "scans_per_second": row.frames_per_second,
        "scans_per_second_measured": table.processor,
    }
    return seal(
        {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "kind": PUBLISHED,
            "track": {
                "dataset": _DATASET,
                "dataset_version": "as-published",
                "scheme": "frame",
                "split": "test",
                "lidars": ["hokuyo-utm-30lx-ew"],
            },
            "metadata": metadata | ({"features": row.features} if row.features else {}),
            "source": {
                "paper": table.paper,
                "table": table.table,
                "measured_on": table.measured_on,
                "processor": table.processor,
                "data": f"https://doi.org/{_DOI}",
            },
            "figures": {
                metric: {name: list(pair) for name, pair in row.figures[metric].items()}
                for metric in METRICS
            },
        }
    )
