"""A session of the published layout as arrays of a sequence, a bounded block at a time."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from conversion.layouts import npy
from conversion.layouts.field_encoding import (
    Encoded,
    FieldEncoder,
    FileError,
    PlacedEncoder,
    UnplacedEncoder,
)
from conversion.layouts.fields import places, storage_of
from conversion.layouts.kept_files import join_names, keep_files
from conversion.layouts.rows import SYNTHETIC_STEP_NS
from conversion.layouts.sessions import Session
from conversion.options import Options
from conversion.plan import BLOCK, Arrays
from semantic2d_dataset.errors import RecordingError

LAYOUT, LAYOUT_VERSION = "semantic2d-release", 1
NAMES_ARRAY, LAYOUT_ARRAY = "original/scans.names", "original/layout.json"

MAX_KEPT_BYTES = 1 << 24
_BLOCK_BYTES = 1 << 25
_SAMPLES = 16


def usual_names(scans: int) -> list[str]:
    """Return the file names that scans have where nothing else is kept."""
    return [f"{n:07d}.npy" for n in range(scans)]


def read_files(session: Session, field: str, names: Sequence[str]) -> list[bytes | None]:
    """Read the files of a field, None where there is none."""
    there = frozenset(session.files[field])
    found = [name for name in names if name in there]
    contents = dict(
        zip(found, session.tree.read_many([session.name(field, n) for n in found]), strict=True)
    )
    return [contents.get(name) for name in names]


def encode_files(
    session: Session, field: str, encoder: FieldEncoder, names: Sequence[str]
) -> tuple[Encoded, dict[str, bytes]]:
    """Read and encode the files of a field; also return those that are to be kept whole.

    Raises
    ------
    RecordingError
        If one is no .npy file, not all of one, or holds pickled objects.
    """
    files = read_files(session, field, names)
    try:
        encoded = encoder.encode(files)
    except FileError as err:
        name = session.name(field, names[err.which])
        raise RecordingError(
            session.tree.path, f"{name}: {err}; semantic2d audit lists all such files"
        ) from err
    whole = {f"{field}/{names[n]}": files[n] for n in encoded.whole}
    return encoded, {name: content for name, content in whole.items() if content is not None}


def others_of(session: Session) -> list[str]:
    """Return the names of its files that belong to no scan, such as the split lists."""
    scans = frozenset(session.scans)
    return [name for name in session.inside if not _is_of_scan(name, session, scans)]


def blocks_of(
    session: Session, beams: int, options: Options, keep: NDArray[np.bool_]
) -> Iterator[Arrays]:
    """Yield the arrays of up to `BLOCK` scans at a time, then what else a way back needs.

    Parameters
    ----------
    session
        What to read.
    beams
        Of its lidar.
    options
        `no_return` and `reverse_intensities` count here.
    keep
        (N,) bool, the scans to yield.

    Raises
    ------
    RecordingError
        If a file is damaged.
    """
    indices = np.flatnonzero(keep)
    names = [session.scans[i] for i in indices]
    encoders = _encoders(session, beams, options)
    step = _rows_at_a_time(session)
    with tqdm(total=len(names), desc="convert", unit="scan", disable=None, leave=False) as bar:
        for start in range(0, len(names), step):
            some = names[start : start + step]
            block: Arrays = {"scans/stamps_ns": indices[start : start + step] * SYNTHETIC_STEP_NS}
            whole: dict[str, bytes] = {}
            for field, encoder in encoders.items():
                encoded, to_keep = encode_files(session, field, encoder, some)
                block |= encoded.arrays
                whole |= to_keep
            yield block | keep_files(whole)
            bar.update(len(some))
    yield from _keep_others(session)
    yield _finish(names, encoders, reversed_intensities=options.reverse_intensities)


def _encoders(session: Session, beams: int, options: Options) -> dict[str, FieldEncoder]:
    known = places(
        beams,
        no_return=options.no_return,
        reversed_intensities=options.reverse_intensities,
    )
    scans = frozenset(session.scans)
    return {
        field: PlacedEncoder(field, known[field])
        if field in known
        else UnplacedEncoder(field, _usual_layout(session, field))
        for field, files in session.files.items()
        if not scans.isdisjoint(files)
    }


def _usual_layout(session: Session, field: str) -> npy.Layout:
    """Return what most files of a field are like, judged by a few of them."""
    files = session.files[field]
    some = files[:: max(1, len(files) // _SAMPLES)]
    layouts = []
    for name in some:
        try:
            layouts.append(npy.split(session.tree.read(session.name(field, name)))[1])
        except npy.NpyError as err:
            raise RecordingError(
                session.tree.path,
                f"{session.name(field, name)}: {err}; semantic2d audit lists all such files",
            ) from err
    usual = Counter(map(storage_of, layouts)).most_common(1)[0][0]
    return next(layout for layout in layouts if storage_of(layout) == usual)


def _rows_at_a_time(session: Session) -> int:
    """Bound memory also where a field has large files."""
    sizes = (session.tree.size(session.name(f, each[0])) for f, each in session.files.items())
    return max(1, min(BLOCK, _BLOCK_BYTES // max(1, sum(sizes))))


def _is_of_scan(name: str, session: Session, scans: frozenset[str]) -> bool:
    folder, _, file = name.partition("/")
    return folder in session.files and file in scans


def _keep_others(session: Session) -> Iterator[Arrays]:
    batch: dict[str, bytes] = {}
    room = MAX_KEPT_BYTES
    for name in others_of(session):
        size = session.tree.size(session.name(name))
        if size > MAX_KEPT_BYTES:
            continue
        if size > room:
            yield keep_files(batch)
            batch, room = {}, MAX_KEPT_BYTES
        batch[name] = session.tree.read(session.name(name))
        room -= size
    if batch:
        yield keep_files(batch)


def _finish(
    names: Sequence[str], encoders: Mapping[str, FieldEncoder], *, reversed_intensities: bool
) -> Arrays:
    """Say what only the end knows: the forms of the files, and their names."""
    arrays: Arrays = {}
    said = {}
    for field, encoder in encoders.items():
        more, said[field] = encoder.finish()
        arrays |= more
    if names != usual_names(len(names)):
        arrays[NAMES_ARRAY] = np.frombuffer(join_names(names), np.uint8)
    layout = {
        "layout": LAYOUT,
        "version": LAYOUT_VERSION,
        "scans": len(names),
        "reversed_intensities": reversed_intensities,
        "fields": said,
    }
    return arrays | {
        LAYOUT_ARRAY: np.frombuffer(json.dumps(layout, sort_keys=True).encode(), np.uint8)
    }
