"""Chunks as HDF5's filters shuffle, deflate and Fletcher32 store them, made by all cores.

HDF5 runs its filters on one thread. These give the same bytes, and leave the interpreter's lock
while they work.
"""

from __future__ import annotations

import os
import zlib
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

DEFLATE_LEVEL = 4

_CHECKSUM_BYTES = 4
_BYTES_AHEAD = 1 << 25
_CHUNKS_AHEAD = 8  # for each core: small ones cost more to keep than their bytes
_ROW = 256  # words; their sum fits 32 bits
_Name = TypeVar("_Name")


def pack(chunk: NDArray[Any]) -> bytes:
    """Return what HDF5 stores of a whole chunk: shuffled, deflated, and its checksum."""
    values = np.ascontiguousarray(chunk).reshape(-1).view(np.uint8)
    shuffled = np.ascontiguousarray(values.reshape(-1, chunk.dtype.itemsize).T)
    deflated = zlib.compress(shuffled.data, DEFLATE_LEVEL)
    return deflated + fletcher32(deflated).to_bytes(_CHECKSUM_BYTES, "little")


def is_intact(stored: bytes) -> bool:
    """Tell whether a stored chunk's checksum fits its bytes."""
    found = int.from_bytes(stored[-_CHECKSUM_BYTES:], "little")
    return fletcher32(stored[:-_CHECKSUM_BYTES]) == found


def fletcher32(data: bytes) -> int:
    """Return the checksum of `H5_checksum_fletcher32` in HDF5's ``H5checksum.c``.

    The sums, modulo 65535, of the big-endian 16-bit words and of the words by how many are left.
    Read little-endian, every word is 256 times as large modulo 65535.
    """
    count = -(-len(data) // 2)
    words = np.frombuffer(data + bytes(-len(data) % (2 * _ROW)), "<u2").reshape(-1, _ROW)
    rows = words.sum(axis=1, dtype=np.uint32).astype(np.int64)
    columns = words.sum(axis=0, dtype=np.int64)
    if not rows.any():
        return 0
    left = (count - _ROW * np.arange(len(rows))) % 65535  # reduced, or 64 MiB would overflow
    first, second = rows.sum(), (left * rows).sum() - (np.arange(_ROW) * columns).sum()
    return _residue(256 * int(second)) << 16 | _residue(256 * int(first))


def _residue(total: int) -> int:
    """Reduce a sum that is not 0 to 1..65535: HDF5 adds carries, so it never reaches 0."""
    return (total - 1) % 65535 + 1


def pack_in_order(
    chunks: Iterable[tuple[_Name, NDArray[Any]]],
) -> Iterator[tuple[_Name, bytes]]:
    """Pack named chunks on all cores given; yield them in their order.

    Chunks are taken ahead as long as they are few and small, so that memory is bounded. An error
    in a thread is raised where its chunk would have been.
    """
    waiting: deque[tuple[_Name, int, Future[bytes]]] = deque()
    ahead, cores = 0, count_cores()
    with ThreadPoolExecutor(cores) as pool:
        for name, chunk in chunks:
            waiting.append((name, chunk.nbytes, pool.submit(pack, chunk)))
            ahead += chunk.nbytes
            while ahead > _BYTES_AHEAD or len(waiting) > _CHUNKS_AHEAD * cores:
                first, size, packed = waiting.popleft()
                ahead -= size
                yield first, packed.result()
        for first, _, packed in waiting:
            yield first, packed.result()


def count_cores() -> int:
    """Return how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
