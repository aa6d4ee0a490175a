"""The child process that writes one HDF5 file for `ContainerWriter`.

Run as ``python -m semantic2d_dataset.format.writer_process KIND PARTIAL FINAL``. It reads
messages from standard input, each a length (4 bytes, little-endian), a JSON header and the
bytes of an array, and renames the partial file to its final name after ``commit``. When its
input ends without ``commit`` it removes the partial file.
"""

from __future__ import annotations

import json
import os
import struct
import sys
from pathlib import Path
from typing import Any, BinaryIO

import h5py
import numpy as np

from semantic2d_dataset.errors import Semantic2DError
from semantic2d_dataset.format.container import check_container
from semantic2d_dataset.format.schema import CHUNK_ROWS, MAX_CHUNK_BYTES, SCHEMAS, FileSchema

_FLAT_CHUNK = 1 << 16
_DTYPES = {"i": np.int64, "f": np.float64}


def write(stream: BinaryIO, schema: FileSchema, partial: Path, final: Path) -> bool:
    """Write what the stream tells; return whether the file was committed."""
    with h5py.File(partial, "x", libver=("v110", "v110"), locking=False) as file:
        while (header := _read_header(stream)) is not None:
            if header["op"] == "commit":
                break
            _apply(header, stream, file, schema)
        else:
            return False
    check_container(partial, schema)
    _sync(partial)
    partial.replace(final)
    _sync(final.parent)
    return True


def _read_header(stream: BinaryIO) -> Any:
    length = stream.read(4)
    if len(length) < 4:
        return None
    text = stream.read(struct.unpack("<I", length)[0])
    return json.loads(text)


def _apply(header: Any, stream: BinaryIO, file: Any, schema: FileSchema) -> None:
    path = header["path"]
    if header["op"] == "attributes":
        owner = file[path] if path in file else file.require_group(path or "/")
        for name, value in header["values"].items():
            owner.attrs.create(name, _encode(value, schema.attribute_kinds(path)[name]))
        return
    dtype, shape = np.dtype(header["dtype"]), tuple(header["shape"])
    rows = np.frombuffer(_read_exactly(stream, dtype.itemsize * int(np.prod(shape))), dtype)
    array = file[path] if path in file else _new_array(file, path, dtype, shape)
    before = len(array)
    array.resize(before + shape[0], axis=0)
    array[before:] = rows.reshape(shape)


def _read_exactly(stream: BinaryIO, count: int) -> bytes:
    data = stream.read(count)
    if len(data) < count:
        raise EOFError("the parent process stopped in the middle of an array")
    return data


def _new_array(file: Any, path: str, dtype: np.dtype[Any], shape: tuple[int, ...]) -> Any:
    row_bytes = max(1, dtype.itemsize * int(np.prod(shape[1:])))
    wanted = CHUNK_ROWS if len(shape) > 1 else _FLAT_CHUNK
    chunk = (max(1, min(wanted, MAX_CHUNK_BYTES // row_bytes)), *(max(1, n) for n in shape[1:]))
    return file.create_dataset(
        path,
        shape=(0, *shape[1:]),
        maxshape=(None, *shape[1:]),
        dtype=dtype,
        chunks=chunk,
        compression="gzip",
        compression_opts=4,
        shuffle=True,
        fletcher32=True,
    )


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
    done = False
    try:
        done = write(sys.stdin.buffer, SCHEMAS[kind], partial, final)
    except (OSError, RuntimeError, ValueError, KeyError, EOFError, Semantic2DError) as err:
        sys.stderr.write(f"{type(err).__name__}: {err}\n")
    finally:
        partial.unlink(missing_ok=True)
    sys.exit(0 if done else 1)


if __name__ == "__main__":
    main()
