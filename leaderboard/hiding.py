"""Dividing a data set: scans that everybody gets, and labels that only the maintainer holds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from semantic2d_dataset.access.registry import OpenDataset
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.manifest import publish
from semantic2d_dataset.format.sequence import SequenceReader, SequenceWriter
from semantic2d_dataset.format.splits import TRAIN, VAL, SplitScheme
from semantic2d_dataset.format.writing import make_folder
from semantic2d_dataset.scene.taxonomy import UNLABELLED

# What goes to participants. A list of what may, not of what may not: maps, confidences and
# original arrays tell labels.
_PUBLIC = (
    "scans/ranges",
    "scans/intensities",
    "scans/stamps_ns",
    "poses/initial",
    "poses/refined",
    "commands/velocity",
)
_PRIVATE = ("scans/ranges", "scans/stamps_ns", "scans/labels")


def hide_labels(data: OpenDataset, public: Path, private: Path, *, scheme: str = "block") -> int:
    """Write a data set without the labels of its test split, and one with what scoring needs.

    Both have the name, version and split scheme of the original, so that predictions for the
    public one are scored against the private one. Labels of train and val stay public; those of
    all other scans are hidden, and every map with them.

    Parameters
    ----------
    data
        The data set; every sequence of the scheme must have labels.
    public, private
        The folders to make.
    scheme
        The only split scheme that the two have.

    Returns
    -------
    int
        How many scans have hidden labels.

    Raises
    ------
    InvalidInputError
        If a folder is there already or lies in the other, a sequence has no labels, or nothing
        would be hidden.
    """
    public, private = public.resolve(), private.resolve()
    if public.is_relative_to(private) or private.is_relative_to(public):
        raise InvalidInputError(
            f"{private}: is {public}, or one lies in the other; the private labels would go out "
            "with the public scans: choose two folders side by side"
        )
    division = data.scheme(scheme)
    for folder in (public, private):
        if folder.exists():
            raise InvalidInputError(f"{folder}: exists already; choose a new folder")
    hidden = sum(int((~_is_open(division, name)).sum()) for name in division.membership)
    if not hidden:
        raise InvalidInputError(
            f"{data.manifest.name}: every scan of scheme {scheme} is in train or val; "
            "there is nothing to hide"
        )
    make_folder(private, _maker(data, division, _write_private), lambda: False)
    make_folder(public, _maker(data, division, _write_public), lambda: False)
    return hidden


_Write = Callable[[Path, SequenceReader, SplitScheme], None]


def _maker(data: OpenDataset, division: SplitScheme, write: _Write) -> Callable[[Path], None]:
    """Return what fills a folder with sequences, and publishes it under the original's name."""

    def make(folder: Path) -> None:
        (folder / "sequences").mkdir()
        names = tqdm(sorted(division.membership), "writing", unit="sequence", disable=None)
        for name in names:
            with data.reader(name) as reader:
                if "scans/labels" not in reader:
                    raise InvalidInputError(f"{reader.path}: has no labels; label it first")
                write(folder / "sequences" / f"{name}.h5", reader, division)
        said = data.manifest
        publish(
            folder, name=said.name, version=said.version, license=said.license, schemes=[division]
        )

    return make


def _write_public(path: Path, reader: SequenceReader, division: SplitScheme) -> None:
    labels = reader.read("scans/labels")
    labels[~_is_open(division, reader.header.sequence_id)] = UNLABELLED
    header = replace(reader.header, provenance={"source": "labels of the test split are private"})
    with SequenceWriter(path, header) as writer:
        writer.copy(reader, [name for name in _PUBLIC if name in reader])
        writer.append({"scans/labels": labels})


def _write_private(path: Path, reader: SequenceReader, division: SplitScheme) -> None:  # noqa: ARG001
    with SequenceWriter(path, replace(reader.header, provenance={"source": "private"})) as writer:
        writer.copy(reader, _PRIVATE)


def _is_open(division: SplitScheme, sequence_id: str) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Tell of every scan whether its labels stay public: gaps beside the test split do not."""
    return np.isin(division.membership[sequence_id], (TRAIN, VAL))
