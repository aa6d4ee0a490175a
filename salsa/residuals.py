"""How far points are from what is mapped, and what that says of the pose they were seen from.

Poses are x, y, yaw in the frame of the grid (m, rad; the corner of cell (0, 0) is its origin),
points are (2, P) f4 in m in the base frame. The distance field comes as a surface (H, W, 4) f4:
between the centres of four cells the distance in m is ``d + du fu + (dv + duv fu) fv``, with what
is looked up together lying together.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.scene.geometry import beam_directions, mount_in_plane
from semantic2d_dataset.scene.scans import ScanBatch

Float = NDArray[np.float64]
Surface = NDArray[np.float32]
Seen = NDArray[np.float32]
Points = NDArray[np.float32]
_FAST = {"reassoc", "contract", "nsz", "arcp"}  # sums need not keep their order


class Normals(NamedTuple):
    """Normal equations of weighted distances d with Geman-McClure weights w.

    `hessian` (3, 3), `gradient` (3,), `squares` the sum of w d^2, `weights` the sum of w.
    """

    hessian: Float
    gradient: Float
    squares: float
    weights: float


class Work(NamedTuple):
    """Room for what is looked up of P points: `seen` (4, P) f4 and the index of their `cells`."""

    seen: Seen
    cells: NDArray[np.int32]


Beams = tuple[NDArray[np.float32], NDArray[np.bool_], Float, Float]
"""What the kernels take of N scans: ranges (N, B), which to use (N, B), directions (B, 2) of the
beams in the base frame, and the lidar's place (2,) there."""


def beams_of(batch: ScanBatch, use: NDArray[np.bool_]) -> Beams:
    """Return what the kernels take, with the mount applied: p_base = R p_lidar + t."""
    rotation, offset = mount_in_plane(batch.lidar.base_T_lidar)
    return batch.ranges, use, beam_directions(batch.lidar.bearings) @ rotation.T, offset


@numba.njit(cache=True)
def base_points(
    ranges: NDArray[np.float32], use: NDArray[np.bool_], directions: Float, offset: Float
) -> Points:
    """Return the endpoints (2, P) in the base frame of the beams to use."""
    points = np.empty((2, len(ranges)), np.float32)
    count = 0
    for k in range(len(ranges)):
        if use[k]:
            r = np.float64(ranges[k])
            points[0, count] = offset[0] + r * directions[k, 0]
            points[1, count] = offset[1] + r * directions[k, 1]
            count += 1
    return points[:, :count]


@numba.njit(cache=True)
def workspace(points: int) -> Work:
    """Return room for that many points."""
    return Work(np.empty((4, points), np.float32), np.empty(points, np.int32))


@numba.njit(cache=True)
def thinned(points: Points, wanted: int) -> Points:
    """Return every so-manieth point, so that about `wanted` are left, side by side."""
    return np.ascontiguousarray(points[:, :: max(points.shape[1] // wanted, 1)])


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def distance_at(u: float, v: float, surface: Surface) -> float:
    """Return the distance in m at column u, row v (0, 0 is the centre of a cell); -1 beyond it."""
    rows, columns = surface.shape[:2]
    if not (u >= 0.0 and v >= 0.0 and u < columns - 1 and v < rows - 1):
        return -1.0
    column, row = int(u), int(v)
    fu, fv = u - column, v - row
    d, du, dv, duv = surface[row, column]
    distance: float = d + du * fu + (dv + duv * fu) * fv
    return distance


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def robust_cost(
    points: Points, pose: Float, surface: Surface, resolution: float, scale: float
) -> float:
    """Return the mean Geman-McClure cost 0..1 of the points; outside the map a point costs 1."""
    c, s = math.cos(pose[2]) / resolution, math.sin(pose[2]) / resolution
    u0, v0 = pose[0] / resolution - 0.5, pose[1] / resolution - 0.5
    total = 0.0
    for k in range(points.shape[1]):
        x, y = points[0, k], points[1, k]
        d = distance_at(u0 + c * x - s * y, v0 + s * x + c * y, surface)
        total += d * d / (d * d + scale * scale) if d >= 0.0 else 1.0
    cost: float = total / max(points.shape[1], 1)
    return cost


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def look_up(points: Points, pose: Float, surface: Surface, resolution: float, work: Work) -> int:
    """Write distance, its slopes by x and y, and by yaw, of the points on the map into `work.seen`.

    Slopes are in m a cell; returns how many points they are. First all places are computed, then
    all cells fetched: the former is done for many points at once, and so are the sums in `weigh`.
    """
    seen, cells = work
    place(points, pose, surface.shape, resolution, seen, cells)
    flat = surface.reshape(-1, 4)
    count = 0
    for k in range(points.shape[1]):
        if cells[k] >= 0:
            d, du, dv, duv = flat[cells[k]]
            dx, dy, fu, fv = seen[0, k], seen[1, k], seen[2, k], seen[3, k]
            gx, gy = du + duv * fv, dv + duv * fu
            seen[0, count] = d + du * fu + gy * fv
            seen[1, count], seen[2, count] = gx, gy
            seen[3, count] = gy * dx - gx * dy
            count += 1
    return count


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def place(
    points: Points,
    pose: Float,
    shape: tuple[int, int, int],
    resolution: float,
    seen: Seen,
    cells: NDArray[np.int32],
) -> None:
    """Write where points lie: from the robot (m) and in their cell, and its index; -1 beyond."""
    c, s = np.float32(math.cos(pose[2])), np.float32(math.sin(pose[2]))
    per_m, zero = np.float32(1.0 / resolution), np.float32(0.0)
    u0 = np.float32(pose[0] / resolution - 0.5)
    v0 = np.float32(pose[1] / resolution - 0.5)
    rows, columns = np.float32(shape[0] - 1), np.float32(shape[1] - 1)
    for k in range(points.shape[1]):
        dx, dy = c * points[0, k] - s * points[1, k], s * points[0, k] + c * points[1, k]
        u, v = u0 + dx * per_m, v0 + dy * per_m
        inside = (u >= zero) & (v >= zero) & (u < columns) & (v < rows)
        column, row = np.int32(u) if inside else np.int32(0), np.int32(v) if inside else np.int32(0)
        cells[k] = row * np.int32(shape[1]) + column if inside else np.int32(-1)
        seen[0, k], seen[1, k] = dx, dy
        seen[2, k], seen[3, k] = u - np.float32(column), v - np.float32(row)


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def weigh(seen: Seen, count: int, resolution: float, scale: float) -> Normals:
    """Sum up the normal equations of the points that `look_up` found."""
    d_of, gx_of, gy_of, gt_of = seen[0], seen[1], seen[2], seen[3]  # rows, for the vectoriser
    zero, scale2 = np.float32(0.0), np.float32(scale * scale)
    g0, g1, g2, squares, weights = zero, zero, zero, zero, zero
    h00, h01, h02, h11, h12, h22 = zero, zero, zero, zero, zero, zero
    for k in range(count):
        d, gx, gy, gt = d_of[k], gx_of[k], gy_of[k], gt_of[k]
        share = scale2 / (scale2 + d * d)
        w = share * share
        wx, wy, wt, wd = w * gx, w * gy, w * gt, w * d
        h00, h01, h02 = h00 + wx * gx, h01 + wx * gy, h02 + wx * gt
        h11, h12, h22 = h11 + wy * gy, h12 + wy * gt, h22 + wt * gt
        g0, g1, g2 = g0 + wd * gx, g1 + wd * gy, g2 + wd * gt
        squares += wd * d
        weights += w
    per_m = 1.0 / resolution
    hessian = np.array(((h00, h01, h02), (h01, h11, h12), (h02, h12, h22)), np.float64)
    gradient = np.array((g0, g1, g2), np.float64)
    return Normals(
        hessian * (per_m * per_m), gradient * per_m, np.float64(squares), np.float64(weights)
    )


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def fit_quality(seen: Seen, count: int, points: int, inlier_m: float) -> tuple[float, float]:
    """Return the rms distance of the inliers (m), and their share of all points."""
    limit, squares, inliers = np.float32(inlier_m), np.float32(0.0), 0
    for k in range(count):
        d = seen[0, k]
        near = d <= limit
        inliers += near
        squares += d * d * near
    if inliers == 0:
        return math.inf, 0.0
    return math.sqrt(squares / inliers), inliers / points


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def cost_of(seen: Seen, count: int, points: int, scale: float) -> float:
    """Return the mean Geman-McClure cost 0..1; a point outside the map costs 1."""
    total, scale2 = np.float32(0.0), np.float32(scale * scale)
    for k in range(count):
        d2 = seen[0, k] * seen[0, k]
        total += d2 / (d2 + scale2)
    return float(total + (points - count)) / max(points, 1)
