"""Which scan belongs to train, validation or test: schemes as data, never as a random generator."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Mapping, Sequence
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

_SHARES = (0.7, 0.1, 0.2)  # train, val, test, as published
_GAP_S = 1.0
_ROUND_S = 300.0
_ROUND_SCANS = 100


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

    @property
    def digest(self) -> str:
        """SHA-256 over the membership of every sequence, hex."""
        digest = hashlib.sha256()
        for sequence_id in sorted(self.membership):
            digest.update(sequence_id.encode() + b"\0" + self.membership[sequence_id].tobytes())
        return digest.hexdigest()


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


def make_block_scheme(
    stamps_ns: Mapping[str, NDArray[np.int64]],
    *,
    gap_s: float = _GAP_S,
    round_s: float = _ROUND_S,
) -> SplitScheme:
    """Divide every recording into contiguous blocks in time with gaps between them.

    A recording is cut into rounds of about `round_s`; in each, 70 % of the time are train, 10 %
    val and 20 % test, with `gap_s` left out wherever one follows another. Which of the three
    comes first changes from recording to recording. All lidars of a recording share its blocks.
    In a recording shorter than ten gaps, a gap is a tenth of it.

    Parameters
    ----------
    stamps_ns
        By sequence id, (N,) i8.
    """
    recordings: dict[str, list[str]] = {}
    for sequence_id in sorted(stamps_ns):
        recordings.setdefault(sequence_id.rsplit("--", 1)[0], []).append(sequence_id)
    membership = {}
    for number, ids in enumerate(recordings.values()):
        scans = [stamps_ns[i] for i in ids if len(stamps_ns[i])]
        first = min((int(s[0]) for s in scans), default=0)
        last = max((int(s[-1]) for s in scans), default=0)
        longest = max(map(len, scans), default=0)
        borders = _block_borders((last - first) / 1e9, longest, number, gap_s, round_s)
        for i in ids:
            membership[i] = _members((stamps_ns[i] - first) / 1e9, borders)
    made_by = f"blocks of rounds of {round_s:g} s, shares {_SHARES}, gaps of {gap_s:g} s"
    return SplitScheme("block", membership, made_by)


def _block_borders(
    span_s: float, scans: int, number: int, gap_s: float, round_s: float
) -> list[tuple[float, float, int]]:
    """Start, stop (s) and split of every block of one recording."""
    # stamps may leap: no more rounds than there are scans for
    rounds = max(1, min(round(span_s / round_s), scans // _ROUND_SCANS))
    gap_s = min(gap_s, span_s / 10)
    usable = max(span_s - (3 * rounds - 1) * gap_s, 0.0) / rounds
    blocks, start = [], 0.0
    for _ in range(rounds):
        for split in ((number + i) % 3 for i in range(3)):
            stop = start + usable * _SHARES[split]
            blocks.append((start, stop, split))
            start = stop + gap_s
    begin, _, split = blocks[-1]
    blocks[-1] = (begin, np.inf, split)  # the last scan, whatever rounding did
    return blocks


def _members(
    times_s: NDArray[np.float64], blocks: list[tuple[float, float, int]]
) -> NDArray[np.uint8]:
    ids = np.full(len(times_s), NONE, np.uint8)
    for start, stop, split in blocks:
        ids[(times_s >= start) & (times_s < stop)] = split
    return ids


def make_environment_scheme(
    lengths: Mapping[str, int],
    *,
    val: Collection[str] | None = None,
    test: Collection[str] | None = None,
) -> SplitScheme:
    """Hold whole environments out.

    Without a choice, environments are ordered by the SHA-256 of their names; the first tenth
    (at least one) are val, the next fifth (at least one) test.

    Parameters
    ----------
    lengths
        Number of scans by sequence id.
    val, test
        Environments to hold out.

    Raises
    ------
    InvalidInputError
        If a named environment does not exist, or there are fewer than three to choose from.
    """
    found = sorted({i.split("--", 1)[0] for i in lengths}, key=_hash_of)
    if len(found) < 3:
        raise InvalidInputError(
            f"an environment scheme needs at least 3 environments, found {sorted(found)}"
        )
    if val is None:
        free = [name for name in found if name not in (test or ())]
        val = free[: max(1, round(len(found) * _SHARES[VAL]))]
    if test is None:
        free = [name for name in found if name not in val]
        test = free[: max(1, round(len(found) * _SHARES[TEST]))]
    if {*val} & {*test}:
        raise InvalidInputError(f"environments both in val and test: {sorted({*val} & {*test})}")
    unknown = {*val, *test} - set(found)
    if unknown:
        raise InvalidInputError(
            f"unknown environments {sorted(unknown)}; known are {sorted(found)}"
        )
    membership = {
        i: np.full(n, _held_out(i.split("--", 1)[0], val, test), np.uint8)
        for i, n in lengths.items()
    }
    return SplitScheme(
        "environment", membership, f"val {', '.join(sorted(val))}; test {', '.join(sorted(test))}"
    )


def _held_out(environment: str, val: Collection[str], test: Collection[str]) -> int:
    if environment in test:
        return TEST
    return VAL if environment in val else TRAIN


def _hash_of(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def make_frame_scheme(lengths: Mapping[str, int], *, seed: int) -> SplitScheme:
    """Divide single scans at random as the published lists do, 70 / 10 / 20 in each sequence.

    Scans 50 ms apart fall into train and test: use it to compare with published figures only.

    Parameters
    ----------
    lengths
        Number of scans by sequence id.
    seed
        Seed of the permutation; the result is stored, never the seed alone.
    """
    membership = {}
    for number, sequence_id in enumerate(sorted(lengths)):
        n = lengths[sequence_id]
        order = np.random.default_rng((seed, number)).permutation(n)
        ids = np.full(n, TRAIN, np.uint8)
        n_test, n_val = round(n * _SHARES[TEST]), round(n * _SHARES[VAL])
        ids[order[:n_test]] = TEST
        ids[order[n_test : n_test + n_val]] = VAL
        membership[sequence_id] = ids
    return SplitScheme("frame", membership, f"single scans at random, seed {seed}")


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


def schemes_of(stamps_ns: Mapping[str, NDArray[np.int64]]) -> Sequence[SplitScheme]:
    """Make every standard scheme that these sequences allow: block, frame, environment."""
    lengths = {i: len(stamps) for i, stamps in stamps_ns.items()}
    schemes = [make_block_scheme(stamps_ns), make_frame_scheme(lengths, seed=0)]
    if len({i.split("--", 1)[0] for i in lengths}) >= 3:
        schemes.append(make_environment_scheme(lengths))
    return schemes
