"""What differs between two versions of a data set, and which number that calls for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.manifest import FileEntry, Manifest
from semantic2d_dataset.format.splits import SplitScheme

Schemes = Mapping[str, SplitScheme | None]
"""By name; None where a scheme cannot be read any more as it was published."""


class Change(IntEnum):
    """How much differs; the larger, the more users must know of it."""

    NONE = 0
    PATCH = 1
    MINOR = 2
    MAJOR = 3


@dataclass(frozen=True)
class Difference:
    """One thing that differs: how much that changes, and what it is."""

    change: Change
    text: str

    def __str__(self) -> str:
        return f"{self.change.name}: {self.text}"


def compare(
    old: Manifest, new: Manifest, old_schemes: Schemes, new_schemes: Schemes
) -> list[Difference]:
    """Return what differs between two versions, what matters most first.

    Data and splits that existed and are others now, or gone, make a MAJOR change; what was added
    makes a MINOR one; other bytes that hold the same data, a PATCH.

    Parameters
    ----------
    old, new
        Their manifests.
    old_schemes, new_schemes
        Their schemes.
    """
    found = [
        *_sequences(old, new),
        *_schemes(old, new, old_schemes, new_schemes),
        *_packaging(old, new),
    ]
    return sorted(found, key=lambda each: -each.change)


def change_of(differences: list[Difference]) -> Change:
    """Return the largest change."""
    return max((each.change for each in differences), default=Change.NONE)


def next_version(version: str, change: Change) -> str:
    """Return the version number that a change calls for.

    >>> next_version("1.2.3", Change.MINOR)
    '1.3.0'
    """
    major, minor, patch = parse_version(version)
    return {
        Change.NONE: version,
        Change.PATCH: f"{major}.{minor}.{patch + 1}",
        Change.MINOR: f"{major}.{minor + 1}.0",
        Change.MAJOR: f"{major + 1}.0.0",
    }[change]


def parse_version(version: str) -> tuple[int, int, int]:
    """Split a version of a data set into its three numbers.

    Raises
    ------
    InvalidInputError
        If it is none.
    """
    parts = version.split(".")
    if len(parts) != 3 or not all(part.isascii() and part.isdigit() for part in parts):
        raise InvalidInputError(f"data set version {version!r}: expected one like 1.0.0")
    major, minor, patch = map(int, parts)
    return major, minor, patch


def _sequences(old: Manifest, new: Manifest) -> Iterator[Difference]:
    before = {entry.id: entry for entry in old.sequences}
    after = {entry.id: entry for entry in new.sequences}
    for sequence_id in sorted(before.keys() - after.keys()):
        yield Difference(Change.MAJOR, f"sequence {sequence_id} was removed")
    for sequence_id in sorted(before.keys() & after.keys()):
        if before[sequence_id].content_digest != after[sequence_id].content_digest:
            yield Difference(Change.MAJOR, f"sequence {sequence_id} holds other data")
        elif before[sequence_id].sha256 != after[sequence_id].sha256:
            yield Difference(Change.PATCH, f"sequence {sequence_id} is stored otherwise")
    for sequence_id in sorted(after.keys() - before.keys()):
        yield Difference(Change.MINOR, f"sequence {sequence_id} was added")


def _schemes(
    old: Manifest, new: Manifest, old_schemes: Schemes, new_schemes: Schemes
) -> Iterator[Difference]:
    common = {entry.id for entry in old.sequences} & {entry.id for entry in new.sequences}
    for name in sorted(old.splits.keys() - new.splits.keys()):
        yield Difference(Change.MAJOR, f"scheme {name} was removed")
    for name in sorted(old.splits.keys() & new.splits.keys()):
        before, after = old_schemes[name], new_schemes[name]
        if before is None or after is None:
            if old.splits[name].sha256 != new.splits[name].sha256:
                yield Difference(Change.MAJOR, f"scheme {name} is another one than was published")
        elif moved := [i for i in sorted(common) if not _same_members(before, after, i)]:
            yield Difference(
                Change.MAJOR,
                f"scheme {name} divides {len(moved)} sequence(s) otherwise (first: {moved[0]})",
            )
    for name in sorted(new.splits.keys() - old.splits.keys()):
        yield Difference(Change.MINOR, f"scheme {name} was added")


def _same_members(before: SplitScheme, after: SplitScheme, sequence_id: str) -> bool:
    one, other = before.membership.get(sequence_id), after.membership.get(sequence_id)
    if one is None or other is None:
        return one is other
    return np.array_equal(one, other)


def _packaging(old: Manifest, new: Manifest) -> Iterator[Difference]:
    if old.license != new.license:
        yield Difference(Change.PATCH, f"the licence was {old.license}, and is {new.license}")
    before, after = _digests(old.documents), _digests(new.documents)
    for name in sorted(before.keys() | after.keys()):
        if before.get(name) != after.get(name):
            yield Difference(Change.PATCH, f"{name} {_what(name, before, after)}")


def _what(name: str, before: Mapping[str, str], after: Mapping[str, str]) -> str:
    if name not in before:
        return "was added"
    return "says something else" if name in after else "was removed"


def _digests(entries: tuple[FileEntry, ...]) -> dict[str, str]:
    return {entry.file: entry.sha256 for entry in entries}
