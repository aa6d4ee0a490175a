"""Named presets: what is known of a public data set before its files are looked at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from conversion.options import Options
from semantic2d_dataset.errors import InvalidInputError

STATA, OGM = "stata", "ogm-turtlebot2"
PRESETS = (STATA, OGM)

_GROUND_TRUTH = "*.gt.laser.poses"


def apply_preset(options: Options, recording: Sequence[Path]) -> Options:
    """Fill in what a preset knows and the user has not said.

    ``stata``, MIT Stata Center: a PR2 with its base laser on ``/base_scan``; poses from the
    ground truth file beside the bag where there is one (``<bag>*.gt.laser.poses``), else as
    recorded. ``ogm-turtlebot2`` only names the layout.

    Raises
    ------
    InvalidInputError
        If no preset has that name.
    """
    if options.preset not in (None, *PRESETS):
        raise InvalidInputError(
            f"unknown preset {options.preset!r}; known are {', '.join(PRESETS)}"
        )
    if options.preset != STATA:
        return options
    path = recording[0]
    truth = sorted(path.parent.glob(f"{path.stem}{_GROUND_TRUTH}"))
    untold = options.poses == "auto"
    return replace(
        options,
        scan_topics=options.scan_topics or ("/base_scan",),
        poses=str(truth[0]) if untold and truth else options.poses,
        environment=options.environment or "stata-center",
    )
