"""Where the files of a tree lie: in a folder, in a zip or tar archive, in what one unpacks to."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import BinaryIO, Protocol

from conversion.layouts.members import (
    LINK,
    MAX_MEMBER_BYTES,
    OTHER,
    Index,
    check_count,
    describe_ignored,
    is_litter,
)
from conversion.layouts.tars import index_tar, is_packed
from conversion.layouts.zips import index_zip, read_zipped
from conversion.temporary import temporary_folder
from semantic2d_dataset.errors import RecordingError


class Store(Protocol):
    """Where the files of a tree lie."""

    names: tuple[str, ...]
    notices: tuple[str, ...]

    def size(self, position: int) -> int:
        """Return the bytes of the file whose name stands at a position of `names`."""
        ...

    def read(self, position: int) -> bytes:
        """Return what is in the file whose name stands at a position of `names`."""
        ...

    def close(self) -> None:
        """Close what is open."""
        ...


class FolderStore:
    """Files of a folder, opened when they are read.

    Parameters
    ----------
    path
        The folder.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._root = os.fspath(path)
        self._ignored: dict[str, int] = {}
        self.names = tuple(sorted(self._walk()))
        self.notices = describe_ignored(self._ignored)

    def size(self, position: int) -> int:
        """Ask the file system."""
        return Path(self._place(position)).lstat().st_size

    def read(self, position: int) -> bytes:
        """Read a file; a link that has taken its place is not followed."""
        try:
            descriptor = os.open(self._place(position), os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
        except FileNotFoundError as err:
            raise RecordingError(self._path, f"{self.names[position]}: was removed") from err
        try:
            size = os.fstat(descriptor).st_size
            if size > MAX_MEMBER_BYTES:
                raise RecordingError(
                    self._path,
                    f"{self.names[position]}: expected at most {MAX_MEMBER_BYTES} bytes, "
                    f"found {size}",
                )
            return os.read(descriptor, size + 1)
        finally:
            os.close(descriptor)

    def close(self) -> None:
        """Nothing stays open."""

    def _place(self, position: int) -> str:
        return f"{self._root}/{self.names[position]}"

    def _walk(self) -> Iterator[str]:
        folders, found = [""], 0
        while folders:
            folder = folders.pop()
            with os.scandir(f"{self._root}/{folder}") as entries:
                for entry in entries:
                    name = f"{folder}{entry.name}"
                    if is_litter(name):
                        continue
                    if entry.is_dir(follow_symlinks=False):
                        folders.append(f"{name}/")
                    elif entry.is_file(follow_symlinks=False):
                        found += 1
                        yield name
                    else:
                        kind = LINK if entry.is_symlink() else OTHER
                        self._ignored[kind] = self._ignored.get(kind, 0) + 1
            check_count(self._path, found)


class _ZipStore:
    """Files of a zip archive, unpacked when they are read."""

    def __init__(self, file: BinaryIO, index: Index) -> None:
        self._file, self._index = file, index
        self.names, self.notices = index.names, index.notices

    def size(self, position: int) -> int:
        return self._index[position].size

    def read(self, position: int) -> bytes:
        name, member = self.names[position], self._index[position]
        return read_zipped(self._index.path, self._file.fileno(), name, member)

    def close(self) -> None:
        self._file.close()


class _TarStore:
    """Files of a tar archive, which lie in it, or in what it was unpacked to, as they are."""

    def __init__(self, file: BinaryIO, index: Index) -> None:
        self._file, self._index = file, index
        self.names, self.notices = index.names, index.notices

    def size(self, position: int) -> int:
        return self._index[position].size

    def read(self, position: int) -> bytes:
        member = self._index[position]
        content = os.pread(self._file.fileno(), member.size, member.offset)
        if len(content) < member.size:
            raise RecordingError(
                self._index.path, f"{self.names[position]}: truncated; get the archive again"
            )
        return content

    def close(self) -> None:
        self._file.close()


def open_zip(path: Path) -> Store:
    """List a zip archive; raises as `conversion.layouts.zips.index_zip` does."""
    with ExitStack() as failing:
        file = failing.enter_context(path.open("rb"))
        store = _ZipStore(file, index_zip(path, file))
        failing.pop_all()
    return store


def open_tar(path: Path, spool_dir: Path | None) -> Store:
    """List a tar archive, unpacking a packed one; raises as `index_tar` does."""
    if not is_packed(path):
        found = index_tar(path, None, path.parent)
        return _TarStore(path.open("rb"), found)
    folder = spool_dir or _spool_folder(path)
    with ExitStack() as failing:
        spool = failing.enter_context(tempfile.TemporaryFile(dir=folder))
        index = index_tar(path, spool, folder)
        spool.flush()
        failing.pop_all()
    return _TarStore(spool, index)


def _spool_folder(path: Path) -> Path:
    own = path.resolve().parent
    if not os.environ.get("TMPDIR") and os.access(own, os.W_OK | os.X_OK):
        return own
    return Path(temporary_folder() or tempfile.gettempdir())
