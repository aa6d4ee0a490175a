"""What of a sequence a data set, or another sequence, has already."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from semantic2d_dataset.format.schema import CHUNK_ROWS
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.publishing.findings import ERROR, NOTE, WARNING, Finding

Hashes = NDArray[np.uint64]

_BLOCK = 16 * CHUNK_ROWS
_SEED = 2024
_SAME_SCANS = 0.01
_ADVICE = "leave it out: the same scans in train and test make results too good"


@dataclass(frozen=True)
class Print:
    """What tells a sequence from others.

    Parameters
    ----------
    path, id, content_digest, environment, recording, lidar, stamps_source
        As in its file.
    span_ns
        First and last stamp; None without scans.
    beams
        Number of beams.
    hashes
        (n,) u8 of the ranges of each scan that has a return.
    """

    path: Path
    id: str
    content_digest: str
    environment: str
    recording: str
    lidar: str
    stamps_source: str
    span_ns: tuple[int, int] | None
    beams: int
    hashes: Hashes


def print_of(
    path: Path, content_digest: str | None = None, beams: Collection[int] | None = None
) -> Print:
    """Read what tells a sequence from others.

    Parameters
    ----------
    path
        Its file.
    content_digest
        Where it is known already.
    beams
        Scans of so many beams are hashed; all where not given.

    Raises
    ------
    CorruptFileError, UnsafeFileError
        If the file cannot be read.
    """
    with SequenceReader(path) as reader:
        header, stamps = reader.header, reader.read("scans/stamps_ns")
        is_wanted = beams is None or header.lidar.beams in beams
        hashes = [np.zeros(0, np.uint64), *(_hashes(reader) if is_wanted else ())]
        return Print(
            path=path,
            id=header.sequence_id,
            content_digest=content_digest or reader.content_digest(),
            environment=header.environment,
            recording=header.recording,
            lidar=header.lidar.name,
            stamps_source=header.stamps_source,
            span_ns=(int(stamps[0]), int(stamps[-1])) if len(stamps) else None,
            beams=header.lidar.beams,
            hashes=np.concatenate(hashes),
        )


def prints_of(
    digests: Mapping[Path, str | None], beams: Collection[int] | None = None
) -> list[Print]:
    """Read what tells each sequence from others; arguments as of `print_of`."""
    bar = tqdm(digests.items(), desc="reading scans", unit="file", disable=None, leave=False)
    return [print_of(path, digest, beams) for path, digest in bar]


def find_overlap(one: Print, others: Collection[Print]) -> list[Finding]:
    """Compare a sequence with others."""
    findings: list[Finding] = []
    for other in others:
        findings += _copies(one, other)
    return [*findings, *_times(one, others), *_places(one, others)]


def _copies(one: Print, other: Print) -> Iterator[Finding]:
    where = str(one.path)
    if one.content_digest == other.content_digest:
        yield Finding(ERROR, where, f"holds the same data as {other.path}", "new data", _ADVICE)
        return
    if one.id == other.id:
        yield Finding(
            ERROR,
            where,
            f"is named {one.id}, as {other.path} is",
            "a name of its own",
            "name the recording otherwise; a corrected version belongs in its place instead",
        )
    shared = _shared(one, other)
    if shared:
        share = shared / len(one.hashes)
        yield Finding(
            ERROR if share > _SAME_SCANS else WARNING,
            where,
            f"{shared} scans ({share:.1%}) have the ranges of scans in {other.path}",
            "new scans",
            _ADVICE,
        )


def _times(one: Print, others: Collection[Print]) -> Iterator[Finding]:
    same = [other for other in others if _overlaps_in_time(one, other)]
    if same:
        yield Finding(
            WARNING,
            str(one.path),
            f"was recorded at the time of {_first(same)}, by a lidar of the same name",
            "one recording at a time by one lidar",
            "look whether both are of one recording, or a clock is wrong; nothing if there are two",
        )


def _places(one: Print, others: Collection[Print]) -> Iterator[Finding]:
    known = [other for other in others if other.environment == one.environment]
    together = [o for o in known if o.recording == one.recording and o.lidar != one.lidar]
    apart = [o for o in known if o.recording != one.recording]
    if together:
        yield Finding(
            NOTE,
            str(one.path),
            f"is of the recording of {_first(together)}, by another lidar",
            "the same split for both",
            "nothing: block keeps them together; do not split them by hand",
        )
    if apart:
        yield Finding(
            NOTE,
            str(one.path),
            f"is of the environment of {_first(apart)}",
            "one name for one place",
            "nothing if it is the same place: the environment scheme keeps them together",
        )


def _first(prints: Sequence[Print]) -> str:
    more = f" and {len(prints) - 1} more" if len(prints) > 1 else ""
    return f"{prints[0].path}{more}"


def _shared(one: Print, other: Print) -> int:
    """Count scans of one that the other has too."""
    if one.beams != other.beams or not len(one.hashes):
        return 0
    return int(np.isin(one.hashes, other.hashes).sum())


def _overlaps_in_time(one: Print, other: Print) -> bool:
    if one.lidar != other.lidar or one.span_ns is None or other.span_ns is None:
        return False
    measured = "synthetic" not in (one.stamps_source, other.stamps_source)
    return measured and one.span_ns[0] <= other.span_ns[1] and other.span_ns[0] <= one.span_ns[1]


def _hashes(reader: SequenceReader) -> Iterator[Hashes]:
    """Hash the ranges of each scan that has a return: sums of bits by odd random numbers."""
    rng = np.random.default_rng(_SEED)
    factors = rng.integers(0, 1 << 63, reader.lidar.beams, np.uint64) * np.uint64(2) + np.uint64(1)
    for start in range(0, len(reader), _BLOCK):
        ranges = reader.read("scans/ranges", start, start + _BLOCK)
        ranges = ranges[reader.lidar.has_return(ranges).any(axis=1)]
        bits = np.ascontiguousarray(ranges).view(np.uint32).astype(np.uint64)
        mixed = (bits ^ (bits << np.uint64(17))) * factors
        yield (mixed ^ (mixed >> np.uint64(29))).sum(axis=1, dtype=np.uint64)
