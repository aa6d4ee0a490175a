"""From published archives to a data set: each is converted aside, then all are put together."""

from __future__ import annotations

import glob
import hashlib
import json
import shutil
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from semantic2d_dataset.access.download import download
from semantic2d_dataset.access.installed import Lidars, Part, includes
from semantic2d_dataset.access.known_datasets import KnownDataset, RemoteFile
from semantic2d_dataset.errors import (
    DatasetNotFoundError,
    RecordingError,
    Semantic2DError,
)
from semantic2d_dataset.format.container import load_json
from semantic2d_dataset.format.manifest import publish, read_manifest
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.format.split_schemes import schemes_of
from semantic2d_dataset.format.splits import BY_LISTS, NONE, SplitScheme, read_scheme
from semantic2d_dataset.format.writing import write_text_atomically
from semantic2d_dataset.pipeline.seeds import Seeds
from semantic2d_dataset.pipeline.siblings import load_sibling
from semantic2d_dataset.pipeline.staging import link
from semantic2d_dataset.publishing.staging import SEQUENCES, SPLITS

_FRAME = "frame"
_MARK = "part.json"


@dataclass(frozen=True)
class Converter:
    """Makes a data set of archives, in a folder aside.

    Parameters
    ----------
    known
        What is said of the data set, and where its archives are.
    version
        Of the data set, for its manifest.
    folder
        To be filled.
    work
        For what leads there; what an earlier run has done is kept.
    seeds
        What the data set has already.
    archives
        Where archives are kept.
    remove_archives
        Whether each is removed when what it gave is complete.
    offline
        Whether no host may be asked.
    """

    known: KnownDataset
    version: str
    folder: Path
    work: Path
    seeds: Seeds
    archives: Path
    remove_archives: bool = False
    offline: bool = False

    def fill(self, wanted: Mapping[RemoteFile, Lidars]) -> tuple[Part, ...]:
        """Convert archives, and publish all that is in the folder then.

        Parameters
        ----------
        wanted
            The archives, and the lidars whose scans are converted.

        Returns
        -------
        tuple of Part
            What each archive gave; of those, too, that were converted earlier.

        Raises
        ------
        RecordingError
            If an archive cannot be read, or none holds a recording.
        DatasetNotFoundError
            If none holds scans of these lidars.
        DownloadError, OfflineError, ChecksumError, WriteError
            As from `semantic2d_dataset.access.download.download`.
        """
        parts = {part.file: part for part in self.seeds.parts}
        todo = [file for file in wanted if not self._is_done(file, wanted[file])]
        works: dict[Path, Part] = {}
        failures: list[RecordingError] = []
        for group in [[file] for file in todo] if self.remove_archives else [todo]:
            missing = [file for file in group if self._marked(file, wanted[file]) is None]
            if missing:
                names = [glob.escape(file.name) for file in missing]
                download(self.known, self.archives, only=names, offline=self.offline)
            for file in group:
                try:
                    part = self._marked(file, wanted[file]) or self._convert(file, wanted[file])
                except _NothingKnownError as err:
                    failures.append(err)
                    continue
                works[self._work(file)] = part
                parts[file.name] = _joined(parts.get(file.name), part)
                if self.remove_archives:
                    (self.archives / file.name).unlink(missing_ok=True)
        if failures and not parts:
            raise RecordingError(failures[0].path, failures[0].message)
        for failure in failures:
            tqdm.write(f"left as it is: {failure}", file=sys.stderr)
        if not any(part.sequences for part in parts.values()):
            raise DatasetNotFoundError(
                f"{self.known.name}: nothing in {', '.join(file.name for file in wanted)} was "
                f"measured by {', '.join({n: 0 for each in wanted.values() for n in each or ()})}"
            )
        self._put_together(works)
        return tuple(parts.values())

    def _is_done(self, file: RemoteFile, lidars: Lidars) -> bool:
        """Tell whether nothing is left to be made of an archive."""
        return any(
            (part.file, part.checksum) == (file.name, file.checksum)
            and includes(part.lidars, lidars)
            and set(part.sequences) <= set(self.seeds.good)
            and not self.seeds.frame_lost
            for part in self.seeds.parts
        )

    def _work(self, file: RemoteFile) -> Path:
        return self.work / hashlib.sha256(file.name.encode()).hexdigest()[:16]

    def _marked(self, file: RemoteFile, lidars: Lidars) -> Part | None:
        """Return what an earlier run has made of an archive."""
        try:
            said = load_json((self._work(file) / _MARK).read_bytes())
        except (OSError, Semantic2DError):
            return None
        part = Part(
            said["file"],
            said["checksum"],
            None if said["lidars"] is None else tuple(said["lidars"]),
            tuple(said["sequences"]),
        )
        same = (part.file, part.checksum) == (file.name, file.checksum)
        return part if same and part.lidars == lidars else None

    def _convert(self, file: RemoteFile, lidars: Lidars) -> Part:
        archive, work = self.archives / file.name, self._work(file)
        work.mkdir(parents=True, exist_ok=True)
        for part in self.seeds.parts:
            for name in part.sequences if part.file == file.name else ():
                if name in self.seeds.good and not (work / SEQUENCES / f"{name}.h5").exists():
                    link(self.seeds.good[name], work / SEQUENCES / f"{name}.h5")
        options = load_sibling("conversion", "options").Options(
            only_lidars=lidars or (), license=self.known.license
        )
        try:
            results = load_sibling("conversion", "convert").convert_recording(
                archive, work, options, replace_outdated=True
            )
        except RecordingError as err:
            if load_sibling("conversion", "sources").holds_layout(archive):
                raise
            raise _NothingKnownError(err.path, err.message) from err
        for result in results:
            _move(Path(result.file), work / SEQUENCES)
        ids = tuple(sorted(result.sequence_id for result in results))
        part = Part(file.name, file.checksum, lidars, ids)
        write_text_atomically(work / _MARK, json.dumps(asdict(part)) + "\n")
        return part

    def _put_together(self, works: Mapping[Path, Part]) -> None:
        """Give the folder every sequence, their lists and splits, and the manifest."""
        sequences = self.folder / SEQUENCES
        shutil.rmtree(sequences, ignore_errors=True)
        for name, path in self.seeds.good.items():
            link(path, sequences / f"{name}.h5")
        owners: dict[str, str] = {}
        for work, part in works.items():
            for name in part.sequences:
                if owners.setdefault(name, part.file) != part.file:
                    raise RecordingError(
                        self.archives / part.file, f"holds {name}, and so does {owners[name]}"
                    )
                if name not in self.seeds.good:
                    link(work / SEQUENCES / f"{name}.h5", sequences / f"{name}.h5")
        self._publish(works)

    def _publish(self, works: Mapping[Path, Part]) -> None:
        stamps = {}
        for path in sorted((self.folder / SEQUENCES).glob("*.h5")):
            with SequenceReader(path) as reader:
                stamps[reader.header.sequence_id] = reader.read("scans/stamps_ns")
        shutil.rmtree(self.folder / SPLITS, ignore_errors=True)
        (self.folder / SPLITS).mkdir()
        members = {name: np.full(len(each), NONE, np.uint8) for name, each in stamps.items()}
        frames = [*filter(None, (self.seeds.frame, *map(_frame_of, works)))]
        for frame in frames:
            members |= {n: each for n, each in frame.membership.items() if n in members}
        for lists in [self.seeds.lists, *(work / SPLITS / _FRAME for work in works)]:
            for file in lists.glob("*/*.txt") if lists is not None else ():
                if file.parent.name in members:
                    link(file, self.folder / SPLITS / _FRAME / file.parent.name / file.name)
        schemes = list(schemes_of(stamps))
        if frames:
            schemes = [each for each in schemes if each.name != _FRAME]
            schemes.append(SplitScheme(_FRAME, members, BY_LISTS))
        made = publish(
            self.folder,
            name=self.known.id,
            version=self.version,
            license=self.known.license,
            schemes=schemes,
        )
        self.seeds.check(made)


class _NothingKnownError(RecordingError):
    """An archive of something else than recordings."""


def _joined(one: Part | None, other: Part) -> Part:
    if one is None or one.checksum != other.checksum:
        return other
    both = one.lidars is None or other.lidars is None
    return replace(
        other,
        lidars=None if both else tuple(sorted({*(one.lidars or ()), *(other.lidars or ())})),
        sequences=tuple(sorted({*one.sequences, *other.sequences})),
    )


def _frame_of(work: Path) -> SplitScheme | None:
    file = work / SPLITS / f"{_FRAME}.h5"
    if not file.is_file():
        return None
    scheme = read_scheme(file, _FRAME, read_manifest(work).lengths)
    return scheme if scheme.made_by == BY_LISTS else None


def _move(file: Path, folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    if file.parent != folder:
        file.replace(folder / file.name)
