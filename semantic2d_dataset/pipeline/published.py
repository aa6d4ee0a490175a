"""Data sets that are published in this package's format: got as they are, whole or by lidars."""

from __future__ import annotations

import glob
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from semantic2d_dataset.access.download import download, matches
from semantic2d_dataset.access.installed import Lidars
from semantic2d_dataset.access.known_datasets import KnownDataset, RemoteFile
from semantic2d_dataset.errors import DatasetNotFoundError
from semantic2d_dataset.format.manifest import (
    MANIFEST_NAME,
    Manifest,
    SequenceEntry,
    find_problems,
    publish,
    read_manifest,
)
from semantic2d_dataset.format.splits import SplitScheme, read_scheme
from semantic2d_dataset.pipeline.staging import link
from semantic2d_dataset.publishing.staging import SEQUENCES, SPLITS


def is_published_as_data_set(files: Sequence[RemoteFile]) -> bool:
    """Tell by their names whether files are a data set in this package's format."""
    names = {file.name for file in files}
    return MANIFEST_NAME in names and any(n.startswith(f"{SEQUENCES}/") for n in names)


@dataclass(frozen=True)
class Fetcher:
    """Gets a data set, in a folder aside.

    Parameters
    ----------
    known
        Where it is.
    folder
        To be filled.
    work
        For what leads there; what an earlier run has got is kept.
    good
        A folder of files of the same names that need not be got again, if they are the same.
    offline
        Whether no host may be asked.
    """

    known: KnownDataset
    folder: Path
    work: Path
    good: Path
    offline: bool = False

    def fill(self, files: Sequence[RemoteFile], lidars: Lidars) -> None:
        """Get files, and check that they are a data set.

        Parameters
        ----------
        files
            All that there are.
        lidars
            The sequences of others are left out, of splits and manifest too.

        Raises
        ------
        DatasetNotFoundError
            If it has no sequence of these lidars.
        DownloadError, OfflineError, ChecksumError, WriteError
            As from `semantic2d_dataset.access.download.download`.
        Semantic2DError
            If the files are not those of a data set.
        """
        by_name = {file.name: file for file in files}
        self._get([by_name[MANIFEST_NAME]])
        theirs = read_manifest(self.work)
        chosen = [e for e in theirs.sequences if lidars is None or e.lidar in lidars]
        if not chosen:
            raise DatasetNotFoundError(
                f"{self.known.name}: has no sequence of {', '.join(lidars or ())}; it has "
                f"{', '.join(sorted({e.lidar for e in theirs.sequences}))}"
            )
        left_out = {e.file for e in theirs.sequences} - {e.file for e in chosen}
        wanted = [file for file in files if file.name not in left_out]
        self._get(wanted)
        self._assemble(wanted)
        if left_out:
            self._reduce(theirs, chosen)
        for problem in find_problems(self.folder):
            raise problem

    def _get(self, files: Sequence[RemoteFile]) -> None:
        folder = self.work
        for file in files:
            here, there = self.good / file.name, folder / file.name
            if not there.exists() and _is_same(here, file):
                link(here, there)
        names = [glob.escape(file.name) for file in files]
        download(self.known, folder, only=names, offline=self.offline)

    def _assemble(self, files: Sequence[RemoteFile]) -> None:
        shutil.rmtree(self.folder)
        self.folder.mkdir()
        for file in files:
            link(self.work / file.name, self.folder / file.name)

    def _reduce(self, theirs: Manifest, chosen: Sequence[SequenceEntry]) -> None:
        """Leave the sequences of other lidars out of splits and manifest."""
        ids = {entry.id for entry in chosen}
        schemes = []
        for name, entry in theirs.splits.items():
            scheme = read_scheme(self.folder / entry.file, name, theirs.lengths)
            members = {i: each for i, each in scheme.membership.items() if i in ids}
            schemes.append(SplitScheme(name, members, scheme.made_by))
        for folder in (self.folder / SPLITS).glob("*/*"):
            if folder.is_dir() and folder.name not in ids:
                shutil.rmtree(folder)
        (self.folder / MANIFEST_NAME).unlink()
        publish(
            self.folder,
            name=theirs.name,
            version=theirs.version,
            license=theirs.license,
            schemes=schemes,
        )


def _is_same(path: Path, file: RemoteFile) -> bool:
    return path.is_file() and path.stat().st_size == file.size and matches(path, file)
