"""Small ROS 1 and ROS 2 recordings with known contents."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

KINDS = ("ros1", "db3", "mcap")
START_NS = 1_700_000_000_000_000_000
BEAMS = 8
LASER = "sensor_msgs/msg/LaserScan"
TF = "tf2_msgs/msg/TFMessage"
OLD_TF = "tf/msg/tfMessage"
AMCL = "geometry_msgs/msg/PoseWithCovarianceStamped"
POSE = "geometry_msgs/msg/PoseStamped"
ODOMETRY = "nav_msgs/msg/Odometry"
STRING = "std_msgs/msg/String"
CUSTOM = "my_robot/msg/Bumper"

_TF_DEFINITION = "geometry_msgs/TransformStamped[] transforms"


def typestore(kind: str) -> Any:
    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    types = get_types_from_msg("std_msgs/Header header\nfloat32[] force", CUSTOM)
    if kind == "ros1":
        types |= get_types_from_msg(_TF_DEFINITION, TF)
        types |= get_types_from_msg(_TF_DEFINITION, OLD_TF)
    store.register(types)
    return store


@dataclass
class Recording:
    """Messages to be written as a bag of one kind."""

    kind: str
    messages: list[tuple[str, str, int, Any]] = field(default_factory=list)
    store: Any = None

    def __post_init__(self) -> None:
        self.store = typestore(self.kind)

    def new(self, type_: str, **values: Any) -> Any:
        return self.store.types[type_](**values)

    def add(self, topic: str, message: Any, record_ns: int) -> None:
        self.messages.append((topic, message.__msgtype__, record_ns, message))

    def stamp(self, ns: int) -> Any:
        return self.new("builtin_interfaces/msg/Time", sec=ns // 10**9, nanosec=ns % 10**9)

    def header(self, ns: int, frame: str) -> Any:
        values: dict[str, Any] = {"stamp": self.stamp(ns), "frame_id": frame}
        if self.kind == "ros1":
            values["seq"] = 7
        return self.new("std_msgs/msg/Header", **values)

    def add_scan(
        self,
        ns: int,
        ranges: Iterable[float],
        *,
        intensities: Iterable[float] = (),
        topic: str = "/scan",
        frame: str = "laser",
        angle_min: float = -1.0,
        increment: float = 0.25,
        limits: tuple[float, float] = (0.1, 30.0),
        record_ns: int | None = None,
    ) -> None:
        values = np.ascontiguousarray(ranges, np.float32)
        scan = self.new(
            LASER,
            header=self.header(ns, frame),
            angle_min=angle_min,
            angle_max=angle_min + increment * (len(values) - 1),
            angle_increment=increment,
            time_increment=0.0,
            scan_time=0.1,
            range_min=limits[0],
            range_max=limits[1],
            ranges=values,
            intensities=np.ascontiguousarray(intensities, np.float32),
        )
        self.add(topic, scan, ns if record_ns is None else record_ns)

    def pose(self, x: float, y: float, yaw: float) -> Any:
        point = self.new("geometry_msgs/msg/Point", x=x, y=y, z=0.0)
        return self.new(
            "geometry_msgs/msg/Pose", position=point, orientation=self.turn(0.0, 0.0, yaw)
        )

    def turn(self, roll: float, pitch: float, yaw: float) -> Any:
        cr, cp, cy = (math.cos(a / 2) for a in (roll, pitch, yaw))
        sr, sp, sy = (math.sin(a / 2) for a in (roll, pitch, yaw))
        return self.new(
            "geometry_msgs/msg/Quaternion",
            x=sr * cp * cy - cr * sp * sy,
            y=cr * sp * cy + sr * cp * sy,
            z=cr * cp * sy - sr * sp * cy,
            w=cr * cp * cy + sr * sp * sy,
        )

    def add_pose(
        self,
        ns: int,
        xyyaw: tuple[float, float, float],
        *,
        topic: str,
        type_: str = AMCL,
        frame: str = "map",
        record_ns: int | None = None,
    ) -> None:
        pose = self.pose(*xyyaw)
        values: dict[str, Any] = {"header": self.header(ns, frame), "pose": pose}
        zeros = np.zeros(36)
        if type_ != POSE:
            values["pose"] = self.new(
                "geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=zeros
            )
        if type_ == ODOMETRY:
            zero = self.new("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
            twist = self.new("geometry_msgs/msg/Twist", linear=zero, angular=zero)
            values["twist"] = self.new(
                "geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=zeros
            )
            values["child_frame_id"] = "base_link"
        self.add(topic, self.new(type_, **values), ns if record_ns is None else record_ns)

    def add_tf(
        self,
        ns: int,
        parent: str,
        child: str,
        xyz: tuple[float, float, float],
        rpy: tuple[float, float, float] = (0.0, 0.0, 0.0),
        *,
        topic: str = "/tf",
        type_: str = TF,
        record_ns: int | None = None,
    ) -> None:
        move = self.new(
            "geometry_msgs/msg/Transform",
            translation=self.new("geometry_msgs/msg/Vector3", **dict(zip("xyz", xyz, strict=True))),
            rotation=self.turn(*rpy),
        )
        item = self.new(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(ns, parent),
            child_frame_id=child,
            transform=move,
        )
        message = self.new(type_, transforms=[item])
        self.add(topic, message, ns if record_ns is None else record_ns)

    def write(
        self, folder: Path, name: str = "drive", *, compression: str | None = None, chunk: int = 0
    ) -> Path:
        """Write the bag; its path is a .bag file, or a ROS 2 folder.

        `compression` is bz2 or lz4 in ROS 1; file, message or storage (of MCAP) in ROS 2.
        `chunk` is the size in bytes that a chunk of ROS 1 grows to.
        """
        path = folder / (f"{name}.bag" if self.kind == "ros1" else name)
        with self._writer(path, compression, chunk) as writer:
            serialise: Callable[[Any, str], Any] = self.store.serialize_cdr
            if self.kind == "ros1":
                serialise = self.store.serialize_ros1
            connections: dict[tuple[str, str], Any] = {}
            for topic, type_, record_ns, message in self.messages:
                key = (topic, type_)
                if key not in connections:
                    connections[key] = writer.add_connection(topic, type_, typestore=self.store)
                writer.write(connections[key], record_ns, serialise(message, type_))
        return path

    def _writer(self, path: Path, compression: str | None, chunk: int) -> Any:
        if self.kind == "ros1":
            writer = Writer1(path)
            if compression:
                writer.set_compression(Writer1.CompressionFormat[compression.upper()])
            writer.chunk_threshold = chunk or writer.chunk_threshold
            return writer
        plugin = StoragePlugin.MCAP if self.kind == "mcap" else StoragePlugin.SQLITE3
        writer2 = Writer2(path, version=9, storage_plugin=plugin)
        if compression:
            writer2.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
        return writer2


def storage_of(path: Path) -> Path:
    """The file that holds the messages of a bag."""
    return path if path.is_file() else next(p for p in path.iterdir() if p.suffix != ".yaml")


def add_checksums(mcap: Path) -> None:
    """Give an MCAP the checksums that ROS 2's recorder writes, and rosbags' does not."""
    data = bytearray(mcap.read_bytes())
    at = 8
    while data[at] != 0x02:
        size = int.from_bytes(data[at + 1 : at + 9], "little")
        if data[at] == 0x06:  # an uncompressed chunk: times, size, checksum, codec, size, records
            crc = zlib.crc32(data[at + 9 + 40 : at + 9 + size])
            data[at + 33 : at + 37] = crc.to_bytes(4, "little")
        at += 9 + size
    start = int.from_bytes(data[at + 9 : at + 17], "little")
    data[at + 25 : at + 29] = zlib.crc32(data[start : at + 25]).to_bytes(4, "little")
    mcap.write_bytes(data)


def straight_drive(
    kind: str, scans: int = 12, *, reach: float = 2.0, with_tf: bool = True
) -> Recording:
    """One lidar at 10 Hz on a base that drives 1 m/s along x, turning 0.5 rad/s, in the map.

    The lidar sits 0.2 m ahead of the base, 0.1 m to the left, upside down and turned by 0.3 rad.
    """
    drive = Recording(kind)
    random = np.random.default_rng(3)
    if with_tf:
        mount = ((0.2, 0.1, 0.3), (math.pi, 0.0, 0.3))
        drive.add_tf(START_NS, "base_link", "laser", *mount, topic="/tf_static")
        drive.add_tf(START_NS, "map", "odom", (5.0, 1.0, 0.0), topic="/tf_static")
    for n in range(scans):
        ns = START_NS + n * 100_000_000
        if with_tf:
            t = n * 0.1
            drive.add_tf(ns, "odom", "base_link", (t, 0.0, 0.0), (0.0, 0.0, 0.5 * t))
        ranges = random.uniform(0.2, reach, BEAMS).astype(np.float32)
        drive.add_scan(ns + 50_000_000, ranges, intensities=np.arange(BEAMS) + n)
    return drive
