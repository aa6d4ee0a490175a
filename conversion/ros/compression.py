"""Decompression that never makes more than was announced."""

from __future__ import annotations

import bz2
import shutil
import sys
from pathlib import Path

from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
MAX_PIECE = 1 << 28
"""Bytes of a chunk or message beyond which none is read; ROS writes chunks of 768 KiB."""

_COPIED = 1 << 20


_CODECS = {"lz4": LZ4FrameDecompressor, "bz2": bz2.BZ2Decompressor, "zstd": zstd.ZstdDecompressor}


def decompress(codec: str, data: bytes, size: int) -> bytes:
    """Decompress a chunk of an announced size.

    Parameters
    ----------
    codec
        ``lz4``, ``bz2``, ``zstd``; ``none`` or nothing.

    Raises
    ------
    Exception
        If the data are damaged, are of another size, or of more than `MAX_PIECE`.
    """
    if size > MAX_PIECE:
        raise ValueError(f"a chunk has {size} bytes: more than can be read")
    done, whole = data, True
    if codec not in ("none", ""):
        if codec not in _CODECS:
            raise ValueError(f"a chunk is compressed by {codec!r}, which is not known")
        work = _CODECS[codec]()
        done = work.decompress(data, max_length=size + 1)  # one more would be too many
        whole = work.eof
    if len(done) != size or not whole:
        raise ValueError(f"a chunk has not the {size} bytes that its header says")
    return done


def decompress_message(raw: bytes) -> bytes:
    """Decompress a message that was compressed by zstd on its own.

    Raises
    ------
    Exception
        If it is damaged, or of more than `MAX_PIECE`.
    """
    work = zstd.ZstdDecompressor()
    done = work.decompress(raw, max_length=MAX_PIECE)
    if not work.eof:
        raise ValueError("a compressed message is damaged")
    return done


def decompress_file(path: Path, target: Path) -> None:
    """Decompress a file that was compressed by zstd as a whole."""
    with zstd.open(path, "rb") as source, target.open("wb") as file:
        shutil.copyfileobj(source, file, _COPIED)
