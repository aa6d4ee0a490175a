"""A sequence as a session folder of the published layout."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from conversion.layouts.field_decoding import FieldDecoder, PlacedDecoder, UnplacedDecoder
from conversion.layouts.fields import POSITIONS, places
from conversion.layouts.kept_files import kept_files, split_names
from conversion.layouts.members import clean_name
from conversion.layouts.session_blocks import (
    LAYOUT,
    LAYOUT_ARRAY,
    LAYOUT_VERSION,
    NAMES_ARRAY,
    usual_names,
)
from conversion.layouts.sessions import LISTS, is_field_name
from conversion.plan import BLOCK
from semantic2d_dataset.errors import CorruptFileError, InvalidInputError, WriteError
from semantic2d_dataset.format.container import load_json
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.format.splits import SPLIT_IDS
from semantic2d_dataset.format.writing import make_folder

_NOT_VALID = (KeyError, TypeError, ValueError, AttributeError)
_REFINED = "poses/refined"


@dataclass(frozen=True)
class Exported:
    """What an export wrote.

    Parameters
    ----------
    folder
        The session folder.
    scans
        How many scans it holds.
    fields
        Its fields.
    identical
        Those whose files have the bytes that they had in the layout the sequence comes from.
    """

    folder: Path
    scans: int
    fields: tuple[str, ...]
    identical: tuple[str, ...]


def export_npy(sequence: Path, out: Path, *, members: NDArray[np.uint8] | None = None) -> Exported:
    """Write a sequence as a session folder of the published layout.

    What was converted from that layout becomes byte for byte what it was; of that, arrays that
    were made anew since are written as they are now. Any other sequence is written as far as the
    layout has a place for it: no return (and any range that is not finite) as 0, labels as
    float32, positions from the refined poses where there are any.

    Parameters
    ----------
    sequence
        The sequence file.
    out
        The folder to make; it does not exist, or is empty.
    members
        (N,) u1, 0 train, 1 val, 2 test: written as ``train.txt``, ``dev.txt``, ``test.txt``
        instead of the lists that the sequence keeps.

    Raises
    ------
    InvalidInputError
        If the folder holds anything, or `members` are not one for each scan.
    CorruptFileError
        If the sequence is damaged.
    WriteError
        If the folder cannot be written; nothing of it is left.
    """
    _check_free(out)
    with SequenceReader(sequence) as reader:
        if members is not None and members.shape != (len(reader),):
            raise InvalidInputError(
                f"members: expected one for each of {len(reader)} scans, found {members.shape}"
            )
        session = _Session(reader)
        try:
            make_folder(out, partial(session.write, members=members), partial(_refuse, out))
        except OSError as err:
            raise WriteError(f"{out}: could not be written: {err}") from err
        return Exported(out, len(reader), tuple(session.decoders), session.identical)


class _Session:
    """What a sequence becomes in the published layout."""

    def __init__(self, reader: SequenceReader) -> None:
        self._reader = reader
        self._said = _read_layout(reader)
        try:
            self._names = _read_names(reader) if self._said else usual_names(len(reader))
            self.decoders = dict(self._make_decoders())
            self.identical = tuple(
                field for field, each in self.decoders.items() if each.is_as_converted
            )
        except _NOT_VALID as err:
            raise CorruptFileError(f"{reader.path}: /original is not valid: {err}") from err

    def write(self, folder: Path, members: NDArray[np.uint8] | None) -> None:
        """Write all files."""
        for field in self.decoders:
            (folder / field).mkdir()
        scans = len(self._reader)
        with tqdm(total=scans, desc="export", unit="scan", disable=None, leave=False) as bar:
            for start in range(0, scans, BLOCK):
                stop = min(start + BLOCK, scans)
                for field, decoder in self.decoders.items():
                    self._write_files(folder / field, decoder, start, stop)
                bar.update(stop - start)
        self._write_kept(folder, without_lists=members is not None)
        if members is not None:
            self._write_lists(folder, members)

    def _make_decoders(self) -> Iterator[tuple[str, FieldDecoder]]:
        reader, fields = self._reader, self._said.get("fields", {})
        reversed_ = bool(self._said.get("reversed_intensities"))
        known = places(reader.lidar.beams, reversed_intensities=reversed_)
        if _REFINED in reader:
            known[POSITIONS] = replace(known[POSITIONS], array=_REFINED)
        for field, place in known.items():
            if place.array in reader and not (place.ragged and "lines/offsets" not in reader):
                yield field, PlacedDecoder(reader, field, place, fields.get(field))
        for field in sorted(fields.keys() - known.keys()):
            if not is_field_name(field):
                raise ValueError(f"{field!r} is no name of a field")
            yield field, UnplacedDecoder(reader, field, fields[field])

    def _write_files(self, folder: Path, decoder: FieldDecoder, start: int, stop: int) -> None:
        try:
            files = decoder.files(start, stop)
        except (ValueError, IndexError) as err:
            raise CorruptFileError(
                f"{self._reader.path}: {folder.name}: /original does not fit the scans: {err}"
            ) from err
        for name, content in zip(self._names[start:stop], files, strict=True):
            if content is not None:
                (folder / name).write_bytes(content)

    def _write_kept(self, folder: Path, *, without_lists: bool) -> None:
        if not self._said:
            return
        anew = {field for field, each in self.decoders.items() if not each.is_as_converted}
        lists = {f"{split}.txt" for split in LISTS}
        scans = frozenset(self._names)
        for name, content in kept_files(self._reader):
            above, _, file = name.rpartition("/")
            if (above in anew and file in scans) or (without_lists and name in lists):
                continue
            (folder / above).mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)

    def _write_lists(self, folder: Path, members: NDArray[np.uint8]) -> None:
        for split in LISTS:
            chosen = np.flatnonzero(members == SPLIT_IDS[split])
            text = "".join(f"{self._names[n]}\n" for n in chosen)
            (folder / f"{split}.txt").write_text(text, encoding="utf-8")


def _read_layout(reader: SequenceReader) -> Mapping[str, Any]:
    """Return what was kept of the layout that a sequence comes from; nothing of any other."""
    if LAYOUT_ARRAY not in reader:
        return {}
    try:
        said = load_json(reader.read(LAYOUT_ARRAY).tobytes())
        version = int(said["version"])
        if said["layout"] != LAYOUT or said["scans"] != len(reader):
            return {}  # scans were left out since
    except _NOT_VALID as err:
        raise CorruptFileError(f"{reader.path}: {LAYOUT_ARRAY} is not valid: {err}") from err
    if version > LAYOUT_VERSION:
        raise InvalidInputError(
            f"{reader.path}: {LAYOUT_ARRAY} is of version {version}, and this package reads up to "
            f"{LAYOUT_VERSION}: update it"
        )
    return dict(said)


def _read_names(reader: SequenceReader) -> list[str]:
    if NAMES_ARRAY not in reader:
        return usual_names(len(reader))
    names = split_names(reader, NAMES_ARRAY)
    if len({*names}) != len(reader) or len(names) != len(reader):
        raise ValueError(f"{len(names)} names for {len(reader)} scans")
    if any("/" in name or not name or clean_name(name) != name for name in names):
        raise ValueError("a name that leads out of its folder")
    return names


def _check_free(out: Path) -> None:
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        _refuse(out)


def _refuse(out: Path) -> bool:
    raise InvalidInputError(f"{out}: exists, and is no empty folder; choose another name")
