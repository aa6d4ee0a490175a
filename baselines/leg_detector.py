"""People by geometry: pairs of edges in a scan that are as far apart as legs are.

A scan is smoothed, every jump of its range is an edge, falling where something nearer begins and
rising where it ends, and three sequences of edges are looked for, in this order: two legs apart
(fall, rise, fall, rise), one leg in front of the other (fall, fall, rise or fall, rise, rise), and
legs together or a single one (fall, rise). An edge belongs to one person. (Bellotto and Hu,
"Multisensor-based human detection and tracking for mobile service robots", IEEE Transactions on
Systems, Man, and Cybernetics B 39(1), 2009, section on leg detection.)
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.lidars import LidarSpec
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, Taxonomy

Float = NDArray[np.float64]
Int = NDArray[np.int64]

PERSON = "Person"

PATTERNS = ("legs apart", "forward straddle", "single leg or legs together")
"""What `LegDetections.patterns` counts in."""

_APART, _STRADDLE, _SINGLE = range(3)
_FALL, _RISE = -1, 1


@dataclass(frozen=True)
class LegParameters:
    """Settings of the detection.

    The sizes a, b and c are those that the paper advises, as two public implementations of it
    hold them (edge_leg_detector and leg_pplp). "First author's code" is the leg detector that he
    published (LegsDetector, 2005).

    Parameters
    ----------
    min_leg_m, max_leg_m
        Width of a leg, the paper's a: 0.1 to 0.2.
    max_gap_m
        Between two legs, the paper's b: at most 0.4.
    min_together_m, max_together_m
        Width of a single leg or of legs together, the paper's c: 0.1 to 0.4.
    edge_m
        Ranges of neighbouring beams that differ by more are an edge (0.1 in edge_leg_detector;
        the first author's code has 0.1 between legs and 0.3 beside them).
    same_edge_m
        Edges of one kind with less than this between them are one: beams that end on nothing
        between a leg and what lies behind it (0.05 in the first author's code).
    window_beams
        Odd; narrower peaks, of cloth that swallows the beam, are levelled (3 in leg_pplp).
    max_distance_m
        Legs farther away are not looked for (8 in the first author's code, for halls).

    Raises
    ------
    InvalidInputError
        If a value is out of its domain.
    """

    min_leg_m: float = 0.1
    max_leg_m: float = 0.2
    max_gap_m: float = 0.4
    min_together_m: float = 0.1
    max_together_m: float = 0.4
    edge_m: float = 0.1
    same_edge_m: float = 0.05
    window_beams: int = 3
    max_distance_m: float = 8.0

    def __post_init__(self) -> None:
        if not all(math.isfinite(value) and value > 0 for value in astuple(self)):
            raise InvalidInputError(f"leg parameters must be finite and above 0, found {self}")
        if self.window_beams % 2 == 0:
            raise InvalidInputError(f"window_beams: expected an odd number, found {self}")


@dataclass(frozen=True)
class LegDetections:
    """The people found in N scans.

    Parameters
    ----------
    offsets
        (N + 1,) i8: scan n has the people ``offsets[n]:offsets[n + 1]``.
    positions
        (M, 2) f4, m, lidar frame: half way between the middles of the legs' visible sides.
    patterns
        (M,) u1, index in `PATTERNS`.
    spans
        (M, 2, 2) i4: first and last beam of one leg, then of the other; twice the same where
        the pattern has one thing only.
    """

    offsets: NDArray[np.int64]
    positions: NDArray[np.float32]
    patterns: NDArray[np.uint8]
    spans: NDArray[np.int32]


def detect_legs(
    ranges: ArrayLike,
    bearings: ArrayLike,
    parameters: LegParameters | None = None,
    *,
    range_min: float,
    range_max: float,
) -> LegDetections:
    """Find the people of every scan, as the module's docstring describes.

    Legs that the first or the last beam cuts are not found, nor are those across the seam of a
    scan that goes all the way round.

    Parameters
    ----------
    ranges
        (N, B) in m; a beam without ``range_min <= r < range_max`` and r > 0 counts as far away.
    bearings
        (B,) in rad, increasing, evenly spaced.
    parameters
        Settings; the published ones where not given.
    range_min, range_max
        Limits of a return, m.

    Raises
    ------
    InvalidInputError
        If the shapes do not fit together.
    """
    return _detect(ranges, bearings, parameters, range_min, range_max)[0]


def label_people(
    ranges: ArrayLike,
    lidar: LidarSpec,
    parameters: LegParameters | None = None,
    *,
    taxonomy: Taxonomy = SEMANTIC2D,
) -> NDArray[np.uint8]:
    """Label the beams that end on a leg Person, and the others background.

    Parameters
    ----------
    ranges
        (N, B) in m, as measured.
    lidar
        The sensor, B beams.
    parameters
        Settings; the published ones where not given.
    taxonomy
        Where the ids come from.

    Returns
    -------
    (N, B) u1 class ids.

    Raises
    ------
    InvalidInputError
        If the ranges do not have the lidar's beams, or the taxonomy has no Person.
    """
    person = taxonomy.id_of(PERSON)
    limits = (lidar.range_min, lidar.range_max)
    _, on_leg = _detect(ranges, lidar.bearings, parameters, *limits)
    return np.where(on_leg, person, taxonomy.background_id).astype(np.uint8)


def _detect(
    ranges: ArrayLike,
    bearings: ArrayLike,
    parameters: LegParameters | None,
    range_min: float,
    range_max: float,
) -> tuple[LegDetections, NDArray[np.bool_]]:
    """Return the people, and which beams (N, B) end on their legs."""
    r = np.ascontiguousarray(ranges, np.float32)
    phi = np.ascontiguousarray(bearings, np.float64)
    if r.ndim != 2 or phi.shape != r.shape[1:]:
        raise InvalidInputError(
            f"expected ranges (N, B) and bearings (B,), found {r.shape} and {phi.shape}"
        )
    n, most = len(r), r.shape[1] // 2 + 1  # a person has two edges at least
    positions = np.empty((n, most, 2), np.float32)
    patterns = np.empty((n, most), np.uint8)
    spans = np.empty((n, most, 2, 2), np.int32)
    counts = np.empty(n, np.int64)
    on_leg = np.zeros(r.shape, np.bool_)
    # plain numbers: numba's cached files could not be read once a class in them had moved
    settings = tuple(map(float, astuple(parameters or LegParameters())))
    limits = (float(range_min), float(range_max))
    _detect_all(r, phi, settings, limits, positions, patterns, spans, counts, on_leg)
    offsets = np.concatenate((np.zeros(1, np.int64), np.cumsum(counts)))
    kept = np.arange(most) < counts[:, None]
    return LegDetections(offsets, positions[kept], patterns[kept], spans[kept]), on_leg


@numba.njit(cache=True, parallel=True)
def _detect_all(
    ranges: NDArray[np.float32],
    bearings: Float,
    settings: tuple[float, ...],
    limits: tuple[float, float],
    positions: NDArray[np.float32],
    patterns: NDArray[np.uint8],
    spans: NDArray[np.int32],
    counts: Int,
    on_leg: NDArray[np.bool_],
) -> None:
    directions = np.stack((np.cos(bearings), np.sin(bearings)), axis=-1)
    edge_m, window = settings[5], int(settings[7])
    for n in numba.prange(len(ranges)):
        smooth = _smooth(ranges[n], limits, window)
        counts[n] = _find_people(smooth, bearings, settings, patterns[n], spans[n])
        for i in range(counts[n]):
            _locate(smooth, directions, spans[n, i], positions[n, i])
            for first, last in spans[n, i]:
                for k in range(first, last + 1):
                    on_leg[n, k] = abs(ranges[n, k] - smooth[k]) <= edge_m  # a peak is behind


@numba.njit(cache=True)
def _locate(
    smooth: Float, directions: Float, span: NDArray[np.int32], position: NDArray[np.float32]
) -> None:
    """Write the mean of the ends of both legs."""
    for axis in range(2):
        total = 0.0
        for leg in range(2):
            for k in span[leg]:
                total += smooth[k] * directions[k, axis]
        position[axis] = total / 4


@numba.njit(cache=True)
def _smooth(ranges: NDArray[np.float32], limits: tuple[float, float], window: int) -> Float:
    """Level narrow peaks: the least of each window, then the largest of that.

    The second step puts edges back where they were, which the first moves by half a window.
    """
    beams, half = len(ranges), window // 2
    usable, least, smooth = np.empty(beams), np.empty(beams), np.empty(beams)
    for k in range(beams):
        r = np.float64(ranges[k])
        usable[k] = r if r > 0 and limits[0] <= r < limits[1] else limits[1]
    for k in range(beams):
        least[k] = usable[k]
        for i in range(max(k - half, 0), min(k + half + 1, beams)):
            least[k] = min(least[k], usable[i])
    for k in range(beams):
        smooth[k] = least[k]
        for i in range(max(k - half, 0), min(k + half + 1, beams)):
            smooth[k] = max(smooth[k], least[i])
    return smooth


@numba.njit(cache=True)
def _find_people(
    smooth: Float,
    bearings: Float,
    settings: tuple[float, ...],
    patterns: NDArray[np.uint8],
    spans: NDArray[np.int32],
) -> int:
    """Write patterns and spans of one scan's people, and return how many they are.

    Piece i is what lies between edges i and i + 1.
    """
    a_min, a_max, b_max, c_min, c_max, edge_m, same_edge_m, _, far = settings
    edges = _find_edges(smooth, bearings, edge_m, same_edge_m)
    widths = _measure_pieces(smooth, bearings, edges, far)
    falls = edges[:, 2] == _FALL
    front = falls[:-1] & ~falls[1:]  # nearer than what lies on either side
    leg_sized = (a_min <= widths) & (widths <= a_max)
    person_sized = (c_min <= widths) & (widths <= c_max)
    free = np.ones(len(edges), np.bool_)
    count = 0
    for m in range(len(widths)):
        if front[m] and leg_sized[m] and free[m]:
            n = m + 2
            while n < len(widths) and _aside(smooth, bearings, edges, m, n) <= b_max:
                gap = _gap(smooth, bearings, edges[m + 1, 0], edges[n, 1])
                if front[n] and leg_sized[n] and free[n] and gap <= b_max:
                    count = _take(m, n, _APART, edges, free, patterns, spans, count)
                    break
                n += 1
    for m in range(len(widths) - 1):
        if leg_sized[m] and leg_sized[m + 1] and falls[m] and not falls[m + 2]:
            step = _gap(smooth, bearings, edges[m + 1, 0], edges[m + 1, 1])
            if free[m : m + 3].all() and step <= b_max:
                count = _take(m, m + 1, _STRADDLE, edges, free, patterns, spans, count)
    for m in range(len(widths)):
        if front[m] and person_sized[m] and free[m]:
            count = _take(m, m, _SINGLE, edges, free, patterns, spans, count)
    return count


@numba.njit(cache=True)
def _take(
    m: int,
    n: int,
    pattern: int,
    edges: Int,
    free: NDArray[np.bool_],
    patterns: NDArray[np.uint8],
    spans: NDArray[np.int32],
    count: int,
) -> int:
    """Write the person whose legs are pieces m and n, use the edges up, and return the count."""
    patterns[count] = pattern
    for leg, i in enumerate((m, n)):
        spans[count, leg, 0], spans[count, leg, 1] = edges[i, 1], edges[i + 1, 0]
        free[i : i + 2] = False
    return count + 1


@numba.njit(cache=True)
def _find_edges(smooth: Float, bearings: Float, edge_m: float, same_edge_m: float) -> Int:
    """Return edges (E, 3): the beam before it, the beam after it, and whether it falls or rises."""
    edges = np.empty((len(smooth), 3), np.int64)
    count = 0
    for k in range(len(smooth) - 1):
        jump = smooth[k + 1] - smooth[k]
        if abs(jump) <= edge_m:
            continue
        kind = _RISE if jump > 0 else _FALL
        again = count > 0 and edges[count - 1, 2] == kind
        if again and _gap(smooth, bearings, edges[count - 1, 1], k) < same_edge_m:
            edges[count - 1, 1] = k + 1
        else:
            edges[count, 0], edges[count, 1], edges[count, 2] = k, k + 1, kind
            count += 1
    return edges[:count]


@numba.njit(cache=True)
def _measure_pieces(smooth: Float, bearings: Float, edges: Int, max_distance_m: float) -> Float:
    """Return widths (E - 1,) in m: between the ends, and half a beam's step at each side.

    The steps matter: a leg that three beams hit is as wide as three steps, not two. Pieces that
    are too far away have 0.
    """
    widths = np.zeros(max(len(edges) - 1, 0))
    for i in range(len(widths)):
        first, last = edges[i, 1], edges[i + 1, 0]
        if smooth[first] <= max_distance_m:
            step = bearings[first] - bearings[first - 1]
            mean = (smooth[first] + smooth[last]) / 2
            widths[i] = _gap(smooth, bearings, first, last) + mean * step
    return widths


@numba.njit(cache=True)
def _aside(smooth: Float, bearings: Float, edges: Int, m: int, n: int) -> float:
    """Least distance of piece m from anything that begins at the bearing of piece n."""
    end, begin = edges[m + 1, 0], edges[n, 1]
    return float(smooth[end] * math.sin(min(bearings[begin] - bearings[end], math.pi / 2)))


@numba.njit(cache=True)
def _gap(smooth: Float, bearings: Float, i: int, j: int) -> float:
    """Return the distance between the ends of two beams, by the law of cosines."""
    half = math.sin((bearings[j] - bearings[i]) / 2)
    difference = smooth[i] - smooth[j]
    return math.sqrt(difference * difference + 4 * smooth[i] * smooth[j] * half * half)
