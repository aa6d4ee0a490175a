"""Trees of files to read from: a folder, or a zip or tar archive that is never unpacked to names.

Archives are read member by member. A packed tar has no order that one could read it in at will;
it is unpacked once into a temporary file that has no name.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Self, overload

from numpy.typing import NDArray

from conversion.layouts import npy
from conversion.layouts.stores import FolderStore, Store, open_tar, open_zip
from conversion.layouts.tars import is_tar
from conversion.layouts.zips import MAGIC
from semantic2d_dataset.errors import RecordingError

_ENDINGS = (".zip", ".tar", ".tgz", ".tbz2", ".txz", ".tar.gz", ".tar.bz2", ".tar.xz")
_READERS = 8  # threads: reading files that are not in memory yet is mostly waiting
_FILES_AT_A_TIME = 64
_AFTER_SLASH = "0"  # the character that follows "/": where names under a folder end


class Tree:
    """Files by name, open for reading; a context manager. Threads may share it.

    Parameters
    ----------
    path
        The folder or archive, for messages.
    store
        Where the files lie.
    """

    def __init__(self, path: Path, store: Store) -> None:
        self.path = path
        self.names = store.names
        """Names of files with ``/``, relative, sorted."""
        self.notices = store.notices
        """What was found and is not read: links, devices, names that lead outside."""
        self._store = store
        self._threads: ThreadPoolExecutor | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Close what is open, and stop the threads."""
        if self._threads is not None:
            self._threads.shutdown(cancel_futures=True)
            self._threads = None
        self._store.close()

    def under(self, folder: str) -> tuple[str, ...]:
        """Return the names of the files in a folder and below it; "" is the tree itself."""
        if not folder:
            return self.names
        start = bisect_left(self.names, f"{folder}/")
        return self.names[start : bisect_left(self.names, f"{folder}{_AFTER_SLASH}")]

    def __contains__(self, name: str) -> bool:
        position = bisect_left(self.names, name)
        return position < len(self.names) and self.names[position] == name

    def files(self) -> Sequence[Path]:
        """Return the files on disk: those of a folder, or the archive."""
        return _Paths(self.path, self.names) if self.path.is_dir() else (self.path,)

    def size(self, name: str) -> int:
        """Return how many bytes a file has."""
        return self._store.size(self._position(name))

    def read(self, name: str) -> bytes:
        """Return the bytes of a file.

        Raises
        ------
        RecordingError
            If there is no such file, it is damaged, or larger than `MAX_MEMBER_BYTES`.
        """
        return self._store.read(self._position(name))

    def read_many(self, names: Sequence[str]) -> list[bytes]:
        """Return the bytes of files, read by several threads; raises as `read` does."""
        if len(names) <= _FILES_AT_A_TIME:
            return [self.read(name) for name in names]
        if self._threads is None:
            self._threads = ThreadPoolExecutor(_READERS)
        parts = [names[i : i + _FILES_AT_A_TIME] for i in range(0, len(names), _FILES_AT_A_TIME)]
        read = self._threads.map(lambda part: [self.read(name) for name in part], parts)
        return [content for part in read for content in part]

    def read_array(self, name: str) -> NDArray[Any]:
        """Return the array of an .npy file; it is not to be written to.

        Raises
        ------
        RecordingError
            As from `read`, or if it is no .npy file, truncated, or holds pickled objects.
        """
        try:
            return npy.read(self.read(name))
        except npy.NpyError as err:
            raise RecordingError(self.path, f"{name}: {err}") from err

    def _position(self, name: str) -> int:
        position = bisect_left(self.names, name)
        if self.names[position : position + 1] != (name,):
            raise RecordingError(self.path, f"has no file {name}")
        return position


def open_tree(path: Path, *, spool_dir: Path | None = None) -> Tree:
    """Open a folder, a .zip, or a .tar, packed by gzip, bzip2, xz or not, for reading.

    Links are not followed. Closing the tree (it is a context manager) removes what was unpacked.

    Parameters
    ----------
    path
        The folder or archive.
    spool_dir
        Where a packed tar is unpacked to a temporary file without a name; None takes TMPDIR, else
        the archive's own folder, else the system's folder for large temporary files.

    Raises
    ------
    FileNotFoundError
        If there is nothing at the path.
    RecordingError
        If it is neither, damaged, encrypted, a bomb, or there is no room to unpack it.
    """
    path.stat()  # a missing path is reported as such
    if path.is_dir():
        return Tree(path, FolderStore(path))
    if not is_archive(path):
        raise RecordingError(
            path, "expected a folder, a .zip, or a .tar (packed by gzip, bzip2, xz or not)"
        )
    return Tree(path, open_zip(path) if _is_zip(path) else open_tar(path, spool_dir))


def is_archive(path: Path) -> bool:
    """Tell a zip or tar archive by its content, or by its name where it is damaged."""
    return path.is_file() and (
        _is_zip(path) or is_tar(path) or path.name.lower().endswith(_ENDINGS)
    )


def stem_of(path: Path) -> str:
    """Return the name of a folder, or of an archive without its endings."""
    endings = [ending for ending in _ENDINGS if path.name.lower().endswith(ending)]
    if path.is_dir() or not endings:
        return path.name
    return path.name[: -max(map(len, endings))] or path.name


class _Paths(Sequence[Path]):
    """Paths of the files of a folder, made when they are asked for: there may be millions."""

    def __init__(self, folder: Path, names: Sequence[str]) -> None:
        self._folder, self._names = folder, names

    def __len__(self) -> int:
        return len(self._names)

    @overload
    def __getitem__(self, index: int) -> Path: ...

    @overload
    def __getitem__(self, index: slice) -> Sequence[Path]: ...

    def __getitem__(self, index: int | slice) -> Path | Sequence[Path]:
        if isinstance(index, slice):
            return _Paths(self._folder, self._names[index])
        return self._folder / self._names[index]


def _is_zip(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(4) in MAGIC or path.suffix.lower() == ".zip"
