"""Copy arrays of a sequence as they are, in bounded memory."""

from __future__ import annotations

import math
from collections.abc import Iterable

from semantic2d_dataset.format.schema import CHUNK_ROWS
from semantic2d_dataset.format.sequence import SequenceReader, SequenceWriter

_BLOCK_BYTES = 1 << 22


def copy_arrays(reader: SequenceReader, writer: SequenceWriter, names: Iterable[str]) -> None:
    """Copy whole arrays, block by block; one without rows is copied too."""
    for name in names:
        rows = reader.shape(name)[0]
        block = _rows_of_block(reader.shape(name))
        for start in range(0, max(rows, 1), block):
            writer.append({name: reader.read(name, start, min(start + block, rows))})


def _rows_of_block(shape: tuple[int, ...]) -> int:
    """Whole chunks of scans, and many rows of what has one number or byte in each."""
    fitting = _BLOCK_BYTES // (8 * max(math.prod(shape[1:]), 1))
    return max(fitting // CHUNK_ROWS, 1) * CHUNK_ROWS
