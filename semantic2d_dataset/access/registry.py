"""Known data sets, and opening one by its name or folder."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from semantic2d_dataset.access.installed import (
    datasets_home,
    find_installed,
    is_complete,
    is_installed,
    write_record,
)
from semantic2d_dataset.errors import DatasetNotFoundError, InvalidInputError
from semantic2d_dataset.format.locks import alone
from semantic2d_dataset.format.manifest import (
    MANIFEST_NAME,
    Manifest,
    SequenceEntry,
    check_sequence,
    find_file,
    read_manifest,
)
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.format.splits import SplitScheme, read_scheme
from semantic2d_dataset.format.writing import make_folder
from semantic2d_dataset.scene.lidars import full_name

MINI, MINI_VERSION = "semantic2d-mini", "1.1.0"
_MINI_NAMES = (MINI, f"{MINI}@{MINI_VERSION}")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*(@[A-Za-z0-9][A-Za-z0-9._-]*)?")


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
        return read_scheme(find_file(self.root, entry), name, self.manifest.lengths)

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
        reader = SequenceReader(find_file(self.root, entry))
        check_sequence(reader, entry)
        return reader


def open_dataset(
    name: str | Path, *, version: str | None = None, registry: Path | str | None = None
) -> OpenDataset:
    """Open a data set by its folder, or by its name if it is installed.

    ``semantic2d-mini`` is made on first use.

    Parameters
    ----------
    name
        A folder that holds ``dataset.json``, or a name: ``semantic2d``, of which the newest
        version is meant, or ``semantic2d@1``. A Path is always a folder.
    version
        The other way to say a version.
    registry
        A file or URL of known data sets; ``SEMANTIC2D_REGISTRY`` where not given, if set.

    Raises
    ------
    DatasetNotFoundError
        If it is neither; for one that is known, it says how to get it.
    InvalidInputError
        If a version is given twice, or of a folder.
    CorruptFileError, FormatVersionError
        If the manifest cannot be read.
    """
    folder = find_folder(name, version=version, registry=registry)
    return OpenDataset(folder, read_manifest(folder))


def find_folder(
    name: str | Path, *, version: str | None = None, registry: Path | str | None = None
) -> Path:
    """Return the folder of a data set as `open_dataset` finds it, also if it is damaged."""
    if version is not None and (isinstance(name, Path) or "@" in name):
        raise InvalidInputError(f"{name}: a version goes with the name of a data set alone")
    if isinstance(name, str) and (name if version is None else f"{name}@{version}") in _MINI_NAMES:
        return _find_mini()
    if name and version is None and is_installed(Path(name)):
        return Path(name)
    if isinstance(name, str) and _NAME.fullmatch(name):
        return find_installed(name, version=version, registry=registry)
    raise DatasetNotFoundError(
        f"{name}: neither a folder with {MANIFEST_NAME} nor the name of a known data set, such as "
        f"{MINI}; see: semantic2d list"
    )


def _find_mini() -> Path:
    folder = datasets_home() / f"{MINI}-{MINI_VERSION}"
    if not is_complete(folder):
        with alone(folder):  # saves work; it is the renaming that keeps it right
            if not is_complete(folder):
                make_folder(folder, make_mini_whole, lambda: is_complete(folder))
    return folder


def make_mini_whole(folder: Path) -> None:
    """Make ``semantic2d-mini`` with the record that an installed data set has."""
    from semantic2d_dataset.simulation.mini import make_mini

    make_mini(folder)
    write_record(folder, f"{MINI}@{MINI_VERSION}")
