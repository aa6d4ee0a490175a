"""The bytes of poses and transforms in ROS 1 and in little-endian CDR.

rosbags makes an object of every field, covariances included; of a recording's many transforms
and poses only stamps, frames and seven numbers are wanted. Each function returns None where the
bytes are not laid out like its message, and then rosbags has the say.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from functools import lru_cache, partial

from conversion.messages.recordings import PoseSample, TransformSample
from conversion.messages.scans import CDR_LITTLE_ENDIAN, read_frame
from conversion.messages.tracks import usable

POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
ODOMETRY = "nav_msgs/msg/Odometry"

_COUNT = struct.Struct("<I")
_HEADER_ROS1 = struct.Struct("<4I")  # seq, sec, nsec, length of frame_id
_HEADER_CDR = struct.Struct("<iII")  # sec, nanosec, length of frame_id with its NUL
_POSE = struct.Struct("<7d")  # position, quaternion
_COVARIANCE = 36 * 8
_TWIST = 6 * 8
# whether child_frame_id comes before the pose, and how many bytes follow it
_AROUND_POSE = {
    POSE_STAMPED: (False, 0),
    POSE_WITH_COVARIANCE: (False, _COVARIANCE),
    ODOMETRY: (True, _COVARIANCE + _TWIST + _COVARIANCE),
}

Transforms = list[TransformSample]


def transforms_ros1(raw: bytes, *, static: bool) -> Transforms | None:
    """Decode a TFMessage of ROS 1."""
    try:
        (count,), at, found = _COUNT.unpack_from(raw), 4, []
        for _ in range(count):
            _, sec, nsec, size = _HEADER_ROS1.unpack_from(raw, at)
            child_at = at + _HEADER_ROS1.size + size
            (child_size,) = _COUNT.unpack_from(raw, child_at)
            pose_at = child_at + 4 + child_size
            values = usable(_POSE.unpack_from(raw, pose_at))
            parent = read_frame(raw[at + _HEADER_ROS1.size : child_at])
            child = read_frame(raw[child_at + 4 : pose_at])
            at = pose_at + _POSE.size
            if values is not None:
                stamp_ns = sec * 10**9 + nsec
                found.append(TransformSample(stamp_ns, parent, child, values, static))
    except (struct.error, ValueError):
        return None
    return found if at == len(raw) else None


def transforms_cdr(raw: bytes, *, static: bool) -> Transforms | None:
    """Decode a TFMessage in CDR."""
    if raw[:2] != CDR_LITTLE_ENDIAN:
        return None
    try:
        (count,), at, found = _COUNT.unpack_from(raw, 4), 8, []
        for _ in range(count):
            sec, nsec, size = _HEADER_CDR.unpack_from(raw, at)
            parent_at = at + _HEADER_CDR.size
            child_at = parent_at + size + -size % 4 + 4
            (child_size,) = _COUNT.unpack_from(raw, child_at - 4)
            pose_at = child_at + child_size
            pose_at += (4 - pose_at) % 8  # numbers of 8 bytes are aligned from byte 4 on
            values = usable(_POSE.unpack_from(raw, pose_at))
            parent = _read_ended(raw[parent_at : parent_at + size])
            child = _read_ended(raw[child_at : child_at + child_size])
            at = pose_at + _POSE.size
            if values is not None:
                stamp_ns = sec * 10**9 + nsec
                found.append(TransformSample(stamp_ns, parent, child, values, static))
    except (struct.error, ValueError):
        return None
    return found if at == len(raw) else None


def _pose_ros1(raw: bytes, *, child: bool, tail: int) -> PoseSample | None:
    try:
        _, sec, nsec, size = _HEADER_ROS1.unpack_from(raw)
        at = _HEADER_ROS1.size + size
        frame = read_frame(raw[_HEADER_ROS1.size : at])
        if child:
            (size,) = _COUNT.unpack_from(raw, at)
            read_frame(raw[at + 4 : at + 4 + size])
            at += 4 + size
        values = _POSE.unpack_from(raw, at)
    except (struct.error, ValueError):
        return None
    whole = at + _POSE.size + tail == len(raw)
    return PoseSample(sec * 10**9 + nsec, frame, usable(values)) if whole else None


def _pose_cdr(raw: bytes, *, child: bool, tail: int) -> PoseSample | None:
    if raw[:2] != CDR_LITTLE_ENDIAN:
        return None
    try:
        sec, nsec, size = _HEADER_CDR.unpack_from(raw, 4)
        at = 4 + _HEADER_CDR.size
        frame = _read_ended(raw[at : at + size])
        at += size
        if child:
            at += -at % 4 + 4
            (size,) = _COUNT.unpack_from(raw, at - 4)
            _read_ended(raw[at : at + size])
            at += size
        at += (4 - at) % 8
        values = _POSE.unpack_from(raw, at)
    except (struct.error, ValueError):
        return None
    whole = at + _POSE.size + tail == len(raw)
    return PoseSample(sec * 10**9 + nsec, frame, usable(values)) if whole else None


@lru_cache(4096)
def _read_ended(name: bytes) -> str:
    """Read a frame that ends with a NUL."""
    if name[-1:] != b"\0":
        raise ValueError("a text without its NUL")
    return read_frame(name[:-1])


def _poses_by(
    decode: Callable[..., PoseSample | None],
) -> Mapping[str, Callable[[bytes], PoseSample | None]]:
    return {
        type_: partial(decode, child=child, tail=tail)
        for type_, (child, tail) in _AROUND_POSE.items()
    }


POSES_ROS1 = _poses_by(_pose_ros1)
"""Decoders of poses in ROS 1 by their type."""
POSES_CDR = _poses_by(_pose_cdr)
"""Decoders of poses in CDR by their type."""
