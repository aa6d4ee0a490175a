"""The numerical heart of the alignment: robust scan-to-map registration on a distance field.

Poses, points and the surface are those of `salsa.residuals`.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from salsa.residuals import (
    Float,
    Normals,
    Points,
    Surface,
    base_points,
    cost_of,
    fit_quality,
    look_up,
    robust_cost,
    thinned,
    weigh,
    workspace,
)

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
