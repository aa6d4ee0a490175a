"""Known data sets, and opening one by its name or folder."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import platformdirs
from filelock import FileLock

from semantic2d_dataset.errors import (
    DatasetNotFoundError,
    InvalidInputError,
    Semantic2DError,
)
from semantic2d_dataset.format.manifest import (
    MANIFEST_NAME,
    Manifest,
    SequenceEntry,
    check_sequence,
    check_size,
    read_manifest,
)
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.format.splits import SplitScheme, read_scheme
from semantic2d_dataset.format.writing import make_folder
from semantic2d_dataset.scene.lidars import full_name

HOME_VARIABLE = "SEMANTIC2D_HOME"
MINI = "semantic2d-mini"


@dataclass(frozen=True)
class OpenDataset:
    """A data set on this machine: its folder and its manifest."""

    root: Path
    manifest: Manifest

    def sequences(self, lidar: str | None = None) -> list[SequenceEntry]:
        """Return the entries of one lidar, or of all.

        Parameters
        ----------
        lidar
            Id or short name of a lidar of the release, or the name that the data set uses.

        Raises
        ------
        DatasetNotFoundError
            If the data set has no sequence of that lidar.
        """
        names = sorted({entry.lidar for entry in self.manifest.sequences})
        if lidar is None:
            return list(self.manifest.sequences)
        name = lidar if lidar in names else full_name(lidar)
        found = [entry for entry in self.manifest.sequences if entry.lidar == name]
        if not found:
            raise DatasetNotFoundError(
                f"{self.manifest.name}: has no sequence of the lidar {lidar!r}; "
                f"it has {', '.join(names)}"
            )
        return found

    def scheme(self, name: str) -> SplitScheme:
        """Read a split scheme.

        Raises
        ------
        InvalidInputError
            If the data set has no such scheme.
        ChecksumError
            If its file was changed since the manifest was written.
        """
        entry = self.manifest.splits.get(name)
        if entry is None:
            raise InvalidInputError(
                f"{self.manifest.name}: unknown scheme {name!r}; "
                f"known are {', '.join(sorted(self.manifest.splits))}"
            )
        path = self.root / entry.file
        if not path.is_file():
            raise DatasetNotFoundError(f"{path}: missing")
        check_size(path, entry)
        return read_scheme(path, name, self.manifest.lengths)

    def lidars_of(self, scheme: str, split: str) -> list[str]:
        """Return the names of the lidars that have scans in a split.

        Raises
        ------
        InvalidInputError
            If the data set has no such scheme, or there is no such split.
        """
        found = self.scheme(scheme)
        taken = {i for i in found.membership if found.scans_of(i, split).size}
        return sorted({entry.lidar for entry in self.manifest.sequences if entry.id in taken})

    def reader(self, sequence_id: str) -> SequenceReader:
        """Open a sequence by its id.

        Raises
        ------
        DatasetNotFoundError
            If the manifest does not name it, or its file is missing.
        ChecksumError
            If the file was changed since the manifest was written.
        """
        entry = next((e for e in self.manifest.sequences if e.id == sequence_id), None)
        if entry is None:
            raise DatasetNotFoundError(f"{self.manifest.name}: has no sequence {sequence_id!r}")
        path = self.root / entry.file
        if not path.is_file():
            raise DatasetNotFoundError(f"{path}: missing")
        check_size(path, entry)
        reader = SequenceReader(path)
        check_sequence(reader, entry)
        return reader


def home() -> Path:
    """Return the folder that data sets are kept in: ``SEMANTIC2D_HOME`` or the user's cache."""
    chosen = os.environ.get(HOME_VARIABLE)
    return Path(chosen) if chosen else platformdirs.user_cache_path("semantic2d_dataset")


def open_dataset(name: str | Path) -> OpenDataset:
    """Open a data set by its folder, or by its name if it is one of those known.

    ``semantic2d-mini`` is made on first use.

    Parameters
    ----------
    name
        A folder that holds ``dataset.json``, or ``semantic2d-mini``; a Path is always a folder.

    Raises
    ------
    DatasetNotFoundError
        If it is neither.
    CorruptFileError, FormatVersionError
        If the manifest cannot be read.
    """
    if name == MINI:
        return _open_mini()
    folder = Path(name)
    if not name or not (folder / MANIFEST_NAME).is_file():
        raise DatasetNotFoundError(
            f"{name}: neither a folder with {MANIFEST_NAME} nor a known data set; known: {MINI}"
        )
    return OpenDataset(folder, read_manifest(folder))


def _open_mini() -> OpenDataset:
    from semantic2d_dataset.simulation.mini import MINI_VERSION, make_mini

    folder = home() / f"{MINI}-{MINI_VERSION}"
    if not _is_complete(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        # the lock saves work; it is the renaming that keeps it right
        with FileLock(folder.with_name(f"{folder.name}.lock")):
            if not _is_complete(folder):
                make_folder(folder, make_mini, lambda: _is_complete(folder))
    return OpenDataset(folder, read_manifest(folder))


def _is_complete(folder: Path) -> bool:
    """Tell whether every file that the manifest names is there with its size."""
    try:
        files = read_manifest(folder).files
        return all((folder / e.file).stat().st_size == e.bytes for e in files)
    except (Semantic2DError, OSError):
        return False
