"""A data set is made aside and then put in its place, which holds the old one until then."""

from __future__ import annotations

import shutil
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path

from semantic2d_dataset.format.checksums import CHECKSUMS_NAME
from semantic2d_dataset.format.manifest import MANIFEST_NAME, Manifest, publish
from semantic2d_dataset.format.splits import SplitScheme

SEQUENCES, SPLITS = "sequences", "splits"
PREVIOUS_NAME = "previous.json"
"""The manifest that is being replaced, among what is made aside."""


def stage(
    staged: Path,
    sequences: Sequence[Path],
    schemes: Sequence[SplitScheme],
    *,
    name: str,
    version: str,
    license: str,  # noqa: A002 - the field's name in the format
) -> Manifest:
    """Make splits and manifest beside links to the sequences, in a fresh folder.

    Raises
    ------
    Semantic2DError
        If a sequence or a name is not right.
    """
    shutil.rmtree(staged, ignore_errors=True)
    (staged / SEQUENCES).mkdir(parents=True)
    for file in sequences:
        (staged / SEQUENCES / file.name).symlink_to(file.resolve())
    return publish(staged, name=name, version=version, license=license, schemes=schemes)


def swap(
    out: Path,
    staged: Path,
    sequences: Mapping[str, Path],
    *,
    removed: Path,
    documents: Iterable[str] = (),
) -> None:
    """Put the new data set into the place of the old one, and remove the folder it was made in.

    Killed in between, there is no manifest and so no data set; every sequence is still at its
    old place or at its new one, and the old manifest is `PREVIOUS_NAME` in the staged folder.

    Parameters
    ----------
    out
        The data set's folder.
    staged
        What `stage` made, with documents and their manifest.
    sequences
        Where the sequences lie, by the name of their file.
    removed
        Folder for what `out` has and the new data set has not.
    documents
        Relative names of staged files to be moved besides.
    """
    for part in (SEQUENCES, SPLITS):
        (out / part).mkdir(exist_ok=True)
    if (out / MANIFEST_NAME).exists():
        (out / MANIFEST_NAME).replace(staged / PREVIOUS_NAME)
    (out / CHECKSUMS_NAME).unlink(missing_ok=True)
    splits = {file.name: file for file in (staged / SPLITS).iterdir()}
    for part, new in ((SEQUENCES, sequences), (SPLITS, splits)):
        _set_aside(out / part, new, removed)
        for name, file in new.items():
            file.replace(out / part / name)
    for document in documents:
        (staged / document).replace(out / document)
    (staged / MANIFEST_NAME).replace(out / MANIFEST_NAME)
    shutil.rmtree(staged)


def _set_aside(folder: Path, kept: Collection[str], removed: Path) -> None:
    for file in folder.glob("*.h5"):
        if file.name not in kept:
            removed.mkdir(exist_ok=True)
            file.replace(removed / file.name)
