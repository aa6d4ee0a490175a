"""What the beams of scans hold: kinds of ranges, values that stand for no return, intensities."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

KINDS = (
    "returns",
    "no return (+inf)",
    "too close (-inf)",
    "invalid (NaN)",
    "zero",
    "below range_min",
    "range_max and more",
)
"""Kinds of ranges, each beam one of them."""

_RETURN, _NONE, _CLOSE, _INVALID, _ZERO, _BELOW, _ABOVE = range(len(KINDS))

CELL_M = 0.01
"""Width of a cell of the histogram of ranges, m."""
_CELLS = 10_001  # to 100 m; the last holds all that is farther
_MOST_COUNTS = 8  # of beams, of which each is counted beam by beam

_RECURS = 0.01  # of all beams: a value that often is one that the driver chose
_ALONE = 0.2  # of its count: what may lie within `_NEAR_CELLS` of it
_NEAR_CELLS = 10
_BEYOND = 0.01  # of the nearer ranges: what may lie beyond a value that stands for no return
_BELT = 0.2  # of the value: how far it stands off from what is measured

_FINITE, _NULL, _DENORMAL, _NEGATIVE, _BAD = range(5)
_SMALLEST_NORMAL = float(np.finfo(np.float32).tiny)


class Recurring(NamedTuple):
    """A range that is written far more often than its neighbours.

    Parameters
    ----------
    value_m
        The range.
    share
        Of all beams.
    counts_as_return
        Whether it lies within the limits, so that it would be taken for a return.
    no_return
        Whether it looks like what the driver writes where there is no return.
    """

    value_m: float
    share: float
    counts_as_return: bool
    no_return: bool


@dataclass(frozen=True)
class Intensities:
    """What the intensities of scans are.

    Parameters
    ----------
    kind
        ``none``, ``all zero``, ``constant``, ``denormal`` or ``measured``.
    low, high
        Span of the finite ones; None where there are none.
    zero, denormal, negative, invalid
        Shares of all intensities; denormal are floats too small for any sensor.
    """

    kind: str = "none"
    low: float | None = None
    high: float | None = None
    zero: float = 0.0
    denormal: float = 0.0
    negative: float = 0.0
    invalid: float = 0.0


class ScanStatistics:
    """Count what scans hold, a block at a time, whatever their number.

    Parameters
    ----------
    range_min, range_max
        Limits of a return, m: ``range_min <= r < range_max``.
    """

    def __init__(self, range_min: float, range_max: float) -> None:
        self.limits = (np.float32(range_min), np.float32(range_max))
        self.scans = 0
        self._kinds = np.zeros(len(KINDS), np.int64)
        self._by_beam: dict[int, NDArray[np.int64]] = {}
        self._cells = np.zeros(_CELLS, np.int64)
        self._returns = np.zeros(_CELLS, np.int64)
        self._values = np.zeros(_CELLS, np.float32)
        self._votes = np.zeros(_CELLS, np.int64)
        self._intensities = np.zeros(5, np.int64)
        self._intensity_span = np.array((np.inf, -np.inf))

    def add(
        self, ranges: NDArray[np.float32], intensities: NDArray[np.float32] | None = None
    ) -> None:
        """Count ranges (N, B) f4, m, and the intensities (N, B) f4 of the same beams."""
        beams = ranges.shape[1]
        kinds = np.zeros((beams, len(KINDS)), np.int64)
        low, high = self.limits
        cells, returns, values = self._cells, self._returns, self._values
        _count_ranges(ranges, low, high, kinds, cells, returns, values, self._votes)
        self.scans += len(ranges)
        self._kinds += kinds.sum(axis=0)
        if beams in self._by_beam or len(self._by_beam) < _MOST_COUNTS:
            self._by_beam[beams] = self._by_beam.get(beams, 0) + kinds
        if intensities is not None:
            _count_intensities(intensities, self._intensities, self._intensity_span)

    @property
    def shares(self) -> dict[str, float]:
        """Share of the beams by kind."""
        total = max(int(self._kinds.sum()), 1)
        return {name: int(count) / total for name, count in zip(KINDS, self._kinds, strict=True)}

    @property
    def shares_by_beam(self) -> NDArray[np.float64]:
        """Shares of the kinds in each beam, (B, K) f8, of the scans of the usual beam count."""
        if not self._by_beam:
            return np.zeros((0, len(KINDS)))
        usual = max(self._by_beam.values(), key=lambda counts: int(counts.sum()))
        shares: NDArray[np.float64] = usual / usual.sum(axis=1, keepdims=True)
        return shares

    @property
    def dead_beams(self) -> int:
        """How many beams never hold a return, though others do."""
        returns = self.shares_by_beam[:, _RETURN]
        return int((returns == 0).sum()) if returns.any() else 0

    @property
    def histogram(self) -> NDArray[np.int64]:
        """Counts (H,) i8 of the returns in cells of `CELL_M`; the last is open."""
        return self._returns

    def quantiles(self, *shares: float) -> tuple[float, ...] | None:
        """Return ranges below which these shares of the returns lie, m, to a centimetre."""
        below = np.cumsum(self._returns)
        if not below[-1]:
            return None
        cells = np.searchsorted(below, np.array(shares) * below[-1])
        return tuple(float(cell * CELL_M) for cell in np.minimum(cells, _CELLS - 1))

    @property
    def recurring(self) -> tuple[Recurring, ...]:
        """Values that more than one beam in a hundred holds, and few hold one near; by value."""
        votes = np.where(self._votes > _RECURS * self._kinds.sum(), self._votes, 0)
        found = []
        for cell in np.flatnonzero(votes).tolist():
            near = slice(max(cell - _NEAR_CELLS, 0), cell + _NEAR_CELLS + 1)
            others = self._cells[near].sum() - votes[near].sum()
            if others <= _ALONE * votes[cell]:
                found.append(cell)
        far = self._far(found)
        return tuple(self._describe(cell, is_far=cell in far) for cell in found)

    @property
    def intensities(self) -> Intensities:
        """What the intensities are."""
        counts = self._intensities
        total = int(counts[_FINITE] + counts[_BAD])
        if not total:
            return Intensities()
        shares = [int(count) / total for count in counts]
        found = np.isfinite(self._intensity_span).all()
        low, high = (float(v) for v in self._intensity_span) if found else (None, None)
        kind = _kind_of(low, high, int(counts[_DENORMAL]))
        return Intensities(
            kind, low, high, shares[_NULL], shares[_DENORMAL], shares[_NEGATIVE], shares[_BAD]
        )

    def _far(self, cells: list[int]) -> set[int]:
        """Return those cells beyond which, and in a belt before which, next to nothing lies.

        A robot that stands still in a simulation without noise has values that recur, too: but
        one after the other.
        """
        real, found = self._cells.copy(), set[int]()
        for group in _groups(cells):
            votes, first = self._votes[group].sum(), group[-1]
            real[group] -= self._votes[group]
            nearer = real[1:first].sum()
            measures = nearer > _RECURS * self._kinds.sum()
            alone = real[int(first * (1 - _BELT)) :].sum() <= _ALONE * votes
            if not (measures and alone and real[first:].sum() <= _BEYOND * nearer):
                break
            found.update(group)
        return found

    def _describe(self, cell: int, *, is_far: bool) -> Recurring:
        value, share = self._values[cell], int(self._votes[cell]) / int(self._kinds.sum())
        low, high = self.limits
        live = self._live_share(_ZERO) if value == 0 else share
        stands_for_none = (
            (is_far and value >= low and value > 0) or value == 0 or (low < high == value)
        )
        return Recurring(
            value_m=float(str(value)),  # the shortest number that is the same float
            share=share,
            counts_as_return=bool(value > 0 and low <= value < high),
            no_return=bool(stands_for_none and live > _RECURS),
        )

    def _live_share(self, kind: int) -> float:
        """Share of a kind in the beams that are not dead: these are masked, not empty-handed."""
        shares = self.shares_by_beam
        live = shares[:, _RETURN] > 0
        return float(shares[live, kind].sum() / max(len(shares), 1))


def _groups(cells: list[int]) -> list[list[int]]:
    """Divide cells into those near one another, the farthest first."""
    groups: list[list[int]] = []
    for cell in sorted(cells, reverse=True):
        if not groups or groups[-1][-1] - cell > _NEAR_CELLS:
            groups.append([])
        groups[-1].append(cell)
    return groups


def _kind_of(low: float | None, high: float | None, denormal: int) -> str:
    if low is None or high is None:
        return "invalid"
    if low == high:
        return "all zero" if low == 0 else "constant"
    if denormal and max(abs(low), abs(high)) < _SMALLEST_NORMAL:
        return "denormal"
    return "measured"


@numba.njit(cache=True, error_model="numpy")
def _count_ranges(
    ranges: NDArray[np.float32],
    low: np.float32,
    high: np.float32,
    kinds: NDArray[np.int64],
    cells: NDArray[np.int64],
    returns: NDArray[np.int64],
    values: NDArray[np.float32],
    votes: NDArray[np.int64],
) -> None:
    """Count kinds by beam; in each cell of the histogram vote for the value that fills it.

    The vote is Boyer and Moore's: a value that more than half of a cell's ranges are wins it, and
    its votes are at least by how much.
    """
    last = len(cells) - 1
    for n in range(ranges.shape[0]):
        for b in range(ranges.shape[1]):
            r = ranges[n, b]
            if not math.isfinite(r):
                kinds[b, _INVALID if math.isnan(r) else _NONE if r > 0 else _CLOSE] += 1
                continue
            k = int(min(max(r, 0.0) / CELL_M, last))
            cells[k] += 1
            if r == 0:
                kinds[b, _ZERO] += 1
            elif r < low or r < 0:
                kinds[b, _BELOW] += 1
            elif r < high:
                kinds[b, _RETURN] += 1
                returns[k] += 1
            else:
                kinds[b, _ABOVE] += 1
            if r == values[k]:
                votes[k] += 1
            elif votes[k] > 0:
                votes[k] -= 1
            else:
                values[k] = r
                votes[k] = 1


@numba.njit(cache=True, error_model="numpy")
def _count_intensities(
    intensities: NDArray[np.float32], counts: NDArray[np.int64], span: NDArray[np.float64]
) -> None:
    for n in range(intensities.shape[0]):
        for b in range(intensities.shape[1]):
            value = float(intensities[n, b])
            if not math.isfinite(value):
                counts[_BAD] += 1
                continue
            counts[_FINITE] += 1
            counts[_NULL] += value == 0
            counts[_DENORMAL] += value != 0 and abs(value) < _SMALLEST_NORMAL
            counts[_NEGATIVE] += value < 0
            span[0] = min(span[0], value)
            span[1] = max(span[1], value)
