"""A room of axis-parallel boxes: exact ranges in it, and the map that mapping would make of it."""

import json
from dataclasses import replace

import numpy as np

from semantic2d_dataset.scene.geometry import Pose2, compose, mount_in_plane, to_base
from semantic2d_dataset.scene.lidars import LidarSpec
from semantic2d_dataset.scene.maps import FREE, OCCUPIED, UNKNOWN, SemanticMap, write_map
from semantic2d_dataset.scene.scans import ScanBatch
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, UNLABELLED

RESOLUTION = 0.05
ORIGIN = Pose2(0.0, 0.0, 0.0)
SHAPE = (140, 180)
# x1, y1, x2, y2 in m: surfaces run through the middle of cells
BOXES = {
    "Wall": (0.525, 0.525, 8.525, 6.525),
    "Pillar": (3.025, 2.025, 3.525, 2.525),
    "Table": (5.525, 4.525, 6.725, 5.325),
    "Sofa": (7.525, 0.525, 8.525, 2.025),
}
LIDAR = LidarSpec(
    "test", "test", 541, -2.356, 2 * 2.356 / 540, 0.1, 20.0, (-0.12, 0.05, 0, 0, 0, 0)
)
UPSIDE_DOWN = replace(LIDAR, base_T_lidar=(0.065, 0.02, 0.182, np.pi, 0.0, 0.3))
BACKWARD = replace(LIDAR, base_T_lidar=(0.065, 0.0, 0.11, 0.0, 0.0, np.pi))


def room_map(origin=ORIGIN):
    """Cells that a surface runs through are occupied, those outside the walls unknown."""
    occupancy = np.full(SHAPE, UNKNOWN, np.uint8)
    labels = np.full(SHAPE, UNLABELLED, np.uint8)
    r1, c1, r2, c2 = _cells(BOXES["Wall"])
    occupancy[r1:r2, c1:c2] = FREE
    for name, box in BOXES.items():
        r1, c1, r2, c2 = _cells(box)
        edge = np.zeros(SHAPE, bool)
        edge[r1 : r2 + 1, c1 : c2 + 1] = True
        edge[r1 + 1 : r2, c1 + 1 : c2] = False
        occupancy[edge], labels[edge] = OCCUPIED, SEMANTIC2D.id_of(name)
    return SemanticMap(occupancy, labels, RESOLUTION, origin)


def _cells(box):
    x1, y1, x2, y2 = (int(value / RESOLUTION) for value in box)
    return y1, x1, y2, x2


def true_poses(count):
    """A walk through the free space of the room."""
    turn = np.linspace(0.0, 1.5, count)
    return np.stack((4.5 + 1.3 * np.cos(turn), 3.5 + 0.7 * np.sin(turn), 2.0 * turn), axis=-1)


def cast(pose, lidar, boxes):
    """Exact ranges (B,) of a lidar whose base stands at a pose."""
    rotation, _ = mount_in_plane(lidar.base_T_lidar)
    c, s = np.cos(pose[2]), np.sin(pose[2])
    turn = np.array(((c, -s), (s, c)))
    place = pose[:2] + turn @ to_base(np.zeros(2), lidar.base_T_lidar)
    beams = np.stack((np.cos(lidar.bearings), np.sin(lidar.bearings)), axis=-1)
    d = beams @ (turn @ rotation).T
    nearest = np.full(lidar.beams, np.inf)
    for x1, y1, x2, y2 in boxes:
        for axis, level, low, high in (
            (0, x1, y1, y2),
            (0, x2, y1, y2),
            (1, y1, x1, x2),
            (1, y2, x1, x2),
        ):
            with np.errstate(divide="ignore", invalid="ignore"):
                t = (level - place[axis]) / d[:, axis]
                other = place[1 - axis] + t * d[:, 1 - axis]
            hit = (t > 0) & (other >= low) & (other <= high)
            nearest[hit] = np.minimum(nearest[hit], t[hit])
    return nearest


def batch_at(poses, rough, lidar=LIDAR, extra=(), noise=0.01, seed=0):
    """Scans taken at `poses` with rough poses beside them; 2 % of the beams return nothing."""
    rng = np.random.default_rng(seed)
    ranges = np.stack([cast(pose, lidar, (*BOXES.values(), *extra)) for pose in poses])
    ranges += rng.normal(0.0, noise, ranges.shape)
    ranges[rng.random(ranges.shape) < 0.02] = np.inf
    stamps = 1_700_000_000_000_000_000 + np.arange(len(poses)) * 50_000_000
    return ScanBatch(lidar, ranges.astype(np.float32), None, None, np.asarray(rough, float), stamps)


def rough_poses(poses, metres=0.08, degrees=2.0, seed=1):
    rng = np.random.default_rng(seed)
    sigma = np.array((metres, metres, np.deg2rad(degrees)))
    return compose(poses, rng.normal(0.0, 1.0, poses.shape) * sigma / np.array((2**0.5, 2**0.5, 1)))


def errors(found, truth):
    difference = found - truth
    turn = (difference[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return np.hypot(difference[:, 0], difference[:, 1]), np.abs(np.rad2deg(turn))


def shape(label, points, shape_type="polygon", **more):
    return {"label": label, "points": points, "shape_type": shape_type, **more}


def pixel_box(box, margin=2.0):
    """Corners of a box in the pixels of the map's image, whose row 0 is the largest y."""
    x1, y1, x2, y2 = (value / RESOLUTION for value in box)
    top, bottom = SHAPE[0] - y2 - margin, SHAPE[0] - y1 + margin
    return [[x1 - margin, top], [x2 + margin, top], [x2 + margin, bottom], [x1 - margin, bottom]]


def room_shapes():
    """Walls first, so that the furniture that stands at them is drawn on top."""
    return [shape(name, pixel_box(box)) for name, box in BOXES.items()]


def write_labelme(path, shapes, size=SHAPE):
    content = {"version": "5.5.0", "shapes": shapes, "imageHeight": size[0], "imageWidth": size[1]}
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def write_room(folder):
    """Write map and annotation, return their paths."""
    write_map(folder / "room.yaml", room_map())
    return folder / "room.yaml", write_labelme(folder / "room.json", room_shapes())
