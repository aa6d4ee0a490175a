"""A recording as rows, one for each scan: what every file of them offers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Selector = str | tuple[str, ...]
"""An array by its name, a column by its name or its number from 0, or several of them."""

Rows = dict[str, NDArray[Any]]
"""Some rows (n, B) of arrays, by name."""


@dataclass(frozen=True)
class Contents:
    """What there is besides ranges, intensities and labels.

    Parameters
    ----------
    rows, beams
        Number of scans, and of ranges in each.
    stamps_ns
        (N,) i8, or None.
    others
        (N, W) f8 by name.
    """

    rows: int
    beams: int
    stamps_ns: NDArray[np.int64] | None
    others: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)


class RowFile(Protocol):
    """Rows in a file or folder; every failure is a `RecordingError` that names it."""

    def files(self, selectors: Sequence[Selector]) -> list[Path]:
        """Return the files that these are read from."""
        ...

    def contents(
        self,
        ranges: Selector,
        stamps: Selector | None,
        units_per_s: int,
        others: Mapping[str, Selector],
    ) -> Contents:
        """Count the scans, and read what has a few numbers a scan.

        Parameters
        ----------
        ranges, stamps, others
            Where they are.
        units_per_s
            What the stamps count.
        """
        ...

    def blocks(self, wanted: Mapping[str, Selector], size: int) -> Iterator[Rows]:
        """Yield rows (n, B) of all that is wanted, up to `size` at a time, as they are stored.

        The first of `wanted` are the ranges; the others have their shape.
        """
        ...
