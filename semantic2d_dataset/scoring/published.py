"""The segmentation results that were published with the data set, as data.

They were measured on the published release with other code: show them marked as published, and
never rank them among results of this package's evaluator. What was published of the other two
lidars is bar charts without figures.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any

ALL = "All"
"""The name of the mean over classes among the classes of a row."""

METRICS = ("CA", "IoU")
"""CA is recall here, as in `metrics`."""

ClassFigures = Mapping[str, tuple[float, float | None]]
"""Mean and standard deviation, fractions, by class name and `ALL`; absent where there is none."""


@dataclass(frozen=True)
class PublishedRow:
    """One method of the published table.

    Parameters
    ----------
    method
        Its name.
    features
        Letters of R, I, P, A; None for a method without a network.
    frames_per_second
        On the processor that `PublishedTable` names.
    figures
        By metric (`METRICS`) and class. The mean over classes is the plain one of those present;
        the standard deviation is over 32 samples of the latent, None where nothing is drawn.
    """

    method: str
    features: str | None
    frames_per_second: float
    figures: Mapping[str, ClassFigures]


@dataclass(frozen=True)
class PublishedTable:
    """Rows in the order of the paper, where they are from, and what they were measured on."""

    paper: str
    table: str
    measured_on: str
    processor: str
    rows: tuple[PublishedRow, ...]

    def find(self, method: str, features: str | None = None) -> PublishedRow | None:
        """Return the row of a method, of those features where it has any, or None."""
        wanted = (method, features)
        return next((row for row in self.rows if (row.method, row.features) == wanted), None)


@cache
def published_segmentation() -> PublishedTable:
    """Return the paper's table of segmentation results, figures as fractions.

    Examples
    --------
    >>> published_segmentation().find("S3-Net", "RIA").figures["IoU"]["All"]
    (0.2624, 0.0079)
    """
    said = json.loads(resources.files(__package__).joinpath("published.json").read_text("utf-8"))
    return PublishedTable(
        said["paper"],
        said["table"],
        said["measured_on"],
        said["processor"],
        tuple(_row(row) for row in said["rows"]),
    )


def _row(said: Mapping[str, Any]) -> PublishedRow:
    figures = {
        metric: {name: _fractions(*printed) for name, printed in said[metric].items()}
        for metric in METRICS
    }
    return PublishedRow(said["method"], said["features"], said["frames_per_second"], figures)


def _fractions(mean: float, std: float | None) -> tuple[float, float | None]:
    return round(mean / 100, 6), None if std is None else round(std / 100, 6)
