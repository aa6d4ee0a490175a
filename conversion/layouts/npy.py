"""The bytes of .npy files: headers that are trusted only as far as they fit, and values."""

from __future__ import annotations

import io
import math
import tokenize
import warnings
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

_MAGIC = b"\x93NUMPY"
_LONGEST_HEADER = 10_000  # as numpy itself accepts
_ALIGNMENT = 64
_FAILURES = (
    ValueError,
    TypeError,
    SyntaxError,
    LookupError,
    AttributeError,
    OverflowError,
    RecursionError,
    MemoryError,
    tokenize.TokenError,
)


class NpyError(ValueError):
    """Bytes that are no .npy file, not all of one, or that only pickle could read."""


class Layout(NamedTuple):
    """What a header says of the values that follow it."""

    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    fortran: bool

    @property
    def size(self) -> int:
        """How many values there are."""
        return math.prod(self.shape)

    @property
    def nbytes(self) -> int:
        """How many bytes they take."""
        return self.size * self.dtype.itemsize


def split(content: bytes) -> tuple[bytes, Layout]:
    """Return the header of a file, magic and all, and what it says.

    Raises
    ------
    NpyError
        If it is none, its values are not all there, or they are pickled objects.
    """
    header = _header_of(content)
    layout = parse(header)
    found = len(content) - len(header)
    if layout.nbytes > found:
        raise NpyError(
            f"truncated: its header says {layout.shape} of {layout.dtype}, {layout.nbytes} bytes, "
            f"and {found} follow"
        )
    return header, layout


def read(content: bytes) -> NDArray[Any]:
    """Return the array of a file; it shares the memory of `content`, and is not to be written.

    Raises
    ------
    NpyError
        As from `split`.
    """
    header, layout = split(content)
    if not layout.size:
        return np.zeros(layout.shape, layout.dtype)
    if not layout.dtype.itemsize:
        raise NpyError(f"expected values of a size, found {layout.dtype}")
    flat = np.frombuffer(content, layout.dtype, layout.size, len(header))
    return flat.reshape(layout.shape, order="F" if layout.fortran else "C")


@lru_cache(maxsize=1 << 12)
def parse(header: bytes) -> Layout:
    """Read a header; the same few are met again and again.

    Raises
    ------
    NpyError
        If it is none, or announces pickled objects.
    """
    stream = io.BytesIO(header)
    try:
        version = np.lib.format.read_magic(stream)
        reads = (
            np.lib.format.read_array_header_1_0
            if version == (1, 0)
            else np.lib.format.read_array_header_2_0
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numpy warns of headers that Python 2 wrote
            shape, fortran, dtype = reads(stream)
    except _FAILURES as err:
        raise NpyError(f"its .npy header cannot be read: {err}") from err
    if any(length < 0 for length in shape):
        raise NpyError(f"its .npy header says {shape}: no shape has that")
    if dtype.hasobject:
        raise NpyError(
            "holds pickled Python objects, which are never read: save it anew as plain numbers"
        )
    return Layout(dtype, tuple(int(length) for length in shape), bool(fortran))


def make_header(dtype: np.dtype[Any], shape: tuple[int, ...]) -> bytes:
    """Return the header that `numpy.save` writes of a C-ordered array."""
    text = f"{{'descr': {dtype.str!r}, 'fortran_order': False, 'shape': {shape!r}, }}"
    size = len(_MAGIC) + 4 + len(text) + 1
    size += -size % _ALIGNMENT
    room = size - len(_MAGIC) - 4
    return _MAGIC + b"\x01\x00" + room.to_bytes(2, "little") + text.ljust(room - 1).encode() + b"\n"


def _header_of(content: bytes) -> bytes:
    if content[:6] != _MAGIC:
        what = "empty" if not content else f"begins with {content[:6]!r}"
        raise NpyError(f"expected an .npy file, found one that is {what}")
    width = 2 if content[6:7] == b"\x01" else 4
    start = 8 + width
    length = int.from_bytes(content[8:start], "little")
    if length > _LONGEST_HEADER or start + length > len(content):
        raise NpyError(f"truncated in its .npy header, which should take {length} bytes")
    return content[: start + length]
