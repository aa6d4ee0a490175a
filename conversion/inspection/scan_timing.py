"""When scans were taken: what their headers say, alone and against the times of recording."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any, NamedTuple

import numpy as np

from conversion.inspection.findings import StampReport
from conversion.messages.scans import Beams
from conversion.messages.survey import ScanLog

_MISSING_FROM = 1.5  # periods: from there on a gap lacks scans
_NEAR, _STEADY = 0.2, 0.6  # this share of gaps near the median: else nothing can be missing
_TOLERANCE = 0.1
_BEAM_SHARE = 0.5  # of a beam's width, and then some, is what angle_max may be off


class Timing(NamedTuple):
    """What a LaserScan says besides its ranges: the last angle, rad, and how long it takes, s."""

    angle_max: float
    time_increment: float
    scan_time: float

    @classmethod
    def of(cls, message: Any) -> Timing:
        """Take it from a deserialised LaserScan."""
        numbers = (message.angle_max, message.time_increment, message.scan_time)
        return cls(*(float(number) for number in numbers))


def iso(stamp_ns: int) -> str:
    """Write a stamp as ISO 8601 in UTC, to the millisecond."""
    moment = datetime.fromtimestamp(stamp_ns // 10**9, UTC)
    return f"{moment:%Y-%m-%dT%H:%M:%S}.{stamp_ns // 10**6 % 1000:03d}Z"


def report_stamps(log: ScanLog) -> StampReport | None:
    """Look at the stamps of headers, alone and against the times of recording."""
    header, record = log.header_ns, log.record_ns
    if not header.size:
        return None
    steps = np.diff(header)
    onward = steps[steps > 0]
    period = float(np.median(onward)) / 1e9 if onward.size else None
    lead, low, high = (float(q) / 1e9 for q in np.quantile(header - record, (0.5, 0.05, 0.95)))
    missing = 0
    periods = onward / (period * 1e9) if period is not None else np.zeros(0)
    if periods.size and np.mean(np.abs(periods - 1) <= _NEAR) >= _STEADY:
        missing = int(np.round(periods[periods > _MISSING_FROM] - 1).sum())
    return StampReport(
        first=iso(int(header[0])),
        last=iso(int(header[-1])),
        period_s=period,
        missing=missing,
        zero=int((header == 0).sum()),
        repeated=int((steps == 0).sum()),
        backward=int((steps < 0).sum()),
        furthest_back_s=max(0, -int(steps.min(initial=0))) / 1e9,
        lead_s=lead,
        lead_low_s=low,
        lead_high_s=high,
    )


def timing_oddities(
    timings: Sequence[Timing], beams: Beams, period_s: float | None
) -> tuple[str, ...]:
    """Say what does not fit: the last angle, the time of a beam, the time of a scan.

    Parameters
    ----------
    timings
        Of some of the scans.
    beams
        Of the first of them.
    period_s
        Median time between scans, s.
    """
    if not timings:
        return ()
    table = np.array(timings)
    angle_max, increment, scan_time = table.T
    said = [*_angle_oddities(float(angle_max[0]), beams)]
    for name, values in (("time_increment", increment), ("scan_time", scan_time)):
        low, high = float(values.min()), float(values.max())
        if not math.isfinite(low + high) or low < 0:
            said.append(f"{name} is {low:g}")
        elif high - low > _TOLERANCE * high:
            said.append(f"{name} changes from message to message, {low:.3g} to {high:.3g} s")
    sweep, stated = float(np.median(increment)) * (beams.count - 1), float(np.median(scan_time))
    if period_s and sweep > (1 + _TOLERANCE) * period_s:
        said.append(f"time_increment makes a scan {sweep:.3g} s, one comes every {period_s:.3g} s")
    if period_s and stated > 0 and abs(stated - period_s) > _TOLERANCE * period_s:
        said.append(f"scan_time is {stated:.3g} s, a scan comes every {period_s:.3g} s")
    return tuple(said)


def _angle_oddities(angle_max: float, beams: Beams) -> tuple[str, ...]:
    if not 0 < beams.angle_increment < math.inf:
        return (f"angle_increment is {beams.angle_increment:g}",)
    first, last = beams.angle_min, beams.angle_min + beams.angle_increment * (beams.count - 1)
    off = abs(angle_max - (first if beams.reversed else last)) / beams.angle_increment
    if not off > _BEAM_SHARE:
        return ()
    given = "what angle_min, angle_increment and the number of beams give, which are taken"
    return (f"angle_max is {off:.1f} beams off {given}",)
