"""ROS messages of a bag as scans, poses, transforms and velocities."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np

from conversion.messages.recordings import Message, PoseSample, Topic, TransformSample
from conversion.messages.scans import LASER_SCAN, Scan, decode_cdr, decode_ros1, plain_frame
from conversion.messages.tracks import values_of
from conversion.plan import Arrays
from conversion.ros.bags import ROSBAGS_VERSION, Bag
from conversion.ros.definitions import TF_TYPES
from conversion.ros.wire import (
    ODOMETRY,
    POSE_STAMPED,
    POSE_WITH_COVARIANCE,
    POSES_CDR,
    POSES_ROS1,
    transforms_cdr,
    transforms_ros1,
)

POSE_TYPES = (POSE_WITH_COVARIANCE, POSE_STAMPED, ODOMETRY)
TWIST_STAMPED = "geometry_msgs/msg/TwistStamped"
TWIST_TYPES = ("geometry_msgs/msg/Twist", TWIST_STAMPED)


class RosRecording:
    """A bag as a `conversion.messages.recordings.Recording`.

    Parameters
    ----------
    bag
        An open bag; leaving this context closes it.
    """

    def __init__(self, bag: Bag) -> None:
        self.bag = bag
        self.path: Path = bag.path
        self.kind = "ROS 1 bag" if bag.ros1 else "ROS 2 bag"
        self.topics: tuple[Topic, ...] = bag.topics
        self.scan_topics = bag.of_type((LASER_SCAN,))
        self.pose_topics = bag.of_type(POSE_TYPES)
        self.transform_topics = bag.of_type(TF_TYPES)
        self.velocity_topics = bag.of_type(TWIST_TYPES)
        self.versions: Mapping[str, str] = {"rosbags": ROSBAGS_VERSION}
        self.notices: tuple[str, ...] = bag.notices
        # by their layout are read the types that are ROS's own; the others by rosbags
        own = {
            type_
            for type_ in (LASER_SCAN, *POSE_TYPES, *TF_TYPES)
            if bag.of_type((type_,)) and bag.is_standard(type_)
        }
        scan, poses, transforms = _CODECS[bag.ros1]
        self._scan = scan if LASER_SCAN in own else _nothing
        self._poses = {type_: poses[type_] for type_ in POSE_TYPES if type_ in own}
        self._transforms = {type_: transforms for type_ in TF_TYPES if type_ in own}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.bag.__exit__(*error)

    def files(self) -> Sequence[Path]:
        """Return the files of the bag."""
        return self.bag.files()

    def messages(self, topics: Collection[Topic], start_ns: int = 0) -> Iterator[Message]:
        """Yield the messages of some topics, in the order of recording."""
        return self.bag.messages(topics, start_ns)

    def scan(self, message: Message) -> Scan:
        """Decode a LaserScan: by its layout where it is ROS's own, else by rosbags.

        Raises
        ------
        RecordingError
            If its bytes are no LaserScan.
        """
        return self._scan(message.raw) or self.parse_scan(message)

    def parse_scan(self, message: Message) -> Scan:
        """Decode a LaserScan through rosbags' deserialiser, whatever its layout."""
        return self.bag.read(message, self._scan_of)

    def pose(self, message: Message) -> PoseSample:
        """Decode a message of one of `POSE_TYPES`."""
        fast = self._poses.get(message.type, _nothing)
        return fast(message.raw) or self.parse_pose(message)

    def parse_pose(self, message: Message) -> PoseSample:
        """Decode a pose through rosbags' deserialiser, whatever its layout."""
        stamped = message.type == POSE_STAMPED
        return self.bag.read(
            message, lambda m: self._pose_of(m.header, m.pose if stamped else m.pose.pose)
        )

    def transforms(self, message: Message) -> Sequence[TransformSample]:
        """Decode a TFMessage; static are the transforms of a topic named tf_static."""
        static = message.topic.rsplit("/", 1)[-1] == "tf_static"
        fast = self._transforms.get(message.type)
        found = None if fast is None else fast(message.raw, static=static)
        return self.parse_transforms(message) if found is None else found

    def parse_transforms(self, message: Message) -> Sequence[TransformSample]:
        """Decode a TFMessage through rosbags' deserialiser, whatever its layout."""
        static = message.topic.rsplit("/", 1)[-1] == "tf_static"
        return self.bag.read(message, lambda m: list(self._transforms_of(m, static=static)))

    def velocity(self, message: Message) -> tuple[float, float]:
        """Decode a Twist or TwistStamped."""
        stamped = message.type == TWIST_STAMPED
        return self.bag.read(message, lambda m: _velocity_of(m.twist if stamped else m))

    def streams(self, names: Collection[str], start_ns: int, stop_ns: int) -> Iterator[Arrays]:
        """Yield arrays of other topics, as `conversion.ros.streams.read_streams`."""
        from conversion.ros.streams import read_streams

        return read_streams(self.bag, names, start_ns, stop_ns)

    def _stamp_ns(self, stamp: Any) -> int:
        """Seconds have a sign in ROS 2 only; rosbags gives them one in ROS 1 too."""
        seconds = int(stamp.sec) % 2**32 if self.bag.ros1 else int(stamp.sec)
        return seconds * 10**9 + int(stamp.nanosec)

    def _scan_of(self, message: Any) -> Scan:
        return Scan(
            self._stamp_ns(message.header.stamp),
            plain_frame(message.header.frame_id),
            float(message.angle_min),
            float(message.angle_increment),
            float(message.range_min),
            float(message.range_max),
            np.asarray(message.ranges, np.float32),
            np.asarray(message.intensities, np.float32),
        )

    def _pose_of(self, header: Any, pose: Any) -> PoseSample:
        values = values_of(pose.position, pose.orientation)
        return PoseSample(self._stamp_ns(header.stamp), plain_frame(header.frame_id), values)

    def _transforms_of(self, message: Any, *, static: bool) -> Iterator[TransformSample]:
        for item in message.transforms:
            values = values_of(item.transform.translation, item.transform.rotation)
            if values is not None:
                frames = (plain_frame(item.header.frame_id), plain_frame(item.child_frame_id))
                stamp_ns = self._stamp_ns(item.header.stamp)
                yield TransformSample(stamp_ns, *frames, values, static)


def _velocity_of(twist: Any) -> tuple[float, float]:
    return float(twist.linear.x), float(twist.angular.z)


def _nothing(raw: bytes) -> None:
    """Decode no layout: rosbags has the say."""


_CODECS = {
    True: (decode_ros1, POSES_ROS1, transforms_ros1),
    False: (decode_cdr, POSES_CDR, transforms_cdr),
}
