"""Take scans out of a labelled sequence that somebody looked at and found wrong."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from salsa.sequences import check_target
from semantic2d_dataset.errors import CorruptFileError, InvalidInputError
from semantic2d_dataset.format.schema import CHUNK_ROWS
from semantic2d_dataset.format.sequence import SequenceReader, SequenceWriter
from semantic2d_dataset.scene.taxonomy import UNLABELLED

Indices = NDArray[np.int64]

_BLOCK = 8 * CHUNK_ROWS  # scans
_LINE = re.compile(r"(\d{1,18})(?:\s*-\s*(\d{1,18}))?", re.ASCII)
_CLEARED = {"scans/labels": UNLABELLED, "scans/confidence": 0, "alignment/accepted": 0}


def read_drop_list(path: Path, scans: int) -> Indices:
    """Read which scans to drop: an index or a range ``start-stop`` a line, ``#`` comments.

    Parameters
    ----------
    path
        The text file; both ends of a range are dropped.
    scans
        How many scans the sequence has.

    Returns
    -------
    Each index once, in order, (K,) i8.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    InvalidInputError
        If a line is neither, names a scan that there is not, or there is none to drop.
    """
    path = Path(path)
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as err:
        raise InvalidInputError(f"{path}: expected a text file in UTF-8: {err}") from err
    ranges = []
    for number, line in enumerate(lines, start=1):
        text = line.partition("#")[0].strip()
        if text:
            ranges.append(_range_of(text, scans, f"{path}, line {number}"))
    if not ranges:
        raise InvalidInputError(f"{path}: names no scan to drop")
    return np.unique(np.concatenate([np.arange(first, last + 1) for first, last in ranges]))


def _range_of(text: str, scans: int, where: str) -> tuple[int, int]:
    match = _LINE.fullmatch(text)
    if match is None:
        raise InvalidInputError(
            f"{where}: expected the index of a scan, such as 12, or a range, such as 12-30, "
            f"found {text[:60]!r}"
        )
    first, last = int(match[1]), int(match[2] or match[1])
    if last < first:
        raise InvalidInputError(f"{where}: expected a range from low to high, found {text!r}")
    if last >= scans:
        raise InvalidInputError(
            f"{where}: the sequence has {scans} scans, from 0 to {scans - 1}; found {text!r}"
        )
    return first, last


def format_ranges(scans: ArrayLike) -> list[str]:
    """Write indices as lines of a drop list.

    >>> format_ranges([7, 3, 4, 5])
    ['3-5', '7']
    """
    ordered = np.unique(np.asarray(scans, np.int64))
    if not ordered.size:
        return []
    runs = np.split(ordered, np.flatnonzero(np.diff(ordered) > 1) + 1)
    return [f"{run[0]}-{run[-1]}" if len(run) > 1 else str(run[0]) for run in runs]


def dropped_before(reader: SequenceReader) -> NDArray[np.bool_]:
    """Tell which scans `drop_scans` took out of a sequence, (N,) bool.

    Raises
    ------
    CorruptFileError
        If its provenance does not say it as `drop_scans` does.
    """
    mask = np.zeros(len(reader), np.bool_)
    try:
        drops = dict(reader.header.provenance.get("salsa", {})).get("dropped", [])
        for line in (line for drop in drops for line in drop["scans"]):
            first, last = _range_of(line, len(reader), "salsa.dropped")
            mask[first : last + 1] = True
    except (KeyError, TypeError, ValueError) as err:
        raise CorruptFileError(f"{reader.path}: provenance: {err}") from err
    return mask


def drop_scans(source: Path, scans: ArrayLike, out: Path, *, force: bool = False) -> None:
    """Write a copy of a labelled sequence in which some scans are not accepted.

    Their labels become 255, their confidence 0; everything else stays, and the provenance says
    which were dropped from which file.

    Parameters
    ----------
    source
        A sequence that `salsa.sequences.label_sequence` wrote.
    scans
        (K,) indices.
    out
        The file to write.
    force
        Replace `out` where it exists.

    Raises
    ------
    FileNotFoundError, CorruptFileError, InvalidInputError
        If the source is missing or not labelled, has no such scans, or `out` exists or is it.
    WriteError
        If `out` cannot be written.
    """
    source, out = Path(source), Path(out)
    check_target(out, (source,), force=force)
    with SequenceReader(source) as reader:
        dropped = _mask(scans, len(reader), source)
        missing = [name for name in _CLEARED if name not in reader]
        if missing:
            raise InvalidInputError(f"{source}: has no {', '.join(missing)}; label it first")
        dropped_before(reader)  # refuses a provenance that cannot be added to
        drop = {
            "source": {"name": source.name, "sha256": _sha256(source)},
            "scans": format_ranges(np.flatnonzero(dropped)),
        }
        header = replace(reader.header, provenance=_with_drop(reader.header.provenance, drop))
        with SequenceWriter(out, header) as writer:
            for name, value in _CLEARED.items():
                _copy_cleared(reader, writer, name, dropped, value)
            writer.copy(reader, _others(reader))
            scene = reader.read_map()
            if scene is not None:
                writer.set_map(scene)


def _mask(scans: ArrayLike, count: int, source: Path) -> NDArray[np.bool_]:
    """Which scans to drop, (N,) bool."""
    wanted = np.asarray(scans)
    if wanted.ndim != 1 or not wanted.size or wanted.dtype.kind not in "iu":
        raise InvalidInputError(
            f"scans to drop: expected at least one index, (K,) integers, found {wanted.dtype} "
            f"{wanted.shape}"
        )
    outside = wanted[(wanted < 0) | (wanted >= count)]
    if outside.size:
        raise InvalidInputError(
            f"{source}: has {count} scans, from 0 to {count - 1}, so none to drop with index "
            f"{', '.join(map(str, outside[:10].tolist()))}"
        )
    mask = np.zeros(count, np.bool_)
    mask[wanted] = True
    return mask


def _with_drop(provenance: Mapping[str, Any], drop: Mapping[str, Any]) -> dict[str, Any]:
    said = dict(provenance.get("salsa", {}))
    return {**provenance, "salsa": said | {"dropped": [*said.get("dropped", []), drop]}}


def _copy_cleared(
    reader: SequenceReader,
    writer: SequenceWriter,
    name: str,
    dropped: NDArray[np.bool_],
    value: int,
) -> None:
    for start in range(0, len(reader), _BLOCK):
        rows = reader.read(name, start, start + _BLOCK)
        rows[dropped[start : start + _BLOCK]] = value
        writer.append({name: rows})


def _others(reader: SequenceReader) -> list[str]:
    return [
        name
        for name in reader.names
        if name not in _CLEARED and name != "provenance" and not name.startswith("map/")
    ]


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
