"""LaserScan messages: one message, and the beams that all messages of a topic share."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

LASER_SCAN = "sensor_msgs/msg/LaserScan"
CDR_LITTLE_ENDIAN = b"\x00\x01"
"""First bytes of a message in CDR, its encapsulation."""

_ROS1_HEADER = struct.Struct("<4I")  # seq, sec, nsec, length of frame_id
_CDR_HEADER = struct.Struct("<iII")  # sec, nanosec, length of frame_id with its NUL
_LIMITS = struct.Struct("<7fI")  # angles, times and range limits, number of ranges
_COUNT = struct.Struct("<I")
_F4 = np.dtype("<f4")
_ANGLE_SHARE = 0.1  # of a beam's width: how far angles may wander within a topic


class Scan(NamedTuple):
    """One LaserScan message: angles in rad, ranges (B,) f4 in m, intensities (B,) or (0,) f4."""

    stamp_ns: int
    frame: str
    angle_min: float
    angle_increment: float
    range_min: float
    range_max: float
    ranges: NDArray[np.float32]
    intensities: NDArray[np.float32]


@dataclass(frozen=True)
class Beams:
    """What all scans of a topic share; angles in rad, counter-clockwise whatever was recorded.

    Parameters
    ----------
    frame
        The lidar's frame.
    count
        Number of beams B.
    angle_min, angle_increment
        Bearing of the first beam and positive step, after the reversal.
    range_min, range_max
        Limits as the first message states them, m.
    reversed
        Whether the messages run clockwise, so that rows are reversed.
    """

    frame: str
    count: int
    angle_min: float
    angle_increment: float
    range_min: float
    range_max: float
    reversed: bool

    @classmethod
    def of(cls, scan: Scan) -> Beams:
        """Take the beams of a scan."""
        count, step = len(scan.ranges), scan.angle_increment
        clockwise = step < 0
        first = scan.angle_min + step * (count - 1) if clockwise else scan.angle_min
        limits = (scan.range_min, scan.range_max)
        return cls(scan.frame, count, first, abs(step), *limits, clockwise)

    def difference(self, scan: Scan) -> str | None:
        """Say in what a scan differs from these beams, or None where it does not."""
        other = Beams.of(scan)
        if other == self:
            return None
        if other.frame != self.frame:
            return f"frame {other.frame!r} after {self.frame!r}"
        if other.count != self.count:
            return f"{other.count} beams after {self.count}"
        ends = (self.angle_min, self.angle_min + self.angle_increment * (self.count - 1))
        found = (other.angle_min, other.angle_min + other.angle_increment * (self.count - 1))
        wander = max(abs(a - b) for a, b in zip(ends, found, strict=True))
        same = other.reversed == self.reversed and wander <= _ANGLE_SHARE * self.angle_increment
        if same:
            return None
        return f"angles {found[0]:.6f} to {found[1]:.6f} after {ends[0]:.6f} to {ends[1]:.6f} rad"


def plain_frame(name: str) -> str:
    """Write a frame as tf2 does: tf allowed a leading slash."""
    return name.strip().lstrip("/")


@lru_cache(4096)
def read_frame(name: bytes) -> str:
    """Read a frame of a message; the same few come again and again."""
    return plain_frame(name.decode())


def decode_ros1(raw: bytes) -> Scan | None:
    """Decode a ROS 1 LaserScan; None where the bytes are not laid out like one."""
    try:
        _, sec, nsec, size = _ROS1_HEADER.unpack_from(raw)
        at = _ROS1_HEADER.size + size
        return _decode_body(raw, at, sec * 10**9 + nsec, raw[_ROS1_HEADER.size : at])
    except (struct.error, ValueError):
        return None


def decode_cdr(raw: bytes) -> Scan | None:
    """Decode a LaserScan in little-endian CDR; None where the bytes are not laid out like one."""
    if raw[:2] != CDR_LITTLE_ENDIAN:
        return None
    try:
        sec, nsec, size = _CDR_HEADER.unpack_from(raw, 4)
        start = 4 + _CDR_HEADER.size
        at = start + size + -size % 4  # the encapsulation and the header before are multiples of 4
        return _decode_body(raw, at, sec * 10**9 + nsec, raw[start : start + max(size - 1, 0)])
    except (struct.error, ValueError):
        return None


def _decode_body(raw: bytes, at: int, stamp_ns: int, frame: bytes) -> Scan | None:
    angle_min, _, increment, _, _, range_min, range_max, count = _LIMITS.unpack_from(raw, at)
    at += _LIMITS.size
    ranges = np.frombuffer(raw, _F4, count, at)
    at += 4 * count
    (count,) = _COUNT.unpack_from(raw, at)
    at += _COUNT.size
    intensities = np.frombuffer(raw, _F4, count, at)
    if at + 4 * count != len(raw):
        return None
    name = read_frame(frame)
    return Scan(stamp_ns, name, angle_min, increment, range_min, range_max, ranges, intensities)
