"""What differs between two versions of one sequence, a block of scans at a time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.format.schema import CHUNK_ROWS
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.scene.taxonomy import UNLABELLED, Taxonomy

LABELS, RANGES = "scans/labels", "scans/ranges"
_BLOCK = 8 * CHUNK_ROWS
_POSES = ("poses/initial", "poses/refined")

Counts = NDArray[np.int64]


@dataclass(frozen=True)
class SequenceDiff:
    """What differs in a sequence that both versions have.

    Parameters
    ----------
    id
        Its id.
    texts
        What differs, in words.
    relabelled
        Beams whose label differs, by the names of the old and the new class.
    beams
        Beams that were compared; 0 where the labels cannot be.
    """

    id: str
    texts: tuple[str, ...]
    relabelled: dict[tuple[str, str], int]
    beams: int


def diff_sequences(old: SequenceReader, new: SequenceReader) -> SequenceDiff:
    """Compare two versions of a sequence.

    Raises
    ------
    CorruptFileError
        If a checksum does not fit.
    """
    texts = [*_said(old, new)]
    relabelled: dict[tuple[str, str], int] = {}
    beams = 0
    for name in sorted({*old.names, *new.names} - {"provenance"}):
        if name not in old or name not in new:
            texts.append(f"{name} was {'added' if name in new else 'removed'}")
        elif old.shape(name) != new.shape(name):
            texts.append(f"{name}: was {old.shape(name)}, and is {new.shape(name)}")
        elif name == LABELS:
            table = _confusion(old, new)
            beams = int(table.sum())
            relabelled = _named(table, old.header.taxonomy, new.header.taxonomy)
        else:
            texts += _array(name, old, new)
    return SequenceDiff(old.header.sequence_id, tuple(texts), relabelled, beams)


def count_classes(reader: SequenceReader) -> dict[str, int]:
    """Count the labelled beams with a return by the name of their class."""
    counts = np.zeros(256, np.int64)
    for start in range(0, len(reader) if LABELS in reader else 0, _BLOCK):
        labels = reader.read(LABELS, start, start + _BLOCK)
        ranges = reader.read(RANGES, start, start + _BLOCK)
        counts += np.bincount(labels[reader.lidar.has_return(ranges)], minlength=256)
    names = reader.header.taxonomy.names
    return {name: int(count) for name, count in zip(names, counts, strict=False)}


def _said(old: SequenceReader, new: SequenceReader) -> Iterator[str]:
    """Compare what is said of the sequences."""
    for what in ("license", "stamps_source", "taxonomy"):
        before, after = getattr(old.header, what), getattr(new.header, what)
        if before != after:
            is_text = isinstance(before, str)
            yield f"{what}: was {before}, and is {after}" if is_text else f"{what} is another one"
    for each in fields(old.lidar):
        before, after = getattr(old.lidar, each.name), getattr(new.lidar, each.name)
        if before != after:
            yield f"lidar {each.name}: was {before}, and is {after}"
    one, other = old.read_map(), new.read_map()
    if one and other and (one.resolution, one.origin) != (other.resolution, other.origin):
        yield "the map has another resolution or origin"


def _array(name: str, old: SequenceReader, new: SequenceReader) -> Iterator[str]:
    rows = old.shape(name)[0]
    changed, largest = 0, 0.0
    for before, after in _blocks(name, old, new):
        is_same = np.equal(before, after)
        if before.dtype.kind == "f":
            is_same |= np.isnan(before) & np.isnan(after)
        changed += int((~is_same).reshape(len(before), -1).any(axis=1).sum())
        if name in _POSES:
            moved = np.hypot(*(after - before)[:, :2].T)
            largest = max(largest, float(np.nanmax(moved, initial=0.0)))
    if changed:
        how_far = f", by up to {largest:.3g} m" if name in _POSES else ""
        yield f"{name}: {changed} of {rows} rows ({changed / rows:.1%}) differ{how_far}"


def _confusion(old: SequenceReader, new: SequenceReader) -> Counts:
    """Count beams by old and new label, (256, 256) i8."""
    table = np.zeros(1 << 16, np.int64)
    for before, after in _blocks(LABELS, old, new):
        pairs = before.astype(np.uint16) << 8 | after
        table += np.bincount(pairs.ravel(), minlength=len(table))
    return table.reshape(256, 256)


def _named(table: Counts, old: Taxonomy, new: Taxonomy) -> dict[tuple[str, str], int]:
    """Return what differs by names, most first."""
    pairs = (
        (_name(old, int(i)), _name(new, int(j)), int(table[i, j])) for i, j in np.argwhere(table)
    )
    found = {(before, after): count for before, after, count in pairs if before != after}
    return dict(sorted(found.items(), key=lambda each: -each[1]))


def _name(taxonomy: Taxonomy, label: int) -> str:
    if label == UNLABELLED:
        return "unlabelled"
    return taxonomy.names[label] if label < len(taxonomy) else f"class {label}"


def _blocks(
    name: str, old: SequenceReader, new: SequenceReader
) -> Iterator[tuple[NDArray[Any], NDArray[Any]]]:
    for start in range(0, old.shape(name)[0], _BLOCK):
        yield old.read(name, start, start + _BLOCK), new.read(name, start, start + _BLOCK)
