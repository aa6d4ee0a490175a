"""The second pass over a recording: scans as arrays, a bounded block at a time."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from conversion.messages.parts import Part
from conversion.messages.recordings import Recording
from conversion.messages.scans import Scan
from conversion.messages.survey import is_scan, with_progress
from conversion.options import Options
from conversion.plan import BLOCK, Arrays
from semantic2d_dataset.errors import RecordingError


def read_blocks(
    recording: Recording,
    part: Part,
    keep: NDArray[np.bool_],
    rows: Arrays,
    options: Options,
) -> Iterator[Arrays]:
    """Yield the arrays of up to `BLOCK` scans at a time, named as the format names them.

    Beams run counter-clockwise; every range and intensity keeps its bits, but for the ranges
    that the user says mean no return. An intensity row that has not one value for each beam is
    NaN.

    Parameters
    ----------
    recording, part
        What to read, and which scans of it.
    keep
        (n,) bool, the scans of the part to yield.
    rows
        What else there is of each scan of the part, (n, ...).
    options
        `no_return` and `reverse_intensities` count here.

    Raises
    ------
    RecordingError
        If the recording is damaged, or is not what it was in the survey.
    """
    beams, kept = part.run.beams, np.flatnonzero(keep)
    block: Arrays = {"scans/ranges": np.empty((BLOCK, beams.count), np.float32)}
    if part.run.has_intensities:
        block["scans/intensities"] = np.empty((BLOCK, beams.count), np.float32)
    start = filled = 0
    for scan in _kept_scans(recording, part, keep):
        block["scans/ranges"][filled] = scan.ranges
        if part.run.has_intensities:
            whole = len(scan.intensities) == beams.count
            block["scans/intensities"][filled] = scan.intensities if whole else np.nan
        filled += 1
        if filled == BLOCK or start + filled == len(kept):
            which = kept[start : start + filled]
            others = {name: array[which] for name, array in rows.items()}
            yield _finish(block, filled, options, clockwise=beams.reversed) | others
            start, filled = start + filled, 0


def _kept_scans(recording: Recording, part: Part, keep: NDArray[np.bool_]) -> Iterator[Scan]:
    messages = with_progress(recording, (part.log.topic,), "convert", int(part.record_ns[0]))
    scans = (scan for scan in map(recording.scan, messages) if is_scan(scan))
    index = -1
    for index, scan in enumerate(islice(scans, part.skip, part.skip + len(part))):
        if len(scan.ranges) != part.run.beams.count:
            raise RecordingError(recording.path, "the recording changed while it was read")
        if keep[index]:
            yield scan
    if index + 1 != len(part):
        raise RecordingError(recording.path, "the recording changed while it was read")


def _finish(block: Arrays, filled: int, options: Options, *, clockwise: bool) -> Arrays:
    flips = {
        "scans/ranges": clockwise,
        "scans/intensities": clockwise != options.reverse_intensities,
    }
    done = {
        name: array[:filled, :: -1 if flips[name] else 1].copy()  # the buffer is used again
        for name, array in block.items()
    }
    if options.no_return:
        missed = np.isin(done["scans/ranges"], np.array(options.no_return, np.float32))
        done["scans/ranges"][missed] = np.inf
    return done
