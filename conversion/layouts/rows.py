"""What the sources of arrays share: options that mean nothing to them, and ranges in one form."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from conversion.options import Options
from semantic2d_dataset.errors import InvalidInputError

SYNTHETIC_STEP_NS = 50_000_000
"""Between scans of a layout without stamps: 20 Hz, as the format says."""

# What every layout of arrays understands.
_ALWAYS = (
    "environment",
    "recording",
    "license",
    "lidar",
    "mount",
    "drop_without_pose",
    "no_return",
    "preset",
)
_FLAGS = {
    "scan_topics": "--scan-topic",
    "clock_offset_s": "--clock-offset",
    "max_gap_s": "--max-gap",
    "streams": "--stream",
}
_NUMBERS = re.compile(r"(\d+)")
_SAME_RANGE = 1e-6  # of a range: half a step of a float32 is 6e-8 of it, and units are converted


def refuse_options(path: Path, kind: str, options: Options, honoured: Collection[str] = ()) -> None:
    """Refuse what a user has asked for, and a layout of arrays cannot give.

    Parameters
    ----------
    path, kind
        The source, for messages.
    options
        What the user has asked for.
    honoured
        Names of options that this layout understands beside the usual ones.

    Raises
    ------
    InvalidInputError
        If an option that it does not understand is not as it is by default.
    """
    plain = Options()
    asked = [
        field.name
        for field in fields(Options)
        if getattr(options, field.name) != getattr(plain, field.name)
        and field.name not in (*_ALWAYS, *honoured)
    ]
    if asked:
        names = ", ".join(_FLAGS.get(name, f"--{name.replace('_', '-')}") for name in asked)
        raise InvalidInputError(f"{path}: {names}: has no meaning for a {kind}; leave it out")


def to_ranges(values: ArrayLike, metres: float, no_return: Sequence[float]) -> NDArray[np.float32]:
    """Return ranges in m as f4; those that stand for no return become +inf.

    Parameters
    ----------
    values
        Ranges of any dtype and shape.
    metres
        Length of their unit.
    no_return
        Ranges that stand for no return, m.
    """
    found = np.asarray(values)
    ranges: NDArray[np.float32] = (found if metres == 1.0 else found * metres).astype(np.float32)
    for value in no_return:
        ranges[np.isclose(ranges, value, rtol=_SAME_RANGE, atol=_SAME_RANGE)] = np.inf
    return ranges


def only_finite(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return poses (N, 3) of which a row that is not finite is NaN."""
    known: NDArray[np.bool_] = np.logical_and.reduce(np.isfinite(rows), axis=1)
    return np.where(known[:, None], rows, np.nan)


def natural_order(name: str) -> list[tuple[int, str]]:
    """Return what orders names by the numbers in them: 2 before 10, whatever the zeros."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in _NUMBERS.split(name)]
