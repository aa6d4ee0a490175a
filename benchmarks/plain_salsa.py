"""The steps of SALSA in plain numpy and scikit-learn: what ours is measured beside.

As the paper describes them, with the published settings: points near line features, point-to-point
ICP of them onto the occupied cells of the map, and a look-up of every point in the label image.
Nothing of the package's own alignment is used, only its conversions of coordinates.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from sklearn.neighbors import KDTree

from semantic2d_dataset.scene.geometry import to_base, to_points, transform
from semantic2d_dataset.scene.lidars import LidarSpec
from semantic2d_dataset.scene.maps import FREE, OCCUPIED, SemanticMap

# published settings of the line extraction, m and rad
RANGE_STD_DEV, BEARING_STD_DEV = 0.02, 1e-5
MAX_LINE_GAP, MIN_LINE_LENGTH, MIN_SPLIT_DIST, MIN_LINE_POINTS = 1.0, 0.4, 0.04, 15
NEAR_LINE, NEAR_BOX = 0.3, 1.0
# published settings of ICP, and the gate that common code has
MAX_STEPS, MIN_CHANGE, MAX_PAIR = 500, 1e-6, 1.0
WINDOW = np.stack(np.meshgrid(np.arange(-2, 2), np.arange(-2, 2)), axis=-1).reshape(16, 2)
OTHER, PERSON, CLASSES, NONE = 0, 4, 10, 255


class Prepared(NamedTuple):
    """A map, once for all scans."""

    scene: SemanticMap
    occupied: np.ndarray  # (M, 2), m
    tree: KDTree
    label_image: np.ndarray  # (H, W) u1, row 0 at the smallest y


def prepare(scene: SemanticMap, label_image: np.ndarray | None = None) -> Prepared:
    """Build the tree; without a label image the labels of the occupied cells are one."""
    occupied = scene.centres_of(np.argwhere(scene.occupancy == OCCUPIED))
    labels = scene.labels if label_image is None else label_image
    return Prepared(scene, occupied, KDTree(occupied), np.pad(labels, 2, constant_values=NONE))


def label_scan(
    ranges: np.ndarray, lidar: LidarSpec, rough: np.ndarray, known: Prepared
) -> tuple[np.ndarray, np.ndarray]:
    """Return the refined pose (3,) and the label (B,) of every beam, Other without a return."""
    valid = lidar.has_return(ranges)
    points = to_points(ranges, lidar.bearings)[valid]  # (P, 2), m, lidar frame
    features = points[near_lines(points, extract_lines(points))]
    pose = icp(to_base(features, lidar.base_T_lidar), rough, known)
    labels = np.full(len(ranges), OTHER, np.uint8)
    labels[valid] = look_up(transform(pose, to_base(points, lidar.base_T_lidar)), known)
    return pose, labels


def extract_lines(points: np.ndarray) -> np.ndarray:
    """Split and merge: segments (L, 4), x1 y1 x2 y2, of points in the order of the beams."""
    gaps = np.hypot(*np.diff(points, axis=0).T)
    pieces, lines = [], []
    todo = [(0, len(points))]
    while todo:
        first, past = todo.pop()
        if past - first < MIN_LINE_POINTS:
            continue
        widest = first + int(np.argmax(gaps[first : past - 1]))
        normal, radius = chord(points[first], points[past - 1])
        off = np.abs(points[first:past] @ normal - radius)
        if off.max() >= MIN_SPLIT_DIST:
            middle = first + int(np.argmax(off))
            todo += [(middle, past), (first, middle)]
        elif gaps[widest] >= MAX_LINE_GAP:
            todo += [(widest + 1, past), (first, widest + 1)]
        elif np.hypot(*(points[past - 1] - points[first])) >= MIN_LINE_LENGTH:
            pieces.append(points[first:past])
    for piece in pieces:
        joined = np.concatenate((lines[-1], piece)) if lines else piece
        if lines and is_line(joined):
            lines[-1] = joined
        else:
            lines.append(piece)
    return np.array([ends(line) for line in lines]).reshape(-1, 4)


def chord(start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the unit normal and the radius of the line through two points."""
    normal = np.array((start[1] - end[1], end[0] - start[0]))
    normal /= max(np.hypot(*normal), 1e-9)
    return normal, float(start @ normal)


def fit_line(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Fit a line by least squares, each point weighted by its variance across the line."""
    normal, _ = chord(points[0], points[-1])
    across, along = points @ normal, points @ np.array((-normal[1], normal[0]))
    squares = across**2 + along**2
    weights = 1 / (RANGE_STD_DEV**2 * across**2 / squares + BEARING_STD_DEV**2 * along**2 + 1e-9)
    middle = weights @ points / weights.sum()
    d = points - middle
    xx, xy, yy = weights @ d[:, 0] ** 2, weights @ (d[:, 0] * d[:, 1]), weights @ d[:, 1] ** 2
    angle = 0.5 * np.arctan2(-2 * xy, yy - xx)
    normal = np.array((np.cos(angle), np.sin(angle)))
    return normal, float(middle @ normal)


def is_line(points: np.ndarray) -> bool:
    """Tell whether two neighbouring pieces are one line."""
    if np.hypot(*np.diff(points, axis=0).T).max() >= MAX_LINE_GAP:
        return False
    normal, radius = fit_line(points)
    return bool(np.abs(points @ normal - radius).max() < MIN_SPLIT_DIST)


def ends(points: np.ndarray) -> np.ndarray:
    """Return the feet of the first and the last point on the line through all of them, (4,)."""
    normal, radius = fit_line(points)
    outer = points[[0, -1]]
    return (outer - np.outer(outer @ normal - radius, normal)).ravel()


def near_lines(points: np.ndarray, lines: np.ndarray) -> np.ndarray:
    """Tell which points (P,) lie near a line and near its box."""
    start, end = lines[:, None, :2], lines[:, None, 2:]  # (L, 1, 2)
    low, high = np.minimum(start, end) - NEAR_BOX, np.maximum(start, end) + NEAR_BOX
    way, d = end - start, points - start
    off = np.abs(way[..., 0] * d[..., 1] - way[..., 1] * d[..., 0]) / np.hypot(*way.T).T
    inside = ((points >= low) & (points <= high)).all(axis=-1)
    return (inside & (off <= NEAR_LINE)).any(axis=0)


def icp(points: np.ndarray, start: np.ndarray, known: Prepared) -> np.ndarray:
    """Move a pose (3,) until the points lie on the occupied cells."""
    if len(points) < MIN_LINE_POINTS:
        return start
    moved = transform(start, points)
    last = np.inf
    for _ in range(MAX_STEPS):
        distance, nearest = known.tree.query(moved, sort_results=False)
        close = distance[:, 0] < MAX_PAIR
        if close.sum() < MIN_LINE_POINTS:
            return start
        error = distance[close, 0].mean()
        if abs(last - error) < MIN_CHANGE:
            break
        last = error
        rotation, shift = rigid_fit(moved[close], known.occupied[nearest[close, 0]])
        moved = moved @ rotation.T + shift
    rotation, shift = rigid_fit(points, moved)
    return np.array((*shift, np.arctan2(rotation[1, 0], rotation[0, 0])))


def rigid_fit(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation (2, 2) and shift (2,) that bring points (P, 2) nearest to their partners."""
    a, b = source.mean(axis=0), target.mean(axis=0)
    u, _, vt = np.linalg.svd((source - a).T @ (target - b))
    turn = np.diag((1.0, np.sign(np.linalg.det(vt.T @ u.T))))
    rotation = vt.T @ turn @ u.T
    return rotation, b - rotation @ a


def look_up(points: np.ndarray, known: Prepared) -> np.ndarray:
    """Return the labels (P,) u1 of points in the map: the majority of a window of pixels.

    Of a labelled object the class, in free space Person, else Other.
    """
    height, width = known.scene.occupancy.shape
    cells = known.scene.cells_of(points)
    inside = ((cells >= 0) & (cells < (height, width))).all(axis=-1)
    cells = np.where(inside[:, None], cells, 0)
    window = cells[:, None] + 2 + WINDOW  # the image has a border of 2
    pixels = known.label_image[window[..., 0], window[..., 1]]  # (P, 16)
    votes = (pixels[..., None] == np.arange(1, CLASSES)).sum(axis=1)  # (P, 9)
    free = known.scene.occupancy[cells[:, 0], cells[:, 1]] == FREE
    labels = np.where(votes.any(axis=-1), votes.argmax(axis=-1) + 1, np.where(free, PERSON, OTHER))
    return np.where(inside, labels, OTHER).astype(np.uint8)
