"""Messages of ROS 2, and the MCAP that they are written to."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from conversion.plan import Arrays
from semantic2d_dataset.scene.lidars import LidarSpec
from semantic2d_dataset.scene.maps import SemanticMap

MAP_FRAME, BASE_FRAME, LIDAR_FRAME = "map", "base_link", "lidar"

STRING = "std_msgs/msg/String"
LASER_SCAN = "sensor_msgs/msg/LaserScan"
POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
OCCUPANCY_GRID = "nav_msgs/msg/OccupancyGrid"
MULTI_ARRAYS: Mapping[str, str] = {
    "<f4": "std_msgs/msg/Float32MultiArray",
    "<f8": "std_msgs/msg/Float64MultiArray",
    "|u1": "std_msgs/msg/UInt8MultiArray",
    "<u2": "std_msgs/msg/UInt16MultiArray",
    "<u4": "std_msgs/msg/UInt32MultiArray",
    "<u8": "std_msgs/msg/UInt64MultiArray",
    "|i1": "std_msgs/msg/Int8MultiArray",
    "<i2": "std_msgs/msg/Int16MultiArray",
    "<i4": "std_msgs/msg/Int32MultiArray",
    "<i8": "std_msgs/msg/Int64MultiArray",
}

_BAG_VERSION: Literal[8] = 8  # ROS 2 Humble cannot read the quality of service of version 9
_FOREVER = QosTime(9223372036, 854775807)  # as ROS writes it

# Fields of the labelled cloud: offset in a point, dtype, and sensor_msgs/PointField's datatype.
_POINT_BYTES = 24
_POINT: Mapping[str, tuple[int, str, int]] = {
    "x": (0, "<f4", 7),
    "y": (4, "<f4", 7),
    "z": (8, "<f4", 7),
    "rgb": (12, "<f4", 7),
    "intensity": (16, "<f4", 7),
    "label": (20, "|u1", 2),
    "confidence": (21, "|u1", 2),
}


@contextmanager
def open_mcap(folder: Path, latched: Collection[str]) -> Iterator[MessageWriter]:
    """Write a ROS 2 bag: a folder that holds ``<its name>.mcap`` and ``metadata.yaml``.

    Parameters
    ----------
    folder
        It must not exist.
    latched
        Topics whose last message those who come late get too (transient local).
    """
    writer = Writer(folder, version=_BAG_VERSION, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        yield MessageWriter(writer, latched)


class MessageWriter:
    """Messages of ROS 2, and the bag that they go to."""

    def __init__(self, writer: Writer, latched: Collection[str]) -> None:
        self._writer = writer
        self._latched = latched
        self._store = get_typestore(Stores.ROS2_HUMBLE)
        self._connections: dict[str, Connection] = {}
        self.counts: dict[str, int] = {}

    def new(self, type_: str, **values: Any) -> Any:
        """Return a message of a type such as ``std_msgs/String``."""
        return self._store.types[type_.replace("/", "/msg/")](**values)

    def send(self, topic: str, message: Any, log_ns: int) -> None:
        """Write a message at a time of recording."""
        type_ = message.__msgtype__
        if topic not in self._connections:
            qos = _quality_of_service(latched=topic in self._latched)
            self._connections[topic] = self._writer.add_connection(
                topic, type_, typestore=self._store, offered_qos_profiles=[qos]
            )
        raw = self._store.serialize_cdr(message, type_)
        self._writer.write(self._connections[topic], log_ns, raw)
        self.counts[topic] = self.counts.get(topic, 0) + 1

    def header(self, stamp_ns: int, frame: str) -> Any:
        """Return a header."""
        stamp = self.time(stamp_ns)
        return self.new("std_msgs/Header", stamp=stamp, frame_id=frame)

    def time(self, stamp_ns: int) -> Any:
        """Return a stamp."""
        sec, nanosec = divmod(int(stamp_ns), 10**9)
        return self.new("builtin_interfaces/Time", sec=sec, nanosec=nanosec)

    def text(self, text: str) -> Any:
        """Return a String."""
        return self.new("std_msgs/String", data=text)

    def rows(self, array: NDArray[Any]) -> Any:
        """Return an array as the MultiArray of its dtype, with its shape as the layout."""
        type_ = MULTI_ARRAYS[array.dtype.str].replace("/msg/", "/")
        sizes = array.shape
        dim = [
            self.new(
                "std_msgs/MultiArrayDimension", label="", size=size, stride=math.prod(sizes[i:])
            )
            for i, size in enumerate(sizes)
        ]
        layout = self.new("std_msgs/MultiArrayLayout", dim=dim, data_offset=0)
        return self.new(type_, layout=layout, data=np.ascontiguousarray(array).reshape(-1))

    def pose(self, x: float, y: float, yaw: float) -> Any:
        """Return a pose in the plane."""
        point = self.new("geometry_msgs/Point", x=x, y=y, z=0.0)
        return self.new("geometry_msgs/Pose", position=point, orientation=self.turn(0.0, 0.0, yaw))

    def turn(self, roll: float, pitch: float, yaw: float) -> Any:
        """Return the quaternion of R = Rz(yaw) Ry(pitch) Rx(roll)."""
        cr, cp, cy = (math.cos(angle / 2) for angle in (roll, pitch, yaw))
        sr, sp, sy = (math.sin(angle / 2) for angle in (roll, pitch, yaw))
        return self.new(
            "geometry_msgs/Quaternion",
            x=sr * cp * cy - cr * sp * sy,
            y=cr * sp * cy + sr * cp * sy,
            z=cr * cp * sy - sr * sp * cy,
            w=cr * cp * cy + sr * sp * sy,
        )

    def transform(self, stamp_ns: int, parent: str, child: str, mount: tuple[float, ...]) -> Any:
        """Return a TFMessage of one transform, x y z roll pitch yaw."""
        x, y, z, *angles = mount
        move = self.new(
            "geometry_msgs/Transform",
            translation=self.new("geometry_msgs/Vector3", x=x, y=y, z=z),
            rotation=self.turn(*angles),
        )
        item = self.new(
            "geometry_msgs/TransformStamped",
            header=self.header(stamp_ns, parent),
            child_frame_id=child,
            transform=move,
        )
        return self.new("tf2_msgs/TFMessage", transforms=[item])

    def scan(self, lidar: LidarSpec, period_s: float, stamp_ns: int, rows: Arrays) -> Any:
        """Return a LaserScan of ranges and intensities (B,)."""
        return self.new(
            "sensor_msgs/LaserScan",
            header=self.header(stamp_ns, LIDAR_FRAME),
            angle_min=lidar.angle_min,
            angle_max=lidar.angle_min + lidar.angle_increment * (lidar.beams - 1),
            angle_increment=lidar.angle_increment,
            time_increment=0.0,
            scan_time=period_s,
            range_min=lidar.range_min,
            range_max=lidar.range_max,
            ranges=rows["scans/ranges"],
            intensities=rows.get("scans/intensities", np.empty(0, np.float32)),
        )

    def cloud(self, stamp_ns: int, points: NDArray[Any]) -> Any:
        """Return a PointCloud2 of points (B,) of a dtype that `cloud_dtype` made."""
        names = points.dtype.names or ()
        fields = [
            self.new("sensor_msgs/PointField", name=name, offset=at, datatype=code, count=1)
            for name, (at, _, code) in _POINT.items()
            if name in names
        ]
        return self.new(
            "sensor_msgs/PointCloud2",
            header=self.header(stamp_ns, LIDAR_FRAME),
            height=1,
            width=len(points),
            fields=fields,
            is_bigendian=False,
            point_step=_POINT_BYTES,
            row_step=_POINT_BYTES * len(points),
            data=points.view(np.uint8),
            is_dense=False,
        )

    def grid(self, stamp_ns: int, scene: SemanticMap) -> Any:
        """Return an OccupancyGrid; unknown cells, 255, are its -1."""
        rows, columns = scene.occupancy.shape
        info = self.new(
            "nav_msgs/MapMetaData",
            map_load_time=self.time(stamp_ns),
            resolution=scene.resolution,
            width=columns,
            height=rows,
            origin=self.pose(scene.origin.x, scene.origin.y, scene.origin.yaw),
        )
        return self.new(
            "nav_msgs/OccupancyGrid",
            header=self.header(stamp_ns, MAP_FRAME),
            info=info,
            data=np.ascontiguousarray(scene.occupancy).reshape(-1).view(np.int8),
        )


def _quality_of_service(*, latched: bool) -> Qos:
    return Qos(
        QosHistory.KEEP_LAST,
        1 if latched else 10,
        QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        _FOREVER,
        _FOREVER,
        QosLiveliness.AUTOMATIC,
        _FOREVER,
        avoid_ros_namespace_conventions=False,
    )


def cloud_dtype(absent: Collection[str]) -> np.dtype[Any]:
    """Return the dtype of the points of a cloud, without the fields that are absent."""
    kept = {name: field for name, field in _POINT.items() if name not in absent}
    return np.dtype(
        {
            "names": list(kept),
            "formats": [dtype for _, dtype, _ in kept.values()],
            "offsets": [at for at, _, _ in kept.values()],
            "itemsize": _POINT_BYTES,
        }
    )
