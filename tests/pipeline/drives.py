"""Recordings made in the room of `tests.salsa.rooms`, and configurations that use them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from tests.conversion.recordings import Recording
from tests.salsa import rooms


def room_drive(
    folder: Path,
    name: str,
    *,
    kind: str = "mcap",
    scans: int = 24,
    seed: int = 0,
    warp: Callable[[NDArray[Any]], NDArray[Any]] | None = None,
) -> Path:
    """A recording of a walk through the room, its poses 8 cm and 2 degrees off.

    `warp` makes other ranges of those of the room.
    """
    truth = rooms.true_poses(scans)
    batch = rooms.batch_at(truth, rooms.rough_poses(truth, seed=seed + 1), seed=seed)
    drive, lidar = Recording(kind), rooms.LIDAR
    ranges_of = batch.ranges if warp is None else warp(batch.ranges).astype(np.float32)
    start = int(batch.stamps_ns[0])
    mount = tuple(lidar.base_T_lidar)
    drive.add_tf(start, "base_link", "laser", mount[:3], mount[3:], topic="/tf_static")
    for ranges, pose, stamp in zip(ranges_of, batch.poses, batch.stamps_ns, strict=True):
        drive.add_pose(int(stamp), tuple(map(float, pose)), topic="/amcl_pose")
        drive.add_scan(
            int(stamp),
            ranges,
            intensities=np.ones_like(ranges),
            angle_min=lidar.angle_min,
            increment=lidar.angle_increment,
            limits=(lidar.range_min, lidar.range_max),
        )
    return drive.write(folder, name)


def two_drives(folder: Path, **more: Any) -> Path:
    """Two recordings, map, annotation and the configuration of a data set of them."""
    folder.mkdir(exist_ok=True)
    rooms.write_room(folder)
    room_drive(folder, "monday", kind="ros1", **more)
    room_drive(folder, "tuesday", seed=5, **more)
    return write_config(folder, config())


def config() -> dict[str, Any]:
    return {
        "name": "rooms",
        "version": "1.0.0",
        "license": "CC0-1.0",
        "out": "data",
        "maps": {"room": {"map": "room.yaml", "annotation": "room.json"}},
        "recordings": [
            {"path": "monday.bag", "map": "room"},
            {"path": "tuesday", "map": "room", "recording": "second"},
        ],
    }


def write_config(folder: Path, said: dict[str, Any], name: str = "data.yaml") -> Path:
    (folder / name).write_text(yaml.safe_dump(said), encoding="utf-8")
    return folder / name


def files_of(folder: Path) -> dict[str, bytes]:
    """Everything in a data set's folder but the working files."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.relative_to(folder).parts[0] != "work"
    }
