"""What of a data set is good already, and need not be got again."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from semantic2d_dataset.access.installed import Part, Record, read_record
from semantic2d_dataset.errors import ChecksumError, Semantic2DError
from semantic2d_dataset.format.manifest import Manifest, read_manifest
from semantic2d_dataset.format.splits import BY_LISTS, SplitScheme, read_scheme
from semantic2d_dataset.publishing.staging import SPLITS

_FRAME = "frame"


@dataclass(frozen=True)
class Seeds:
    """What of a data set is good already.

    Parameters
    ----------
    record
        What the data set was made of; None where there is no data set yet.
    manifest
        What it holds when it is whole.
    good
        Files of sequences that are as the manifest says, by id.
    frame
        The `frame` scheme, if it was made of lists and is good.
    frame_lost
        Whether there was one that is not good any more.
    lists
        The folder of the lists that archives bring.
    """

    record: Record | None = None
    manifest: Manifest | None = None
    good: Mapping[str, Path] = field(default_factory=dict)
    frame: SplitScheme | None = None
    frame_lost: bool = False
    lists: Path | None = None

    @property
    def parts(self) -> tuple[Part, ...]:
        """The archives that were converted."""
        return () if self.record is None else self.record.parts

    def check(self, made: Manifest) -> None:
        """Check that what was good is the same still.

        Raises
        ------
        ChecksumError
            If it was changed meanwhile, or before without being noticed.
        """
        entries = {} if self.manifest is None else {e.id: e for e in self.manifest.sequences}
        for entry in made.sequences:
            if entry.id in self.good and entry.sha256 != entries[entry.id].sha256:
                raise ChecksumError(
                    f"{self.good[entry.id]}: was changed; see: semantic2d verify --repair"
                )


def seeds_of(
    folder: Path, manifest: Manifest | None = None, damaged: Collection[str] = ()
) -> Seeds:
    """Look up what of a data set is good.

    Parameters
    ----------
    folder
        The data set, if there is one.
    manifest
        What it holds when it is whole; read where not given.
    damaged
        Files that are not good, as the manifest names them.
    """
    record = read_record(folder)
    try:
        manifest = manifest or read_manifest(folder)
    except (Semantic2DError, OSError):
        return Seeds(record)
    good = {
        entry.id: folder / entry.file
        for entry in manifest.sequences
        if entry.file not in damaged and (folder / entry.file).is_file()
    }
    frame = manifest.splits.get(_FRAME)
    scheme = _read(folder, manifest) if frame and frame.file not in damaged else None
    return Seeds(
        record,
        manifest,
        good,
        frame=scheme if scheme and scheme.made_by == BY_LISTS else None,
        frame_lost=frame is not None and scheme is None,
        lists=folder / SPLITS / _FRAME,
    )


def _read(folder: Path, manifest: Manifest) -> SplitScheme | None:
    try:
        return read_scheme(folder / manifest.splits[_FRAME].file, _FRAME, manifest.lengths)
    except (Semantic2DError, OSError):
        return None
