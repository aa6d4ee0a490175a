"""Line segments in scans: split and merge with Pfister's weighted fit.

Points are split where they leave the chord between their ends, each piece is fitted in normal form
``x cos(angle) + y sin(angle) = radius`` with every point weighted by its variance across the line
(Pfister, Roumeliotis and Burdick, "Weighted line fitting algorithms for mobile robot map building
and efficient data representation", ICRA 2003), and neighbours that agree within their covariances
become one line. Filters, the order of the steps and the details of the split are those of the
classic ROS line extraction node, so that the segments are the same as its own.
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from semantic2d_dataset.errors import InvalidInputError

Float = NDArray[np.float64]

_MAX_STEPS = 5_000  # angle and radius settle in turns, and short lines take hundreds of them
_CHI_SQUARED = 3.0  # distance below which two neighbours are one line, as in the ROS node


@dataclass(frozen=True)
class LineParameters:
    """Settings of the extraction; the defaults are those published with the data set.

    Parameters
    ----------
    bearing_std_dev, range_std_dev
        Standard deviations of a beam's bearing (rad) and range (m).
    least_sq_angle_thresh, least_sq_radius_thresh
        The fit stops when angle (rad) and radius (m) change by no more than this.
    max_line_gap
        Largest distance between neighbouring points of one line, m.
    min_line_length
        Shortest segment, m.
    min_split_dist
        A point this far from the chord splits it, m.
    outlier_dist
        A point whose range differs by more than this from both neighbours may be an outlier, m.
    min_line_points
        Fewest points of one segment.
    """

    bearing_std_dev: float = 1e-5
    range_std_dev: float = 0.02
    least_sq_angle_thresh: float = 1e-4
    least_sq_radius_thresh: float = 1e-4
    max_line_gap: float = 1.0
    min_line_length: float = 0.4
    min_split_dist: float = 0.04
    outlier_dist: float = 0.06
    min_line_points: int = 15

    def __post_init__(self) -> None:
        if not all(math.isfinite(value) and value > 0 for value in astuple(self)):
            raise InvalidInputError(f"line parameters must be finite and above 0, found {self}")


PUBLISHED = LineParameters()
"""The parameters published with the data set."""


def extract_lines(
    ranges: ArrayLike,
    bearings: ArrayLike,
    parameters: LineParameters = PUBLISHED,
    *,
    range_min: float,
    range_max: float,
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Find the line segments of every scan.

    Parameters
    ----------
    ranges
        (N, B) in m; only beams with ``range_min <= r < range_max`` and r > 0 are
        used.
    bearings
        (B,) in rad, increasing.
    parameters
        Settings of the extraction.
    range_min, range_max
        Limits of a usable return, m. (Published labels of the Hokuyo: 0.6 to 60.)

    Returns
    -------
    segments, offsets
        (M, 4) f4 x1 y1 x2 y2 in m, lidar frame, in the order of the beams, and (N + 1,) i8:
        scan n has the segments ``offsets[n]:offsets[n + 1]``.

    Raises
    ------
    InvalidInputError
        If the shapes do not fit together.
    """
    r = np.ascontiguousarray(ranges, np.float32)
    phi = np.ascontiguousarray(bearings, np.float64)
    if r.ndim != 2 or phi.shape != r.shape[1:]:
        raise InvalidInputError(
            f"expected ranges (N, B) and bearings (B,), found {r.shape} and {phi.shape}"
        )
    most = r.shape[1] // max(int(parameters.min_line_points), 2) + 1
    found = np.empty((len(r), most, 4), np.float32)
    counts = np.empty(len(r), np.int64)
    directions = np.stack((np.cos(phi), np.sin(phi)), axis=-1)
    numbers = np.array(astuple(parameters), np.float64)
    _extract_all(r, directions, numbers, range_min, range_max, found, counts)
    offsets = np.concatenate((np.zeros(1, np.int64), np.cumsum(counts)))
    return found[np.arange(most) < counts[:, None]], offsets


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _extract_all(
    ranges: NDArray[np.float32],
    directions: Float,
    numbers: Float,
    range_min: float,
    range_max: float,
    found: NDArray[np.float32],
    counts: NDArray[np.int64],
) -> None:
    for n in numba.prange(ranges.shape[0]):
        counts[n] = _extract(ranges[n], directions, numbers, range_min, range_max, found[n])


@numba.njit(cache=True, error_model="numpy")
def _extract(
    ranges: NDArray[np.float32],
    directions: Float,
    numbers: Float,
    range_min: float,
    range_max: float,
    found: NDArray[np.float32],
) -> int:
    """Write the segments of one scan into `found` and return how many they are."""
    points = _keep_usable(ranges, directions, range_min, range_max)
    points = _drop_outliers(points, numbers[7], numbers[6])
    lines = _split(points, numbers)
    for k in range(len(lines)):
        _fit(points, lines[k], numbers)
    lines = _merge(lines)
    count = 0
    for k in range(len(lines)):
        for m in range(4):
            found[count, m] = lines[k, 2 + m]
        count += _is_segment(found[count])
    return count


@numba.njit(cache=True, error_model="numpy")
def _is_segment(segment: NDArray[np.float32]) -> bool:
    """Tell whether a fit came to something: points that are one, or nearly, have no line."""
    dx, dy = segment[2] - segment[0], segment[3] - segment[1]
    return math.isfinite(dx * dx + dy * dy) and dx * dx + dy * dy > 0


@numba.njit(cache=True, error_model="numpy")
def _keep_usable(
    ranges: NDArray[np.float32], directions: Float, range_min: float, range_max: float
) -> Float:
    """Return x, y, range (P, 3) of the beams whose range lies within the limits."""
    points = np.empty((len(ranges), 3))
    count = 0
    for k in range(len(ranges)):
        r = np.float64(ranges[k])
        if r > 0 and range_min <= r < range_max:
            points[count, 0] = r * directions[k, 0]
            points[count, 1] = r * directions[k, 1]
            points[count, 2] = r
            count += 1
    return points[:count]


@numba.njit(cache=True, error_model="numpy")
def _drop_outliers(points: Float, outlier_dist: float, min_split_dist: float) -> Float:
    """Drop points whose range jumps from both neighbours and that lie off the chord of them."""
    count = len(points)
    if count < 3:
        return points
    kept = np.empty_like(points)
    n = 0
    for i in range(count):
        j, k = i - 1, i + 1
        if i == 0:
            j, k = 1, 2
        elif i == count - 1:
            j, k = i - 1, i - 2
        jumps = (
            abs(points[i, 2] - points[j, 2]) > outlier_dist
            and abs(points[i, 2] - points[k, 2]) > outlier_dist
        )
        if jumps:
            c, s, radius = _chord(points, j, k)
            if abs(points[i, 0] * c + points[i, 1] * s - radius) > min_split_dist:
                continue
        kept[n] = points[i]
        n += 1
    return kept[:n]


@numba.njit(cache=True, error_model="numpy")
def _chord(points: Float, first: int, last: int) -> tuple[float, float, float]:
    """Return the unit normal and the radius, never negative, of the line through two points."""
    dx, dy = points[last, 0] - points[first, 0], points[last, 1] - points[first, 1]
    length = math.sqrt(dx * dx + dy * dy)
    if abs(dx) > 1e-9:
        c, s = -dy / length, dx / length
    else:
        c, s = 1.0, 0.0
    radius = points[first, 0] * c + points[first, 1] * s
    if radius < 0:
        return -c, -s, -radius
    return c, s, radius


@numba.njit(cache=True, error_model="numpy")
def _distance(points: Float, i: int, j: int) -> float:
    dx, dy = points[i, 0] - points[j, 0], points[i, 1] - points[j, 1]
    return math.sqrt(dx * dx + dy * dy)


@numba.njit(cache=True, error_model="numpy")
def _split(points: Float, numbers: Float) -> Float:
    """Split the points into pieces that are straight and without gaps.

    Returns
    -------
    Lines (L, 11) f8: angle, radius, x1, y1, x2, y2, first point, past the last point, and three
    places for the covariance. Angle and radius are those of the chord.
    """
    max_gap, min_length, min_points = numbers[4], numbers[5], max(int(numbers[8]), 2)
    lines = np.empty((len(points) // min_points + 1, 11))
    stack = np.empty((len(points) + 1, 2), np.int64)
    count, top = 0, 0
    if len(points) > max(min_points, 3):
        stack[0, 0], stack[0, 1] = 0, len(points)
        top = 1
    while top > 0:
        top -= 1
        first, past = stack[top, 0], stack[top, 1]
        if past - first < min_points:  # no part of it can become a line
            continue
        i_split, straight = _find_split(points, first, past, numbers[6], max_gap)
        if straight:
            if _distance(points, first, past - 1) >= min_length:
                _set_chord(points, first, past, lines[count])
                count += 1
            continue
        # As in the ROS node, the point before the split and the last one belong to no part.
        stack[top, 0], stack[top, 1] = i_split, past - 1
        stack[top + 1, 0], stack[top + 1, 1] = first, i_split - 1
        top += 2
    return lines[:count]


@numba.njit(cache=True, error_model="numpy")
def _find_split(
    points: Float, first: int, past: int, min_split_dist: float, max_gap: float
) -> tuple[int, bool]:
    """Return where to split the points, and whether they are one piece as they are."""
    c, s, radius = _chord(points, first, past - 1)
    farthest, i_farthest, widest, i_widest = 0.0, first + 1, 0.0, first + 1
    for i in range(first + 1, past - 1):
        distance = abs(points[i, 0] * c + points[i, 1] * s - radius)
        if distance > farthest:
            farthest, i_farthest = distance, i
        gap = _distance(points, i, i + 1)
        if gap > widest:
            widest, i_widest = gap, i
    if _distance(points, first, first + 1) > widest:
        widest, i_widest = _distance(points, first, first + 1), first + 1
    if _distance(points, past - 2, past - 1) > widest:
        widest, i_widest = _distance(points, past - 2, past - 1), past - 1
    straight = farthest < min_split_dist and widest < max_gap
    return (i_farthest if farthest >= min_split_dist else i_widest), straight


@numba.njit(cache=True, error_model="numpy")
def _set_chord(points: Float, first: int, past: int, line: Float) -> None:
    c, s, radius = _chord(points, first, past - 1)
    line[0], line[1] = math.atan2(s, c), radius
    line[2], line[3] = points[first, 0], points[first, 1]
    line[4], line[5] = points[past - 1, 0], points[past - 1, 1]
    line[6], line[7] = first, past


@numba.njit(cache=True, error_model="numpy")
def _fit(points: Float, line: Float, numbers: Float) -> None:
    """Fit angle and radius in turns until both settle, then the covariance and the ends."""
    var_phi, var_r = numbers[0] ** 2, numbers[1] ** 2
    first, past = int(line[6]), int(line[7])
    last_angle, last_radius = 0.0, 0.0
    weight, curvature = 0.0, 0.0
    for _ in range(_MAX_STEPS):
        settled = (
            abs(line[1] - last_radius) <= numbers[3] and abs(line[0] - last_angle) <= numbers[2]
        )
        if settled:
            break
        last_angle, last_radius = line[0], line[1]
        weight, line[1] = _fit_radius(points, first, past, last_angle, var_r, var_phi)
        slope, curvature = _angle_derivatives(
            points, first, past, last_angle, line[1], var_r, var_phi
        )
        line[0] = last_angle - slope / curvature
    _set_covariance(points, line, weight, curvature, last_angle, var_r, var_phi)
    _project_ends(line)


@numba.njit(cache=True, error_model="numpy")
def _fit_radius(
    points: Float, first: int, past: int, angle: float, var_r: float, var_phi: float
) -> tuple[float, float]:
    """Return the variance of the radius and the radius, given the angle (Pfister, eq. 12)."""
    c, s = math.cos(angle), math.sin(angle)
    total, weighted = 0.0, 0.0
    for i in range(first, past):
        across, along = points[i, 0] * c + points[i, 1] * s, points[i, 0] * s - points[i, 1] * c
        r2 = points[i, 2] * points[i, 2]
        inverse = r2 / (var_r * across * across + var_phi * r2 * along * along)
        total += inverse
        weighted += across * inverse
    return 1.0 / total, weighted / total


@numba.njit(cache=True, error_model="numpy")
def _angle_derivatives(
    points: Float, first: int, past: int, angle: float, radius: float, var_r: float, var_phi: float
) -> tuple[float, float]:
    """Return the first two derivatives of the weighted error a / b by the angle (eq. 14)."""
    c, s = math.cos(angle), math.sin(angle)
    slope, curvature = 0.0, 0.0
    for i in range(first, past):
        across, along = points[i, 0] * c + points[i, 1] * s, points[i, 0] * s - points[i, 1] * c
        r2 = points[i, 2] * points[i, 2]
        error = across - radius
        spread = 2.0 * (r2 * var_phi - var_r) / r2
        a, b = error * error, var_r * across * across / r2 + var_phi * along * along
        a1, a2 = -2.0 * along * error, 2.0 * along * along - 2.0 * across * error
        b1, b2 = spread * across * along, spread * (across * across - along * along)
        first_order = a1 * b - a * b1
        slope += first_order / (b * b)
        curvature += ((a2 * b - a * b2) * b - 2.0 * first_order * b1) / (b * b * b)
    return slope, curvature


@numba.njit(cache=True, error_model="numpy")
def _set_covariance(
    points: Float,
    line: Float,
    weight: float,
    curvature: float,
    last_angle: float,
    var_r: float,
    var_phi: float,
) -> None:
    """Store the covariance of radius and angle: rr, ra, aa (Pfister, eq. 17 to 19)."""
    c, s = math.cos(line[0]), math.sin(line[0])
    last_c, last_s = math.cos(last_angle), math.sin(last_angle)
    sum_a, sum_b = 0.0, 0.0
    for i in range(int(line[6]), int(line[7])):
        x, y, r2 = points[i, 0], points[i, 1], points[i, 2] * points[i, 2]
        across, along = x * last_c + y * last_s, x * last_s - y * last_c
        b = var_r * across * across / r2 + var_phi * along * along
        lever = x * s - y * c
        sum_a += 2.0 * lever / b
        sum_b += 4.0 * lever * lever / b
    line[8] = weight
    line[9] = weight * sum_a / curvature
    line[10] = sum_b / (curvature * curvature)


@numba.njit(cache=True, error_model="numpy")
def _project_ends(line: Float) -> None:
    c, s = math.cos(line[0]), math.sin(line[0])
    for k in (2, 4):
        error = line[k] * c + line[k + 1] * s - line[1]
        line[k] -= error * c
        line[k + 1] -= error * s


@numba.njit(cache=True, error_model="numpy")
def _merge(lines: Float) -> Float:
    """Join neighbours that agree within their covariances."""
    if len(lines) < 2:
        return lines
    merged = np.empty_like(lines)
    count = 0
    for i in range(1, len(lines)):
        if not _join(lines[i - 1], lines[i]):
            merged[count] = lines[i - 1]
            count += 1
    merged[count] = lines[-1]
    return merged[: count + 1]


@numba.njit(cache=True, error_model="numpy")
def _join(before: Float, line: Float) -> bool:
    """Merge the line before into `line` if their chi-squared distance is small."""
    dr, da = before[1] - line[1], before[0] - line[0]
    rr, ra, aa = before[8] + line[8], before[9] + line[9], before[10] + line[10]
    chi_squared = (aa * dr * dr - 2.0 * ra * dr * da + rr * da * da) / (rr * aa - ra * ra)
    if not chi_squared < _CHI_SQUARED:
        return False
    information = _inverse(before[8:11]) + _inverse(line[8:11])
    radius, angle = np.zeros(2), np.zeros(2)
    for k, each in enumerate((before, line)):
        i = _inverse(each[8:11])
        radius[k] = i[0] * each[1] + i[1] * each[0]
        angle[k] = i[1] * each[1] + i[2] * each[0]
    line[8:11] = _inverse(information)
    line[1] = line[8] * radius.sum() + line[9] * angle.sum()
    line[0] = line[9] * radius.sum() + line[10] * angle.sum()
    line[2:4] = before[2:4]
    _project_ends(line)
    return True


@numba.njit(cache=True, error_model="numpy")
def _inverse(m: Float) -> Float:
    """Invert a symmetric 2 x 2 matrix given as (m00, m01, m11)."""
    determinant = m[0] * m[2] - m[1] * m[1]
    return np.array((m[2] / determinant, -m[1] / determinant, m[0] / determinant))
