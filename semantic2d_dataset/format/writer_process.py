"""The child process that writes one HDF5 file for `ContainerWriter`.

Run as ``python -m semantic2d_dataset.format.writer_process KIND PARTIAL FINAL``. It reads
messages from standard input, each a length (4 bytes, little-endian), a JSON header and the
bytes of an array, and renames the partial file to its final name after ``commit``. When its
input ends without ``commit`` it removes the partial file.
"""

from __future__ import annotations

import json
import math
import os
import sys
import zlib
from collections.abc import Iterator, Sequence
from io import BufferedReader
from pathlib import Path
from typing import Any, NamedTuple, cast

import h5py
import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.errors import CorruptFileError, Semantic2DError
from semantic2d_dataset.format.chunks import DEFLATE_LEVEL, Chunk, is_intact, pack_in_order
from semantic2d_dataset.format.container import ContainerReader
from semantic2d_dataset.format.schema import CHUNK_ROWS, SCHEMAS, FileSchema

_FLAT_CHUNK = 1 << 16
_CHUNK_BYTES = 1 << 22  # readers decompress a whole chunk for one row
_DTYPES = {"i": np.int64, "f": np.float64}
_FAILURES = (
    OSError,
    RuntimeError,
    ValueError,
    KeyError,
    EOFError,
    MemoryError,
    zlib.error,
    Semantic2DError,
)


def write(stream: BufferedReader, schema: FileSchema, partial: Path, final: Path) -> None:
    """Write what the stream tells, and give the file its final name.

    Raises
    ------
    EOFError
        If the stream ends before the file is committed.
    CorruptFileError
        If the file does not hold what was written to it.
    """
    with h5py.File(partial, "x", libver=("v110", "v110"), locking=False) as file:
        for place, stored in pack_in_order(_chunks(stream, file, schema)):
            place.array.set_extent((place.stop, *place.array.shape[1:]))
            place.array.write_direct_chunk(_offset(place.array, place.start), stored)
    _check(partial, schema)
    _sync(partial)
    partial.replace(final)
    _sync(final.parent)


class _Place(NamedTuple):
    """Which rows of an open HDF5 array a chunk holds."""

    array: Any
    start: int
    stop: int


_Chunks = Iterator[tuple[_Place, Chunk]]


class _GrowingArray:
    """Rows of one array on their way into chunks."""

    def __init__(self, array: Any) -> None:
        self._array, self._start, self._filled = array, 0, 0
        self._chunk = np.zeros(array.chunks, array.dtype)

    def grow(self, stream: BufferedReader, rows: int) -> _Chunks:
        """Read rows from the stream; yield the chunks that they complete."""
        while rows:
            stop = min(self._filled + rows, len(self._chunk))
            _read_into(stream, self._chunk[self._filled : stop])
            rows, self._filled = rows - (stop - self._filled), stop
            if stop == len(self._chunk):
                yield from self.finish()

    def finish(self) -> _Chunks:
        """Yield the chunk that is being filled, the rest of it zeros."""
        if self._filled:
            stop = self._start + self._filled
            yield _Place(self._array.id, self._start, stop), self._chunk
            self._start, self._filled = stop, 0
            self._chunk = np.zeros_like(self._chunk)


def _chunks(stream: BufferedReader, file: Any, schema: FileSchema) -> _Chunks:
    """Do what the stream tells up to ``commit``; yield the chunks that are to be stored."""
    arrays: dict[str, _GrowingArray] = {}
    while (header := _read_header(stream))["op"] != "commit":
        path = header["path"]
        if header["op"] == "attributes":
            _set_attributes(file, path, header["values"], schema)
            continue
        if header["op"] == "copy":
            yield from _copy(Path(header["source"]), file, path, schema)
            continue
        if path not in arrays:
            arrays[path] = _GrowingArray(_new_array(file, path, header["dtype"], header["shape"]))
        yield from arrays[path].grow(stream, header["shape"][0])
    for array in arrays.values():
        yield from array.finish()


def _copy(source: Path, file: Any, path: str, schema: FileSchema) -> _Chunks:
    """Yield the chunks of a whole array of another file, as they are stored there.

    An array that is stored in another way, by another writer, is read and packed again.
    """
    with ContainerReader(source, schema) as reader, h5py.File(source, "r", locking=False) as other:
        given = other[path]
        made = _new_array(file, path, given.dtype.str, given.shape)
        same = _layout(given) == _layout(made)
        for start in range(0, len(given), made.chunks[0]):
            stop = min(start + made.chunks[0], len(given))
            yield (
                _Place(made.id, start, stop),
                (
                    _intact_chunk(source, given, start)
                    if same
                    else _padded(reader.read(path, start, stop), made)
                ),
            )


def _layout(array: Any) -> tuple[Any, ...]:
    filters = array.id.get_create_plist()
    return (
        array.dtype.str,
        array.chunks,
        [filters.get_filter(i)[0] for i in range(filters.get_nfilters())],
    )


def _intact_chunk(source: Path, array: Any, row: int) -> bytes:
    skipped, stored = array.id.read_direct_chunk(_offset(array.id, row))
    if skipped or not is_intact(stored):
        raise CorruptFileError(f"{source}: {array.name}: a chunk is damaged; get the file again")
    return bytes(stored)


def _padded(rows: NDArray[Any], array: Any) -> NDArray[Any]:
    chunk = np.zeros(array.chunks, array.dtype)
    chunk[: len(rows)] = rows
    return chunk


def _read_header(stream: BufferedReader) -> Any:
    length = np.zeros(1, "<u4")
    _read_into(stream, length)
    text = np.zeros(length[0], np.uint8)
    _read_into(stream, text)
    return json.loads(text.tobytes())


def _read_into(stream: BufferedReader, values: NDArray[Any]) -> None:
    room = values.reshape(-1).view(np.uint8)
    if stream.readinto(room.data) < len(room):
        raise EOFError("the parent process stopped before the file was complete")


def _set_attributes(file: Any, path: str, values: dict[str, Any], schema: FileSchema) -> None:
    owner = file[path] if path in file else file.require_group(path or "/")
    for name, value in values.items():
        owner.attrs.create(name, _encode(value, schema.attribute_kinds(path)[name]))


def _new_array(file: Any, path: str, dtype: str, shape: Sequence[int]) -> Any:
    row_bytes = max(1, np.dtype(dtype).itemsize * math.prod(shape[1:]))
    wanted = CHUNK_ROWS if len(shape) > 1 else _FLAT_CHUNK
    return file.create_dataset(
        path,
        shape=(0, *shape[1:]),
        maxshape=(None, *shape[1:]),
        dtype=dtype,
        chunks=(max(1, min(wanted, _CHUNK_BYTES // row_bytes)), *shape[1:]),
        compression="gzip",
        compression_opts=DEFLATE_LEVEL,
        shuffle=True,
        fletcher32=True,
    )


def _check(path: Path, schema: FileSchema) -> None:
    """Open the file as readers do, and compare every chunk in it with its checksum.

    Decompressing too would cost a quarter of the time that compressing takes.
    """
    with ContainerReader(path, schema) as reader, h5py.File(path, "r", locking=False) as file:
        for name in reader.names:
            if not all(map(is_intact, _stored(file[name]))):
                raise CorruptFileError(f"{path}: {name} does not hold what was written to it")


def _stored(array: Any) -> Iterator[bytes]:
    for start in range(0, len(array), array.chunks[0]):
        yield array.id.read_direct_chunk(_offset(array.id, start))[1]


def _offset(array: Any, row: int) -> tuple[int, ...]:
    """Return where the chunk that begins at a row lies; chunks span the other axes."""
    return (row, *[0] * (array.rank - 1))


def _encode(value: Any, kind: str) -> Any:
    """Turn a JSON value into an attribute without variable-length parts."""
    if kind == "str":
        raw = value.encode()
        return np.array(raw, h5py.string_dtype("utf-8", max(1, len(raw))))
    if kind == "strs":
        raws = [item.encode() for item in value]
        return np.array(raws, h5py.string_dtype("utf-8", max(1, *map(len, raws))))
    return np.asarray(value, _DTYPES[kind[0]])


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def main() -> None:
    """Run the process; its last line on standard error says what failed."""
    kind, partial, final = sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3])
    try:
        write(cast("BufferedReader", sys.stdin.buffer), SCHEMAS[kind], partial, final)
    except _FAILURES as err:
        sys.exit(f"{type(err).__name__}: {err}")
    finally:
        partial.unlink(missing_ok=True)


if __name__ == "__main__":
    main()
