"""Weighted fits of one line in normal form: ``x cos(angle) + y sin(angle) = radius``.

Every point is weighted by its variance across the line (Pfister, Roumeliotis and Burdick,
"Weighted line fitting algorithms for mobile robot map building and efficient data
representation", ICRA 2003). A line is a row (11,) f8: angle, radius, x1, y1, x2, y2, number of
the first point, number past the last, and the covariance of radius and angle rr, ra, aa.
Points are three arrays (P,) f8: x and y in m, and the variance of the range over its square.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Points = tuple[Float, Float, Float]

_MAX_TURNS = 5_000  # angle and radius settle in turns, and short lines take hundreds of them
_MAX_STEPS = 20  # of the joint fit, which needs two or three
_SUMS = {"reassoc", "contract", "nsz"}  # lets sums run over vectors; NaN and inf stay what they are


@numba.njit(cache=True, error_model="numpy")
def fit_in_turns(
    points: Points, line: Float, var_phi: float, angle_thresh: float, radius_thresh: float
) -> None:
    """Fit angle and radius in turns until both settle, as the ROS node does."""
    last_angle, last_radius = 0.0, 0.0
    weight, curvature = 0.0, 0.0
    for _ in range(_MAX_TURNS):
        settled = (
            abs(line[1] - last_radius) <= radius_thresh
            and abs(line[0] - last_angle) <= angle_thresh
        )
        if settled:
            break
        last_angle, last_radius = line[0], line[1]
        weight, line[1] = _fit_radius(points, last_angle, var_phi)
        slope, curvature = _angle_derivatives(points, last_angle, line[1], var_phi)
        line[0] = last_angle - slope / curvature
    _set_covariance(points, line, weight, curvature, last_angle, var_phi)


@numba.njit(cache=True, error_model="numpy", fastmath=_SUMS)
def _fit_radius(points: Points, angle: float, var_phi: float) -> tuple[float, float]:
    """Return the variance of the radius and the radius, given the angle (Pfister, eq. 12)."""
    c, s = math.cos(angle), math.sin(angle)
    x, y, spread = points
    total, weighted = 0.0, 0.0
    for i in range(len(x)):
        across, along = x[i] * c + y[i] * s, x[i] * s - y[i] * c
        w = 1.0 / (spread[i] * across * across + var_phi * along * along)
        total += w
        weighted += across * w
    return 1.0 / total, weighted / total


@numba.njit(cache=True, error_model="numpy", fastmath=_SUMS)
def _angle_derivatives(
    points: Points, angle: float, radius: float, var_phi: float
) -> tuple[float, float]:
    """Return the first two derivatives of the weighted error a / b by the angle (eq. 14)."""
    c, s = math.cos(angle), math.sin(angle)
    x, y, spread = points
    slope, curvature = 0.0, 0.0
    for i in range(len(x)):
        across, along = x[i] * c + y[i] * s, x[i] * s - y[i] * c
        error = across - radius
        w = 1.0 / (spread[i] * across * across + var_phi * along * along)  # 1 / b
        change = 2.0 * w * (var_phi - spread[i])
        a, a1 = error * error, -2.0 * along * error
        a2 = 2.0 * along * along - 2.0 * across * error
        b1, b2 = change * across * along, change * (across * across - along * along)  # over b
        first_order = w * (a1 - a * b1)
        slope += first_order
        curvature += w * (a2 - a * b2) - 2.0 * first_order * b1
    return slope, curvature


@numba.njit(cache=True, error_model="numpy", fastmath=_SUMS)
def _set_covariance(
    points: Points,
    line: Float,
    weight: float,
    curvature: float,
    last_angle: float,
    var_phi: float,
) -> None:
    """Store the covariance of radius and angle: rr, ra, aa (Pfister, eq. 17 to 19)."""
    c, s = math.cos(line[0]), math.sin(line[0])
    last_c, last_s = math.cos(last_angle), math.sin(last_angle)
    x, y, spread = points
    sum_a, sum_b = 0.0, 0.0
    for i in range(len(x)):
        across, along = x[i] * last_c + y[i] * last_s, x[i] * last_s - y[i] * last_c
        w = 1.0 / (spread[i] * across * across + var_phi * along * along)
        lever = x[i] * s - y[i] * c
        sum_a += 2.0 * lever * w
        sum_b += 4.0 * lever * lever * w
    line[8] = weight
    line[9] = weight * sum_a / curvature
    line[10] = sum_b / (curvature * curvature)


@numba.njit(cache=True, error_model="numpy")
def fit_jointly(
    points: Points, line: Float, var_phi: float, angle_thresh: float, radius_thresh: float
) -> None:
    """Fit angle and radius at once by Gauss-Newton.

    The covariance is the inverse of the normal matrix. Points so far from straight that the steps
    do not settle keep their chord, without covariance.
    """
    angle, radius = line[0], line[1]
    for _ in range(_MAX_STEPS):
        rr, ra, aa, to_radius, to_angle = _normal_equations(points, line[0], line[1], var_phi)
        determinant = rr * aa - ra * ra
        step_radius = (aa * to_radius - ra * to_angle) / determinant
        step_angle = (rr * to_angle - ra * to_radius) / determinant
        line[0] += step_angle
        line[1] += step_radius
        if abs(step_angle) <= angle_thresh and abs(step_radius) <= radius_thresh:
            line[8], line[9], line[10] = aa / determinant, -ra / determinant, rr / determinant
            return
    line[0], line[1] = angle, radius
    line[8:11] = np.nan


@numba.njit(cache=True, error_model="numpy", fastmath=_SUMS)
def _normal_equations(
    points: Points, angle: float, radius: float, var_phi: float
) -> tuple[float, float, float, float, float]:
    """Return the normal matrix rr, ra, aa and the right side of a step in radius and angle.

    A point's error falls by the step in radius, and by `along` times the step in angle. The right
    side is the slope of the weighted error with the weights' own change by angle (eq. 14): without
    it walls seen at a slant come out turned, since noise moves `across` and `along` together.
    """
    c, s = math.cos(angle), math.sin(angle)
    x, y, spread = points
    rr, ra, aa, to_radius, to_angle = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(len(x)):
        across, along = x[i] * c + y[i] * s, x[i] * s - y[i] * c
        w = 1.0 / (spread[i] * across * across + var_phi * along * along)
        rr += w
        ra += w * along
        aa += w * along * along
        pull = w * (across - radius)
        to_radius += pull
        to_angle += pull * along * (1.0 + pull * across * (var_phi - spread[i]))
    return rr, ra, aa, to_radius, to_angle


@numba.njit(cache=True, error_model="numpy")
def project_ends(line: Float) -> None:
    """Move the ends of a segment onto its line."""
    c, s = math.cos(line[0]), math.sin(line[0])
    for k in (2, 4):
        error = line[k] * c + line[k + 1] * s - line[1]
        line[k] -= error * c
        line[k + 1] -= error * s
