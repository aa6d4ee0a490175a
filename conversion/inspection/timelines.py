"""When messages came: rates, regularity and gaps, in memory that does not grow with them."""

from __future__ import annotations

from array import array
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

_BUFFER = 4096
_BINS = 1024
_FIRST_BIN_NS = 10_000_000
_GAPS_PER_DECADE = 200  # 1.2 % wide; their means are kept, so that a steady rate is exact
_SHORTEST_NS, _DECADES = 1_000, 14  # 1 us to 3 years
_NEAR = 0.2  # of the typical gap
_NEAR_NS = 1_000_000


class Gap(NamedTuple):
    """A time without messages."""

    start_ns: int
    stop_ns: int

    @property
    def seconds(self) -> float:
        """How long it is, s."""
        return (self.stop_ns - self.start_ns) / 1e9


class Timeline:
    """Collect stamps that never go backward; keep counts over time and how long gaps are.

    Of any number of stamps it keeps `_BINS` counts, whose bins double as time goes on, and a
    histogram of the gaps.
    """

    def __init__(self) -> None:
        self._first_ns: int | None = None
        self._last_ns = 0
        self._longest: Gap | None = None
        self._count = 0
        self._buffer = array("q")
        self._counts = np.zeros(_BINS, np.int64)
        self._bin_ns = _FIRST_BIN_NS
        self._gaps = np.zeros(_GAPS_PER_DECADE * _DECADES, np.int64)
        self._gap_sums_ns = np.zeros(_GAPS_PER_DECADE * _DECADES)

    def __len__(self) -> int:
        return self._count + len(self._buffer)

    def add(self, stamp_ns: int) -> None:
        """Add a stamp."""
        self._buffer.append(stamp_ns)
        if len(self._buffer) == _BUFFER:
            self._flush()

    def extend(self, stamps_ns: ArrayLike) -> None:
        """Add stamps (N,) i8."""
        self._flush()
        self._add_all(np.asarray(stamps_ns, np.int64))

    @property
    def first_ns(self) -> int | None:
        """The first stamp."""
        self._flush()
        return self._first_ns

    @property
    def last_ns(self) -> int | None:
        """The last stamp."""
        self._flush()
        return None if self._first_ns is None else self._last_ns

    @property
    def longest(self) -> Gap | None:
        """The longest gap; None of fewer than two stamps."""
        self._flush()
        return self._longest

    @property
    def duration_s(self) -> float:
        """From the first stamp to the last, s."""
        self._flush()
        return 0.0 if self._first_ns is None else (self._last_ns - self._first_ns) / 1e9

    @property
    def rate_hz(self) -> float | None:
        """Mean rate over the whole time; None where there are fewer than two stamps apart."""
        duration = self.duration_s
        return (self._count - 1) / duration if duration > 0 else None

    @property
    def period_s(self) -> float | None:
        """Typical gap: the median, s."""
        self._flush()
        if self._count < 2:
            return None
        at = int(np.searchsorted(np.cumsum(self._gaps), (self._count - 1) / 2))
        return float(self._gap_sums_ns[at] / self._gaps[at]) / 1e9

    @property
    def regularity(self) -> float | None:
        """Share of gaps within a fifth of the typical one."""
        period = self.period_s
        if period is None:
            return None
        means = np.divide(
            self._gap_sums_ns,
            self._gaps,
            out=np.full(len(self._gaps), np.inf),
            where=self._gaps > 0,
        )
        near = np.abs(means - period * 1e9) <= max(_NEAR * period * 1e9, _NEAR_NS)
        return float(self._gaps[near].sum() / self._gaps.sum())

    def rates(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return times (K + 1,) f8, s since the epoch, and the rates (K,) f8, Hz, between them."""
        self._flush()
        if self._first_ns is None:
            return np.zeros(1), np.zeros(0)
        used, width_s = (self._last_ns - self._first_ns) // self._bin_ns + 1, self._bin_ns / 1e9
        edges = self._first_ns / 1e9 + np.arange(used + 1, dtype=np.float64) * width_s
        return edges, self._counts[:used] / width_s

    def _flush(self) -> None:
        if self._buffer:
            stamps = np.array(self._buffer, np.int64)
            self._buffer = array("q")
            self._add_all(stamps)

    def _add_all(self, stamps: NDArray[np.int64]) -> None:
        if not stamps.size:
            return
        if self._first_ns is None:
            self._first_ns = int(stamps[0])
        else:
            stamps = np.concatenate(([self._last_ns], stamps))
        self._add_gaps(stamps)
        fresh = stamps if not self._count else stamps[1:]
        self._add_counts(fresh, self._first_ns)
        self._count += fresh.size
        self._last_ns = int(stamps[-1])

    def _add_gaps(self, stamps: NDArray[np.int64]) -> None:
        gaps = np.diff(stamps)
        if not gaps.size:
            return
        at = np.log10(np.maximum(gaps, _SHORTEST_NS) / _SHORTEST_NS) * _GAPS_PER_DECADE
        bins = np.minimum(at.astype(np.int64), len(self._gaps) - 1)
        self._gaps += np.bincount(bins, minlength=len(self._gaps))
        self._gap_sums_ns += np.bincount(bins, gaps, minlength=len(self._gaps))
        k = int(gaps.argmax())
        if self._longest is None or gaps[k] > self._longest.stop_ns - self._longest.start_ns:
            self._longest = Gap(int(stamps[k]), int(stamps[k + 1]))

    def _add_counts(self, stamps: NDArray[np.int64], first_ns: int) -> None:
        while (int(stamps[-1]) - first_ns) // self._bin_ns >= _BINS:
            pairs = self._counts.reshape(-1, 2).sum(axis=1)
            self._counts = np.concatenate((pairs, np.zeros_like(pairs)))
            self._bin_ns *= 2
        self._counts += np.bincount((stamps - first_ns) // self._bin_ns, minlength=_BINS)
