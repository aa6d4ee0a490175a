"""The files of an archive: their names, where their bytes lie, and what is refused.

An index keeps about 100 bytes a member (`zipfile` and `tarfile` keep 700 and more), so that an
archive of millions of small files is read in bounded memory.
"""

from __future__ import annotations

import re
from array import array
from itertools import zip_longest
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.errors import RecordingError

MAX_MEMBERS = 4_000_000
MAX_MEMBER_BYTES = 1 << 28
MAX_TOTAL_BYTES = 1 << 40
MAX_RATIO, RATIO_FROM_BYTES = 1000, 1 << 30
"""What unpacks to more than this, and to so many times its own size, is a bomb."""

LINK, OUTSIDE, TOO_LARGE, OTHER = "link", "outside", "too large", "other"
_REASONS = {
    LINK: "links",
    OUTSIDE: "names that lead out of it",
    TOO_LARGE: f"files larger than {MAX_MEMBER_BYTES >> 20} MiB",
    OTHER: "things that are neither files nor folders",
}
_LITTER = re.compile(r"(?:^|/)(?:__MACOSX|\.DS_Store|\._[^/]*)(?:/|$)")  # of file managers
_PLAIN = re.compile(r"[^/.:\0][^/:\0]*(?:/[^/.:\0][^/:\0]*)*")
_DRIVE = re.compile(r"[A-Za-z]:")


class Member(NamedTuple):
    """Where the bytes of a file lie, and how they are packed."""

    offset: int
    size: int
    packed: int
    method: int = 0
    crc: int = 0


class Index:
    """The files of an archive by name, and how many entries are not read.

    Parameters
    ----------
    path
        The archive, for messages.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.names: tuple[str, ...] = ()
        self._found: list[str] = []
        self._fields = array("q")  # those of one member after the other
        self._ignored: dict[str, int] = {}
        self._total = 0
        self._order: NDArray[np.int64] = np.zeros(0, np.int64)

    def add(self, name: str, member: Member) -> None:
        """Keep a file.

        Raises
        ------
        RecordingError
            If there are too many, or they declare too many bytes.
        """
        self._found.append(name)
        self._fields.extend(member)
        self._total += member.size
        check_count(self.path, len(self._found))
        if self._total > MAX_TOTAL_BYTES:
            raise RecordingError(
                self.path, f"declares files of more than {MAX_TOTAL_BYTES >> 40} TiB: refused"
            )

    def ignore(self, kind: str) -> None:
        """Count an entry that is not read."""
        self._ignored[kind] = self._ignored.get(kind, 0) + 1

    def finish(self) -> None:
        """Sort by name; of files of one name the last counts, as it would when unpacking."""
        found = self._found
        order = sorted(range(len(found)), key=found.__getitem__)
        last = [
            this
            for this, after in zip_longest(order, order[1:])
            if after is None or found[this] != found[after]
        ]
        self.names = tuple(found[i] for i in last)
        self._order = np.array(last, np.int64)
        self._found = []

    def __getitem__(self, position: int) -> Member:
        """Return the file whose name stands at a position of `names`."""
        at = int(self._order[position]) * len(Member._fields)
        return Member(*self._fields[at : at + len(Member._fields)])

    def spans(self) -> NDArray[np.int64]:
        """Return where packed bytes begin and end, (n, 2) i8, in their order in the archive."""
        fields = np.array(self._fields, np.int64).reshape(-1, len(Member._fields))
        starts, packed = fields[:, 0], fields[:, 2]
        order = np.argsort(starts, kind="stable")
        return np.stack([starts[order], (starts + packed)[order]], axis=1)

    @property
    def notices(self) -> tuple[str, ...]:
        """What was not read, in words."""
        return describe_ignored(self._ignored)


def describe_ignored(ignored: dict[str, int]) -> tuple[str, ...]:
    """Say how many entries of each kind are not read."""
    return tuple(f"not read: {count} {_REASONS[kind]}" for kind, count in sorted(ignored.items()))


def check_count(path: Path, files: int) -> None:
    """Refuse more files than an index may hold."""
    if files > MAX_MEMBERS:
        raise RecordingError(path, f"holds more than {MAX_MEMBERS} files; convert parts of it")


def check_ratio(path: Path, unpacked: int, packed: int) -> None:
    """Refuse what only a bomb unpacks to."""
    if unpacked > RATIO_FROM_BYTES and unpacked > MAX_RATIO * packed:
        raise RecordingError(
            path, f"unpacks to more than {MAX_RATIO} times its {packed} bytes: refused as a bomb"
        )


def clean_name(name: str) -> str | None:
    """Return a member's name without ``./``; None if it leads out of the archive."""
    if _PLAIN.fullmatch(name):
        return name
    parts = name.split("/")
    if name.startswith("/") or _DRIVE.match(name) or "\0" in name or ".." in parts:
        return None
    return "/".join(part for part in parts if part not in ("", "."))


def is_litter(name: str) -> bool:
    """Tell what file managers leave behind, such as ``__MACOSX/``."""
    return _LITTER.search(name) is not None
