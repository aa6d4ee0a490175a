"""The numerical heart of the alignment: robust scan-to-map registration on a distance field.

Poses are x, y, yaw in the frame of the grid (m, rad; the corner of cell (0, 0) is its origin),
points are (P, 2) f8 in m in the base frame. The distance field comes as a surface (H, W, 4) f4:
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
) -> Float:
    """Return the endpoints (P, 2) in the base frame of the beams to use."""
    points = np.empty((len(ranges), 2))
    count = 0
    for k in range(len(ranges)):
        if use[k]:
            r = np.float64(ranges[k])
            points[count, 0] = offset[0] + r * directions[k, 0]
            points[count, 1] = offset[1] + r * directions[k, 1]
            count += 1
    return points[:count]


@numba.njit(cache=True, fastmath=_FAST)
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


@numba.njit(cache=True, fastmath=_FAST)
def robust_cost(
    points: Float, stride: int, pose: Float, surface: Surface, resolution: float, scale: float
) -> float:
    """Return the mean Geman-McClure cost 0..1 of the points; outside the map a point costs 1."""
    c, s = math.cos(pose[2]) / resolution, math.sin(pose[2]) / resolution
    u0, v0 = pose[0] / resolution - 0.5, pose[1] / resolution - 0.5
    total, count = 0.0, 0
    for k in range(0, len(points), stride):
        x, y = points[k, 0], points[k, 1]
        d = distance_at(u0 + c * x - s * y, v0 + s * x + c * y, surface)
        total += d * d / (d * d + scale * scale) if d >= 0.0 else 1.0
        count += 1
    return total / max(count, 1)


@numba.njit(cache=True, fastmath=_FAST)
def look_up(
    points: Float, stride: int, pose: Float, surface: Surface, resolution: float, seen: Seen
) -> int:
    """Write distance, its slopes by x and y, and by yaw, of the points on the map into `seen`.

    Slopes are in m a cell; returns how many points they are. Kept apart from `weigh`, so that the
    sums there run over what lies side by side.
    """
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    per_m = 1.0 / resolution
    u0, v0 = pose[0] * per_m - 0.5, pose[1] * per_m - 0.5
    rows, columns = surface.shape[:2]
    count = 0
    for k in range(0, len(points), stride):
        dx = cos * points[k, 0] - sin * points[k, 1]
        dy = sin * points[k, 0] + cos * points[k, 1]
        u, v = u0 + dx * per_m, v0 + dy * per_m
        if u >= 0.0 and v >= 0.0 and u < columns - 1 and v < rows - 1:
            column, row = int(u), int(v)
            fu, fv = np.float32(u - column), np.float32(v - row)
            d, du, dv, duv = surface[row, column]
            gx, gy = du + duv * fv, dv + duv * fu
            seen[0, count] = d + du * fu + gy * fv
            seen[1, count], seen[2, count] = gx, gy
            seen[3, count] = gy * np.float32(dx) - gx * np.float32(dy)
            count += 1
    return count


@numba.njit(cache=True, fastmath=_FAST)
def weigh(seen: Seen, count: int, resolution: float, scale: float) -> Normals:
    """Sum up the normal equations of the points that `look_up` found."""
    zero, scale2 = np.float32(0.0), np.float32(scale * scale)
    g0, g1, g2, squares, weights = zero, zero, zero, zero, zero
    h00, h01, h02, h11, h12, h22 = zero, zero, zero, zero, zero, zero
    for k in range(count):
        d, gx, gy, gt = seen[0, k], seen[1, k], seen[2, k], seen[3, k]
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


@numba.njit(cache=True, fastmath=_FAST)
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


@numba.njit(cache=True, fastmath=_FAST)
def cost_of(seen: Seen, count: int, points: int, scale: float) -> float:
    """Return the mean Geman-McClure cost 0..1; a point outside the map costs 1."""
    total, scale2 = np.float32(0.0), np.float32(scale * scale)
    for k in range(count):
        d2 = seen[0, k] * seen[0, k]
        total += d2 / (d2 + scale2)
    return float(total + (points - count)) / max(points, 1)


@numba.njit(cache=True)
def refine(
    points: Float, start: Float, surface: Surface, resolution: float, first_scale: float
) -> tuple[Float, float]:
    """Move a pose so that the points lie on the map: Gauss-Newton with a shrinking robust scale.

    Returns
    -------
    pose, cost
        (3,), and its cost at the last scale.
    """
    seen = np.empty((4, len(points)), np.float32)
    pose, scale, fine = start.copy(), first_scale, 0
    for _ in range(MAX_STEPS):
        stride = max(len(points) // (COARSE_POINTS if fine == 0 else FINE_POINTS), 1)
        count = look_up(points, stride, pose, surface, resolution, seen)
        found = weigh(seen, count, resolution, scale)
        step = solve(found.hessian, found.gradient, 1e-3 * found.weights + 1e-9)
        pose -= step
        if scale <= LAST_SCALE_M:
            done = abs(step[0]) < STEP_M and abs(step[1]) < STEP_M and abs(step[2]) < STEP_RAD
            if fine == FINE_STEPS or (done and fine > 0):
                break
            fine += done or fine > 0
        scale = max(scale * SHRINK, LAST_SCALE_M)
    count = look_up(points, 1, pose, surface, resolution, seen)
    return pose, cost_of(seen, count, len(points), LAST_SCALE_M)


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
    points: Float, centre: Float, surface: Surface, resolution: float
) -> tuple[Float, float]:
    """Score a lattice of poses around a centre, refine the best few; best pose and its cost."""
    stride = max(len(points) // SEARCH_POINTS, 1)
    best_costs = np.full(CANDIDATES, np.inf)
    best_poses = np.zeros((CANDIDATES, 3))
    pose = np.empty(3)
    for i in range(-SEARCH_STEPS, SEARCH_STEPS + 1):
        for j in range(-SEARCH_STEPS, SEARCH_STEPS + 1):
            for k in range(-SEARCH_STEPS, SEARCH_STEPS + 1):
                pose[0] = centre[0] + i * SEARCH_M
                pose[1] = centre[1] + j * SEARCH_M
                pose[2] = centre[2] + k * SEARCH_RAD
                cost = robust_cost(points, stride, pose, surface, resolution, SEARCH_SCALE_M)
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
    points: Float, start: Float, surface: Surface, resolution: float, out: Float
) -> float:
    """Write the refined pose into `out` and return its cost, infinity where nothing was done."""
    if len(points) == 0 or not np.isfinite(start).all():
        return np.inf
    pose, cost = register(points, start, surface, resolution)
    out[:] = pose
    return cost


@numba.njit(cache=True)
def register(
    points: Float, start: Float, surface: Surface, resolution: float
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
        if len(points) > 0 and np.isfinite(poses[n, 0]):
            seen = np.empty((4, len(points)), np.float32)
            count = look_up(points, 1, poses[n], surface, resolution, seen)
            residual_m[n], inlier_ratio[n] = fit_quality(seen, count, len(points), inlier_m)


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
        if len(points) > 0 and np.isfinite(poses[n, 0]):
            seen = np.empty((4, len(points)), np.float32)
            count = look_up(points, 1, poses[n], surface, resolution, seen)
            residual_m[n], inlier_ratio[n] = fit_quality(seen, count, len(points), inlier_m)
            found = weigh(seen, count, resolution, LAST_SCALE_M)
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
