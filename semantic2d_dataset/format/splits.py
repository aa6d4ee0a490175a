"""Which scan belongs to train, validation or test: membership is data, never a generator."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.errors import CorruptFileError, InvalidInputError
from semantic2d_dataset.format.container import ContainerReader
from semantic2d_dataset.format.schema import SPLITS
from semantic2d_dataset.format.writing import ContainerWriter, root_attributes

TRAIN, VAL, TEST, NONE = 0, 1, 2, 255
SPLIT_IDS = MappingProxyType({"train": TRAIN, "val": VAL, "dev": VAL, "test": TEST})

BY_LISTS = "the lists of the source"
"""What the `frame` scheme says that was made of the lists of a published layout."""


@dataclass(frozen=True)
class SplitScheme:
    """One way to divide a data set.

    Parameters
    ----------
    name
        ``block``, ``frame``, ``environment`` or a name of one's own.
    membership
        By sequence id, (N,) u1: 0 train, 1 val, 2 test, 255 none.
    made_by
        How it was made, for people.
    """

    name: str
    membership: Mapping[str, NDArray[np.uint8]]
    made_by: str

    def __post_init__(self) -> None:
        for sequence_id, ids in self.membership.items():
            if not np.isin(ids, (TRAIN, VAL, TEST, NONE)).all():
                raise InvalidInputError(
                    f"scheme {self.name}: {sequence_id}: expected only 0 train, 1 val, 2 test, "
                    "255 none"
                )

    def scans_of(self, sequence_id: str, split: str) -> NDArray[np.int64]:
        """Return the indices (n,) i8 of the scans of a sequence that belong to a split.

        Raises
        ------
        InvalidInputError
            If the split is unknown, or the scheme does not know the sequence.
        """
        wanted = split_id(split)
        if sequence_id not in self.membership:
            raise InvalidInputError(f"scheme {self.name} does not cover {sequence_id}")
        return np.flatnonzero(self.membership[sequence_id] == wanted)

    def neighbour_share(self, split: str) -> float:
        """Return the share of the scans of a split before or after which a train scan lies."""
        next_to = [
            is_next_to(ids == TRAIN)[self.scans_of(name, split)]
            for name, ids in self.membership.items()
        ]
        found = np.concatenate([np.zeros(0, np.bool_), *next_to])
        return float(found.mean()) if found.size else 0.0

    @property
    def sizes(self) -> dict[str, int]:
        """Number of scans of train, val and test, and of those in none."""
        ids = {"train": TRAIN, "val": VAL, "test": TEST, "none": NONE}
        counts = sum(
            (np.bincount(each, minlength=256) for each in self.membership.values()),
            np.zeros(256, np.int64),
        )
        return {name: int(counts[i]) for name, i in ids.items()}

    @property
    def digest(self) -> str:
        """SHA-256 over the membership of every sequence, hex."""
        digest = hashlib.sha256()
        for sequence_id in sorted(self.membership):
            digest.update(sequence_id.encode() + b"\0" + self.membership[sequence_id].tobytes())
        return digest.hexdigest()


def is_next_to(these: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Tell (N,) whether the scan before or after a scan is one of these."""
    padded = np.pad(these, 1)
    neighbours: NDArray[np.bool_] = padded[:-2] | padded[2:]
    return neighbours


def split_id(split: str) -> int:
    """Return the id of a split by its name; ``dev`` is ``val``.

    Raises
    ------
    InvalidInputError
        If there is no such split.
    """
    if split not in SPLIT_IDS:
        raise InvalidInputError(f"unknown split {split!r}; known are {', '.join(SPLIT_IDS)}")
    return SPLIT_IDS[split]


def write_scheme(path: Path, scheme: SplitScheme) -> None:
    """Write a scheme as ``splits/<scheme>.h5``."""
    said = root_attributes(SPLITS, scheme=scheme.name, made_by=scheme.made_by)
    with ContainerWriter(path, SPLITS, {"": said}) as writer:
        writer.append({f"membership/{i}": ids for i, ids in sorted(scheme.membership.items())})


def read_scheme(path: Path, name: str, lengths: Mapping[str, int]) -> SplitScheme:
    """Read a scheme and check its name, and the number of scans of each sequence.

    Raises
    ------
    CorruptFileError, UnsafeFileError, FormatVersionError, FileNotFoundError
        If the file is not a good scheme for these sequences.
    """
    with ContainerReader(path, SPLITS) as reader:
        said = reader.attributes()
        membership = {each.removeprefix("membership/"): reader.read(each) for each in reader.names}
    if said.get("scheme") != name:
        raise CorruptFileError(f"{path}: expected the scheme {name}, found {said.get('scheme')}")
    for sequence_id, ids in membership.items():
        if len(ids) != lengths.get(sequence_id):
            raise CorruptFileError(
                f"{path}: {sequence_id}: {len(ids)} members for a sequence of "
                f"{lengths.get(sequence_id, 'no')} scans"
            )
    try:
        return SplitScheme(name, membership, str(said.get("made_by", "")))
    except InvalidInputError as err:
        raise CorruptFileError(f"{path}: not a valid scheme: {err}") from err
