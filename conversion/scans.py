"""LaserScan messages: one message, and the beams that all messages of a topic share."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from conversion.bags import Bag, Message

LASER_SCAN = "sensor_msgs/msg/LaserScan"

_ROS1_HEADER = struct.Struct("<4I")  # seq, sec, nsec, length of frame_id
_CDR_HEADER = struct.Struct("<iII")  # sec, nanosec, length of frame_id with its NUL
_CDR_LITTLE_ENDIAN = b"\x00\x01"
_LIMITS = struct.Struct("<7fI")  # angles, times and range limits, number of ranges
_COUNT = struct.Struct("<I")
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


class ScanDecoder:
    """Turn messages into scans: by their layout where it is ROS's own, else by rosbags.

    Parameters
    ----------
    bag
        Where the messages come from; its definition of LaserScan decides.
    """

    def __init__(self, bag: Bag) -> None:
        self._bag = bag
        self._fast: Callable[[bytes], Scan | None] | None = None
        if bag.is_standard(LASER_SCAN):
            self._fast = decode_ros1 if bag.ros1 else decode_cdr

    def __call__(self, message: Message) -> Scan:
        """Decode a message.

        Raises
        ------
        RecordingError
            If its bytes are no LaserScan.
        """
        found = self._fast(message.raw) if self._fast is not None else None
        return found if found is not None else self.parse(message)

    def parse(self, message: Message) -> Scan:
        """Decode a message through rosbags' deserialiser, whatever its layout."""
        return self._bag.read(message, _scan_of)


def _scan_of(message: Any) -> Scan:
    stamp = message.header.stamp
    return Scan(
        int(stamp.sec) * 10**9 + int(stamp.nanosec),
        plain_frame(message.header.frame_id),
        float(message.angle_min),
        float(message.angle_increment),
        float(message.range_min),
        float(message.range_max),
        np.asarray(message.ranges, np.float32),
        np.asarray(message.intensities, np.float32),
    )


def plain_frame(name: str) -> str:
    """Write a frame as tf2 does: tf allowed a leading slash."""
    return name.strip().lstrip("/")


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
    if raw[:2] != _CDR_LITTLE_ENDIAN:
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
    ranges = np.frombuffer(raw, "<f4", count, at)
    at += 4 * count
    (count,) = _COUNT.unpack_from(raw, at)
    at += _COUNT.size
    intensities = np.frombuffer(raw, "<f4", count, at)
    if at + 4 * count != len(raw):
        return None
    name = plain_frame(frame.decode())
    return Scan(stamp_ns, name, angle_min, increment, range_min, range_max, ranges, intensities)
