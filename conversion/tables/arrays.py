"""Rows of arrays in a folder of .npy, or in one .npz, a block at a time."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from conversion.layouts import npy
from conversion.layouts.rows import natural_order
from conversion.tables.rows import Contents, Rows, Selector
from conversion.wording import one_line
from semantic2d_dataset.errors import RecordingError

_BLOCK = 4096
_MAX_WHOLE_BYTES = 1 << 28  # arrays with a few numbers a scan: 11 million poses
_MAX_PACKED_BYTES, _MAX_PACKING = 1 << 28, 200  # measured ranges pack 3 to 10 times
_MAX_STAMP_NS = 2**62
_MAGIC_BYTES, _LONGEST_HEADER = 8, 10_000

Header = tuple[tuple[int, ...], np.dtype[Any]]


class Store(Protocol):
    """Arrays by name; every failure is a `RecordingError`."""

    path: Path

    def files(self, name: str) -> list[Path]:
        """Return the files that an array is read from."""
        ...

    def header(self, name: str) -> Header:
        """Return shape and dtype of an array."""
        ...

    def rows(self, name: str, size: int) -> Iterator[NDArray[Any]]:
        """Yield the rows of an array, up to `size` at a time."""
        ...


class ArrayRows:
    """Rows of arrays that a store holds.

    Parameters
    ----------
    store
        A folder of .npy, or a .npz.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._path = store.path

    def files(self, selectors: Sequence[Selector]) -> list[Path]:
        """Return the files of these arrays."""
        names = {name for selector in selectors for name in _names(selector)}
        return sorted({file for name in names for file in self._store.files(name)})

    def contents(
        self,
        ranges: Selector,
        stamps: Selector | None,
        units_per_s: int,
        others: Mapping[str, Selector],
    ) -> Contents:
        """Read the small arrays whole."""
        rows, beams = self._matrix("ranges", ranges)
        read = {name: self._columns(name, each, rows) for name, each in others.items()}
        stamps_ns = None if stamps is None else self._stamps(stamps, rows, units_per_s)
        return Contents(rows, beams, stamps_ns, read)

    def blocks(self, wanted: Mapping[str, Selector], size: int) -> Iterator[Rows]:
        """Read the large arrays together."""
        shapes = {name: self._matrix(name, selector) for name, selector in wanted.items()}
        expected = next(iter(shapes.values()))
        for name, shape in shapes.items():
            if shape != expected:
                raise RecordingError(
                    self._path, f"{name}: expected {expected} as the ranges, found {shape}"
                )
        streams = [self._store.rows(_names(selector)[0], size) for selector in wanted.values()]
        for parts in zip(*streams, strict=True):
            yield dict(zip(wanted, parts, strict=True))

    def _matrix(self, name: str, selector: Selector) -> tuple[int, int]:
        if not isinstance(selector, str):
            raise RecordingError(self._path, f"{name}: expected one array (N, B), found {selector}")
        shape, _ = self._store.header(selector)
        if len(shape) != 2:
            raise RecordingError(
                self._path, f"{name}: expected an array (N, B), found {shape} in {selector}"
            )
        return shape[0], shape[1]

    def _columns(self, name: str, selector: Selector, rows: int) -> NDArray[np.float64]:
        parts = [self._whole(each) for each in _names(selector)]
        parts = [part[:, None] if part.ndim == 1 else part for part in parts]
        if any(part.ndim != 2 or len(part) != rows for part in parts):
            shapes = ", ".join(str(part.shape) for part in parts)
            raise RecordingError(
                self._path, f"{name}: expected a row for each of {rows} scans, found {shapes}"
            )
        return np.hstack(parts).astype(np.float64)

    def _stamps(self, selector: Selector, rows: int, units_per_s: int) -> NDArray[np.int64]:
        stamps = self._whole(_names(selector)[0]).reshape(-1)
        if stamps.size != rows or not np.isfinite(stamps).all():
            lost = int((~np.isfinite(stamps)).sum())
            raise RecordingError(
                self._path,
                f"stamps: expected one for each of {rows} scans, found {stamps.size}, of which "
                f"{lost} are not finite",
            )
        unit_ns = 10**9 // units_per_s
        if (np.abs(stamps.astype(np.float64)) * unit_ns > _MAX_STAMP_NS).any():
            raise RecordingError(
                self._path, "stamps: beyond the year 2116; is stamp_unit s, ms, us or ns right?"
            )
        if stamps.dtype.kind == "f":
            return np.rint(stamps.astype(np.float64) * unit_ns).astype(np.int64)
        return stamps.astype(np.int64) * unit_ns

    def _whole(self, name: str) -> NDArray[Any]:
        shape, dtype = self._store.header(name)
        size = math.prod(shape) * dtype.itemsize
        if not shape or size > _MAX_WHOLE_BYTES:
            raise RecordingError(
                self._path,
                f"{name}: expected a few numbers for each scan, found {shape}, {size} bytes",
            )
        return np.concatenate([np.empty((0, *shape[1:]), dtype), *self._store.rows(name, _BLOCK)])


class FolderStore:
    """Arrays in a folder: ``<name>.npy``, or ``<name>/`` with one .npy for each scan."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def files(self, name: str) -> list[Path]:
        """Return the .npy of an array, or those of its scans in the order of their numbers."""
        if Path(name).is_absolute() or ".." in Path(name).parts:
            raise RecordingError(self.path, f"{name!r}: expected a name in this folder")
        here = self.path / name
        if here.is_dir():
            files = sorted(here.glob("*.npy"), key=lambda path: natural_order(path.name))
            if not files:
                raise RecordingError(here, "expected one .npy for each scan, found none")
            return files
        file = here if here.suffix == ".npy" else here.with_name(f"{here.name}.npy")
        if not file.is_file():
            known = ", ".join(sorted(path.name for path in self.path.iterdir())[:20])
            raise RecordingError(self.path, f"no array {name!r}; it holds {known or 'nothing'}")
        return [file]

    def header(self, name: str) -> Header:
        """Return shape and dtype; of one .npy for each scan, their number comes first."""
        files = self.files(name)
        first = _load(files[0])
        shape = (len(files), *first.shape) if self._is_split(name) else first.shape
        return shape, first.dtype

    def rows(self, name: str, size: int) -> Iterator[NDArray[Any]]:
        """Yield copies of rows of a mapped file, or of files read one by one."""
        files, ((count, *shape), dtype) = self.files(name), self.header(name)
        if not self._is_split(name):
            whole = _load(files[0])
            yield from (np.array(whole[at : at + size]) for at in range(0, count, size))
            return
        for at in range(0, count, size):
            rows = np.empty((min(size, count - at), *shape), dtype)
            for row, file in zip(rows, files[at:], strict=False):
                found = _load(file)
                if found.shape != tuple(shape):
                    raise RecordingError(
                        file, f"expected {tuple(shape)} as in the first file, found {found.shape}"
                    )
                row[...] = found
            yield rows

    def _is_split(self, name: str) -> bool:
        return (self.path / name).is_dir()


class NpzStore:
    """Arrays in a .npz, streamed: never more than a block is unpacked at once.

    Parameters
    ----------
    path
        The file.

    Raises
    ------
    RecordingError
        If it is no .npz.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with _zip_errors(path), zipfile.ZipFile(path) as archive:
            self._members = {
                info.filename.removesuffix(".npy"): info
                for info in archive.infolist()
                if info.filename.endswith(".npy")
            }

    def files(self, name: str) -> list[Path]:  # noqa: ARG002 - all in one
        """Return the file."""
        return [self.path]

    def header(self, name: str) -> Header:
        """Return shape and dtype."""
        with self._open(name) as (_, header):
            return header

    def rows(self, name: str, size: int) -> Iterator[NDArray[Any]]:
        """Unpack the array row by row; its checksum is checked at the end."""
        with self._open(name) as (stream, (shape, dtype)):
            count, *width = shape
            row_bytes = dtype.itemsize * math.prod(width)
            for at in range(0, count, size):
                rows = min(size, count - at)
                data = stream.read(rows * row_bytes)
                if len(data) != rows * row_bytes:
                    raise RecordingError(
                        self.path, f"{name}: expected {count} rows, found it cut after row {at}"
                    )
                yield np.frombuffer(data, dtype).reshape(rows, *width)
            if stream.read(1):
                raise RecordingError(self.path, f"{name}: holds more than the {count} rows it says")

    @contextmanager
    def _open(self, name: str) -> Iterator[tuple[IO[bytes], Header]]:
        info = self._members.get(name.removesuffix(".npy"))
        if info is None:
            known = ", ".join(self._members) or "no arrays"
            raise RecordingError(self.path, f"no array {name!r}; it holds {known}")
        packed = max(info.compress_size, 1)
        if info.file_size > _MAX_PACKED_BYTES and info.file_size > _MAX_PACKING * packed:
            raise RecordingError(
                self.path,
                f"{name}: {info.file_size} bytes in {packed}: no measured array packs like that; "
                "if it is one, give it as a folder of .npy",
            )
        with (
            _zip_errors(self.path),
            zipfile.ZipFile(self.path) as archive,
            archive.open(info) as stream,
        ):
            yield stream, _read_header(self.path, name, stream)


def _names(selector: Selector) -> tuple[str, ...]:
    return (selector,) if isinstance(selector, str) else selector


def _load(file: Path) -> NDArray[Any]:
    """Map a .npy; nothing of it is read yet."""
    try:
        found: NDArray[Any] = np.load(file, mmap_mode="r", allow_pickle=False)
    except (FileNotFoundError, PermissionError):
        raise
    except Exception as err:  # numpy parses headers as Python, and fails in as many ways
        raise RecordingError(file, f"no readable .npy of numbers: {one_line(err)}") from err
    if not isinstance(found, np.ndarray):
        raise RecordingError(file, "expected one .npy, found an archive of several")
    _check_dtype(file, file.name, found.dtype)
    return found


def _read_header(path: Path, name: str, stream: IO[bytes]) -> Header:
    header = stream.read(_MAGIC_BYTES)
    width = 2 if header[6:7] == b"\x01" else 4
    header += stream.read(width)
    length = int.from_bytes(header[_MAGIC_BYTES:], "little")
    try:
        layout = npy.parse(header + stream.read(min(length, _LONGEST_HEADER)))
    except npy.NpyError as err:
        raise RecordingError(path, f"{name}: {err}") from err
    _check_dtype(path, name, layout.dtype)
    if layout.fortran and len(layout.shape) > 1:
        raise RecordingError(
            path,
            f"{name}: is stored column by column, so that its rows cannot be streamed; store it "
            "with np.ascontiguousarray, or give it as a folder of .npy",
        )
    return layout.shape, layout.dtype


def _check_dtype(path: Path, name: str, dtype: np.dtype[Any]) -> None:
    if dtype.kind not in "biuf":
        raise RecordingError(path, f"{name}: expected numbers, found an array of {dtype}")


@contextmanager
def _zip_errors(path: Path) -> Iterator[None]:
    """Name the file in what zipfile raises; of damaged directories that is much."""
    try:
        yield
    except (RecordingError, FileNotFoundError, PermissionError):
        raise
    except Exception as err:
        raise RecordingError(path, f"no readable .npz: {one_line(err)}") from err
