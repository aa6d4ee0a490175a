"""Fields of the published layout: where the values of their files lie in a sequence.

A field is a folder with one .npy file a scan. The array of a sequence holds what such files say;
what it cannot hold (dtypes, labels that are no classes, negative zeros) is kept beside it in
``/original``, so that every file can be written again byte for byte:

- ``<field>.form`` (N,) u1: which header each file has; `MISSING` where there is none, `WHOLE`
  where all its bytes are kept; absent where all files are of form 0;
- ``<field>.at`` i8, ``<field>.bits`` u8 (K,): flat positions in the array where the file holds
  other bits than the array gives, and these bits;
- ``<field>`` (N, ...): the values of a field that has no place in the format.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conversion.layouts import npy
from conversion.layouts.rows import only_finite, to_ranges
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, UNLABELLED

SCANS, INTENSITIES, LABELS = "scans_lidar", "intensities_lidar", "semantic_label"
POSITIONS, VELOCITIES, LINES = "positions", "velocities", "line_segments"

MISSING, WHOLE = 255, 254
MAX_FORMS = 200

_CLASSES = len(SEMANTIC2D)
_LONGEST_HEADER = 1 << 14
_MAX_ROW_BYTES = 1 << 24
_SHAPE = re.compile(rb"'shape': \((?=[0-9])")
_DIGITS = re.compile(rb"[0-9]+")

Values = NDArray[Any]


@dataclass(frozen=True)
class Form:
    """The header of a file; of ragged fields it names the number of items.

    Parameters
    ----------
    head, tail
        What stands before and after the number; `tail` is None where there is none.
    length
        Bytes of the header: spaces fill it up.
    """

    head: bytes
    tail: bytes | None
    length: int

    @classmethod
    def of(cls, header: bytes, *, ragged: bool) -> Form:
        """Return the form of a header."""
        place = _SHAPE.search(header) if ragged else None
        if place is None:
            return cls(header, None, len(header))
        number = _DIGITS.match(header, place.end())
        tail = header[number.end() :].rstrip() if number else b""
        form = cls(header[: place.end()], tail, len(header))
        items = int(number[0]) if number else 0
        return form if form.header(items) == header else cls(header, None, len(header))

    def header(self, items: int) -> bytes:
        """Return the header of a file of so many items."""
        if self.tail is None:
            return self.head
        return (self.head + b"%d" % items + self.tail).ljust(self.length - 1) + b"\n"

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        tail = None if self.tail is None else self.tail.decode("latin-1")
        return {"head": self.head.decode("latin-1"), "tail": tail, "length": self.length}

    @classmethod
    def from_dict(cls, said: Mapping[str, Any]) -> Form:
        """Return the form that `as_dict` described."""
        tail = None if said["tail"] is None else str(said["tail"]).encode("latin-1")
        length = int(said["length"])
        if not 0 < length <= _LONGEST_HEADER:
            raise ValueError(f"a header of {length} bytes")
        return cls(str(said["head"]).encode("latin-1"), tail, length)


@dataclass(frozen=True)
class Place:
    """Where the values of a field lie in a sequence.

    Parameters
    ----------
    array
        The name of the array.
    dtype, fill
        Its dtype, and what it holds where there is no file.
    width
        Values in a row.
    into, back
        From values as in the files, (n, width), to rows of the array, and back.
    anew
        From rows to values of files that are not those the rows come from.
    ragged
        Whether a file holds any number of rows; ``lines/offsets`` divides them.
    """

    array: str
    dtype: str
    fill: float
    width: int
    into: Callable[[Values], Values]
    back: Callable[[Values], Values]
    anew: Callable[[Values], Values]
    ragged: bool = False


def places(
    beams: int, *, no_return: tuple[float, ...] = (), reversed_intensities: bool = False
) -> dict[str, Place]:
    """Return the fields that have a place in the format.

    Parameters
    ----------
    beams
        Of the lidar.
    no_return
        Ranges besides 0 that mean no return, m.
    reversed_intensities
        Whether the files hold intensities in the opposite order of the ranges.
    """
    turn = _reverse if reversed_intensities else _same
    single, double = partial(_convert, "<f4"), partial(_convert, "<f8")
    return {
        SCANS: Place(
            "scans/ranges",
            "<f4",
            fill=np.nan,
            width=beams,
            into=partial(_to_ranges, no_return),
            back=_from_ranges,
            anew=_finite,
        ),
        INTENSITIES: Place(
            "scans/intensities",
            "<f4",
            fill=np.nan,
            width=beams,
            into=lambda values: turn(single(values)),
            back=turn,
            anew=lambda rows: _finite(turn(rows)),
        ),
        LABELS: Place("scans/labels", "|u1", UNLABELLED, beams, _to_labels, _same, _same),
        POSITIONS: Place("poses/initial", "<f8", np.nan, 3, _to_poses, _same, _same),
        VELOCITIES: Place("commands/velocity", "<f8", np.nan, 2, double, _same, _same),
        LINES: Place("lines/segments", "<f4", np.nan, 4, single, _same, _same, ragged=True),
    }


def is_number(dtype: np.dtype[Any]) -> bool:
    """Tell whether values are real numbers of at most 64 bits."""
    return dtype.kind in "biuf" and dtype.itemsize in (1, 2, 4, 8)


def bits_of(values: Values) -> Values:
    """Return the bits of numbers as unsigned integers of their size and byte order."""
    order = ">" if values.dtype.str.startswith(">") else "<"
    return values.view(f"{order}u{values.dtype.itemsize}")


def cast(values: Values, dtype: np.dtype[Any]) -> Values:
    """Convert numbers, the same on every machine: NaN is the usual one, integers saturate."""
    with np.errstate(all="ignore"):
        if dtype.kind in "iu" and values.dtype.kind == "f":
            limits = np.iinfo(dtype)
            below = np.nextafter(float(limits.max) + 1.0, 0.0)
            values = np.clip(np.nan_to_num(values.astype(np.float64)), float(limits.min), below)
        converted = values.astype(dtype)
    if dtype.kind == "f":
        converted[np.isnan(converted)] = np.nan
    return converted


def storage_of(layout: npy.Layout) -> tuple[str, tuple[int, ...]] | None:
    """Return dtype and shape of a row that holds the bits of any such file; None if none does."""
    dtype = layout.dtype
    if not is_number(dtype) or not layout.size or layout.nbytes > _MAX_ROW_BYTES:
        return None
    stored = dtype.newbyteorder("<").str
    if dtype.kind == "b" or stored == "<f2":
        stored = "|u1" if dtype.kind == "b" else "<u2"
    return stored, layout.shape if len(layout.shape) <= 2 else (layout.size,)


def _same(values: Values) -> Values:
    return values


def _reverse(values: Values) -> Values:
    return values[:, ::-1]


def _convert(dtype: str, values: Values) -> Values:
    with np.errstate(all="ignore"):
        return values.astype(dtype)


def _to_ranges(no_return: tuple[float, ...], values: Values) -> Values:
    with np.errstate(all="ignore"):
        rows = to_ranges(values, 1.0, no_return)
    rows[values == 0] = np.inf
    return rows


def _from_ranges(rows: Values) -> Values:
    return np.where(rows == np.inf, np.float32(0), rows)


def _finite(rows: Values) -> Values:
    """Put 0, which means no return, for what is not finite."""
    return np.where(np.isfinite(rows), rows, np.float32(0))


def _to_poses(values: Values) -> Values:
    return only_finite(_convert("<f8", values))


def _to_labels(values: Values) -> Values:
    numbers = values.astype(np.float64)
    valid = (numbers >= 0) & (numbers < _CLASSES) & (numbers == np.floor(numbers))
    return np.where(valid, numbers, UNLABELLED).astype(np.uint8)
