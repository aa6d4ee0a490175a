"""Files that are kept whole in a sequence: those of a layout that no array can stand for.

``original/kept.names`` holds their names, each with a NUL behind it, ``original/kept.sizes`` their
sizes, and ``original/kept.bytes`` what is in them, one after the other.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from conversion.layouts.members import clean_name
from conversion.plan import Arrays
from semantic2d_dataset.errors import CorruptFileError
from semantic2d_dataset.format.sequence import SequenceReader

_NAMES, _SIZES, _BYTES = (f"original/kept.{part}" for part in ("names", "sizes", "bytes"))


def keep_files(files: Mapping[str, bytes]) -> Arrays:
    """Return files by name as rows to append to a sequence; nothing for no files."""
    if not files:
        return {}
    return {
        _NAMES: np.frombuffer(join_names([*files]), np.uint8),
        _SIZES: np.array([len(content) for content in files.values()], np.int64),
        _BYTES: np.frombuffer(b"".join(files.values()), np.uint8),
    }


def kept_files(reader: SequenceReader) -> Iterator[tuple[str, bytes]]:
    """Yield names and contents of the files that a sequence keeps.

    Raises
    ------
    CorruptFileError
        If the sequence does not hold them as it should, or a name leads out of their folder.
    """
    if _NAMES not in reader:
        return
    names = split_names(reader, _NAMES)
    sizes = reader.read(_SIZES).tolist()
    if len(names) != len(sizes) or min(sizes) < 0 or sum(sizes) != reader.shape(_BYTES)[0]:
        raise CorruptFileError(f"{reader.path}: {_SIZES} does not fit the names and bytes")
    start = 0
    for name, size in zip(names, sizes, strict=True):
        if not name or clean_name(name) != name:
            raise CorruptFileError(f"{reader.path}: {_NAMES}: {name!r} is no name of a file")
        yield name, reader.read(_BYTES, start, start + size).tobytes()
        start += size


def join_names(names: Sequence[str]) -> bytes:
    """Return names with a NUL behind each, which no name can hold."""
    return "".join(f"{name}\0" for name in names).encode("utf-8", "surrogateescape")


def split_names(reader: SequenceReader, array: str) -> list[str]:
    """Return the names that `join_names` joined into an array."""
    return reader.read(array).tobytes().decode("utf-8", "surrogateescape").split("\0")[:-1]
