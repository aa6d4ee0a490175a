"""Files whose final name means that they are complete.

HDF5 files are written by a child process (`semantic2d_dataset.format.writer_process`), because
a full disk makes the HDF5 library kill the process that it runs in.
"""

from __future__ import annotations

import contextlib
import datetime
import glob
import json
import os
import secrets
import shutil
import socket
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, BinaryIO, Self, cast

import numpy as np
from numpy.typing import NDArray

import semantic2d_dataset
from semantic2d_dataset.errors import InvalidInputError, WriteError
from semantic2d_dataset.format.container import ContainerReader
from semantic2d_dataset.format.schema import FORMAT_VERSION, FileSchema

_FREE_BYTES_KEPT = 1 << 26


class ContainerWriter:
    """Write one HDF5 file through a child process; its final name appears only when it is whole.

    Use it as a context manager: leaving it by an exception, or killing the process, leaves
    nothing under the final name.

    Parameters
    ----------
    path
        The final name; an existing file is replaced when the new one is complete.
    schema
        What may be written.
    attributes
        Attributes by path ("" is the root), then by name.

    Raises
    ------
    WriteError
        If the folder is missing, the disk is full, or the child process failed.
    """

    def __init__(
        self, path: Path, schema: FileSchema, attributes: Mapping[str, Mapping[str, Any]]
    ) -> None:
        self.path = Path(path)
        self.schema = schema
        if not self.path.parent.is_dir():
            raise WriteError(f"{self.path}: the folder {self.path.parent} does not exist")
        remove_stale_partials(self.path)
        self._partial = partial_name(self.path)
        self._rows: dict[str, tuple[str, tuple[int, ...]]] = {}
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115 - closed in _finish
        self._child = subprocess.Popen(
            [
                sys.executable,
                "-P",  # nothing in the current folder is imported
                "-m",
                "semantic2d_dataset.format.writer_process",
                schema.kind,
                str(self._partial),
                str(self.path),
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=self._stderr,
            # it computes nothing: starting threads for numpy would double its start-up
            env=os.environ | {"PYTHONPATH": _import_path(), "OPENBLAS_NUM_THREADS": "1"},
            start_new_session=True,  # Ctrl-C reaches us only; the child sees its pipe close
        )
        self._pipe = cast("BinaryIO", self._child.stdin)
        for owner, values in attributes.items():
            self._send({"op": "attributes", "path": owner, "values": dict(values)})

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self._send({"op": "commit"})
            self._finish()
        else:
            self.abort()

    def append(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Append rows to arrays along axis 0, creating those that are new.

        Raises
        ------
        InvalidInputError
            If a name, dtype or rank is not in the schema, or rows are not like earlier ones.
        WriteError
            If the disk is full or the child process failed.
        """
        for name, array in arrays.items():
            self._check_rows(name, array)
        self._check_space(sum(array.nbytes for array in arrays.values()))
        for name, array in arrays.items():
            rows = np.ascontiguousarray(array)
            header = {"op": "append", "path": name, "dtype": rows.dtype.str, "shape": rows.shape}
            self._send(header, rows)

    def copy(self, reader: ContainerReader, name: str) -> None:
        """Copy a whole array of another file of this kind, without packing it again.

        Raises
        ------
        InvalidInputError
            If rows of that array were written already, or the reader has none.
        WriteError
            If the disk is full or the child process failed.
        """
        if name in self._rows:
            raise InvalidInputError(f"{self.path}: {name}: has rows already")
        self._rows[name] = (reader.dtype(name).str, reader.shape(name)[1:])
        self._check_space(reader.stored_bytes(name))
        self._send({"op": "copy", "path": name, "source": str(reader.path.resolve())})

    def append_json(self, name: str, value: Any) -> None:
        """Write a value as UTF-8 JSON into an array of bytes."""
        self.append({name: np.frombuffer(json.dumps(value, sort_keys=True).encode(), np.uint8)})

    def set_attributes(self, path: str, values: Mapping[str, Any]) -> None:
        """Set attributes of a group or array."""
        self._send({"op": "attributes", "path": path, "values": dict(values)})

    def abort(self) -> None:
        """Stop, and remove what was written."""
        self._child.kill()
        self._child.wait()
        self._close()

    def _check_rows(self, name: str, array: NDArray[Any]) -> None:
        spec = self.schema.array(name)
        if spec is None:
            raise InvalidInputError(f"{self.path}: {name!r} has no place in {self.schema.kind}")
        found = f"found {array.dtype.str} {array.shape}"
        if array.dtype.str not in spec.dtypes or array.ndim not in spec.ndims:
            raise InvalidInputError(
                f"{self.path}: {name}: expected {' or '.join(spec.dtypes)} of rank "
                f"{' or '.join(map(str, spec.ndims))}, {found}"
            )
        dtype, width = self._rows.setdefault(name, (array.dtype.str, array.shape[1:]))
        if (array.dtype.str, array.shape[1:]) != (dtype, width):
            raise InvalidInputError(
                f"{self.path}: {name}: expected {dtype} {('n', *width)} as before, {found}"
            )

    def _check_space(self, coming: int) -> None:
        free = shutil.disk_usage(self.path.parent).free
        if free < coming + _FREE_BYTES_KEPT:
            self.abort()
            raise WriteError(
                f"{self.path}: the disk is full: {free} bytes are free, and "
                f"{coming + _FREE_BYTES_KEPT} are needed to go on safely"
            )

    def _send(self, header: Mapping[str, Any], rows: NDArray[Any] | None = None) -> None:
        text = json.dumps(header).encode()
        try:
            self._pipe.write(struct.pack("<I", len(text)) + text)
            if rows is not None and rows.size:
                self._pipe.write(rows.reshape(-1).view(np.uint8).data)
            self._pipe.flush()
        except BrokenPipeError as err:
            self._finish()
            raise WriteError(f"{self.path}: the writing process stopped early") from err

    def _finish(self) -> None:
        """Wait for the child; raise what it reported."""
        self._close_pipe()
        status = self._child.wait()
        self._stderr.seek(0)
        report = self._stderr.read().decode(errors="replace").strip().splitlines()
        self._close()
        if status != 0:
            cause = f"killed by signal {-status}" if status < 0 else f"exit status {status}"
            detail = report[-1] if report else f"{cause}; the disk may be full"
            raise WriteError(f"{self.path}: could not be written: {detail}")

    def _close(self) -> None:
        self._close_pipe()
        self._stderr.close()
        self._partial.unlink(missing_ok=True)

    def _close_pipe(self) -> None:
        with contextlib.suppress(BrokenPipeError):
            self._pipe.close()


def check_target(target: Path, inputs: Iterable[Path], *, force: bool) -> None:
    """Check that a file can be written, and takes the place of nothing that is still needed.

    Raises
    ------
    InvalidInputError
        If it is one of the inputs or a folder, or exists and `force` is not given.
    WriteError
        If its folder does not exist.
    """
    if any(_same(target, path) for path in inputs):
        raise InvalidInputError(f"{target}: is an input itself; choose another name")
    if target.is_dir():
        raise InvalidInputError(f"{target}: is a folder; give the name of a file in it")
    if target.exists() and not force:
        raise InvalidInputError(f"{target}: exists already; choose another name or use --force")
    if not target.parent.is_dir():
        raise WriteError(f"{target}: the folder {target.parent} does not exist")
    if not os.access(target.parent, os.W_OK):
        raise WriteError(f"{target}: the folder {target.parent} cannot be written to")


def _same(one: Path, other: Path) -> bool:
    if one.exists() and other.exists():
        return one.samefile(other)
    return one.resolve() == other.resolve()


def partial_name(path: Path) -> Path:
    """Return a fresh temporary name beside a final one, telling whose it is."""
    owner = f"{socket.gethostname()}-{os.getpid()}-{secrets.token_hex(4)}"
    return path.with_name(f".{path.name}.{owner}.partial")


def stale_partials(path: Path) -> list[Path]:
    """Return temporary files of a final name whose process on this machine is gone."""
    start = f".{path.name}.{socket.gethostname()}"
    found = path.parent.glob(f"{glob.escape(start)}-*.partial")
    parts = ((partial, partial.name.rsplit("-", 2)) for partial in found)
    return [
        partial
        for partial, (owner, pid, _) in parts
        if owner == start and pid.isdigit() and not _is_alive(int(pid))
    ]


def remove_stale_partials(path: Path) -> None:
    """Remove temporary files of a final name whose process on this machine is gone."""
    for partial in stale_partials(path):
        partial.unlink(missing_ok=True)


def write_text_atomically(path: Path, text: str) -> None:
    """Write a UTF-8 file as `write_bytes_atomically` does."""
    write_bytes_atomically(path, text.encode())


def write_bytes_atomically(path: Path, content: bytes) -> None:
    """Write a file so that its name never means half of it.

    Raises
    ------
    WriteError
        If its folder does not exist, or the disk is full or fails; what was there stays.
    PermissionError
        If the folder may not be written to.
    """
    path = Path(path)
    remove_stale_partials(path)
    partial = partial_name(path)
    try:
        with partial.open("wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        partial.replace(path)
    except PermissionError:
        raise
    except FileNotFoundError as err:
        raise WriteError(f"{path}: the folder {path.parent} does not exist") from err
    except OSError as err:
        raise WriteError(f"{path}: could not be written: {err.strerror or err}") from err
    finally:
        with contextlib.suppress(OSError):
            partial.unlink()


def root_attributes(schema: FileSchema, **said: str) -> dict[str, str]:
    """Return the root attributes that every file has, and what else is said of this one."""
    return {
        "format": schema.kind,
        "format_version": FORMAT_VERSION,
        "generator": f"semantic2d-dataset {semantic2d_dataset.__version__}",
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    } | said


def make_folder(folder: Path, make: Callable[[Path], object], is_whole: Callable[[], bool]) -> None:
    """Make a folder under a temporary name, and give it its own when it is whole.

    Parameters
    ----------
    folder
        The final name.
    make
        Fills the folder that it gets.
    is_whole
        Tells whether a good one is there under the final name, from a faster process.
    """
    for stale in stale_partials(folder):
        shutil.rmtree(stale, ignore_errors=True)
    partial, aside = partial_name(folder), partial_name(folder)
    partial.mkdir(parents=True)
    try:
        make(partial)
        try:
            partial.rename(folder)
        except OSError:
            if is_whole():
                return
            folder.rename(aside)  # damaged
            partial.rename(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        shutil.rmtree(aside, ignore_errors=True)


def _import_path() -> str:
    """Where the child finds this package, however this process found it."""
    here = str(Path(semantic2d_dataset.__file__).resolve().parents[1])
    return os.pathsep.join(filter(None, (here, os.environ.get("PYTHONPATH"))))


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
