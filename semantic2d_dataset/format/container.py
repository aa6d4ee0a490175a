"""HDF5 files that open only when every part of them is listed in a schema.

Reading never follows an external, soft or virtual link, and checks names, types, filters and
declared sizes before any data is read.
"""

from __future__ import annotations

import json
import math
import os
import re
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Self, TypeVar

import h5py
import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.errors import (
    CorruptFileError,
    FormatVersionError,
    InvalidInputError,
    UnsafeFileError,
)
from semantic2d_dataset.format.schema import (
    FORMAT_MAJOR,
    FORMAT_MINOR,
    FORMAT_VERSION,
    MAX_ATTRIBUTE_BYTES,
    MAX_CHUNK_BYTES,
    ArraySpec,
    FileSchema,
)

_Result = TypeVar("_Result")
_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_FILTERS = {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32}
_HDF5_FAILURES = (OSError, RuntimeError, KeyError, ValueError, TypeError, MemoryError)


class ContainerReader:
    """A checked, read-only HDF5 file; it pickles without its handle and opens once per process.

    Parameters
    ----------
    path
        The file.
    schema
        What it may hold.

    Raises
    ------
    FileNotFoundError, PermissionError, IsADirectoryError
        As from opening any file.
    CorruptFileError
        If it is not HDF5, truncated, damaged, or of another kind.
    UnsafeFileError
        If it holds anything that the schema does not list.
    FormatVersionError
        If it was written in a newer major format.
    """

    def __init__(self, path: Path, schema: FileSchema) -> None:
        self.path = Path(path)
        self.schema = schema
        self._file: Any = None
        self._pid = -1
        self.groups: list[str] = []
        self._hint = ""
        with self.path.open("rb") as stream:
            found = stream.read(len(_SIGNATURE))
        if found != _SIGNATURE:
            kind = "an empty file" if not found else "no HDF5 file"
            raise CorruptFileError(f"{self.path}: expected a {schema.kind} file, found {kind}")
        self.names: tuple[str, ...] = tuple(sorted(self._guard(self._check)))

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_file": None, "_pid": -1}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def close(self) -> None:
        """Close this process's handle; the next read opens it again."""
        if self._file is not None and self._pid == os.getpid():
            self._file.close()
        self._file = None

    def shape(self, name: str) -> tuple[int, ...]:
        """Return the shape of an array."""
        return tuple(self._guard(lambda: self._array(name).shape))

    def dtype(self, name: str) -> np.dtype[Any]:
        """Return the dtype of an array."""
        dtype: np.dtype[Any] = self._guard(lambda: self._array(name).dtype)
        return dtype

    def chunks(self, name: str) -> tuple[int, ...]:
        """Return the shape of an array's chunks."""
        return tuple(self._guard(lambda: self._array(name).chunks))

    def stored_bytes(self, name: str) -> int:
        """Return how many bytes an array takes in the file."""
        return int(self._guard(self._array(name).id.get_storage_size))

    def read(self, name: str, start: int = 0, stop: int | None = None) -> NDArray[Any]:
        """Read rows start to stop of an array.

        Raises
        ------
        InvalidInputError
            If the file has no such array.
        CorruptFileError
            If a checksum does not fit.
        """
        return np.asarray(self._guard(lambda: self._array(name)[start:stop]))

    def read_json(self, name: str) -> Any:
        """Read an array of UTF-8 bytes as JSON; its numbers are finite, its text is Unicode."""
        try:
            return load_json(self.read(name).tobytes())
        except InvalidInputError as err:
            raise CorruptFileError(f"{self.path}: {name}: {err}") from err

    def attributes(self, path: str = "") -> dict[str, Any]:
        """Return the attributes of the root, a group or an array; text as str."""
        return self._guard(lambda: _read_attributes(self._handle()[path or "/"]))

    def has_group(self, path: str) -> bool:
        """Tell whether there is a group at a path."""
        return bool(self._guard(lambda: path in self._handle()))

    def read_everything(self) -> None:
        """Read every chunk, so that every checksum is checked."""
        for name in self.names:
            for _ in self.blocks(name):
                pass

    def blocks(self, name: str) -> Iterator[NDArray[Any]]:
        """Yield an array in runs of whole chunks."""
        rows = self.shape(name)[0]
        step = self.chunks(name)[0]
        for start in range(0, rows, step):
            yield self.read(name, start, min(start + step, rows))

    def _array(self, name: str) -> Any:
        if name not in self.names:
            raise InvalidInputError(
                f"{self.path}: has no array {name!r}; it has {', '.join(self.names)}"
            )
        return self._handle()[name]

    def _handle(self) -> Any:
        if self._file is None or self._pid != os.getpid():
            self._file = h5py.File(self.path, "r", locking=False)
            self._pid = os.getpid()
        return self._file

    def _guard(self, action: Callable[[], _Result]) -> _Result:
        """Run an action on the file; what HDF5 reports of damage becomes our error."""
        try:
            return action()
        except (FileNotFoundError, PermissionError, InvalidInputError):
            raise
        except _HDF5_FAILURES as err:
            raise CorruptFileError(
                f"{self.path}: truncated or damaged, or its writer did not finish ({err}); "
                "get or make the file again"
            ) from err

    def _check(self) -> list[str]:
        root = self._handle().id
        self._check_kind(_text_attribute(root, "format"))
        version = _text_attribute(root, "format_version")
        check_version(self.path, version)
        self._hint = newer_minor_hint(version)
        found: list[str] = []
        self._check_attributes(root, "")
        self._check_group(root, "", found)
        missing = [name for name in self.schema.required if name not in found]
        if missing:
            raise CorruptFileError(f"{self.path}: lacks {', '.join(missing)}")
        return found

    def _check_kind(self, kind: str) -> None:
        if kind != self.schema.kind:
            raise CorruptFileError(
                f"{self.path}: expected a {self.schema.kind} file, "
                f"found {kind or 'an HDF5 file of another kind'}"
            )

    def _check_group(self, group: Any, path: str, found: list[str]) -> None:
        most = self.schema.max_links
        if group.get_num_objs() > most:
            raise UnsafeFileError(f"{self.path}: /{path} holds more than {most} entries")
        for raw in group:
            name = raw.decode("utf-8")
            child = f"{path}/{name}" if path else name
            if group.links.get_info(raw).type != h5py.h5l.TYPE_HARD:
                raise UnsafeFileError(f"{self.path}: /{child} is a soft or external link")
            self._check_object(group, raw, child, found)

    def _check_object(self, group: Any, raw: bytes, path: str, found: list[str]) -> None:
        spec = self.schema.array(path)
        kind = h5py.h5o.get_info(group, raw).type
        if kind == h5py.h5o.TYPE_DATASET and spec is not None:
            opened = h5py.h5o.open(group, raw)
            self._check_array(opened, path, spec)
            found.append(path)
        elif kind == h5py.h5o.TYPE_GROUP and self.schema.is_group(path):
            opened = h5py.h5o.open(group, raw)
            self.groups.append(path)
            self._check_group(opened, path, found)
        else:
            raise UnsafeFileError(
                f"{self.path}: /{path} has no place in a {self.schema.kind} file{self._hint}"
            )
        self._check_attributes(opened, path)

    def _check_array(self, array: Any, path: str, spec: ArraySpec) -> None:
        where = f"{self.path}: /{path}"
        layout = array.get_create_plist()
        if layout.get_external_count() or layout.get_layout() != h5py.h5d.CHUNKED:
            raise UnsafeFileError(f"{where} is not stored in chunks of this file")
        filters = {layout.get_filter(i)[0] for i in range(layout.get_nfilters())}
        if not filters <= _FILTERS:
            raise UnsafeFileError(f"{where} uses filters {sorted(filters - _FILTERS)}")
        if h5py.h5z.FILTER_FLETCHER32 not in filters:
            raise UnsafeFileError(f"{where} has no checksums")
        dtype = array.dtype
        if dtype.str not in spec.dtypes or array.rank not in spec.ndims:
            raise UnsafeFileError(
                f"{where}: expected {' or '.join(spec.dtypes)} of rank "
                f"{' or '.join(map(str, spec.ndims))}, found {dtype.str} {array.shape}"
            )
        sizes = (_bytes_of(array.shape, dtype), _bytes_of(layout.get_chunk(), dtype))
        if sizes[0] > spec.max_bytes or sizes[1] > MAX_CHUNK_BYTES:
            raise UnsafeFileError(f"{where} declares {sizes[0]} bytes in chunks of {sizes[1]}")
        chunks = math.prod(-(-n // c) for n, c in zip(array.shape, layout.get_chunk(), strict=True))
        if array.get_num_chunks() != chunks:  # a missing chunk would read as zeros
            raise CorruptFileError(
                f"{where}: expected {chunks} chunks, found {array.get_num_chunks()}"
            )

    def _check_attributes(self, owner: Any, path: str) -> None:
        allowed = self.schema.attribute_kinds(path)
        for i in range(h5py.h5a.get_num_attrs(owner)):
            attribute = h5py.h5a.open(owner, index=i)
            name = attribute.name.decode("utf-8", "replace")
            where = f"{self.path}: attribute {name!r} of /{path}"
            if name not in allowed:
                raise UnsafeFileError(
                    f"{where} has no place in a {self.schema.kind} file{self._hint}"
                )
            if attribute.dtype.kind != {"s": "S", "i": "i", "f": "f"}[allowed[name][0]]:
                raise UnsafeFileError(f"{where}: expected {allowed[name]}, found {attribute.dtype}")
            if _bytes_of(attribute.shape, attribute.dtype) > MAX_ATTRIBUTE_BYTES:
                raise UnsafeFileError(f"{where} is larger than {MAX_ATTRIBUTE_BYTES} bytes")


def kind_of(path: Path) -> str:
    """Return the kind that a file says it is of, "" where it says nothing; trust nothing else."""
    try:
        with h5py.File(path, "r", locking=False) as file:
            return _text_attribute(file.id, "format")
    except _HDF5_FAILURES:
        return ""


def _bytes_of(shape: tuple[int, ...], dtype: np.dtype[Any]) -> int:
    count = 1
    for length in shape:
        count *= int(length)
    return count * dtype.itemsize


def _text_attribute(owner: Any, name: str) -> str:
    """Return a short text attribute, or "" where there is none of a fixed length."""
    if not h5py.h5a.exists(owner, name.encode()):
        return ""
    attribute = h5py.h5a.open(owner, name.encode())
    if attribute.dtype.kind != "S" or attribute.shape != () or attribute.dtype.itemsize > 256:
        return ""
    value = np.zeros((), attribute.dtype)
    attribute.read(value)
    return bytes(value[()]).decode("utf-8")


def _read_attributes(owner: Any) -> dict[str, Any]:
    return {name: _plain_value(value) for name, value in owner.attrs.items()}


def _plain_value(value: Any) -> Any:
    if isinstance(value, bytes):
        return value.decode("utf-8")
    if isinstance(value, np.ndarray) and value.dtype.kind == "S":
        return [item.decode("utf-8") for item in value.tolist()]
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def read_json_file(path: Path, most_bytes: int) -> Any:
    """Read a JSON file that came from elsewhere, as `load_json` parses it.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    CorruptFileError
        If it is larger, or no such JSON.
    """
    with path.open("rb") as stream:
        content = stream.read(most_bytes + 1)
    if len(content) > most_bytes:
        raise CorruptFileError(f"{path}: larger than {most_bytes} bytes; no file of its kind is")
    try:
        return load_json(content)
    except InvalidInputError as err:
        raise CorruptFileError(f"{path}: {err}") from err


def load_json(text: str | bytes) -> Any:
    """Parse JSON that came from elsewhere: finite numbers, Unicode text, no absurd depth.

    Nor does a member stand twice in an object: readers differ in which one they believe.

    Raises
    ------
    InvalidInputError
        If it is anything else.
    """
    try:
        value = json.loads(text, parse_constant=_refuse_constant, object_pairs_hook=_refuse_twins)
        json.dumps(value, allow_nan=False, ensure_ascii=False).encode()
    except (ValueError, RecursionError) as err:
        raise InvalidInputError(f"not JSON: {err}") from err
    return value


def _refuse_twins(members: list[tuple[str, Any]]) -> dict[str, Any]:
    value = dict(members)
    if len(value) < len(members):
        counts = Counter(name for name, _ in members)
        twice = next(name for name, count in counts.items() if count > 1)
        raise ValueError(f"{twice[:80]!r} stands there more than once")
    return value


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is no JSON number")


def check_version(path: Path, version: str) -> None:
    """Check that a file's format version is one that this package reads.

    Raises
    ------
    FormatVersionError
        If its major number is a newer one.
    CorruptFileError
        If it is no version.
    """
    major = version.split(".", maxsplit=1)[0]
    if not re.fullmatch("[0-9]{1,9}", major):
        raise CorruptFileError(f"{path}: expected a format version, found {version!r}")
    if int(major) > FORMAT_MAJOR:
        raise FormatVersionError(
            f"{path}: written in format {version}, and this package reads up to "
            f"{FORMAT_MAJOR}.x; install semantic2d-dataset {major}.0 or later"
        )


def newer_minor_hint(version: object) -> str:
    """Return the end of a message about what is unknown here, where a newer format explains it."""
    found = re.fullmatch(rf"{FORMAT_MAJOR}\.([0-9]{{1,9}})", str(version))
    if found is None or int(found[1]) <= FORMAT_MINOR:
        return ""
    return (
        f"; the file is of format {version}, and this package knows {FORMAT_VERSION}: "
        "install a newer semantic2d-dataset"
    )
