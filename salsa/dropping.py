"""Take scans out of a labelled sequence that somebody looked at and found wrong."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from salsa.sequences import sha256_of
from semantic2d_dataset.errors import CorruptFileError, InvalidInputError
from semantic2d_dataset.format.drop_lists import format_ranges, parse_range, read_lines
from semantic2d_dataset.format.schema import CHUNK_ROWS
from semantic2d_dataset.format.sequence import SequenceReader, SequenceWriter
from semantic2d_dataset.format.writing import check_target
from semantic2d_dataset.scene.taxonomy import UNLABELLED

Indices = NDArray[np.int64]

_BLOCK = 8 * CHUNK_ROWS  # scans
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
    ranges = [parse_range(text, scans, where) for where, text in read_lines(path)]
    if not ranges:
        raise InvalidInputError(f"{path}: names no scan to drop")
    return np.unique(np.concatenate([np.arange(first, last + 1) for first, last in ranges]))


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
            first, last = parse_range(line, len(reader), "salsa.dropped")
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
            "source": {"name": source.name, "sha256": sha256_of(source)},
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
