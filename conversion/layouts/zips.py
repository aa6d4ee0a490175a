"""Zip archives: the central directory as an index, and members read by their place in it."""

from __future__ import annotations

import os
import stat
import struct
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO, NamedTuple

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

MAGIC = (b"PK\x03\x04", b"PK\x05\x06")

# PKWARE's APPNOTE.TXT 6.3, sections 4.3.7 (local), 4.3.12 (central), 4.3.14 to 4.3.16 (end)
_LOCAL = struct.Struct("<4s5H3I2H")
_CENTRAL = struct.Struct("<4s6H3I5H2I")
_END = struct.Struct("<4s4H2IH")
_LOCATOR = struct.Struct("<4sIQI")
_END_64 = struct.Struct("<4sQ2H2I4Q")
_LONGEST_COMMENT = 0xFFFF
_IN_EXTRA = 0xFFFFFFFF
_EXTRA_64 = 1
_ENCRYPTED, _UTF8 = 1, 1 << 11
_STORED, _DEFLATED = 0, 8
_DAMAGED = "truncated or damaged, or no zip archive"


class _Directory(NamedTuple):
    entries: int
    size: int
    offset: int
    shift: int
    """How many bytes stand before the archive."""


class _Entry(NamedTuple):
    name: str
    member: Member
    flags: int
    mode: int


def index_zip(path: Path, file: BinaryIO) -> Index:
    """List the files of a zip archive.

    Raises
    ------
    RecordingError
        If it is damaged, encrypted, in several parts, or a bomb.
    """
    size = os.fstat(file.fileno()).st_size
    try:
        index = _read_index(path, file, _find_directory(path, file, size))
    except (struct.error, UnicodeDecodeError, OverflowError) as err:
        raise RecordingError(path, f"{_DAMAGED} ({err}); get it again") from err
    index.finish()
    spans = index.spans()
    if (spans[1:, 0] < spans[:-1, 1]).any() or (spans > size).any() or (spans < 0).any():
        raise RecordingError(path, "its members overlap or lie outside it: refused as a bomb")
    return index


def read_zipped(path: Path, descriptor: int, name: str, member: Member) -> bytes:
    """Read a file of a zip archive, and check its size and CRC.

    Raises
    ------
    RecordingError
        If it is damaged, or packed in a way that is not known.
    """
    try:
        head = _LOCAL.unpack(os.pread(descriptor, _LOCAL.size, member.offset))
    except struct.error as err:
        raise RecordingError(path, f"{name}: {_DAMAGED}; get it again") from err
    start = member.offset + _LOCAL.size + head[-2] + head[-1]
    packed = os.pread(descriptor, member.packed, start)
    if head[0] != MAGIC[0] or len(packed) != member.packed:
        raise RecordingError(path, f"{name}: {_DAMAGED}; get it again")
    if member.method not in (_STORED, _DEFLATED):
        raise RecordingError(
            path,
            f"{name}: is packed by method {member.method}; only stored and deflated members are "
            "read: unpack the archive, and give its folder",
        )
    content = packed if member.method == _STORED else _inflate(path, name, packed, member.size)
    if len(content) != member.size or zlib.crc32(content) != member.crc:
        raise RecordingError(path, f"{name}: damaged: its size or CRC do not fit; get it again")
    return content


def _inflate(path: Path, name: str, packed: bytes, size: int) -> bytes:
    try:
        return zlib.decompressobj(-zlib.MAX_WBITS).decompress(packed, size + 1)
    except zlib.error as err:
        raise RecordingError(path, f"{name}: damaged ({err}); get it again") from err


def _find_directory(path: Path, file: BinaryIO, size: int) -> _Directory:
    start = max(0, size - _LONGEST_COMMENT - _END.size - _END_64.size - _LOCATOR.size)
    file.seek(start)
    tail = file.read()
    at = tail.rfind(MAGIC[1])
    if at < 0 or len(tail) < at + _END.size:
        raise RecordingError(path, f"{_DAMAGED}: it has no directory; get it again")
    _, disk, first_disk, _, entries, length, offset, _ = _END.unpack_from(tail, at)
    end = start + at
    locator = tail[max(0, at - _LOCATOR.size) : at]
    if len(locator) == _LOCATOR.size and locator.startswith(b"PK\x06\x07"):
        end -= _LOCATOR.size + _END_64.size
        file.seek(max(end, 0))
        said = _END_64.unpack(file.read(_END_64.size))
        disk, first_disk, entries, length, offset = *said[4:6], *said[7:10]
    if disk or first_disk:
        raise RecordingError(path, "is one of several parts of an archive: join them first")
    shift = end - length - offset
    if shift < 0:
        raise RecordingError(path, f"{_DAMAGED}: its directory does not fit; get it again")
    return _Directory(entries, length, offset, shift)


def _read_index(path: Path, file: BinaryIO, directory: _Directory) -> Index:
    index, unpacked = Index(path), 0
    for entry in _entries(file, directory):
        name, mode = clean_name(entry.name), stat.S_IFMT(entry.mode)
        if entry.flags & _ENCRYPTED:
            raise RecordingError(
                path, f"{entry.name}: is encrypted: unpack it, and give its folder"
            )
        if name is None:
            index.ignore(OUTSIDE)
        elif entry.name.endswith("/") or is_litter(name):
            continue
        elif mode not in (0, stat.S_IFREG):
            index.ignore(LINK if mode == stat.S_IFLNK else OTHER)
        elif entry.member.size > MAX_MEMBER_BYTES:
            index.ignore(TOO_LARGE)
        else:
            unpacked += entry.member.size
            index.add(name, entry.member)
    check_ratio(path, unpacked, os.fstat(file.fileno()).st_size)
    return index


def _entries(file: BinaryIO, directory: _Directory) -> Iterator[_Entry]:
    file.seek(directory.offset + directory.shift)
    left = directory.size
    for _ in range(directory.entries):
        head = _CENTRAL.unpack(file.read(_CENTRAL.size))
        _, version, _, flags, method, _, _, crc, packed, size, *lengths = head[:13]
        rest = file.read(sum(lengths))
        left -= _CENTRAL.size + len(rest)
        if head[0] != b"PK\x01\x02" or len(rest) < sum(lengths) or left < 0:
            raise struct.error("its directory is cut off")
        raw, extra = rest[: lengths[0]], rest[lengths[0] : sum(lengths[:2])]
        name = raw.decode("utf-8" if flags & _UTF8 else "cp437").replace("\\", "/")
        size, packed, offset = _widen(extra, size, packed, head[16])
        member = Member(offset + directory.shift, size, packed, method, crc)
        yield _Entry(name, member, flags, _mode(version, head[15]))


def _mode(version: int, attributes: int) -> int:
    """Return the file mode that an archiver of Unix kept, 0 of any other."""
    return attributes >> 16 if version >> 8 == 3 else 0


def _widen(extra: bytes, *values: int) -> Sequence[int]:
    """Replace sizes and the offset that do not fit 32 bits by those of the ZIP64 field."""
    wide = iter(())
    if _IN_EXTRA not in values:
        return values
    at = 0
    while at + 4 <= len(extra):
        kind, length = struct.unpack_from("<2H", extra, at)
        if kind == _EXTRA_64:
            count = min(length, len(extra) - at - 4) // 8
            wide = iter(struct.unpack_from(f"<{count}Q", extra, at + 4))
            break
        at += 4 + length
    return [next(wide, value) if value == _IN_EXTRA else value for value in values]
