"""How stamps and poses of a sequence look: rate, gaps, jumps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.scene.geometry import wrap_angle

_NS = 1e9


@dataclass(frozen=True)
class MotionMeasures:
    """What stamps and poses tell.

    Parameters
    ----------
    scans
        Number of scans.
    first_ns, last_ns
        Stamps of the first and the last one.
    period_s
        Median time between scans.
    repeated
        Scans with the stamp of the one before.
    gap_s, gap_at
        Longest time between two scans, and the index of the second.
    posed
        Scans with a pose.
    speed_m_s, speed_at, turn_rad_s, turn_at
        Largest speed and turn rate from scan to scan, and the indices of the second ones.
    """

    scans: int
    first_ns: int
    last_ns: int
    period_s: float
    repeated: int
    gap_s: float
    gap_at: int
    posed: int
    speed_m_s: float
    speed_at: int
    turn_rad_s: float
    turn_at: int


def measure_motion(reader: SequenceReader) -> MotionMeasures:
    """Measure the stamps and the best poses of a sequence with a scan or more."""
    stamps, poses = reader.read("scans/stamps_ns"), reader.read_poses()
    steps = np.diff(stamps / _NS) if len(stamps) > 1 else np.zeros(1)
    period = float(np.median(steps))
    moves = np.diff(poses, axis=0) if len(poses) > 1 else np.zeros((1, 3))
    # two scans of one stamp do not make a speed: none is faster than the usual rate tells
    times = np.maximum(steps, max(period, 1e-3))
    speed = np.nan_to_num(np.hypot(moves[:, 0], moves[:, 1]) / times)
    turn = np.nan_to_num(np.abs(wrap_angle(moves[:, 2])) / times)
    return MotionMeasures(
        scans=len(stamps),
        first_ns=int(stamps[0]),
        last_ns=int(stamps[-1]),
        period_s=period,
        repeated=int((np.diff(stamps) == 0).sum()),
        gap_s=float(steps.max()),
        gap_at=int(steps.argmax()) + 1,
        posed=int(np.isfinite(poses).all(axis=1).sum()),
        speed_m_s=float(speed.max()),
        speed_at=int(speed.argmax()) + 1,
        turn_rad_s=float(turn.max()),
        turn_at=int(turn.argmax()) + 1,
    )
