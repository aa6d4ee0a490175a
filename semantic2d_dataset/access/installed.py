"""Data sets that were installed on this machine, and what each of them was made of."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from semantic2d_dataset.access.known_datasets import KnownDataset, find_known, known_datasets
from semantic2d_dataset.access.places import home
from semantic2d_dataset.errors import DatasetNotFoundError, Semantic2DError
from semantic2d_dataset.format.container import load_json
from semantic2d_dataset.format.manifest import MANIFEST_NAME, read_manifest
from semantic2d_dataset.format.splits import read_scheme
from semantic2d_dataset.format.writing import write_text_atomically
from semantic2d_dataset.scene.documents import hint

RECORD_NAME = ".installed.json"
_KIND = "semantic2d-installation"

Lidars = tuple[str, ...] | None
"""Names of lidars; None is all that there are."""


@dataclass(frozen=True)
class Part:
    """What became of one archive.

    Parameters
    ----------
    file, checksum
        Its name and digest as listed.
    lidars
        Those whose scans were looked for.
    sequences
        Ids of those that it gave.
    """

    file: str
    checksum: str
    lidars: Lidars
    sequences: tuple[str, ...]


@dataclass(frozen=True)
class Record:
    """What a data set was made of; kept in its folder.

    Parameters
    ----------
    dataset
        Id and version: ``semantic2d@2``.
    lidars
        Those that it was made for, of everything published; () where of chosen files only.
    parts
        The archives that were converted; none where it was published as it is.
    manifest
        A copy of ``dataset.json``.
    schemes
        The digest of each split scheme, by its name.
    """

    dataset: str
    lidars: Lidars
    parts: tuple[Part, ...]
    manifest: str
    schemes: Mapping[str, str]


def data_folder(known: KnownDataset) -> Path:
    """Return the folder that a data set is installed in unless another is chosen."""
    return datasets_home() / f"{known.id}-{known.version}"


def datasets_home() -> Path:
    """Return the folder of all data sets that are installed; below `places.home`."""
    return home() / "datasets"


def includes(lidars: Lidars, others: Lidars) -> bool:
    """Tell whether lidars hold others."""
    return lidars is None or (others is not None and set(others) <= set(lidars))


def write_record(
    folder: Path, dataset: str, lidars: Lidars = None, parts: tuple[Part, ...] = ()
) -> None:
    """Write the record of a data set that is whole into its folder."""
    manifest = read_manifest(folder)
    schemes = {
        name: read_scheme(folder / entry.file, name, manifest.lengths).digest
        for name, entry in manifest.splits.items()
    }
    text = (folder / MANIFEST_NAME).read_text("utf-8")
    record = Record(dataset, lidars, parts, text, schemes)
    said = {"format": _KIND, "format_version": "1.0"} | asdict(record)
    write_text_atomically(folder / RECORD_NAME, json.dumps(said, indent=1) + "\n")


def read_record(folder: Path) -> Record | None:
    """Read the record of a data set; None where there is none that can be read."""
    try:
        said = load_json((folder / RECORD_NAME).read_bytes())
        if said["format"] != _KIND or not said["format_version"].startswith("1."):
            return None
        parts = tuple(
            Part(p["file"], p["checksum"], _lidars(p["lidars"]), tuple(p["sequences"]))
            for p in said["parts"]
        )
        schemes = {str(name): str(digest) for name, digest in said["schemes"].items()}
        record = Record(said["dataset"], _lidars(said["lidars"]), parts, said["manifest"], schemes)
    except (OSError, Semantic2DError, KeyError, TypeError, AttributeError):
        return None
    return record if isinstance(record.dataset, str) and isinstance(record.manifest, str) else None


def _lidars(said: Collection[str] | None) -> Lidars:
    return None if said is None else tuple(said)


def is_complete(folder: Path) -> bool:
    """Tell whether every file that the manifest names is there with its size."""
    try:
        files = read_manifest(folder).files
        return all((folder / e.file).stat().st_size == e.bytes for e in files)
    except (Semantic2DError, OSError):
        return False


def is_installed(folder: Path) -> bool:
    """Tell whether a data set, be it damaged, is in a folder."""
    return (folder / MANIFEST_NAME).is_file() or (folder / RECORD_NAME).is_file()


def installed() -> Iterator[tuple[str, Path]]:
    """Yield id and version, and folder, of every data set that is installed."""
    for folder in sorted(datasets_home().glob("[!.]*")):
        record = read_record(folder)
        if record is not None:
            yield record.dataset, folder


def find_installed(
    name: str, *, version: str | None = None, registry: Path | str | None = None
) -> Path:
    """Return the folder of a data set that is installed.

    Parameters
    ----------
    name
        ``ID``, which means the newest that is known, or ``ID@VERSION``.
    version
        The other way to say a version.
    registry
        As for `known_datasets.known_datasets`.

    Raises
    ------
    DatasetNotFoundError
        If it is not known, or not installed; then it says how to get it.
    """
    wanted = name if version is None else f"{name}@{version}"
    here = dict(installed())
    if wanted in here:
        return here[wanted]
    try:
        known = find_known(wanted, registry)
    except DatasetNotFoundError as err:
        of_that_id = [each for each in here if each.partition("@")[0] == wanted]
        if len(of_that_id) == 1:
            return here[of_that_id[0]]
        names = [each.name for each in known_datasets(registry)]
        raise DatasetNotFoundError(
            f"{wanted}: neither a folder with {MANIFEST_NAME} nor a known data set"
            f"{hint(wanted, names)}"
        ) from err
    if is_installed(data_folder(known)):
        return data_folder(known)
    others = [each for each in here if each.partition("@")[0] == known.id]
    raise DatasetNotFoundError(
        f"{known.name}: not installed{f' ({_names(others)} is)' if others else ''}; get it with: "
        f"semantic2d download {known.name} (load_dataset: download=True)"
    )


def _names(names: Collection[str]) -> str:
    return ", ".join(names)
