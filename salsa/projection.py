"""Detections projected onto the beams: what moves takes its class from an image (paper, limits).

A point in free space is a person, because nothing else moved in the recordings of the paper. Where
a calibrated camera saw the point inside the box of a detection, it is what was detected.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from salsa.cameras import Camera, mount_matrix, pixel_of
from salsa.detections import Detections
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.geometry import (
    beam_directions,
    compose,
    interpolate_poses,
    invert,
)
from semantic2d_dataset.scene.scans import ScanBatch
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, UNLABELLED, Taxonomy

Float = NDArray[np.float64]
Labels = NDArray[np.uint8]

_BORDER = 0.01  # of the image's height: a box that ends so near to its border was cut there
_TOUCHES = 1e-9  # fit of a box and a thing that is seen by one beam


@dataclass(frozen=True)
class Matching:
    """How boxes and points come together.

    Parameters
    ----------
    max_gap_s
        A scan and an image farther apart in time have nothing to do with each other, s. A thing
        at 1.5 m/s moves 15 cm in the default; a camera of 10 Hz may miss an image.
    clock_offset_s
        Added to the stamps of the images, s.
    depth_gap_m
        Points in a box are one thing as long as none is this much deeper than the one before, m:
        the legs of a stride are, a wall or a person behind the thing is not.
    beside
        A box is widened by this share of its width to either side: 2 px for a dog of 20.
    above
        And by this share of its height up and down; None admits any height. Generous, as the
        pitch of a robot moves the plane of its scan by many pixels (3 degrees: 30), and little
        is to be confused above or below. Boxes cut by the upper or lower border of the image are
        open there: the feet of who stands near are below it.
    """

    max_gap_s: float = 0.1
    clock_offset_s: float = 0.0
    depth_gap_m: float = 0.5
    beside: float = 0.1
    above: float | None = 0.5

    def __post_init__(self) -> None:
        limits = (self.max_gap_s, self.depth_gap_m, self.beside, self.above or 0.0)
        if not all(0 <= value < math.inf for value in limits):
            raise InvalidInputError(f"matching: expected finite numbers from 0 on, found {self}")
        if not math.isfinite(self.clock_offset_s):
            raise InvalidInputError(f"clock_offset_s must be finite, found {self.clock_offset_s}")


DEFAULT_MATCHING = Matching()
"""The limits used unless others are given."""


def check_detections(
    stamps_ns: NDArray[np.int64],
    camera: Camera,
    detections: Detections,
    *,
    matching: Matching = DEFAULT_MATCHING,
    taxonomy: Taxonomy = SEMANTIC2D,
) -> int:
    """Check once, before any work, that detections belong to a recording and its camera.

    Parameters
    ----------
    stamps_ns
        (N,) i8 of all scans.
    camera, detections, matching, taxonomy
        As `apply_detections`.

    Returns
    -------
    int
        Scans that have an image.

    Raises
    ------
    InvalidInputError
        If no scan has one, boxes lie outside the image, or classes outside the taxonomy.
    """
    _check(camera, detections, taxonomy)
    taken_ns = _taken(detections, matching)
    frames = _nearest(stamps_ns.astype(np.float64), taken_ns, 1e9 * matching.max_gap_s)
    found = int((frames >= 0).sum())
    if not found:
        raise InvalidInputError(
            f"no image lies within {matching.max_gap_s:g} s of a scan: scans are from "
            f"{_span(stamps_ns.astype(np.float64))}, images from {_span(taken_ns)}; do the "
            f"detections belong to this recording, and are both clocks the same?"
        )
    return found


def apply_detections(
    batch: ScanBatch,
    poses: Float,
    labels: Labels,
    confidence: Labels,
    camera: Camera,
    detections: Detections,
    *,
    matching: Matching = DEFAULT_MATCHING,
    taxonomy: Taxonomy = SEMANTIC2D,
) -> tuple[Labels, Labels]:
    """Give what moves the class that a camera saw in it.

    Points labelled Person are taken, nothing else. Of those in a box only the nearest in depth are
    the thing, the rest is seen past it. Where boxes overlap, the box that a thing fills best takes
    its points first. What lies in no box stays as it is: detectors miss people.

    Parameters
    ----------
    batch
        N scans.
    poses
        (N, 3) f8 x y yaw of the base in the map, as aligned: what the robot moves between a scan
        and an image is taken into account, between labelled scans.
    labels, confidence
        (N, B) u1, from `salsa.labelling.transfer_labels`.
    camera
        Where pixels are.
    detections
        Boxes; their classes are of the taxonomy.
    matching
        Limits.
    taxonomy
        Classes of labels and detections.

    Returns
    -------
    labels, confidence
        (N, B) u1 each, new arrays. Confidence is multiplied by the score of the detection where
        the class has changed.

    Raises
    ------
    InvalidInputError
        If boxes lie outside the camera's image, or their classes outside the taxonomy.
    """
    _check(camera, detections, taxonomy)
    labels, confidence = labels.copy(), confidence.copy()
    person = taxonomy.id_of("Person")
    taken_ns = _taken(detections, matching)
    frames = _nearest(batch.stamps_ns.astype(np.float64), taken_ns, 1e9 * matching.max_gap_s)
    if not (frames >= 0).any():
        return labels, confidence
    labelled = (labels != UNLABELLED).any(axis=-1) & np.isfinite(poses).all(axis=-1)
    motion = _motion(batch.stamps_ns, poses, labelled, taken_ns[frames])
    base_T_lidar = mount_matrix(batch.lidar.base_T_lidar)
    camera_T_lidar = np.linalg.inv(camera.in_base(batch.lidar)) @ motion @ base_T_lidar
    _apply(
        batch.ranges,
        (labels == person) & batch.valid,
        beam_directions(batch.lidar.bearings),
        np.ascontiguousarray(camera_T_lidar[:, :3]),
        camera.lens,
        frames,
        detections.offsets,
        detections.boxes,
        _windows(camera, detections.boxes, matching),
        detections.class_ids,
        detections.scores,
        matching.depth_gap_m,
        person,
        labels,
        confidence,
    )
    return labels, confidence


def _check(camera: Camera, detections: Detections, taxonomy: Taxonomy) -> None:
    centres = (detections.boxes[:, :2] + detections.boxes[:, 2:]) / 2
    outside = ((centres < 0) | (centres > (camera.width, camera.height))).any(axis=-1)
    if outside.any():
        raise InvalidInputError(
            f"{outside.sum()} of {len(detections)} boxes lie outside the camera's image of "
            f"{camera.width} x {camera.height} pixels, such as "
            f"{detections.boxes[outside][0].tolist()}; are they of an image of another size?"
        )
    if (detections.class_ids >= len(taxonomy)).any():
        raise InvalidInputError(
            f"detections: expected class ids 0 to {len(taxonomy) - 1}, "
            f"found {detections.class_ids.max()}"
        )


def _taken(detections: Detections, matching: Matching) -> Float:
    """Return when the images (F,) were taken by the clock of the scans, ns."""
    return detections.stamps_ns.astype(np.float64) + 1e9 * matching.clock_offset_s


def _span(stamps_ns: Float) -> str:
    if not len(stamps_ns):
        return "no time at all"
    return f"{stamps_ns[0] / 1e9:.3f} to {stamps_ns[-1] / 1e9:.3f} s"


def _nearest(stamps_ns: Float, taken_ns: Float, max_gap_ns: float) -> NDArray[np.int64]:
    """Return the image (N,) nearest in time to each scan; -1 where none is near enough."""
    if not len(taken_ns):
        return np.full(len(stamps_ns), -1)
    after = np.searchsorted(taken_ns, stamps_ns).clip(0, len(taken_ns) - 1)
    before = (after - 1).clip(0)
    gaps = np.abs(taken_ns[before] - stamps_ns), np.abs(taken_ns[after] - stamps_ns)
    return np.where(np.minimum(*gaps) > max_gap_ns, -1, np.where(gaps[0] <= gaps[1], before, after))


def _motion(
    stamps_ns: NDArray[np.int64], poses: Float, known: NDArray[np.bool_], taken_ns: Float
) -> Float:
    """Return the pose (N, 4, 4) of the base at each scan as seen from the base at its image.

    An image before the first or after the last known pose is seen from there.
    """
    motion = np.tile(np.eye(4), (len(poses), 1, 1))
    if not known.any():
        return motion
    stamps = stamps_ns[known]
    at_ns = taken_ns.clip(float(stamps[0]), float(stamps[-1])).astype(np.int64)
    there = interpolate_poses(stamps, poses[known], at_ns.clip(stamps[0], stamps[-1]))
    moved = compose(invert(there), poses)[known]
    c, s = np.cos(moved[:, 2]), np.sin(moved[:, 2])
    motion[known, 0, 0], motion[known, 0, 1] = c, -s
    motion[known, 1, 0], motion[known, 1, 1] = s, c
    motion[known, :2, 3] = moved[:, :2]
    return motion


def _windows(camera: Camera, boxes: Float, matching: Matching) -> Float:
    """Return where (M, 4) the points of a box may be seen."""
    size = boxes[:, 2:] - boxes[:, :2]
    slack = np.stack((matching.beside * size[:, 0], (matching.above or 0.0) * size[:, 1]), axis=-1)
    windows = np.concatenate((boxes[:, :2] - slack, boxes[:, 2:] + slack), axis=-1)
    border = _BORDER * camera.height
    always = matching.above is None
    windows[always | (boxes[:, 1] <= border), 1] = -np.inf
    windows[always | (boxes[:, 3] >= camera.height - border), 3] = np.inf
    return windows


@numba.njit(cache=True, parallel=True)
def _apply(
    ranges: NDArray[np.float32],
    moves: NDArray[np.bool_],
    directions: Float,
    camera_T_lidar: Float,
    lens: Float,
    frames: NDArray[np.int64],
    offsets: NDArray[np.int64],
    boxes: Float,
    windows: Float,
    class_ids: Labels,
    scores: Float,
    gap: float,
    person: int,
    labels: Labels,
    confidence: Labels,
) -> None:
    for n in numba.prange(len(ranges)):
        if frames[n] < 0:
            continue
        first, end = offsets[frames[n]], offsets[frames[n] + 1]
        beams = np.flatnonzero(moves[n])
        if first == end or len(beams) == 0:
            continue
        points = _in_camera(ranges[n], beams, directions, camera_T_lidar[n])
        pixels = np.empty((len(points), 2))
        for p in range(len(points)):
            pixels[p] = pixel_of(points[p, 0], points[p, 1], points[p, 2], lens)
        claims = _claims(points, pixels, boxes[first:end], windows[first:end], gap)
        for claimed in np.flatnonzero(claims >= 0):
            k, box = beams[claimed], first + claims[claimed]
            if class_ids[box] != person:
                labels[n, k] = class_ids[box]
                confidence[n, k] = np.uint8(confidence[n, k] * scores[box])


@numba.njit(cache=True)
def _claims(
    points: Float, pixels: Float, boxes: Float, windows: Float, gap: float
) -> NDArray[np.int64]:
    """Return the box (P,) that each point belongs to, -1 for none; the best fit chooses first."""
    extents = _extents(points, pixels, gap)
    claims = np.full(len(points), -1)
    waiting = np.ones(len(boxes), np.bool_)
    while True:
        best, best_fit = -1, 0.0
        for b in range(len(boxes)):
            if not waiting[b]:
                continue
            fit = _fit(boxes[b], extents, _thing(windows[b], points, pixels, claims < 0, gap))
            waiting[b] = fit > 0  # points only become fewer
            if fit > best_fit:
                best, best_fit = b, fit
        if best < 0:
            return claims
        claims[_thing(windows[best], points, pixels, claims < 0, gap)] = best
        waiting[best] = False


@numba.njit(cache=True)
def _in_camera(
    ranges: NDArray[np.float32], beams: NDArray[np.int64], directions: Float, pose: Float
) -> Float:
    """Return the endpoints (P, 3) of some beams in the camera's frame."""
    points = np.empty((len(beams), 3))
    for p in range(len(beams)):
        r = np.float64(ranges[beams[p]])
        x, y = r * directions[beams[p], 0], r * directions[beams[p], 1]
        for i in range(3):
            points[p, i] = pose[i, 0] * x + pose[i, 1] * y + pose[i, 3]
    return points


@numba.njit(cache=True)
def _extents(points: Float, pixels: Float, gap: float) -> Float:
    """Return the left and right end (P, 2) in the image of the run of neighbours of each point."""
    extents = np.full((len(points), 2), np.nan)
    start = 0
    for p in range(len(points)):
        square = 0.0
        for i in range(3):
            if p + 1 < len(points):
                square += (points[p + 1, i] - points[p, i]) ** 2
        if p + 1 == len(points) or square > gap * gap:
            left, right = np.inf, -np.inf
            for q in range(start, p + 1):
                if pixels[q, 0] == pixels[q, 0]:  # not NaN
                    left, right = min(left, pixels[q, 0]), max(right, pixels[q, 0])
            extents[start : p + 1, 0], extents[start : p + 1, 1] = left, right
            start = p + 1
    return extents


@numba.njit(cache=True)
def _thing(
    window: Float, points: Float, pixels: Float, free: NDArray[np.bool_], gap: float
) -> NDArray[np.bool_]:
    """Tell which points (P,) are the foremost thing in a window."""
    inside: NDArray[np.bool_] = free & (pixels[:, 0] >= window[0]) & (pixels[:, 0] <= window[2])
    inside &= (pixels[:, 1] >= window[1]) & (pixels[:, 1] <= window[3])
    depths = np.sort(points[inside, 2])
    if len(depths) == 0:
        return inside
    deepest = depths[0]
    for depth in depths:
        if depth - deepest > gap:
            break
        deepest = depth
    inside &= points[:, 2] <= deepest
    return inside


@numba.njit(cache=True)
def _fit(box: Float, extents: Float, thing: NDArray[np.bool_]) -> float:
    """Return how well a box and the runs of a thing cover each other from left to right, 0 to 1.

    The bag of a person covers little of the person, and a person before a sofa little of its box.
    """
    if not thing.any():
        return 0.0
    left, right = float(extents[thing, 0].min()), float(extents[thing, 1].max())
    overlap = min(right, box[2]) - max(left, box[0])
    union = max(right, box[2]) - min(left, box[0])
    fit: float = max(overlap / union, _TOUCHES)
    return fit
