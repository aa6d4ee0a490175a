"""The second pass over a recording: scans as arrays, a bounded block at a time."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conversion.bags import Bag
from conversion.plan import Plan
from conversion.scans import Scan
from conversion.survey import with_progress
from semantic2d_dataset.errors import RecordingError

BLOCK = 512
"""Scans held at once."""

Arrays = dict[str, NDArray[Any]]


def read_blocks(bag: Bag, plan: Plan) -> Iterator[Arrays]:
    """Yield the arrays of up to `BLOCK` scans at a time, named as the format names them.

    Beams run counter-clockwise; every range and intensity keeps its bits. An intensity row that
    has not one value for each beam is NaN.

    Raises
    ------
    RecordingError
        If the recording is damaged, or is not what it was in the survey.
    """
    beams, rows = plan.found.beams, np.flatnonzero(plan.keep)
    block: Arrays = {"scans/ranges": np.empty((BLOCK, beams.count), np.float32)}
    if plan.found.has_intensities:
        block["scans/intensities"] = np.empty((BLOCK, beams.count), np.float32)
    start = filled = 0
    for scan in _kept_scans(bag, plan):
        block["scans/ranges"][filled] = scan.ranges
        if plan.found.has_intensities:
            whole = len(scan.intensities) == beams.count
            block["scans/intensities"][filled] = scan.intensities if whole else np.nan
        filled += 1
        if filled == BLOCK or start + filled == len(rows):
            yield _finish(block, plan, rows[start : start + filled])
            start, filled = start + filled, 0


def _kept_scans(bag: Bag, plan: Plan) -> Iterator[Scan]:
    index = -1
    for index, message in enumerate(with_progress(bag, (plan.topic,), "convert")):
        scan = plan.decode(message)
        if index >= len(plan.keep) or len(scan.ranges) != plan.found.beams.count:
            raise RecordingError(bag.path, "the recording changed while it was read")
        if plan.keep[index]:
            yield scan
    if index + 1 != len(plan.keep):
        raise RecordingError(bag.path, "the recording changed while it was read")


def _finish(block: Arrays, plan: Plan, rows: NDArray[np.intp]) -> Arrays:
    clockwise = plan.found.beams.reversed
    flips = {"scans/ranges": clockwise, "scans/intensities": clockwise != plan.reverse_intensities}
    done = {
        name: array[: len(rows), :: -1 if flips[name] else 1].copy()  # the buffer is used again
        for name, array in block.items()
    }
    stamps, poses = plan.found.stamps_ns[rows], plan.poses.poses[rows]
    return done | {"scans/stamps_ns": stamps, "poses/initial": poses}
