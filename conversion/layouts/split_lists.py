"""The lists of a published layout that say which scan is for training, validation or test."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.format.splits import NONE, split_id

_ENDING = ".npy"


@dataclass(frozen=True)
class ListCheck:
    """What lists make of the scans of a session, and what is wrong with them.

    Parameters
    ----------
    members
        (N,) u1 by scan: 0 train, 1 val, 2 test, 255 none. A scan in several lists belongs to
        test before val, and to val before train, so that none is trained on that is tested on.
    overlapping, left_out
        Scans in several lists, and in none.
    missing
        Listed files that do not exist.
    repeated
        Files that one list names more than once.
    """

    members: NDArray[np.uint8]
    overlapping: tuple[str, ...]
    left_out: tuple[str, ...]
    missing: tuple[str, ...]
    repeated: tuple[str, ...]

    @property
    def notices(self) -> tuple[str, ...]:
        """What is wrong, in words."""
        found = (
            (self.overlapping, "scans are in several lists: test counts before val before train"),
            (self.missing, "files are listed and do not exist"),
            (self.left_out, "scans are in no list"),
        )
        return tuple(f"lists: {len(n)} {what} (first: {n[0]})" for n, what in found if n)


def frame_members(lists: Mapping[str, bytes], names: Sequence[str]) -> NDArray[np.uint8]:
    """Return what lists make of each scan, (N,) u1: 0 train, 1 val, 2 test, 255 none.

    Parameters
    ----------
    lists
        Contents of the lists by name: ``train``, ``dev`` or ``val``, ``test``; a file name a line.
    names
        File names of the scans.

    Raises
    ------
    InvalidInputError
        If a list has another name.
    """
    return check_lists(lists, names).members


def check_lists(lists: Mapping[str, bytes], names: Sequence[str]) -> ListCheck:
    """Return what lists make of each scan, and what is wrong with them; as `frame_members`."""
    listed = {name: _file_names(content) for name, content in lists.items()}
    position = {name: n for n, name in enumerate(names)}
    members = np.full(len(names), NONE, np.uint8)
    for split in sorted(lists, key=split_id):
        members[[position[name] for name in listed[split] if name in position]] = split_id(split)
    times = Counter(name for each in listed.values() for name in set(each))
    return ListCheck(
        members=members,
        overlapping=_where(names, (times[name] > 1 for name in names)),
        left_out=_where(names, (times[name] == 0 for name in names)) if lists else (),
        missing=tuple(name for name in times if name not in position),
        repeated=tuple(
            name for each in listed.values() for name, n in Counter(each).items() if n > 1
        ),
    )


def _file_names(content: bytes) -> list[str]:
    """Return the file names that a list holds, whatever its line ends; folders are left out."""
    lines = (line.strip() for line in content.decode("utf-8", "replace").splitlines())
    names = (line.replace("\\", "/").rsplit("/", 1)[-1] for line in lines if line)
    return [name if name.endswith(_ENDING) else f"{name}{_ENDING}" for name in names]


def _where(names: Sequence[str], which: Iterable[bool]) -> tuple[str, ...]:
    return tuple(name for name, chosen in zip(names, which, strict=True) if chosen)
