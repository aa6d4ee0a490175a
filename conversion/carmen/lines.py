"""Lines of CARMEN logs: which there are, and what a laser's line holds."""

from __future__ import annotations

import gzip
import math
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.errors import RecordingError

GZIP_MAGIC = b"\x1f\x8b"

_MAX_LINE_BYTES = 1 << 20  # 100,000 beams of ten characters
_SHOWN = 60
_MAX_STAMP_S = 9.2e9  # what fits 64 bits of nanoseconds
_TAIL = 3  # stamp of the message, host, stamp of the logger
_NOTHING = slice(0, 0)

# Steps of the SICK lasers that FLASER lines come from. An even count leaves the last beam out.
_STEP_DEG = {180: 1.0, 181: 1.0, 360: 0.5, 361: 0.5, 400: 0.25, 401: 0.25}
_FIRST_DEG = {400: -50.0, 401: -50.0}  # a field of 100 degrees; of 180 degrees the others
_USUAL_MAX_M = 80.0  # of the same lasers; CARMEN's own reader takes it too


class Layout(NamedTuple):
    """What the lines of one kind hold, beside their ranges.

    Parameters
    ----------
    described
        Whether type, start angle, field of view, step, maximum range, accuracy and remission
        mode of the laser come first.
    remissions
        Whether remissions follow the ranges.
    posed
        Whether x y theta of the laser and of the robot follow then.
    extras
        How many other values do.
    """

    described: bool
    remissions: bool
    posed: bool
    extras: int


# The logger of CARMEN writes these; a tail of two stamps and a host ends each of them.
_OLD = Layout(described=False, remissions=False, posed=True, extras=0)
_BARE = Layout(described=False, remissions=False, posed=False, extras=0)
_RAW = Layout(described=True, remissions=True, posed=False, extras=0)
_ROBOT = Layout(described=True, remissions=True, posed=True, extras=5)
LAYOUTS: Mapping[bytes, Layout] = {
    b"FLASER": _OLD,
    b"RLASER": _OLD,
    b"LASER3": _BARE,
    b"LASER4": _BARE,
    b"RAWLASER1": _RAW,
    b"RAWLASER2": _RAW,
    b"RAWLASER3": _RAW,
    b"RAWLASER4": _RAW,
    b"ROBOTLASER1": _ROBOT,
    b"ROBOTLASER2": _ROBOT,
}


class Angles(NamedTuple):
    """Bearing of the first beam and step to the next, rad; whether they are only assumed."""

    first: float
    step: float
    assumed: bool = False


@dataclass(frozen=True, slots=True)
class LaserLine:
    """A laser's line, split.

    Parameters
    ----------
    kind
        Its first word.
    fields
        All words.
    ranges, remissions
        Where these are among the words.
    tail
        Where the first word after them is.
    """

    kind: str
    fields: list[bytes]
    ranges: slice
    remissions: slice
    tail: int

    @property
    def beams(self) -> int:
        """Number of ranges."""
        return int(self.ranges.stop - self.ranges.start)

    @property
    def stamp_ns(self) -> int:
        """When the message was sent."""
        return nanoseconds(self.fields[-3])

    def values(self, where: slice) -> NDArray[np.float32]:
        """Return words as numbers, (n,) f4."""
        return np.fromiter(map(float, self.fields[where]), np.float32, where.stop - where.start)

    def described(self, index: int) -> float:
        """Return a value of the description: 1 start angle, 2 field, 3 step, 4 maximum range."""
        return float(self.fields[1 + index])

    def poses(self) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        """Return x y theta of the laser and of the robot."""
        x, y, theta, *robot = (float(word) for word in self.fields[self.tail : self.tail + 6])
        return (x, y, theta), (robot[0], robot[1], robot[2])


def read_lines(path: Path) -> Iterator[tuple[int, bytes]]:
    """Yield the lines of a log, plain or gzip, with their numbers from 1.

    Raises
    ------
    RecordingError
        If the gzip data is cut or damaged, or a line has no end: with the line that was reached.
    """
    number = 0
    with path.open("rb") as raw:
        packed = raw.read(2) == GZIP_MAGIC
        raw.seek(0)
        stream: BinaryIO = gzip.GzipFile(fileobj=raw) if packed else raw  # type: ignore[assignment]
        try:
            while line := stream.readline(_MAX_LINE_BYTES):
                number += 1
                if len(line) == _MAX_LINE_BYTES:
                    raise RecordingError(
                        path, f"line {number} is longer than {_MAX_LINE_BYTES} bytes: no CARMEN log"
                    )
                yield number, line
        except EOFError as err:
            raise RecordingError(
                path,
                f"the gzip data is cut off within line {number + 1}; get the whole file again, or "
                f"unpack what is there (zcat {path.name} > part.log), remove its last line and "
                "convert that",
            ) from err
        except (gzip.BadGzipFile, zlib.error) as err:
            raise RecordingError(
                path, f"the gzip data is damaged after line {number}: {err}; get the file again"
            ) from err


def split_line(path: Path, number: int, line: bytes) -> LaserLine:
    """Split a line whose first word is one of `LAYOUTS`, and count what it holds.

    Raises
    ------
    RecordingError
        If it holds more or fewer words than it says, with its number.
    """
    fields = line.split()
    layout = LAYOUTS[fields[0]]
    try:
        ranges = _counted(fields, 8 if layout.described else 1)
        remissions = _counted(fields, ranges.stop) if layout.remissions else _NOTHING
    except ValueError as err:
        raise damaged(path, number, line, err) from err
    tail = remissions.stop if layout.remissions else ranges.stop
    expected = tail + (6 if layout.posed else 0) + layout.extras + _TAIL
    if len(fields) != expected:
        raise damaged(path, number, line, f"expected {expected} words, found {len(fields)}")
    return LaserLine(fields[0].decode(), fields, ranges, remissions, tail)


def damaged(path: Path, number: int, line: bytes, problem: object) -> RecordingError:
    """Say what is wrong with a line, and what to do."""
    if not line.endswith(b"\n"):
        return RecordingError(
            path,
            f"the log is cut off within line {number}: {problem}; get the whole file again, or "
            "remove that line and convert the rest",
        )
    shown = line[:_SHOWN].decode(errors="replace").rstrip()
    return RecordingError(
        path, f"line {number} ({shown} ...) is damaged: {problem}; mend it, or remove it"
    )


def first_word(line: bytes) -> bytes:
    """Return what kind of line it is; nothing of a blank line."""
    return b"" if line.isspace() else line.split(None, 1)[0]


def nanoseconds(text: bytes) -> int:
    """Read seconds, to the microsecond that CARMEN writes.

    Raises
    ------
    ValueError
        If it is no time.
    """
    seconds = float(text)
    if not abs(seconds) < _MAX_STAMP_S:
        raise ValueError(f"no time: {text.decode(errors='replace')}")
    return round(seconds * 1e6) * 1000


def angles_of(line: LaserLine, parameters: Mapping[str, float]) -> Angles:
    """Return the angles of a line: as it says, else as its number of beams suggests.

    The first of 180 or 360 beams is at -90 degrees and the last beam of the half circle is left
    out, as in CARMEN's own reader; two real logs confirm it (their map is sharpest at that).

    Parameters
    ----------
    line
        A laser's line.
    parameters
        The numbers among the log's PARAM lines, by name.
    """
    if LAYOUTS[line.kind.encode()].described:
        field, step = line.described(2), line.described(3)
        return Angles(line.described(1), step if step > 0 else field / max(line.beams - 1, 1))
    if line.beams in _STEP_DEG:
        first = _FIRST_DEG.get(line.beams, -90.0)
        return Angles(math.radians(first), math.radians(_STEP_DEG[line.beams]))
    side = "rear" if line.kind == "RLASER" else "front"
    step = math.radians(parameters.get(f"laser_{side}_laser_resolution", 0.0))
    assumed = not 0 < step * (line.beams - 1) <= 2 * math.pi
    if assumed:
        step = math.pi / max(line.beams - 1, 1)
    return Angles(-step * (line.beams - 1) / 2, step, assumed)


def range_max_of(line: LaserLine, parameters: Mapping[str, float]) -> float:
    """Return the longest range that is a measurement, m."""
    if LAYOUTS[line.kind.encode()].described:
        said = line.described(4)
    else:
        side = "rear" if line.kind == "RLASER" else "front"
        said = parameters.get(f"robot_{side}_laser_max", 0.0)
    return said if 0 < said < math.inf else _USUAL_MAX_M


def read_parameter(line: bytes) -> tuple[str, float] | None:
    """Read a PARAM line whose value is a number."""
    words = line.split(None, 3)
    try:
        return words[1].decode(), float(words[2])
    except (IndexError, ValueError):
        return None


def _counted(fields: list[bytes], at: int) -> slice:
    """Where the words are that the count at `at` announces."""
    count = fields[at] if at < len(fields) else b"the end"
    if not count.isdigit():
        raise ValueError(f"expected a count of values, found {count.decode(errors='replace')!r}")
    return slice(at + 1, at + 1 + int(count))
