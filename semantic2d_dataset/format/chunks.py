"""Chunks as HDF5's filters shuffle, deflate and Fletcher32 store them, made by all cores.

HDF5 runs its filters on one thread, and deflates all bytes alike. After the shuffle a chunk is
planes: the first bytes of all values, then the second ones, and so on. In most planes of ranges
and intensities there are no repeats but runs, and to look for those alone takes half the time.
Every inflater reads the result.
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
_ZLIB_HEADER = b"\x78\x5e"  # RFC 1950: deflate, window of 32 KiB, a fast level
_SMALL_PLANE = 1 << 13  # bytes; not worth a choice
_SAMPLE = 16  # one part in, from each end: four scans of 64 show whether scans repeat
_TOLERANCE = 1.02  # the fast way may cost this much of the size
_BYTES_AHEAD = 1 << 25
_CHUNKS_AHEAD = 8  # for each core: small ones cost more to keep than their bytes
_ROW = 256  # words; their sum fits 32 bits
_Name = TypeVar("_Name")

Chunk = NDArray[Any] | bytes
"""Values, or what HDF5 stores of them."""


def pack(chunk: Chunk) -> bytes:
    """Return what HDF5 stores of a whole chunk: shuffled, deflated, and its checksum.

    What is packed already stays as it is.
    """
    if isinstance(chunk, bytes):
        return chunk
    values = np.ascontiguousarray(chunk).reshape(-1).view(np.uint8)
    shuffled = np.ascontiguousarray(values.reshape(-1, chunk.dtype.itemsize).T)
    deflated = deflate(shuffled)
    return deflated + fletcher32(deflated).to_bytes(_CHECKSUM_BYTES, "little")


def deflate(planes: NDArray[np.uint8]) -> bytes:
    """Compress planes (P, n) as one zlib stream, each in the way that suits it."""
    if planes.shape[1] < _SMALL_PLANE:
        return zlib.compress(planes.data, DEFLATE_LEVEL)
    flushes = [zlib.Z_SYNC_FLUSH] * (len(planes) - 1) + [zlib.Z_FINISH]
    blocks = [
        _deflate_plane(plane, _choose_strategy(plane), flush=flush)
        for plane, flush in zip(planes, flushes, strict=True)
    ]
    return b"".join((_ZLIB_HEADER, *blocks, zlib.adler32(planes.data).to_bytes(4, "big")))


def _choose_strategy(plane: NDArray[np.uint8]) -> int:
    """Return ``Z_RLE``, which is fast, unless repeats make a sample of the plane smaller."""
    part = len(plane) // _SAMPLE
    sample = np.concatenate((plane[:part], plane[-part:]))
    by_runs = len(_deflate_plane(sample, zlib.Z_RLE))
    by_repeats = len(_deflate_plane(sample, zlib.Z_DEFAULT_STRATEGY, level=1))
    return zlib.Z_RLE if by_runs <= _TOLERANCE * by_repeats else zlib.Z_DEFAULT_STRATEGY


def _deflate_plane(
    plane: NDArray[np.uint8],
    strategy: int,
    *,
    level: int = DEFLATE_LEVEL,
    flush: int = zlib.Z_FINISH,
) -> bytes:
    """Return deflate blocks that end on a whole byte, so that others may follow."""
    deflater = zlib.compressobj(level, zlib.DEFLATED, -zlib.MAX_WBITS, zlib.DEF_MEM_LEVEL, strategy)
    return deflater.compress(plane.data) + deflater.flush(flush)


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
    chunks: Iterable[tuple[_Name, Chunk]],
) -> Iterator[tuple[_Name, bytes]]:
    """Pack named chunks on all cores given; yield them in their order.

    Chunks are taken ahead as long as they are few and small, so that memory is bounded. An error
    in a thread is raised where its chunk would have been.
    """
    waiting: deque[tuple[_Name, int, Future[bytes]]] = deque()
    ahead, cores = 0, count_cores()
    with ThreadPoolExecutor(cores) as pool:
        for name, chunk in chunks:
            size = len(chunk) if isinstance(chunk, bytes) else chunk.nbytes
            waiting.append((name, size, pool.submit(pack, chunk)))
            ahead += size
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
