"""What was read of chunks lately, kept for those who read the same files."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any

from numpy.typing import NDArray

_KEPT = 64

Chunk = dict[str, NDArray[Any]]


class ChunkCache:
    """Keeps arrays of the chunks that were used last; pickles empty, and stays shared."""

    def __init__(self) -> None:
        self._chunks: OrderedDict[tuple[int, int], Chunk] = OrderedDict()

    def __reduce__(self) -> tuple[type[ChunkCache], tuple[()]]:
        return ChunkCache, ()

    def take(self, file: int, chunk: int) -> Chunk:
        """Return what is kept of a chunk by name; what is added to it is kept too."""
        key = (file, chunk)
        found = self._chunks.setdefault(key, {})
        self._chunks.move_to_end(key)
        if len(self._chunks) > _KEPT:
            self._chunks.popitem(last=False)
        return found
