"""Line segments in scans: split and merge with Pfister's weighted fit.

Points are split where they leave the chord between their ends, each piece is fitted in normal form
``x cos(angle) + y sin(angle) = radius`` with every point weighted by its variance across the line,
and neighbours that agree within their covariances become one line (Pfister, Roumeliotis and
Burdick, "Weighted line fitting algorithms for mobile robot map building and efficient data
representation", ICRA 2003).

Two fits are offered. The classic one is that of the ROS line extraction node, as are filters, the
order of the steps and the details of the split, so that the segments are the same as its own: angle
and radius in turns, which creeps, and stops short of the best line. The joint one solves for both
at once by Gauss-Newton, with the same weights, and settles in two or three steps.
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass
from typing import Literal

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.line_fits import Points, fit_in_turns, fit_jointly, project_ends

Float = NDArray[np.float64]

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
    fit
        ``classic``: angle and radius in turns, segments as those of the ROS node. ``joint``: both
        at once. It is several times as fast and closer to the walls, and its covariance knows how
        angle and radius depend on each other; a wall is joined again over at most `max_line_gap`,
        where the classic node joins over openings of any width.
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
    fit: Literal["classic", "joint"] = "classic"

    def __post_init__(self) -> None:
        *numbers, fit = astuple(self)
        if not all(math.isfinite(value) and value > 0 for value in numbers):
            raise InvalidInputError(f"line parameters must be finite and above 0, found {self}")
        if fit not in ("classic", "joint"):
            raise InvalidInputError(f"line parameters: fit is classic or joint, found {fit!r}")


PUBLISHED = LineParameters()
"""The parameters published with the data set, and the fit of the node that used them."""

FAST = LineParameters(fit="joint")
"""The published parameters with the joint fit."""


def extract_lines(
    ranges: ArrayLike,
    bearings: ArrayLike,
    parameters: LineParameters = PUBLISHED,
    *,
    range_min: float,
    range_max: float,
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Find the line segments of every scan, as the module's docstring describes.

    Parameters
    ----------
    ranges
        (N, B) in m; only beams with ``range_min <= r < range_max`` and r > 0 are
        used.
    bearings
        (B,) in rad, increasing.
    parameters
        Settings of the extraction: `PUBLISHED`, `FAST` or others.
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

    Notes
    -----
    Fit and covariances: Pfister, Roumeliotis and Burdick, ICRA 2003, equations 12 to 19.
    """
    r = np.ascontiguousarray(ranges, np.float32)
    phi = np.ascontiguousarray(bearings, np.float64)
    if r.ndim != 2 or phi.shape != r.shape[1:]:
        raise InvalidInputError(
            f"expected ranges (N, B) and bearings (B,), found {r.shape} and {phi.shape}"
        )
    *numbers, fit = astuple(parameters)
    most = r.shape[1] // max(int(parameters.min_line_points), 2) + 1
    found = np.empty((len(r), most, 4), np.float32)
    counts = np.empty(len(r), np.int64)
    directions = np.stack((np.cos(phi), np.sin(phi)))
    # plain numbers: numba's cached files could not be read once a class in them had moved
    settings = (*map(float, numbers), float(fit == "joint"))
    _extract_all(r, directions, settings, (float(range_min), float(range_max)), found, counts)
    offsets = np.concatenate((np.zeros(1, np.int64), np.cumsum(counts)))
    return found[np.arange(most) < counts[:, None]], offsets


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _extract_all(
    ranges: NDArray[np.float32],
    directions: Float,
    settings: tuple[float, ...],
    limits: tuple[float, float],
    found: NDArray[np.float32],
    counts: NDArray[np.int64],
) -> None:
    for n in numba.prange(ranges.shape[0]):
        counts[n] = _extract(ranges[n], directions, settings, limits, found[n])


@numba.njit(cache=True, error_model="numpy")
def _extract(
    ranges: NDArray[np.float32],
    directions: Float,
    settings: tuple[float, ...],
    limits: tuple[float, float],
    found: NDArray[np.float32],
) -> int:
    """Write the segments of one scan into `found` and return how many they are."""
    (
        bearing_std_dev,
        range_std_dev,
        angle_thresh,
        radius_thresh,
        max_gap,
        min_length,
        min_split_dist,
        outlier_dist,
        min_points,
        joint,
    ) = settings
    var_phi, var_r = bearing_std_dev * bearing_std_dev, range_std_dev * range_std_dev
    points = _usable_points(ranges, directions, limits, outlier_dist, min_split_dist, var_r)
    lines = _split(points, max(int(min_points), 2), min_length, min_split_dist, max_gap)
    for line in lines:
        if joint:
            fit_jointly(_piece(points, line), line, var_phi, angle_thresh, radius_thresh)
        else:
            fit_in_turns(_piece(points, line), line, var_phi, angle_thresh, radius_thresh)
        project_ends(line)
    if joint:
        _unwrap(lines)
        lines = _merge(lines, max_gap, min_split_dist)
    else:
        lines = _merge(lines, np.inf, np.inf)
    count = 0
    for line in lines:
        for m in range(4):
            found[count, m] = line[2 + m]
        count += _is_segment(found[count])
    return count


@numba.njit(cache=True, error_model="numpy")
def _is_segment(segment: NDArray[np.float32]) -> bool:
    """Tell whether a fit came to something: points that are one, or nearly, have no line."""
    dx, dy = segment[2] - segment[0], segment[3] - segment[1]
    return math.isfinite(dx * dx + dy * dy) and dx * dx + dy * dy > 0


@numba.njit(cache=True, error_model="numpy")
def _usable_points(
    ranges: NDArray[np.float32],
    directions: Float,
    limits: tuple[float, float],
    outlier_dist: float,
    min_split_dist: float,
    var_r: float,
) -> Points:
    """Return the points whose range lies within the limits, without outliers."""
    x, y = np.empty(len(ranges)), np.empty(len(ranges))
    radii = np.empty(len(ranges))
    count = 0
    for k in range(len(ranges)):
        r = np.float64(ranges[k])
        if r > 0 and limits[0] <= r < limits[1]:
            x[count], y[count], radii[count] = r * directions[0, k], r * directions[1, k], r
            count += 1
    count = _drop_outliers(x[:count], y[:count], radii[:count], outlier_dist, min_split_dist)
    spread = radii  # has the radii's place, who are not needed any more
    for i in range(count):
        spread[i] = var_r / (radii[i] * radii[i])
    return x[:count], y[:count], spread[:count]


@numba.njit(cache=True, error_model="numpy")
def _drop_outliers(
    x: Float, y: Float, radii: Float, outlier_dist: float, min_split_dist: float
) -> int:
    """Move the points that stay to the front, and return how many they are.

    A point goes if its range jumps from both neighbours and it lies off the chord of them.
    """
    count = len(x)
    stays = np.ones(count, np.bool_)
    for i in range(count if count > 2 else 0):
        j, k = i - 1, i + 1
        if i == 0:
            j, k = 1, 2
        elif i == count - 1:
            j, k = i - 1, i - 2
        jumps = abs(radii[i] - radii[j]) > outlier_dist and abs(radii[i] - radii[k]) > outlier_dist
        if jumps:
            c, s, radius = _chord(x, y, j, k)
            stays[i] = abs(x[i] * c + y[i] * s - radius) <= min_split_dist
    n = 0
    for i in range(count):
        if stays[i]:
            x[n], y[n], radii[n] = x[i], y[i], radii[i]
            n += 1
    return n


@numba.njit(cache=True, error_model="numpy")
def _chord(x: Float, y: Float, first: int, last: int) -> tuple[float, float, float]:
    """Return the unit normal and the radius, never negative, of the line through two points."""
    dx, dy = x[last] - x[first], y[last] - y[first]
    length = math.sqrt(dx * dx + dy * dy)
    if abs(dx) > 1e-9:
        c, s = -dy / length, dx / length
    else:
        c, s = 1.0, 0.0
    radius = x[first] * c + y[first] * s
    if radius < 0:
        return -c, -s, -radius
    return c, s, radius


@numba.njit(cache=True, error_model="numpy")
def _distance(x: Float, y: Float, i: int, j: int) -> float:
    dx, dy = x[i] - x[j], y[i] - y[j]
    return math.sqrt(dx * dx + dy * dy)


@numba.njit(cache=True, error_model="numpy")
def _split(
    points: Points, min_points: int, min_length: float, min_split_dist: float, max_gap: float
) -> Float:
    """Split the points into pieces that are straight and without gaps.

    Returns
    -------
    Lines (L, 11) as in `line_fits`; angle and radius are those of the chord.
    """
    x, y, _ = points
    gaps = np.empty(len(x))  # to the next point
    for i in range(len(x) - 1):
        gaps[i] = _distance(x, y, i, i + 1)
    lines = np.empty((len(x) // min_points + 1, 11))
    stack = np.empty((len(x) // min_points + 2, 2), np.int64)
    count, top = 0, 0
    if len(x) > max(min_points, 3):
        stack[0, 0], stack[0, 1] = 0, len(x)
        top = 1
    while top > 0:
        top -= 1
        first, past = stack[top, 0], stack[top, 1]
        i_split, straight = _find_split(x, y, gaps, first, past, min_split_dist, max_gap)
        if straight:
            if _distance(x, y, first, past - 1) >= min_length:
                _set_chord(x, y, first, past, lines[count])
                count += 1
            continue
        # As in the ROS node, the point before the split and the last one belong to no part.
        # Parts with too few points cannot become lines.
        if past - 1 - i_split >= min_points:
            stack[top, 0], stack[top, 1] = i_split, past - 1
            top += 1
        if i_split - 1 - first >= min_points:
            stack[top, 0], stack[top, 1] = first, i_split - 1
            top += 1
    return lines[:count]


@numba.njit(cache=True, error_model="numpy")
def _find_split(
    x: Float, y: Float, gaps: Float, first: int, past: int, min_split_dist: float, max_gap: float
) -> tuple[int, bool]:
    """Return where to split the points, and whether they are one piece as they are."""
    c, s, radius = _chord(x, y, first, past - 1)
    farthest, i_farthest, widest, i_widest = 0.0, first + 1, 0.0, first + 1
    for i in range(first + 1, past - 1):
        distance = abs(x[i] * c + y[i] * s - radius)
        if distance > farthest:
            farthest, i_farthest = distance, i
    if farthest >= min_split_dist:
        return i_farthest, False
    for i in range(first + 1, past - 1):
        if gaps[i] > widest:
            widest, i_widest = gaps[i], i
    if gaps[first] > widest:
        widest, i_widest = gaps[first], first + 1
    return i_widest, widest < max_gap


@numba.njit(cache=True, error_model="numpy")
def _set_chord(x: Float, y: Float, first: int, past: int, line: Float) -> None:
    c, s, radius = _chord(x, y, first, past - 1)
    line[0], line[1] = math.atan2(s, c), radius
    line[2], line[3] = x[first], y[first]
    line[4], line[5] = x[past - 1], y[past - 1]
    line[6], line[7] = first, past


@numba.njit(cache=True, error_model="numpy")
def _piece(points: Points, line: Float) -> Points:
    """Return views of the points of a line."""
    x, y, spread = points
    first, past = int(line[6]), int(line[7])
    return x[first:past], y[first:past], spread[first:past]


@numba.njit(cache=True, error_model="numpy")
def _unwrap(lines: Float) -> None:
    """Turn angles by whole turns, so that neighbours differ by half a turn at most."""
    for i in range(1, len(lines)):
        turns = (lines[i - 1, 0] - lines[i, 0]) / (2.0 * math.pi)
        if math.isfinite(turns):
            lines[i, 0] += 2.0 * math.pi * round(turns)


@numba.njit(cache=True, error_model="numpy")
def _merge(lines: Float, max_gap: float, max_off: float) -> Float:
    """Join neighbours that agree within their covariances."""
    if len(lines) < 2:
        return lines
    merged = np.empty_like(lines)
    count = 0
    for i in range(1, len(lines)):
        if not _join(lines[i - 1], lines[i], max_gap, max_off):
            merged[count] = lines[i - 1]
            count += 1
    merged[count] = lines[-1]
    return merged[: count + 1]


@numba.njit(cache=True, error_model="numpy")
def _join(before: Float, line: Float, max_gap: float, max_off: float) -> bool:
    """Merge the line before into `line` if their chi-squared distance is small.

    The gap between them may be `max_gap`, and the four ends `max_off` from the merged line.
    """
    dr, da = before[1] - line[1], before[0] - line[0]
    rr, ra, aa = before[8] + line[8], before[9] + line[9], before[10] + line[10]
    chi_squared = (aa * dr * dr - 2.0 * ra * dr * da + rr * da * da) / (rr * aa - ra * ra)
    gap = math.hypot(line[2] - before[4], line[3] - before[5])
    if not chi_squared < _CHI_SQUARED or gap > max_gap:
        return False
    i, j = _inverse(before[8:11]), _inverse(line[8:11])
    covariance = _inverse(i + j)
    to_radius = i[0] * before[1] + i[1] * before[0] + j[0] * line[1] + j[1] * line[0]
    to_angle = i[1] * before[1] + i[2] * before[0] + j[1] * line[1] + j[2] * line[0]
    radius = covariance[0] * to_radius + covariance[1] * to_angle
    angle = covariance[1] * to_radius + covariance[2] * to_angle
    c, s = math.cos(angle), math.sin(angle)
    for end in (before[2:4], before[4:6], line[2:4], line[4:6]):
        if abs(end[0] * c + end[1] * s - radius) > max_off:
            return False
    line[0], line[1] = angle, radius
    line[2:4] = before[2:4]
    line[8:11] = covariance
    project_ends(line)
    return True


@numba.njit(cache=True, error_model="numpy")
def _inverse(m: Float) -> Float:
    """Invert a symmetric 2 x 2 matrix given as (m00, m01, m11)."""
    determinant = m[0] * m[2] - m[1] * m[1]
    return np.array((m[2] / determinant, -m[1] / determinant, m[0] / determinant))
