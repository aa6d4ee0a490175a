"""The numerical heart of the alignment: robust scan-to-map registration on a distance field.

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

FIRST_SCALE_M, LAST_SCALE_M = 0.5, 0.1  # finer than 0.1 m is worse where the world has changed
SHRINK = 0.75  # of the scale, per iteration
COARSE_POINTS = 128  # evenly spaced, until these have settled at the last scale
FINE_POINTS = 512  # then: more cost time and change nothing
FINE_STEPS = 2  # at most, with these
MAX_STEPS = 30
STEP_M, STEP_RAD = 5e-4, 1e-4  # smaller steps end the iteration

SEARCH_STEPS = 4  # to either side, per axis
SEARCH_M, SEARCH_RAD = 0.2, math.radians(2.75)  # step: 0.8 m and 11 degrees to either side
SEARCH_POINTS = 80
SEARCH_SCALE_M = 0.2
CANDIDATES = 5
HIGH_COST = 0.4  # of a refined pose, above which the neighbourhood is searched
WORSE_COST = 0.02  # than the neighbour's, above which its pose is tried; noise moves a cost less


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


@numba.njit(cache=True)
def refine(
    points: Points, start: Float, surface: Surface, resolution: float, first_scale: float
) -> tuple[Float, float]:
    """Move a pose so that the points lie on the map: Gauss-Newton with a shrinking robust scale.

    Returns
    -------
    pose, cost
        (3,), and its cost at the last scale.
    """
    work = workspace(points.shape[1])
    few, more = thinned(points, COARSE_POINTS), thinned(points, FINE_POINTS)
    pose, scale, fine = start.copy(), first_scale, 0
    for _ in range(MAX_STEPS):
        count = look_up(few if fine == 0 else more, pose, surface, resolution, work)
        found = weigh(work.seen, count, resolution, scale)
        step = solve(found.hessian, found.gradient, 1e-3 * found.weights + 1e-9)
        pose -= step
        if scale <= LAST_SCALE_M:
            done = abs(step[0]) < STEP_M and abs(step[1]) < STEP_M and abs(step[2]) < STEP_RAD
            if fine == FINE_STEPS or (done and fine > 0):
                break
            fine += done or fine > 0
        scale = max(scale * SHRINK, LAST_SCALE_M)
    count = look_up(points, pose, surface, resolution, work)
    return pose, cost_of(work.seen, count, points.shape[1], LAST_SCALE_M)


@numba.njit(cache=True)
def solve(h: Float, g: Float, damping: float) -> Float:
    """Solve (h + damping I) x = g, h symmetric (3, 3), by Cholesky's factors."""
    l00 = math.sqrt(h[0, 0] + damping)
    l10, l20 = h[1, 0] / l00, h[2, 0] / l00
    l11 = math.sqrt(max(h[1, 1] + damping - l10 * l10, 1e-12))
    l21 = (h[2, 1] - l20 * l10) / l11
    l22 = math.sqrt(max(h[2, 2] + damping - l20 * l20 - l21 * l21, 1e-12))
    y0 = g[0] / l00
    y1 = (g[1] - l10 * y0) / l11
    y2 = (g[2] - l20 * y0 - l21 * y1) / l22
    x = np.empty(3)
    x[2] = y2 / l22
    x[1] = (y1 - l21 * x[2]) / l11
    x[0] = (y0 - l10 * x[1] - l20 * x[2]) / l00
    return x


@numba.njit(cache=True)
def search(
    points: Points, centre: Float, surface: Surface, resolution: float
) -> tuple[Float, float]:
    """Score a lattice of poses around a centre, refine the best few; best pose and its cost."""
    few = thinned(points, SEARCH_POINTS)
    best_costs = np.full(CANDIDATES, np.inf)
    best_poses = np.zeros((CANDIDATES, 3))
    pose = np.empty(3)
    for i in range(-SEARCH_STEPS, SEARCH_STEPS + 1):
        for j in range(-SEARCH_STEPS, SEARCH_STEPS + 1):
            for k in range(-SEARCH_STEPS, SEARCH_STEPS + 1):
                pose[0] = centre[0] + i * SEARCH_M
                pose[1] = centre[1] + j * SEARCH_M
                pose[2] = centre[2] + k * SEARCH_RAD
                cost = robust_cost(few, pose, surface, resolution, SEARCH_SCALE_M)
                worst = np.argmax(best_costs)
                if cost < best_costs[worst]:
                    best_costs[worst] = cost
                    best_poses[worst] = pose
    best, lowest = centre.copy(), np.inf
    for m in range(CANDIDATES):
        pose, cost = refine(points, best_poses[m], surface, resolution, FIRST_SCALE_M / 2)
        if cost < lowest:
            best, lowest = pose, cost
    return best, lowest


@numba.njit(cache=True, parallel=True)
def register_each(
    ranges: NDArray[np.float32],
    use: NDArray[np.bool_],
    directions: Float,
    offset: Float,
    starts: Float,
    surface: Surface,
    resolution: float,
    poses: Float,
    costs: Float,
) -> None:
    """Refine every scan from its own start (N, 3); search where the cost stays high."""
    for n in numba.prange(ranges.shape[0]):
        points = base_points(ranges[n], use[n], directions, offset)
        costs[n] = register_one(points, starts[n], surface, resolution, poses[n])


@numba.njit(cache=True)
def register_one(
    points: Points, start: Float, surface: Surface, resolution: float, out: Float
) -> float:
    """Write the refined pose into `out` and return its cost, infinity where nothing was done."""
    if points.shape[1] == 0 or not np.isfinite(start).all():
        return np.inf
    pose, cost = register(points, start, surface, resolution)
    out[:] = pose
    return cost


@numba.njit(cache=True)
def register(
    points: Points, start: Float, surface: Surface, resolution: float
) -> tuple[Float, float]:
    """Refine a start, and search around it where the cost stays high."""
    pose, cost = refine(points, start, surface, resolution, FIRST_SCALE_M)
    if cost > HIGH_COST:
        other, other_cost = search(points, start, surface, resolution)
        if other_cost < cost:
            return other, other_cost
    return pose, cost


@numba.njit(cache=True)
def chain(
    ranges: NDArray[np.float32],
    use: NDArray[np.bool_],
    directions: Float,
    offset: Float,
    starts: Float,
    order: NDArray[np.int64],
    before: Float,
    surface: Surface,
    resolution: float,
    poses: Float,
    costs: Float,
) -> None:
    """Where a neighbour fits better, try its pose as another start: moved as the starts moved, too.

    Starts that drift away still move rightly from scan to scan, so that one good pose pulls those
    after it in; where they jump about, the robot has hardly moved. `order` (N,) says which scan
    follows which, `before` (2, 3) are pose and start of a trusted scan before the first (NaN where
    there is none); a cost of infinity marks a scan that is not aligned.
    """
    pose, start = before[0], before[1]
    cost = -np.inf if np.isfinite(before).all() else np.inf
    for n in order:
        if not costs[n] < np.inf:
            continue
        if costs[n] > cost + WORSE_COST:
            points = base_points(ranges[n], use[n], directions, offset)
            for guess in (carry(pose, start, starts[n]), pose.copy()):
                other, other_cost = register(points, guess, surface, resolution)
                if other_cost < costs[n]:
                    poses[n], costs[n] = other, other_cost
        pose, start, cost = poses[n], starts[n], costs[n]


@numba.njit(cache=True)
def carry(pose: Float, start: Float, next_start: Float) -> Float:
    """Move a pose as its start moved: pose * start^-1 * next_start."""
    turn = pose[2] - start[2]
    c, s = math.cos(turn), math.sin(turn)
    dx, dy = next_start[0] - start[0], next_start[1] - start[1]
    moved = np.empty(3)
    moved[0] = pose[0] + c * dx - s * dy
    moved[1] = pose[1] + s * dx + c * dy
    moved[2] = next_start[2] + turn
    return moved


@numba.njit(cache=True, parallel=True)
def fit_each(
    ranges: NDArray[np.float32],
    use: NDArray[np.bool_],
    directions: Float,
    offset: Float,
    poses: Float,
    surface: Surface,
    resolution: float,
    inlier_m: float,
    residual_m: NDArray[np.float32],
    inlier_ratio: NDArray[np.float32],
) -> None:
    """Say how every scan fits: rms distance of its inliers, and their share."""
    for n in numba.prange(ranges.shape[0]):
        points = base_points(ranges[n], use[n], directions, offset)
        size = points.shape[1]
        if size > 0 and np.isfinite(poses[n, 0]):
            work = workspace(size)
            count = look_up(points, poses[n], surface, resolution, work)
            residual_m[n], inlier_ratio[n] = fit_quality(work.seen, count, size, inlier_m)


@numba.njit(cache=True, parallel=True)
def measure_each(
    ranges: NDArray[np.float32],
    use: NDArray[np.bool_],
    directions: Float,
    offset: Float,
    poses: Float,
    surface: Surface,
    resolution: float,
    inlier_m: float,
    residual_m: NDArray[np.float32],
    inlier_ratio: NDArray[np.float32],
    covariance: Float,
) -> None:
    """Say how every scan fits, and write the covariance (3, 3) of every pose that is known."""
    for n in numba.prange(ranges.shape[0]):
        points = base_points(ranges[n], use[n], directions, offset)
        size = points.shape[1]
        if size > 0 and np.isfinite(poses[n, 0]):
            work = workspace(size)
            count = look_up(points, poses[n], surface, resolution, work)
            residual_m[n], inlier_ratio[n] = fit_quality(work.seen, count, size, inlier_m)
            found = weigh(work.seen, count, resolution, LAST_SCALE_M)
            set_covariance(found, resolution, covariance[n])


@numba.njit(cache=True)
def set_covariance(found: Normals, resolution: float, out: Float) -> None:
    """Write the covariance (3, 3) of a pose, from the normal equations at the last scale.

    The variance of a distance is that of the weighted residuals, and never below that of a point
    spread evenly over one cell.
    """
    variance = max(found.squares / max(found.weights, 1e-9), resolution * resolution / 12.0)
    unit = np.zeros(3)
    for k in range(3):
        unit[:] = 0.0
        unit[k] = variance
        column = solve(found.hessian, unit, 1e-6)
        for m in range(3):
            out[m, k] = column[m]
    for k in range(3):  # exactly symmetric, whatever was rounded
        for m in range(k):
            out[k, m] = out[m, k] = (out[k, m] + out[m, k]) / 2.0
