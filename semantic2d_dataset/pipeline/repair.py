"""Repairing an installed data set: what is damaged or missing is got again, and nothing else."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

from semantic2d_dataset.access.download import find_files, matches
from semantic2d_dataset.access.installed import Part, Record, read_record, write_record
from semantic2d_dataset.access.known_datasets import KnownDataset, RemoteFile, find_known
from semantic2d_dataset.access.registry import make_mini_whole
from semantic2d_dataset.errors import ChecksumError, DatasetNotFoundError, Semantic2DError
from semantic2d_dataset.format.checksums import CHECKSUMS_NAME
from semantic2d_dataset.format.locks import alone
from semantic2d_dataset.format.manifest import (
    MANIFEST_NAME,
    Manifest,
    check_digests,
    check_files,
    find_problems,
    read_manifest,
    write_digests,
    write_manifest,
)
from semantic2d_dataset.format.splits import read_scheme
from semantic2d_dataset.format.writing import write_text_atomically
from semantic2d_dataset.pipeline.archives import Converter
from semantic2d_dataset.pipeline.installation import archives_folder, full_version
from semantic2d_dataset.pipeline.published import Fetcher, is_published_as_data_set
from semantic2d_dataset.pipeline.seeds import seeds_of
from semantic2d_dataset.pipeline.staging import Staging, link

_OTHER_DATA = (
    "holds other data than it did; another version of the package may have made it: remove the "
    "data set, and download it again"
)


def repair(folder: Path, *, registry: Path | str | None = None, offline: bool = False) -> list[str]:
    """Get again what of a data set is damaged or missing.

    Every byte is read to find that out. What is got is verified before the data set is replaced,
    which is as it was where something cannot be got.

    Parameters
    ----------
    folder
        The data set.
    registry
        As for `known_datasets`.
    offline
        Ask no host: make it of archives that are here.

    Returns
    -------
    list of str
        The files that were repaired, as the manifest names them.

    Raises
    ------
    DatasetNotFoundError
        If it was not installed from a registry, so that nothing says where to get it.
    ChecksumError
        If what is got is not what was there.
    Semantic2DError
        If it cannot be got, as from `installation.install`.
    """
    with alone(folder), Staging(folder) as staging:
        record = read_record(folder)
        manifest = _manifest_of(folder, record, staging.work / "told")
        damaged = check_files(folder, manifest, full=True)
        told = _is_told(folder, record)
        if record is not None and not damaged and not told:
            write_text_atomically(folder / MANIFEST_NAME, record.manifest)
        if damaged:
            if record is None:
                raise DatasetNotFoundError(
                    f"{folder}: cannot be repaired, as it was not installed from a registry: get "
                    f"{', '.join(damaged)} where the data set is from, or publish it again"
                )
            known = find_known(record.dataset, registry)
            parts = _make_again(known, staging, folder, record, manifest, damaged, offline=offline)
            _keep_good(folder, staging.data, manifest, record, damaged)
            for problem in find_problems(staging.data, full=True):
                raise problem
            write_record(staging.data, record.dataset, record.lidars, parts)
            staging.publish(lambda: False)
        # without a record, nothing says whether the manifest or the list of digests was changed
        lists_others = record is not None and _lists_others(folder)
        if lists_others:
            write_digests(folder, read_manifest(folder))
        manifests = [] if told else [MANIFEST_NAME]
        return [*damaged, *manifests, *([CHECKSUMS_NAME] if lists_others else [])]


def _manifest_of(folder: Path, record: Record | None, told: Path) -> Manifest:
    """Read the manifest; the copy in the record counts more."""
    if record is not None:
        told.mkdir(exist_ok=True)
        write_text_atomically(told / MANIFEST_NAME, record.manifest)
        try:
            return read_manifest(told)
        except Semantic2DError:
            pass
    try:
        return read_manifest(folder)
    except Semantic2DError as err:
        raise DatasetNotFoundError(
            f"{err}; it cannot be repaired, as no copy is here: publish the sequences again, or "
            "remove the folder and download the data set again"
        ) from err


def _is_told(folder: Path, record: Record | None) -> bool:
    """Tell whether the manifest is as the record has it."""
    try:
        return record is None or (folder / MANIFEST_NAME).read_text("utf-8") == record.manifest
    except (OSError, UnicodeDecodeError):
        return False


def _lists_others(folder: Path) -> bool:
    """Tell whether ``SHA256SUMS`` is there and is not that of the manifest."""
    try:
        check_digests(folder, read_manifest(folder))
    except ChecksumError:
        return True
    return False


def _make_again(
    known: KnownDataset,
    staging: Staging,
    folder: Path,
    record: Record,
    manifest: Manifest,
    damaged: Collection[str],
    *,
    offline: bool,
) -> tuple[Part, ...]:
    seeds = seeds_of(folder, manifest, damaged)
    if not known.sources:
        make_mini_whole(staging.data)
        return ()
    archives = archives_folder(known, folder)
    files = find_files(known, archives, offline=offline)
    if is_published_as_data_set(files):
        Fetcher(known, staging.data, staging.work, folder, offline).fill(files, record.lidars)
        return ()
    sources = {part.file: part.lidars for part in record.parts}
    wanted = {file: sources[file.name] for file in files if file.name in sources}
    kept = [file for file in wanted if _is_kept(archives, file)]
    version = full_version(known)
    converter = Converter(
        known, version, staging.data, staging.work, seeds, archives, not kept, offline
    )
    return converter.fill(wanted)


def _is_kept(archives: Path, file: RemoteFile) -> bool:
    """Tell whether an archive is here; one that is damaged is removed."""
    path = archives / file.name
    if path.is_file() and not (path.stat().st_size == file.size and matches(path, file)):
        path.unlink()
    return path.is_file()


def _keep_good(
    folder: Path, data: Path, manifest: Manifest, record: Record, damaged: Collection[str]
) -> None:
    """Leave what is good the same to the byte, and check that the rest holds what it held."""
    kept = _merge(folder, data, manifest, record, damaged)
    for file in kept.files:
        if file.file not in damaged:
            link(folder / file.file, data / file.file)
    if kept == manifest:  # as it was published, to the byte, which its SHA256SUMS lists
        write_text_atomically(data / MANIFEST_NAME, record.manifest)
    else:
        write_manifest(data, kept)


def _merge(
    folder: Path, data: Path, manifest: Manifest, record: Record, damaged: Collection[str]
) -> Manifest:
    """Return the manifest with the entries of what was made again, which must hold the same."""
    made = read_manifest(data)
    sequences, splits = {e.id: e for e in manifest.sequences}, dict(manifest.splits)
    if sequences.keys() != made.lengths.keys() or splits.keys() != made.splits.keys():
        raise ChecksumError(f"{data}: has other sequences or splits than {folder} had")
    for entry in made.sequences:
        if entry.content_digest != sequences[entry.id].content_digest:
            raise ChecksumError(f"{data / entry.file}: {_OTHER_DATA}")
        if entry.file in damaged:
            sequences[entry.id] = entry
    for name, split in made.splits.items():
        scheme = read_scheme(data / split.file, name, made.lengths)
        if scheme.digest != record.schemes.get(name):
            raise ChecksumError(f"{data / split.file}: {_OTHER_DATA}")
        if split.file in damaged:
            splits[name] = split
    return replace(manifest, sequences=tuple(sequences.values()), splits=splits)
