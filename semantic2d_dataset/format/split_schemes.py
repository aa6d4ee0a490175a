"""The standard ways to divide a data set: by blocks, frames, environments and lidars."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.splits import NONE, TEST, TRAIN, VAL, SplitScheme
from semantic2d_dataset.scene.documents import hint
from semantic2d_dataset.scene.lidars import full_name

_SHARES = (0.7, 0.1, 0.2)  # train, val, test, as published
_GAP_S = 1.0
_ROUND_S = 300.0
_ROUND_SCANS = 100


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


def make_lidar_scheme(
    stamps_ns: Mapping[str, NDArray[np.int64]],
    *,
    train: Collection[str] | None = None,
    test: Collection[str] | None = None,
    gap_s: float = _GAP_S,
    round_s: float = _ROUND_S,
) -> SplitScheme:
    """Train on some lidars, test on others; time and place are shared.

    Of the train lidars, train and val are those of the block scheme, and its test blocks belong
    to no split: a model that was trained on `block` was trained on this scheme too, and is
    chosen without a look at the test lidars. Every scan of a test lidar is test.

    Without a choice, lidars are ordered by the SHA-256 of their names, and the last fifth (at
    least one) is tested; where one list is given, the other has the lidars that remain.

    Parameters
    ----------
    stamps_ns
        By sequence id, (N,) i8.
    train, test
        Ids or short names of lidars; those in neither list belong to no split.
    gap_s, round_s
        As for `make_block_scheme`.

    Raises
    ------
    InvalidInputError
        If a named lidar does not exist or is in both lists, or one of them has none.
    """
    found = sorted({_lidar_of(i) for i in stamps_ns}, key=_hash_of)
    if len(found) < 2:
        raise InvalidInputError(
            f"a lidar scheme needs at least 2 lidars, found {', '.join(found) or 'none'}"
        )
    trained = None if train is None else _known_lidars(train, found)
    tested = None if test is None else _known_lidars(test, found)
    if tested is None:
        left = [name for name in found if name not in (trained or ())]
        tested = left if trained else left[-max(1, round(len(found) * _SHARES[TEST])) :]
    if trained is None:
        trained = [name for name in found if name not in tested]
    if {*trained} & {*tested} or not trained or not tested:
        raise InvalidInputError(
            "a lidar scheme trains on some lidars and tests on others, found "
            f"train {', '.join(sorted(trained)) or 'none'} and "
            f"test {', '.join(sorted(tested)) or 'none'}"
        )
    block = make_block_scheme(stamps_ns, gap_s=gap_s, round_s=round_s)
    membership = {
        i: _of_lidar(_lidar_of(i), trained, tested, ids) for i, ids in block.membership.items()
    }
    made_by = (
        f"train {', '.join(sorted(trained))}; test {', '.join(sorted(tested))}; train and val of "
        f"the train lidars are {block.made_by}"
    )
    return SplitScheme("lidar", membership, made_by)


def _of_lidar(
    name: str, train: Collection[str], test: Collection[str], block: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """Return the members of one sequence by its lidar and what the block scheme makes of it."""
    if name in test:
        return np.full(len(block), TEST, np.uint8)
    if name in train:
        return np.where(block == TEST, np.uint8(NONE), block)
    return np.full(len(block), NONE, np.uint8)


def _lidar_of(sequence_id: str) -> str:
    return sequence_id.rsplit("--", 1)[-1]


def _known_lidars(names: Collection[str], found: Collection[str]) -> list[str]:
    full = [name if name in found else full_name(name) for name in names]
    for name, each in zip(names, full, strict=True):
        if each not in found:
            raise InvalidInputError(f"no sequence of the lidar {name!r}{hint(name, found)}")
    return full


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


def schemes_of(stamps_ns: Mapping[str, NDArray[np.int64]]) -> Sequence[SplitScheme]:
    """Make every standard scheme that these sequences allow: block, frame, environment, lidar."""
    lengths = {i: len(stamps) for i, stamps in stamps_ns.items()}
    schemes = [make_block_scheme(stamps_ns), make_frame_scheme(lengths, seed=0)]
    if len({i.split("--", 1)[0] for i in lengths}) >= 3:
        schemes.append(make_environment_scheme(lengths))
    if len({_lidar_of(i) for i in lengths}) >= 2:
        schemes.append(make_lidar_scheme(stamps_ns))
    return schemes
