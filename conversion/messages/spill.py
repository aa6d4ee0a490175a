"""Bytes that are kept aside: in memory while they are few, then in a file without a name."""

from __future__ import annotations

import weakref
from tempfile import SpooledTemporaryFile

from conversion.temporary import temporary_folder

_IN_MEMORY = 1 << 22  # bytes


class Spill:
    """A growing store of bytes; it vanishes with this object."""

    def __init__(self) -> None:
        self._file = SpooledTemporaryFile(max_size=_IN_MEMORY, dir=temporary_folder())  # noqa: SIM115
        weakref.finalize(self, self._file.close)
        self._size = 0

    def append(self, data: bytes) -> int:
        """Keep some bytes, and return where they lie."""
        at = self._size
        self._file.seek(at)
        self._file.write(data)
        self._size += len(data)
        return at

    def read(self, at: int, size: int) -> bytes:
        """Return bytes that were kept."""
        self._file.seek(at)
        return self._file.read(size)
