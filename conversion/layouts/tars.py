"""Tar archives: walked from start to end once, the files of a packed one put aside."""

from __future__ import annotations

import bz2
import gzip
import lzma
import os
import re
import shutil
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from tarfile import (
    AREGTYPE,
    BLKTYPE,
    BLOCKSIZE,
    CHRTYPE,
    CONTTYPE,
    DIRTYPE,
    FIFOTYPE,
    GNUTYPE_LONGLINK,
    GNUTYPE_LONGNAME,
    GNUTYPE_SPARSE,
    LNKTYPE,
    REGTYPE,
    SOLARIS_XHDTYPE,
    SYMTYPE,
    XGLTYPE,
    XHDTYPE,
    HeaderError,
    TarInfo,
)
from typing import Any, BinaryIO, NamedTuple, cast

from tqdm import tqdm

from conversion.layouts.members import (
    LINK,
    MAX_MEMBER_BYTES,
    OTHER,
    OUTSIDE,
    TOO_LARGE,
    Index,
    Member,
    check_ratio,
    clean_name,
    is_litter,
)
from semantic2d_dataset.errors import RecordingError

_PACKERS: dict[bytes, Any] = {b"\x1f\x8b": gzip, b"BZh": bz2, b"\xfd7zXZ\x00": lzma}
_DAMAGE = (OSError, EOFError, zlib.error, lzma.LZMAError, HeaderError, ValueError)
_FILES = (REGTYPE, AREGTYPE, CONTTYPE)
_LINKS = (LNKTYPE, SYMTYPE)
_WITHOUT_DATA = (*_LINKS, DIRTYPE, CHRTYPE, BLKTYPE, FIFOTYPE)
_PAX = (XHDTYPE, SOLARIS_XHDTYPE)
_OF_NO_INTEREST = (XGLTYPE, GNUTYPE_LONGLINK)
_PAX_RECORD = re.compile(rb"([0-9]{1,9}) ([^=]+)=")
# name, size, checksum, type, link, magic and version, folder (POSIX.1-2008, ustar format)
_PLAIN = struct.Struct("100s24x12s12x8sc100s8s80x155s12x")
_NO_LINK = bytes(100)
_MAGICS = (b"ustar\x0000", b"ustar  \0")
_MAX_EXTENSION_BYTES = 1 << 20
_ENCODING, _ERRORS = "utf-8", "surrogateescape"
_END = bytes(BLOCKSIZE)
_STEP = 1 << 22
_FREE_BYTES_KEPT = 1 << 26


def is_packed(path: Path) -> bool:
    """Tell by its first bytes whether a file is packed by gzip, bzip2 or xz."""
    return _packer_of(path) is not None


def is_tar(path: Path) -> bool:
    """Tell whether a file, packed or not, begins as a tar archive does."""
    try:
        with path.open("rb") as raw, _open(path, raw) as stream:
            first = stream.read(BLOCKSIZE)
        return bool(_header(first))
    except (PermissionError, FileNotFoundError):
        raise
    except _DAMAGE:
        return False


def index_tar(path: Path, spool: BinaryIO | None, spool_dir: Path) -> Index:
    """List the files of a tar archive; what a packed one holds is put into `spool`.

    Parameters
    ----------
    path
        The archive.
    spool, spool_dir
        An empty file, and the folder whose room it takes; None where the archive is not packed,
        so that its members can be read in their places.

    Raises
    ------
    RecordingError
        If it is truncated, damaged or a bomb, or there is no room for what it holds.
    """
    index = Index(path)
    try:
        with (
            path.open("rb") as raw,
            _open(path, raw) as stream,
            tqdm(
                total=path.stat().st_size, desc="list", disable=None, leave=False, unit="B"
            ) as bar,
        ):
            walk = _Walk(path, stream)
            for entry in walk.entries():
                _take(walk, entry, index, spool, spool_dir)
                bar.update(raw.tell() - bar.n)
            walk.drain()
    except (PermissionError, FileNotFoundError):
        raise
    except _DAMAGE as err:
        raise RecordingError(
            path, f"truncated or damaged ({err or type(err).__name__}); get it again"
        ) from err
    index.finish()
    return index


class _Entry(NamedTuple):
    name: str
    kind: bytes
    size: int


class _Walk:
    """The entries of a tar archive, one after the other."""

    def __init__(self, path: Path, stream: BinaryIO) -> None:
        self._path, self._stream = path, stream
        self._bytes, self._packed = path.stat().st_size, is_packed(path)
        self.at = 0

    def entries(self) -> Iterator[_Entry]:
        """Yield each before its data; what is not read of them is passed over."""
        extension: dict[bytes, bytes] = {}
        while (block := self.read(BLOCKSIZE)) != _END:
            header = _header(block)
            data_at = self.at
            if header.kind in _PAX:
                extension |= _pax_records(self._extension(header))
            elif header.kind == GNUTYPE_LONGNAME:
                extension[b"path"] = self._extension(header)
            elif header.kind not in _OF_NO_INTEREST:
                header, extension = _extended(header, extension), {}
                yield header
            if header.kind not in _WITHOUT_DATA:
                padded = header.size + -header.size % BLOCKSIZE
                self._pass_over(data_at + padded - self.at)

    def read(self, size: int) -> bytes:
        """Read so many bytes, or fail."""
        data = self._stream.read(size)
        self.at += len(data)
        if len(data) < size:
            raise EOFError(f"it ends after {self.at} bytes, before its end mark")
        check_ratio(self._path, self.at, self._bytes)
        return data

    def drain(self) -> None:
        """Read what follows the end mark, so that the packer's own checksum is checked."""
        while self._packed and (data := self._stream.read(_STEP)):
            self.at += len(data)
            check_ratio(self._path, self.at, self._bytes)

    def _pass_over(self, size: int) -> None:
        if not self._packed:  # a seek beyond the end is found by the next read
            self._stream.seek(size, os.SEEK_CUR)
            self.at += size
            return
        while size > 0:
            size -= len(self.read(min(size, _STEP)))

    def _extension(self, header: _Entry) -> bytes:
        if header.size > _MAX_EXTENSION_BYTES:
            raise ValueError(f"a header of {header.size} bytes")
        return self.read(header.size)


def _header(block: bytes) -> _Entry:
    """Read a header; most are of plain files, which `tarfile` would take long to read."""
    if len(block) == BLOCKSIZE:
        name, size, checksum, kind, link, magic, folder = _PLAIN.unpack(block)
        plain = kind == REGTYPE and link == _NO_LINK and magic in _MAGICS and folder[0] == 0
        if plain and size[0] < 128 and _octal(checksum) == _checksum(block):
            return _Entry(_text(name), kind, _octal(size))
    info = TarInfo.frombuf(block, _ENCODING, _ERRORS)
    if info.size < 0:
        raise ValueError(f"a file of {info.size} bytes")
    return _Entry(info.name, info.type, info.size)


def _octal(field: bytes) -> int:
    return int(field.strip(b"\0 "), 8)


def _text(field: bytes) -> str:
    return field.split(b"\0", 1)[0].decode(_ENCODING, _ERRORS)


def _checksum(block: bytes) -> int:
    """Sum a header up, its checksum taken as spaces."""
    return sum(block) - sum(block[148:156]) + 8 * ord(" ")


def _pax_records(data: bytes) -> dict[bytes, bytes]:
    """Read records ``<length> <key>=<value>`` (POSIX.1-2008, pax interchange format)."""
    records, at = {}, 0
    while found := _PAX_RECORD.match(data, at):
        stop = at + int(found[1])
        if not found.end() < stop <= len(data):
            raise ValueError("an extended header that does not fit")
        records[found[2]] = data[found.end() : stop - 1]
        at = stop
    return records


def _extended(header: _Entry, extension: dict[bytes, bytes]) -> _Entry:
    """Apply what the headers before it say of an entry."""
    name = _text(extension[b"path"]) if b"path" in extension else header.name
    sparse = any(key.startswith(b"GNU.sparse") for key in extension)
    size = int(extension.get(b"size", header.size))
    if size < 0:
        raise ValueError(f"a file of {size} bytes")
    return _Entry(name, GNUTYPE_SPARSE if sparse else header.kind, size)


def _take(
    walk: _Walk, entry: _Entry, index: Index, spool: BinaryIO | None, spool_dir: Path
) -> None:
    """Put an entry into the index, if it is a file that can be read."""
    name = clean_name(entry.name)
    if name is None:
        index.ignore(OUTSIDE)
    elif entry.kind == DIRTYPE or not name or is_litter(name):
        return
    elif entry.kind not in _FILES:
        index.ignore(LINK if entry.kind in _LINKS else OTHER)
    elif entry.size > MAX_MEMBER_BYTES:
        index.ignore(TOO_LARGE)
    elif spool is None:
        index.add(name, Member(walk.at, entry.size, entry.size))
    else:
        index.add(name, Member(spool.tell(), entry.size, entry.size))
        _make_room(index, entry.size, spool.tell(), spool_dir)
        for start in range(0, entry.size, _STEP):
            spool.write(walk.read(min(_STEP, entry.size - start)))


def _make_room(index: Index, coming: int, written: int, spool_dir: Path) -> None:
    """Look at the free space now and then, and refuse to fill the disk."""
    if written // _STEP == (written + coming) // _STEP and written:
        return
    free = shutil.disk_usage(spool_dir).free
    if free < coming + _FREE_BYTES_KEPT:
        raise RecordingError(
            index.path,
            f"is packed as a whole, and is unpacked to a temporary file in {spool_dir}, where "
            f"only {free} bytes are free: set TMPDIR to a folder with room, or unpack it and "
            "give its folder",
        )


def _packer_of(path: Path) -> Any:
    with path.open("rb") as file:
        start = file.read(8)
    return next((module for magic, module in _PACKERS.items() if start.startswith(magic)), None)


def _open(path: Path, raw: BinaryIO) -> BinaryIO:
    """Open what a file holds, unpacked as it is read."""
    packer = _packer_of(path)
    return raw if packer is None else cast("BinaryIO", packer.open(raw))
