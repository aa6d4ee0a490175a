"""``semantic2d contribute check``: whether sequences from elsewhere can join a data set."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from semantic2d_dataset.access.registry import OpenDataset
from semantic2d_dataset.errors import DatasetNotFoundError, Semantic2DError
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.publishing.findings import ERROR, NOTE, Finding, ordered
from semantic2d_dataset.publishing.label_checks import check_labels
from semantic2d_dataset.publishing.licenses import UNKNOWN, find_spdx
from semantic2d_dataset.publishing.motion_checks import check_motion
from semantic2d_dataset.publishing.overlap import Print, find_overlap, prints_of
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, Taxonomy


@dataclass(frozen=True)
class Contribution:
    """What was found in sequences from elsewhere.

    Parameters
    ----------
    files
        What was checked.
    against
        Name and version of the data set that they were compared with, if with one.
    findings
        Errors first.
    """

    files: tuple[Path, ...]
    against: str | None
    findings: tuple[Finding, ...]

    @property
    def errors(self) -> int:
        """How many findings must be put right."""
        return sum(each.level == ERROR for each in self.findings)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "files": [str(file) for file in self.files],
            "against": self.against,
            "errors": self.errors,
            "findings": [each.as_dict() for each in self.findings],
        }

    def __str__(self) -> str:
        lines = [str(each) for each in self.findings]
        against = f", compared with {self.against}" if self.against else ""
        end = f"{self.errors or 'no'} error(s) in {len(self.files)} sequence(s){against}"
        return "\n".join([*lines, end])


def check_contribution(places: Sequence[Path], against: OpenDataset | None = None) -> Contribution:
    """Check sequences: format, licence, names, taxonomy, labels, stamps, poses, and leakage.

    Parameters
    ----------
    places
        Files, folders of files, or folders with ``sequences/``.
    against
        The data set that they are to join.

    Raises
    ------
    DatasetNotFoundError
        If there is no sequence.
    """
    files = _find(places)
    taxonomy = _taxonomy_of(against)
    findings: list[Finding] = []
    readable = []
    for file in files:
        try:
            with SequenceReader(file) as reader:
                reader.check_values()
                findings += _check(reader, taxonomy)
            readable.append(file)
        except (Semantic2DError, OSError) as err:
            findings.append(
                Finding(
                    ERROR,
                    str(file),
                    str(err).removeprefix(f"{file}: "),  # the finding says it already
                    "a whole file of the format",
                    "write it with semantic2d convert or SequenceWriter",
                )
            )
    mine = prints_of(dict.fromkeys(readable))
    theirs = [] if against is None else _prints_of(against, {each.beams for each in mine})
    for number, each in enumerate(mine):
        findings += find_overlap(each, [*theirs, *mine[:number]])
    name = None if against is None else f"{against.manifest.name} {against.manifest.version}"
    return Contribution(tuple(files), name, tuple(ordered(findings)))


def _find(places: Sequence[Path]) -> list[Path]:
    files: list[Path] = []
    for place in places:
        if not place.exists():
            raise DatasetNotFoundError(
                f"{place}: does not exist; expected a sequence (*.h5) or a folder of them"
            )
        inside = [*place.glob("*.h5"), *place.glob("sequences/*.h5")] if place.is_dir() else [place]
        if not inside:
            raise DatasetNotFoundError(
                f"{place}: no sequences (*.h5) here, nor in {place / 'sequences'}; "
                "make them with semantic2d convert"
            )
        files += sorted(inside)
    return [*dict.fromkeys(files)]


def _prints_of(data: OpenDataset, beams: Collection[int]) -> list[Print]:
    return prints_of(
        {data.root / entry.file: entry.content_digest for entry in data.manifest.sequences}, beams
    )


def _taxonomy_of(data: OpenDataset | None) -> Taxonomy:
    if data is None or not data.manifest.sequences:
        return SEMANTIC2D
    with data.reader(data.manifest.sequences[0].id) as reader:
        return reader.header.taxonomy


def _check(reader: SequenceReader, taxonomy: Taxonomy) -> Iterator[Finding]:
    yield from _check_said(reader, taxonomy)
    if len(reader):
        yield from check_labels(reader)
        yield from check_motion(reader)
    else:
        yield Finding(ERROR, str(reader.path), "has no scan", "scans", "convert it again")


def _check_said(reader: SequenceReader, taxonomy: Taxonomy) -> Iterator[Finding]:
    header, where = reader.header, str(reader.path)
    if reader.path.name != f"{header.sequence_id}.h5":
        yield Finding(
            ERROR,
            where,
            f"is named {reader.path.name}",
            f"{header.sequence_id}.h5",
            "give the file the name <environment>--<recording>--<lidar>.h5",
        )
    if header.license == UNKNOWN:
        yield Finding(
            ERROR,
            where,
            "the licence is unknown",
            "an SPDX id such as CC-BY-4.0 or CC0-1.0",
            "ask who owns the recording, and convert with --license",
        )
    elif find_spdx(header.license) is None:
        yield Finding(
            ERROR,
            where,
            f"the licence is {header.license!r}",
            "an SPDX id such as CC-BY-4.0 or CC0-1.0 (https://spdx.org/licenses)",
            "convert with --license, or LicenseRef-NAME for a licence of your own",
        )
    if header.taxonomy != taxonomy:
        yield Finding(
            ERROR,
            where,
            f"the classes are {', '.join(header.taxonomy.names)}",
            f"{', '.join(taxonomy.names)}, of the same colours",
            "label it with the taxonomy of the data set",
        )
    if not header.provenance:
        yield Finding(
            NOTE,
            where,
            "does not say how it was made",
            "provenance",
            "make it with semantic2d convert, which notes sources and options",
        )
