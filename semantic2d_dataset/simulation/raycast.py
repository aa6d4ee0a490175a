"""Casting all beams of all scans against the segments and circles of a world.

A primitive covers one run of neighbouring beams, so each primitive is drawn into the scan, the
nearest one winning, as a depth buffer does it. Walking legs differ from scan to scan and cost
nothing extra; no tree or grid has to be built.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.geometry import beam_directions, mount_in_plane
from semantic2d_dataset.scene.lidars import LidarSpec

Float = NDArray[np.float64]
_BLOCK = 64  # scans that one thread draws at a time


@dataclass(frozen=True)
class Hits:
    """What N scans of B beams meet first.

    Parameters
    ----------
    distances
        (N, B) f8, m, along the beam; +inf where nothing is met.
    primitives
        (N, B) i4 index of the primitive: S segments, then C circles, then L legs; -1 for none.
    cosines
        (N, B) f8 cosine of the angle of incidence, 0 where nothing is met.
    """

    distances: Float
    primitives: NDArray[np.int32]
    cosines: Float


def cast(segments: Float, circles: Float, legs: Float, poses: Float, lidar: LidarSpec) -> Hits:
    """Cast every beam of a lidar from every pose.

    Parameters
    ----------
    segments
        (S, 4) x1 y1 x2 y2, m, map frame.
    circles
        (C, 3) x y radius, m, map frame.
    legs
        (N, L, 3) circles that are there at one scan only.
    poses
        (N, 3) x y yaw of the base in the map.
    lidar
        Beams and mount; one that hangs upside down sees the plane mirrored.

    Raises
    ------
    InvalidInputError
        If `legs` and `poses` differ in N.
    """
    if len(legs) != len(poses):
        raise InvalidInputError(f"expected legs for {len(poses)} scans, found {len(legs)}")
    axes, origins = lidar_frames(poses, lidar.base_T_lidar)
    shape = (len(poses), lidar.beams)
    hits = Hits(np.full(shape, np.inf), np.full(shape, -1, np.int32), np.zeros(shape))
    directions = beam_directions(lidar.bearings)

    def draw(start: int) -> None:
        rows = slice(start, start + _BLOCK)
        _draw_scans(
            segments, circles, legs[rows], axes[rows], origins[rows], directions,
            lidar.angle_min, lidar.angle_increment,
            hits.distances[rows], hits.primitives[rows], hits.cosines[rows],
        )  # fmt: skip

    # plain threads around a kernel that releases the GIL: safe to fork afterwards
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(draw, range(0, len(poses), _BLOCK)))
    return hits


def lidar_frames(poses: Float, base_T_lidar: Sequence[float]) -> tuple[Float, Float]:
    """Return the lidar's axes (N, 2, 2) and origins (N, 2) in the map: p_map = axes p + origin."""
    mount, offset = mount_in_plane(base_T_lidar)
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    # products one by one: a BLAS rounds as the machine's instructions please
    rows = (np.stack((c, -s), axis=-1), np.stack((s, c), axis=-1))
    axes = np.stack([row[:, :1] * mount[0] + row[:, 1:] * mount[1] for row in rows], axis=1)
    origins = np.stack([row[:, 0] * offset[0] + row[:, 1] * offset[1] for row in rows], axis=-1)
    return np.ascontiguousarray(axes), origins + poses[:, :2]


@numba.njit(cache=True, nogil=True)
def _draw_scans(
    segments: Float,
    circles: Float,
    legs: Float,
    axes: Float,
    origins: Float,
    directions: Float,
    angle_min: float,
    step: float,
    distances: Float,
    primitives: NDArray[np.int32],
    cosines: Float,
) -> None:
    for n in range(len(origins)):
        view = (distances[n], primitives[n], cosines[n])
        first_leg = len(segments) + len(circles)
        for i in range(len(segments)):
            a = _to_lidar(segments[i, 0], segments[i, 1], axes[n], origins[n])
            b = _to_lidar(segments[i, 2], segments[i, 3], axes[n], origins[n])
            _draw_segment(a, b, i, directions, angle_min, step, view)
        for i in range(len(circles)):
            centre = _to_lidar(circles[i, 0], circles[i, 1], axes[n], origins[n])
            number = len(segments) + i
            _draw_circle(centre, circles[i, 2], number, directions, angle_min, step, view)
        for i in range(legs.shape[1]):
            centre = _to_lidar(legs[n, i, 0], legs[n, i, 1], axes[n], origins[n])
            _draw_circle(centre, legs[n, i, 2], first_leg + i, directions, angle_min, step, view)


@numba.njit(cache=True, nogil=True)
def _to_lidar(x: float, y: float, axes: Float, origin: Float) -> tuple[float, float]:
    dx, dy = x - origin[0], y - origin[1]
    return axes[0, 0] * dx + axes[1, 0] * dy, axes[0, 1] * dx + axes[1, 1] * dy


@numba.njit(cache=True, nogil=True)
def _draw_segment(
    a: tuple[float, float],
    b: tuple[float, float],
    number: int,
    directions: Float,
    angle_min: float,
    step: float,
    view: tuple[Float, NDArray[np.int32], Float],
) -> None:
    distances, primitives, cosines = view
    cross = a[0] * b[1] - a[1] * b[0]
    if cross < 0:
        a, b, cross = b, a, -cross
    ex, ey = b[0] - a[0], b[1] - a[1]
    length = math.sqrt(ex * ex + ey * ey)
    if cross <= 1e-12 * length:  # seen exactly edge-on
        return
    first = (math.atan2(a[1], a[0]) - angle_min) / step
    last = first + math.atan2(cross, a[0] * b[0] + a[1] * b[1]) / step
    full_turn = 2 * math.pi / step
    for turn in range(-1, 2):
        start = max(0, math.ceil(first + turn * full_turn))
        stop = min(len(directions) - 1, math.floor(last + turn * full_turn))
        for k in range(start, stop + 1):
            slope = directions[k, 0] * ey - directions[k, 1] * ex
            if slope > 0 and cross < distances[k] * slope:
                distances[k] = cross / slope
                primitives[k] = number
                cosines[k] = slope / length


@numba.njit(cache=True, nogil=True)
def _draw_circle(
    centre: tuple[float, float],
    radius: float,
    number: int,
    directions: Float,
    angle_min: float,
    step: float,
    view: tuple[Float, NDArray[np.int32], Float],
) -> None:
    distances, primitives, cosines = view
    square = centre[0] * centre[0] + centre[1] * centre[1]
    if square <= radius * radius:  # the lidar is inside
        return
    half = math.asin(radius / math.sqrt(square)) / step
    middle = (math.atan2(centre[1], centre[0]) - angle_min) / step
    full_turn = 2 * math.pi / step
    for turn in range(-1, 2):
        start = max(0, math.ceil(middle - half + turn * full_turn))
        stop = min(len(directions) - 1, math.floor(middle + half + turn * full_turn))
        for k in range(start, stop + 1):
            along = directions[k, 0] * centre[0] + directions[k, 1] * centre[1]
            depth = math.sqrt(max(0.0, radius * radius - square + along * along))
            if along - depth < distances[k]:
                distances[k] = along - depth
                primitives[k] = number
                cosines[k] = depth / radius
