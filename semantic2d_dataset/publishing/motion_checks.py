"""Which stamps and poses of a sequence are not to be trusted."""

from __future__ import annotations

from collections.abc import Iterator

from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.publishing.findings import NOTE, WARNING, Finding
from semantic2d_dataset.publishing.motion_measures import MotionMeasures, measure_motion

# The lidars of the release run at 20 Hz; scanners are sold from about 1 Hz to 100 Hz.
_RATES_HZ = (1.0, 100.0)
_GAP_S = 1.0
_REPEATED = 0.01
# A person walks at 1.4 m/s, and a robot indoors seldom faster than 2 m/s; semantic2d-mini has at
# most 0.9 m/s and 1.2 rad/s, the poses of SALSA for it 1.0 m/s.
_SPEED_M_S = 5.0
_TURN_RAD_S = 6.3
_YEAR_2000_NS = 946_684_800_000_000_000


def check_motion(reader: SequenceReader) -> list[Finding]:
    """Check stamps and poses of a sequence; one without scans has been found before."""
    if not len(reader):
        return []
    measures = measure_motion(reader)
    stamps, poses = f"{reader.path}: scans/stamps_ns", f"{reader.path}: poses"
    source = reader.header.stamps_source
    return [*_stamps(stamps, source, measures), *_poses(poses, measures)]


def _stamps(where: str, source: str, found: MotionMeasures) -> Iterator[Finding]:
    if source == "synthetic":
        yield Finding(
            NOTE,
            where,
            "made up from the index, at 20 Hz",
            "stamps of the sensor",
            "convert it from the recording, if there is one",
        )
    elif found.first_ns < _YEAR_2000_NS:
        yield Finding(
            WARNING,
            where,
            f"the first stamp is {found.first_ns / 1e9:.1f} s after 1970",
            "time since the Unix epoch",
            "set the clock that recorded, or add what it lacks",
        )
    if found.scans > 1 and not _RATES_HZ[0] <= 1 / max(found.period_s, 1e-9) <= _RATES_HZ[1]:
        yield Finding(
            WARNING,
            where,
            f"a scan every {found.period_s:g} s",
            f"{_RATES_HZ[0]:g} to {_RATES_HZ[1]:g} scans a second",
            "look at the unit of the stamps",
        )
    if found.gap_s > max(_GAP_S, 5 * found.period_s):
        yield Finding(
            WARNING,
            where,
            f"nothing for {found.gap_s:.1f} s before scan {found.gap_at}",
            f"no gap above {_GAP_S:g} s",
            "make it two recordings if it was one that stopped",
        )
    if found.repeated > _REPEATED * found.scans:
        yield Finding(
            WARNING,
            where,
            f"{found.repeated} scans have the stamp of the one before",
            "a stamp for each scan",
            "keep the stamps of the headers when converting",
        )


def _poses(where: str, found: MotionMeasures) -> Iterator[Finding]:
    if found.posed < found.scans:
        yield Finding(
            NOTE if found.posed else WARNING,
            where,
            f"{found.posed} of {found.scans} scans have one",
            "a pose for each scan",
            "give the conversion a topic or file of poses",
        )
    if found.speed_m_s > _SPEED_M_S:
        yield Finding(
            WARNING,
            where,
            f"{found.speed_m_s:.1f} m/s at scan {found.speed_at}",
            f"at most {_SPEED_M_S:g} m/s",
            "look for jumps of the localiser; SALSA can --smooth",
        )
    if found.turn_rad_s > _TURN_RAD_S:
        yield Finding(
            WARNING,
            where,
            f"{found.turn_rad_s:.1f} rad/s at scan {found.turn_at}",
            f"at most {_TURN_RAD_S:g} rad/s",
            "look for jumps of the localiser; SALSA can --smooth",
        )
