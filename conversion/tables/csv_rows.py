"""Rows in the columns of a .csv file, read line by line."""

from __future__ import annotations

import csv
from array import array
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import TextIO

import numpy as np
from tqdm import tqdm

from conversion.messages.pose_files import nanoseconds
from conversion.tables.rows import Contents, Rows, Selector
from semantic2d_dataset.errors import RecordingError

_MAX_LINE_CHARS = 1 << 22
_DELIMITERS = (",", ";", "\t")


class CsvRows:
    """Columns of a .csv, by their names in its first line or by their numbers from 0.

    Commas, semicolons, tabs or spaces separate them, whichever its first line has.

    Parameters
    ----------
    path
        The file.

    Raises
    ------
    RecordingError
        If it is empty.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        with self._open() as stream:
            first = stream.readline(_MAX_LINE_CHARS).strip().lstrip("#")
        found = max(_DELIMITERS, key=first.count)
        self._delimiter = found if found in first else None
        words = next(self._split([first]), [])
        if not words:
            raise RecordingError(path, "its first line is empty: expected columns")
        self._width = len(words)
        self._header = [word.strip() for word in words] if _is_header(words) else []

    def files(self, selectors: Sequence[Selector]) -> list[Path]:  # noqa: ARG002 - all in one
        """Return the file."""
        return [self._path]

    def contents(
        self,
        ranges: Selector,
        stamps: Selector | None,
        units_per_s: int,
        others: Mapping[str, Selector],
    ) -> Contents:
        """Read the file once for all that has a few numbers a scan."""
        beams = len(self._columns(ranges))
        columns = {name: self._columns(selector) for name, selector in others.items()}
        stamp = None if stamps is None else self._columns(stamps)[0]
        stamps_ns, values, rows = array("q"), {name: array("d") for name in others}, 0
        for number, words in self._rows("survey"):
            rows += 1
            if stamp is not None:
                stamps_ns.append(self._stamp(number, words[stamp], units_per_s))
            for name, which in columns.items():
                values[name].extend(self._floats(number, words, which))
        known = None if stamp is None else np.array(stamps_ns, np.int64)
        read = {name: np.array(v).reshape(rows, len(columns[name])) for name, v in values.items()}
        return Contents(rows, beams, known, read)

    def blocks(self, wanted: Mapping[str, Selector], size: int) -> Iterator[Rows]:
        """Read the file again, a block of lines at a time; an empty cell is NaN."""
        columns = {name: self._columns(selector) for name, selector in wanted.items()}
        beams = len(next(iter(columns.values())))
        for name, which in columns.items():
            if len(which) != beams:
                raise RecordingError(
                    self._path, f"{name}: expected {beams} columns, found {len(which)}"
                )
        lines = self._rows("convert")
        while block := list(islice(lines, size)):
            yield {
                name: np.array([self._floats(number, words, which) for number, words in block])
                for name, which in columns.items()
            }

    def _columns(self, selector: Selector) -> list[int]:
        """Return the numbers of columns; ``a..b`` is all from a to b."""
        found: list[int] = []
        for each in (selector,) if isinstance(selector, str) else selector:
            first, dots, last = each.partition("..")
            start = self._column(first.strip())
            stop = self._column(last.strip()) if dots else start
            if stop < start:
                raise RecordingError(self._path, f"{each}: {last} comes before {first}")
            found += range(start, stop + 1)
        return found

    def _column(self, name: str) -> int:
        if name in self._header:
            return self._header.index(name)
        if name.isdecimal() and int(name) < self._width:
            return int(name)
        shown = f"{', '.join(self._header[:12])}{', ...' if len(self._header) > 12 else ''}"
        raise RecordingError(
            self._path,
            f"no column {name!r} among {self._width}; its first line names "
            f"{shown or 'none: give numbers from 0'}",
        )

    def _open(self) -> TextIO:
        return self._path.open(encoding="utf-8-sig", errors="replace", newline="")

    def _rows(self, what: str) -> Iterator[tuple[int, list[str]]]:
        """Yield the words of each line that has any with its number, beside a bar of bytes."""
        size = self._path.stat().st_size
        with (
            self._open() as stream,
            tqdm(
                total=size, desc=what, unit="B", unit_scale=True, disable=None, leave=False
            ) as bar,
        ):
            for number, words in enumerate(self._split(self._lines(stream, bar)), 1):
                if not words or (number == 1 and self._header):
                    continue
                if len(words) != self._width:
                    raise RecordingError(
                        self._path,
                        f"line {number}: expected {self._width} columns, found {len(words)}",
                    )
                yield number, words

    def _lines(self, stream: TextIO, bar: tqdm) -> Iterator[str]:  # type: ignore[type-arg]
        while line := stream.readline(_MAX_LINE_CHARS):
            if len(line) == _MAX_LINE_CHARS:
                raise RecordingError(self._path, f"a line is longer than {_MAX_LINE_CHARS}")
            bar.update(len(line))
            yield line

    def _split(self, lines: Iterator[str] | list[str]) -> Iterator[list[str]]:
        if self._delimiter is None:
            yield from (line.split() for line in lines)
            return
        try:
            yield from csv.reader(lines, delimiter=self._delimiter)
        except csv.Error as err:
            raise RecordingError(self._path, f"no CSV file: {err}") from err

    def _floats(self, number: int, words: list[str], which: Sequence[int]) -> list[float]:
        try:
            return [float(words[i].strip() or "nan") for i in which]
        except ValueError as err:
            raise RecordingError(self._path, f"line {number}: {err}") from err

    def _stamp(self, number: int, word: str, units_per_s: int) -> int:
        try:
            return nanoseconds(word, units_per_s)
        except ValueError as err:
            raise RecordingError(self._path, f"line {number}: {err}") from err


def _is_header(words: list[str]) -> bool:
    """Tell names from numbers; pandas writes 0, 1, 2, ... over columns without names."""
    told = [word.strip() for word in words if word.strip()]
    if told == [str(number) for number in range(len(told))] and len(told) > 1:
        return True
    try:
        return not [float(word) for word in told]
    except ValueError:
        return True
