"""Installing a known data set: downloaded, converted where need be, and whole when it is there."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from semantic2d_dataset.access.download import download_folder, find_files
from semantic2d_dataset.access.installed import (
    Lidars,
    Part,
    data_folder,
    includes,
    is_complete,
    is_installed,
    read_record,
    write_record,
)
from semantic2d_dataset.access.known_datasets import PROCESSED, KnownDataset, RemoteFile
from semantic2d_dataset.access.registry import OpenDataset, open_dataset
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.locks import alone
from semantic2d_dataset.format.manifest import check_names, read_manifest
from semantic2d_dataset.pipeline.archives import Converter
from semantic2d_dataset.pipeline.published import Fetcher, is_published_as_data_set
from semantic2d_dataset.pipeline.seeds import seeds_of
from semantic2d_dataset.pipeline.staging import Staging, tidy

_ARCHIVES = "archives"


@dataclass(frozen=True)
class Installation:
    """A data set that is installed.

    Parameters
    ----------
    data
        The data set.
    changed
        Whether anything was done.
    archives
        Where its archives are, if it was made of any and they are kept.
    """

    data: OpenDataset
    changed: bool
    archives: Path | None = None


def install(
    known: KnownDataset,
    folder: Path | None = None,
    *,
    lidars: Sequence[str] = (),
    only: Sequence[str] = (),
    remove_archives: bool = False,
    offline: bool = False,
) -> Installation:
    """Download a data set and convert it, unless it is installed already.

    What is not in this package's format is converted, archive by archive, without unpacking. The
    data set appears when it is whole, and is replaced as a whole where something is added to it.
    A run that ends early leaves what the next one goes on from.

    Parameters
    ----------
    known
        From a registry.
    folder
        The folder that becomes the data set; below `places.home` where not given.
    lidars
        Those that are wanted; none means all. Those that are installed stay.
    only
        Glob patterns over whole names of files; all files where none is given.
    remove_archives
        Whether each archive is removed when what it gave is complete.
    offline
        Ask no host: make it of what is here.

    Raises
    ------
    InvalidInputError
        If a name or pattern fits nothing, or the folder holds something else.
    DatasetNotFoundError
        If nothing was measured by these lidars.
    DownloadError, OfflineError, ChecksumError, WriteError
        As from `semantic2d_dataset.access.download.download`.
    RecordingError
        If an archive cannot be converted.
    """
    if not known.sources:
        return _open_generated(known, folder)
    wanted = known.lidar_names(lidars) or None
    check_names(known.id, full_version(known))
    target = data_folder(known) if folder is None else folder
    _check_target(target, known)
    if not only and _has(target, known, wanted):
        tidy(target)
        return Installation(open_dataset(target), changed=False)
    with alone(target), Staging(target) as staging:
        if not only and _has(target, known, wanted):
            return Installation(open_dataset(target), changed=False)
        archives = archives_folder(known, folder)
        files = _choose(known, archives, wanted, only, offline=offline)
        before = seeds_of(target)
        had: Lidars = before.record.lidars if before.record else ()
        both = None if had is None or wanted is None else tuple(sorted({*had, *wanted}))
        parts: tuple[Part, ...] = ()
        if is_published_as_data_set(files):
            Fetcher(known, staging.data, staging.work, target, offline).fill(files, both)
        else:
            converter = Converter(
                known,
                full_version(known),
                staging.data,
                staging.work,
                before,
                archives,
                remove_archives,
                offline,
            )
            parts = converter.fill(dict.fromkeys(files, wanted))
        write_record(staging.data, known.name, had if only else both, parts)
        staging.publish(lambda: _is_no_less(target, staging.data))
    kept = archives if archives.is_dir() and not remove_archives else None
    return Installation(open_dataset(target), changed=True, archives=kept)


def archives_folder(known: KnownDataset, folder: Path | None) -> Path:
    """Return where archives go: beside a folder that was chosen, as that has the room."""
    if folder is None or folder == data_folder(known):
        return download_folder(known)
    return folder.with_name(f"{folder.name}-{_ARCHIVES}")


def full_version(known: KnownDataset) -> str:
    """Return the version as a manifest has it: ``2`` becomes ``2.0.0``."""
    short = re.fullmatch(r"[0-9]+(\.[0-9]+)?", known.version)
    return known.version if short is None else known.version + ".0" * (2 - known.version.count("."))


def _open_generated(known: KnownDataset, folder: Path | None) -> Installation:
    if folder is not None:
        raise InvalidInputError(
            f"{known.name}: is made on this machine, where data sets are kept, not downloaded; "
            "choose that place by SEMANTIC2D_HOME"
        )
    there = is_complete(data_folder(known))
    return Installation(open_dataset(known.name), changed=not there)


def _has(target: Path, known: KnownDataset, wanted: Lidars) -> bool:
    """Tell whether a data set is there with these lidars; all are those that are told."""
    record, wanted = read_record(target), wanted or tuple(known.lidars) or None
    return (
        record is not None
        and record.dataset == known.name
        and includes(record.lidars, wanted)
        and is_complete(target)
    )


def _is_no_less(folder: Path, other: Path) -> bool:
    """Tell whether a data set that is there has all that another one has."""
    here, made = read_record(folder), read_record(other)
    return (
        here is not None
        and made is not None
        and includes(here.lidars, made.lidars)
        and is_complete(folder)
        and set(read_manifest(other).lengths) <= set(read_manifest(folder).lengths)
    )


def _check_target(target: Path, known: KnownDataset) -> None:
    if not target.exists():
        return
    if not target.is_dir():
        raise InvalidInputError(f"{target}: a file is in the way; choose another folder (--to)")
    record = read_record(target)
    if record is None and any(target.iterdir()):
        what = "a data set" if is_installed(target) else "files"
        raise InvalidInputError(
            f"{target}: holds {what} that was not installed here; choose a new folder (--to)"
        )
    if record is not None and record.dataset != known.name:
        raise InvalidInputError(
            f"{target}: holds {record.dataset}, not {known.name}; choose another folder (--to)"
        )


def _choose(
    known: KnownDataset, archives: Path, lidars: Lidars, only: Sequence[str], *, offline: bool
) -> list[RemoteFile]:
    """List the files that are processed data, of the lidars that are wanted where that is told."""
    files = find_files(known, archives, part=PROCESSED, offline=offline)
    if not is_published_as_data_set(files):
        return find_files(
            known, archives, only=only, part=PROCESSED, lidars=lidars or (), offline=offline
        )
    if only:
        raise InvalidInputError(
            f"{known.name}: is published as a data set, of which --only takes no part; "
            "choose by --lidar"
        )
    return files


def describe(known: KnownDataset, done: Installation) -> dict[str, Any]:
    """Return plain values that say what was installed."""
    manifest = done.data.manifest
    return {
        "dataset": known.name,
        "title": known.title,
        "license": known.license,
        "folder": str(done.data.root),
        "changed": done.changed,
        "sequences": len(manifest.sequences),
        "scans": sum(manifest.lengths.values()),
        "lidars": sorted({entry.lidar for entry in manifest.sequences}),
        "bytes": sum(entry.bytes for entry in manifest.files),
        "archives": None if done.archives is None else str(done.archives),
    }


def format_description(said: Mapping[str, Any]) -> str:
    """Return what `describe` says as text."""
    count = said["sequences"]
    sequences = f"{count} {'sequence' if count == 1 else 'sequences'}"
    kept = f"archives are kept in {said['archives']}\n" if said["archives"] else ""
    return (
        f"{said['dataset']}: {said['title']}\nlicense: {said['license']}\n{kept}"
        f"{said['folder']}: {'' if said['changed'] else 'was there; '}{sequences}, "
        f"{said['scans']:,} scans of {', '.join(said['lidars'])}, "
        f"{said['bytes'] / 1e6:,.1f} MB"
    )
