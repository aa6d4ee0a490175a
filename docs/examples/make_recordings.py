"""Recordings in the form of OGM-Turtlebot2 and of MIT Stata Center, with a map and the truth.

They stand in for the published data on the pages beside this file, so that anybody can follow
them::

    python docs/examples/make_recordings.py ogm ogm-example
    python docs/examples/make_recordings.py stata stata-example
    python docs/examples/make_recordings.py check TRUTH.npz LABELLED.h5

The same seed gives the same recordings.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy import ndimage
from scipy.spatial import ConvexHull

from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.scene.geometry import compose, invert, wrap_angle
from semantic2d_dataset.scene.lidars import LidarSpec
from semantic2d_dataset.scene.maps import SemanticMap, write_map
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, UNLABELLED
from semantic2d_dataset.simulation.recording import Scene, SimulatedRecording, record, stage
from semantic2d_dataset.simulation.sensors import Surfaces
from semantic2d_dataset.simulation.worlds import draw_world

Float = NDArray[np.float64]
Cells = NDArray[np.bool_]

TURTLEBOT2 = LidarSpec(
    name="turtlebot2-1080",
    model="simulated lidar of OGM-Turtlebot2",
    beams=1080,
    angle_min=-math.radians(135),
    angle_increment=math.radians(270) / 1079,
    range_min=0.1,
    range_max=30.0,
)
PR2 = LidarSpec(
    name="base-scan-1040",
    model="Hokuyo of a PR2's base",
    beams=1040,
    angle_min=-math.radians(130),
    angle_increment=math.radians(0.25),
    range_min=0.023,
    range_max=60.0,
    base_T_lidar=(0.275, 0.0, 0.252, 0.0, 0.0, 0.0),
)
_PEDESTRIANS = 34
_SHARES = {"train": 0.7, "val": 0.1, "test": 0.2}
_STATA_NAME = "2024-01-01-00-00-00"
_GROUND_TRUTH_ERROR = 0.25  # of a particle filter's: 2 cm and 0.5 degrees root mean square

_GROUP_M = 0.3  # objects of a class this near to each other get one shape
_WALL_MARGIN_M = 0.1  # that boxes are drawn around walls, which everything else is drawn over
_GAP_M = 2.0  # in a wall, that a box goes on over

Out = Annotated[Path, typer.Argument(help="Folder to make.")]
Scans = Annotated[int, typer.Option(min=20, help="How many scans to record.")]
Seed = Annotated[int, typer.Option(min=0, help="Of everything.")]
Margin = Annotated[float, typer.Option(min=0, help="That shapes are drawn around objects, m.")]

app = typer.Typer(add_completion=False, no_args_is_help=True, pretty_exceptions_enable=False)


@app.command()
def ogm(out: Out, *, scans: Scans = 1200, seed: Seed = 1, margin: Margin = 0.0) -> None:
    """Record a Turtlebot2 in a lobby with 34 pedestrians, in the layout of OGM-Turtlebot2."""
    _make_folder(out)
    # the map of a simulated building knows all that stands in it
    world = draw_world("lobby", seed, clutter=False)
    for number, (split, share) in enumerate(_SHARES.items(), start=seed):
        at_20_hz = 2 * round(share * scans)
        crowd = stage(world, seed=number, scans=at_20_hz, people=2 * _PEDESTRIANS)
        scene = _every_second(_pedestrians_only(crowd))
        found = record(scene, TURTLEBOT2, seed=number)
        _write_ogm(out / "OGM-datasets" / "OGM-Turtlebot2" / split, split, found)
        _write_truth(out / "truth" / f"{split}.npz", found)
    _write_annotated_map(out, world.scene_map, margin)
    _tell(out, scans, TURTLEBOT2)


@app.command()
def stata(out: Out, *, scans: Scans = 1200, seed: Seed = 1, margin: Margin = 0.0) -> None:
    """Record a PR2 on an office floor: a bag, and the poses of its laser in a file beside it."""
    _make_folder(out)
    world = draw_world("office", seed)
    found = record(stage(world, seed=seed, scans=scans), PR2, seed=seed)
    _write_bag(out / f"{_STATA_NAME}.bag", found)
    _write_laser_poses(out / f"{_STATA_NAME}.gt.laser.poses", found)
    _write_truth(out / "truth" / f"{_STATA_NAME}.npz", found)
    _write_annotated_map(out, world.scene_map, margin)
    _tell(out, scans, PR2)


@app.command()
def check(
    truth: Annotated[Path, typer.Argument(help="What was written below truth/.")],
    labelled: Annotated[Path, typer.Argument(help="What salsa label made of that recording.")],
) -> None:
    """Compare a labelled sequence with the truth."""
    found = compare(truth, labelled)
    typer.echo(
        f"{labelled}: {found['accepted']} of {found['scans']} scans accepted\n"
        f"poses of these: {100 * found['median_m']:.1f} cm off in the median, "
        f"{100 * found['worst_m']:.1f} cm at most\n"
        f"points of these labelled right: {100 * found['right']:.1f} %, "
        f"Person IoU {100 * found['person_iou']:.1f} %"
    )


def compare(truth: Path, labelled: Path) -> dict[str, float]:
    """Count scans and points that are right; only points with a return in accepted scans count."""
    with np.load(truth, allow_pickle=False) as known, SequenceReader(labelled) as reader:
        expected, poses = known["labels"], known["poses"]
        if len(expected) != len(reader):
            raise typer.BadParameter(
                f"{truth} is of {len(expected)} scans, {labelled} of {len(reader)}"
            )
        accepted = reader.read("alignment/accepted").astype(bool)
        labels = reader.read("scans/labels")
        counted = reader.header.lidar.has_return(reader.read("scans/ranges")) & accepted[:, None]
        off = np.hypot(*(reader.read("poses/refined") - poses)[accepted, :2].T)
    told, meant = labels[counted], expected[counted]
    person = SEMANTIC2D.id_of("Person")
    either = (told == person) | (meant == person)
    return {
        "scans": len(expected),
        "accepted": int(accepted.sum()),
        "median_m": float(np.median(off)),
        "worst_m": float(off.max()),
        "right": float((told == meant).mean()),
        "person_iou": float((told == meant)[either].mean()),
    }


def _make_folder(out: Path) -> None:
    if out.exists():
        raise typer.BadParameter(f"{out} exists; name a folder that does not")
    (out / "truth").mkdir(parents=True)


def _tell(out: Path, scans: int, lidar: LidarSpec) -> None:
    typer.echo(f"{out}: {scans} scans of {lidar.beams} beams, a map, its annotation, the truth")


def _pedestrians_only(scene: Scene) -> Scene:
    """Leave the half out who stand: all people of OGM-Turtlebot2 walk."""
    legs, looks = 2 * _PEDESTRIANS, scene.leg_surfaces
    walking = Surfaces(looks.labels[:legs], looks.materials[:legs], looks.shades[:legs])
    return replace(scene, legs=scene.legs[:, :legs], leg_surfaces=walking)


def _every_second(scene: Scene) -> Scene:
    """Record at 10 Hz, as OGM-Turtlebot2 was."""
    ride = scene.drive
    slower = replace(
        ride,
        poses=ride.poses[::2],
        initial_poses=ride.initial_poses[::2],
        velocity=ride.velocity[::2],
    )
    return replace(scene, drive=slower, legs=scene.legs[::2], stamps_ns=scene.stamps_ns[::2])


def _write_ogm(folder: Path, split: str, found: SimulatedRecording) -> None:
    ranges = found.batch.ranges
    kinds = {
        "scans": np.where(np.isposinf(ranges), np.float32(TURTLEBOT2.range_max), ranges),
        "positions": found.initial_poses,
        "velocities": found.velocity,
    }
    names = [f"{row:07d}.npy" for row in range(len(ranges))]
    for kind, rows in kinds.items():
        (folder / kind).mkdir(parents=True)
        for name, row in zip(names, rows, strict=True):
            np.save(folder / kind / name, row)
        (folder / kind / f"{split}.txt").write_text("".join(f"{name}\n" for name in names))


def _write_truth(path: Path, found: SimulatedRecording) -> None:
    np.savez_compressed(path, labels=found.batch.labels, poses=found.true_poses)


def _write_laser_poses(path: Path, found: SimulatedRecording) -> None:
    """Write lines t_us,x,y,yaw of the laser."""
    error = found.initial_poses - found.true_poses
    error[:, 2] = wrap_angle(error[:, 2])
    mount = np.array(PR2.base_T_lidar)[[0, 1, 5]]
    poses = compose(found.true_poses + _GROUND_TRUTH_ERROR * error, mount)
    lines = (
        f"{stamp // 1000},{x:.6f},{y:.6f},{yaw:.6f}\n"
        for stamp, (x, y, yaw) in zip(found.batch.stamps_ns.tolist(), poses.tolist(), strict=True)
    )
    path.write_text("".join(lines))


def _write_bag(path: Path, found: SimulatedRecording) -> None:
    """Write a ROS 1 bag as a PR2 records it: scans without intensities, tf without a map."""
    store = get_typestore(Stores.ROS1_NOETIC)
    tf_type, scan_type = "tf/msg/tfMessage", "sensor_msgs/msg/LaserScan"
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", tf_type))
    odometry = compose(invert(found.true_poses[0]), found.true_poses)
    with Writer(path) as writer:
        topics = {
            tf_type: writer.add_connection("/tf", tf_type, typestore=store),
            scan_type: writer.add_connection("/base_scan", scan_type, typestore=store),
        }
        stamps = found.batch.stamps_ns.tolist()
        for stamp, ranges, moved in zip(stamps, found.batch.ranges, odometry, strict=True):
            for message in (_tf(store, stamp, moved), _scan(store, stamp, ranges)):
                kind = message.__msgtype__
                writer.write(topics[kind], stamp, store.serialize_ros1(message, kind))


def _header(store: Any, stamp_ns: int, frame: str) -> Any:
    seconds, nanoseconds = divmod(stamp_ns, 10**9)
    stamp = store.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    return store.types["std_msgs/msg/Header"](seq=0, stamp=stamp, frame_id=frame)


def _scan(store: Any, stamp_ns: int, ranges: NDArray[np.float32]) -> Any:
    return store.types["sensor_msgs/msg/LaserScan"](
        header=_header(store, stamp_ns, "base_laser_link"),
        angle_min=PR2.angle_min,
        angle_max=PR2.angle_min + PR2.angle_increment * (PR2.beams - 1),
        angle_increment=PR2.angle_increment,
        time_increment=0.0,
        scan_time=0.05,
        range_min=PR2.range_min,
        range_max=PR2.range_max,
        ranges=ranges,
        intensities=np.zeros(0, np.float32),
    )


def _tf(store: Any, stamp_ns: int, moved: Float) -> Any:
    x, y, yaw = moved.tolist()
    edges = (
        ("odom_combined", "base_footprint", (x, y, 0.0), yaw),
        ("base_footprint", "base_link", (0.0, 0.0, 0.051), 0.0),
        ("base_link", "base_laser_link", PR2.base_T_lidar[:3], 0.0),
    )
    vector, turn = store.types["geometry_msgs/msg/Vector3"], "geometry_msgs/msg/Quaternion"
    transforms = [
        store.types["geometry_msgs/msg/TransformStamped"](
            header=_header(store, stamp_ns, parent),
            child_frame_id=child,
            transform=store.types["geometry_msgs/msg/Transform"](
                translation=vector(x=xyz[0], y=xyz[1], z=xyz[2]),
                rotation=store.types[turn](x=0.0, y=0.0, z=math.sin(a / 2), w=math.cos(a / 2)),
            ),
        )
        for parent, child, xyz, a in edges
    ]
    return store.types["tf/msg/tfMessage"](transforms=transforms)


def _write_annotated_map(out: Path, scene: SemanticMap, margin_m: float) -> None:
    """Write the map, and what somebody would draw over it in labelme: large shapes first."""
    write_map(out / "map.yaml", scene)
    height, width = scene.labels.shape
    upright = scene.labels[::-1]  # row 0 of an image is its top
    walls = upright == SEMANTIC2D.id_of("Wall")
    shapes = [_shape("Wall", box) for box in _wall_boxes(walls, scene.resolution)]
    others = [
        (SEMANTIC2D.names[label], cells)
        for label in np.unique(upright[(upright != UNLABELLED) & ~walls])
        for cells in _objects(upright == label, scene.resolution)
    ]
    others.sort(key=lambda other: _extent(other[1]), reverse=True)
    shapes += [_shape(name, _outline(cells, margin_m / scene.resolution)) for name, cells in others]
    said = {
        "version": "5.11.0",
        "flags": {},
        "shapes": shapes,
        "imagePath": "map.pgm",
        "imageData": None,
        "imageHeight": height,
        "imageWidth": width,
    }
    (out / "map.json").write_text(json.dumps(said, indent=1))


def _shape(name: str, points: Float) -> dict[str, Any]:
    corners = [[round(float(x), 2), round(float(y), 2)] for x, y in points]
    return {
        "label": name,
        "points": corners,
        "group_id": None,
        "shape_type": "polygon",
        "flags": {},
    }


def _wall_boxes(walls: Cells, resolution: float) -> Iterator[Float]:
    """Corners x, y (4, 2) in pixels of boxes along the longest stretches of wall."""
    gap, margin = round(_GAP_M / resolution), round(_WALL_MARGIN_M / resolution)
    left = np.pad(walls, gap)  # closing gaps nibbles at the edge
    while left.any():
        runs = []
        for line in (np.ones((1, gap), bool), np.ones((gap, 1), bool)):
            closed = ndimage.binary_closing(left, line) | left
            along = np.zeros((3, 3), bool)
            along[(1, slice(None)) if line.shape[0] == 1 else (slice(None), 1)] = True
            runs += ndimage.find_objects(ndimage.label(closed, along)[0])
        rows, columns = max(runs, key=lambda run: int(left[run].sum()))
        top, bottom = rows.start - margin, rows.stop + margin
        first, last = columns.start - margin, columns.stop + margin
        left[top:bottom, first:last] = False
        yield np.array(((first, top), (last, top), (last, bottom), (first, bottom))) - float(gap)


def _objects(cells: Cells, resolution: float) -> Iterator[NDArray[np.int64]]:
    """Rows and columns (K, 2) of cells that lie near each other."""
    near = ndimage.distance_transform_edt(~cells) * resolution <= _GROUP_M / 2
    groups, count = ndimage.label(near, np.ones((3, 3)))
    for number in range(1, count + 1):
        yield np.argwhere(cells & (groups == number))


def _extent(cells: NDArray[np.int64]) -> float:
    return float(np.prod(np.ptp(cells, axis=0) + 1))


def _outline(cells: NDArray[np.int64], margin: float) -> Float:
    """Corners x, y (K, 2) in pixels of the hull of cells (row, column), drawn with a margin."""
    low, high = 0.05 - margin, 0.95 + margin  # an edge between pixels would take both
    around = np.array([(a, b) for a in (low, high) for b in (low, high)])
    points = (cells[:, None, ::-1] + around).reshape(-1, 2)
    hull: Float = points[ConvexHull(points).vertices]
    return hull


if __name__ == "__main__":
    app()
