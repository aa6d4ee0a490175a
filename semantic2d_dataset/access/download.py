"""Getting the files of a known data set: resumed, checked, and complete under their names."""

from __future__ import annotations

import fnmatch
import hashlib
import json
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Never

import requests
from tqdm import tqdm

from semantic2d_dataset.access.file_lists import Locations, check_files
from semantic2d_dataset.access.known_datasets import ALL, FileTable, KnownDataset, RemoteFile
from semantic2d_dataset.access.partials import Partial
from semantic2d_dataset.access.places import home, is_offline
from semantic2d_dataset.access.web import AttemptError, new_session, open_url, persist
from semantic2d_dataset.errors import (
    ChecksumError,
    DownloadError,
    InvalidInputError,
    OfflineError,
    Semantic2DError,
    WriteError,
)
from semantic2d_dataset.format.container import load_json
from semantic2d_dataset.format.locks import alone
from semantic2d_dataset.format.writing import write_text_atomically

LIST_NAME = ".files.json"
"""The list of files as it was last seen, kept beside them for the time without a network."""

_FREE_BYTES_KEPT = 1 << 26
_CHUNK = 1 << 16
_TRIES_FOR_CONTENT = 2
"""From each place; bytes that arrived in parts may not fit together."""


@dataclass(frozen=True)
class LocalFile:
    """A file that is here, checked.

    Parameters
    ----------
    name
        As in the list.
    path
        Where it is.
    size
        Bytes.
    checksum
        The digest that it was found to have, such as ``md5:...``.
    fetched
        Whether it was downloaded just now.
    """

    name: str
    path: Path
    size: int
    checksum: str
    fetched: bool


def download_folder(dataset: KnownDataset) -> Path:
    """Return the folder that files go to unless another is chosen; below `registry.home`."""
    return home() / "downloads" / f"{dataset.id}-{dataset.version}"


def find_files(
    dataset: KnownDataset,
    folder: Path,
    *,
    only: Sequence[str] = (),
    part: str = ALL,
    lidars: Sequence[str] = (),
    offline: bool = False,
) -> list[RemoteFile]:
    """List the files of a data set, without fetching any.

    Parameters
    ----------
    dataset
        From a registry.
    folder
        Where the files are or will be.
    only
        Glob patterns over whole names; all files where none is given.
    part
        One of `known_datasets.PARTS`.
    lidars
        Files are left out of which it is told that they hold scans of other lidars only.
    offline
        Ask no host; nor is one asked where `is_offline`.

    Raises
    ------
    InvalidInputError
        If the data set is not one to download, or nothing fits a pattern.
    DownloadError
        If no host answers.
    OfflineError
        If no host may be asked and the list was not kept.
    """
    if offline or is_offline():
        return _choose(dataset, _kept_or_fail(dataset, folder), only, part, lidars)
    with new_session() as session:
        return _choose(dataset, _locate(session, dataset, folder).files, only, part, lidars)


def download(
    dataset: KnownDataset,
    folder: Path,
    *,
    only: Sequence[str] = (),
    part: str = ALL,
    lidars: Sequence[str] = (),
    offline: bool = False,
) -> list[LocalFile]:
    """Get the files of a data set that are not in a folder yet, and check all of them.

    What has arrived when a run ends early is kept, and the next run goes on from there. Several
    processes may do this at once.

    Parameters
    ----------
    dataset
        From a registry.
    folder
        Is made where there is none.
    only
        Glob patterns over whole names; all files where none is given.
    part
        One of `known_datasets.PARTS`.
    lidars
        Files are left out of which it is told that they hold scans of other lidars only.
    offline
        Ask no host: check what is there; so it is where `is_offline`.

    Raises
    ------
    InvalidInputError
        If the data set is not one to download, or nothing fits a pattern.
    ChecksumError
        If a file is there with other content, or no host has the right one.
    DownloadError
        If no host delivers a file.
    OfflineError
        If something is missing and no host may be asked.
    WriteError
        If the disk is or would be full.
    """
    if offline or is_offline():
        files = _choose(dataset, _kept_or_fail(dataset, folder), only, part, lidars)
        missing = [file for file in files if not _is_there(folder, file)]
        if missing:
            raise OfflineError(
                f"{dataset.name}: offline, and {_names(missing)} "
                f"{'is' if len(missing) == 1 else 'are'} missing; put them into {folder}, "
                "or download where there is a network"
            )
        return [_local(folder, file) for file in files]
    with new_session() as session:
        locations = _locate(session, dataset, folder)
        files = _choose(dataset, locations.files, only, part, lidars)
        missing = [file for file in files if not _is_there(folder, file)]
        folder.mkdir(parents=True, exist_ok=True)
        _check_space(folder, missing)
        if _read_list(dataset, folder) != locations.files:  # else the folder may be read-only
            _keep_list(dataset, folder, locations.files)
        for file in missing:
            _fetch_once(session, file, folder, locations)
    return [_local(folder, file, fetched=file in missing) for file in files]


def describe(
    dataset: KnownDataset, files: Iterable[RemoteFile] | Iterable[LocalFile]
) -> dict[str, Any]:
    """Return plain values that say what a data set is and which files these are."""
    said = {
        "dataset": dataset.name,
        "title": dataset.title,
        "license": dataset.license,
        "doi": dataset.doi,
        "citation": dataset.citation,
        "files": [
            {"name": file.name, "bytes": file.size, "checksum": file.checksum}
            | ({"fetched": file.fetched} if isinstance(file, LocalFile) else {})
            for file in files
        ],
    }
    return {key: value for key, value in said.items() if value is not None}


def format_description(said: Mapping[str, Any]) -> str:
    """Return what `describe` says as text; with a folder, what was done there."""
    head = [f"{said['dataset']}: {said['title']}", f"license: {said['license']}"]
    head += [f"cite: {said['citation']}"] if "citation" in said else []
    head += [f"https://doi.org/{said['doi']}"] if "doi" in said else []
    files = said["files"]
    lines = [f"{tqdm.format_sizeof(f['bytes'], 'B', 1000):>8}  {f['name']}" for f in files]
    total = tqdm.format_sizeof(sum(f["bytes"] for f in files), "B", 1000)
    end = f"{len(files)} file(s), {total}"
    if "folder" in said:
        there = sum(not f["fetched"] for f in files)
        end += f" in {said['folder']}, checked; {there} had been there"
    return "\n".join([*head, *lines, end])


def _locate(session: requests.Session, dataset: KnownDataset, folder: Path) -> Locations:
    _check_source(dataset)
    return Locations(session, dataset, kept=_read_list(dataset, folder))


def _check_source(dataset: KnownDataset) -> None:
    if not dataset.sources:
        raise InvalidInputError(
            f"{dataset.name}: is made on this machine when it is first used, not downloaded; "
            f"try: semantic2d info {dataset.id}"
        )


def _kept_or_fail(dataset: KnownDataset, folder: Path) -> list[RemoteFile]:
    _check_source(dataset)
    files = _read_list(dataset, folder)
    table = next((each for each in dataset.sources if isinstance(each, FileTable)), None)
    if not files and table is not None:
        files = check_files(dataset.name, table.files)
    if not files:
        raise OfflineError(
            f"{dataset.name}: offline, and its list of files is not here; download where there is "
            f"a network, then copy that folder, {LIST_NAME} included, to {folder}"
        )
    return files


def _choose(
    dataset: KnownDataset,
    files: Sequence[RemoteFile],
    only: Sequence[str],
    part: str,
    lidars: Sequence[str],
) -> list[RemoteFile]:
    for pattern in only:
        if not any(fnmatch.fnmatchcase(file.name, pattern) for file in files):
            raise InvalidInputError(
                f"no file fits {pattern!r}; the {len(files)} there are: {_names(files)}"
            )
    chosen = [
        file
        for file in files
        if (not only or any(fnmatch.fnmatchcase(file.name, pattern) for pattern in only))
        and dataset.belongs(file.name, part)
        and (not lidars or dataset.may_hold(file.name, lidars))
    ]
    if files and not chosen:
        what = f"{part} data" + (f" of {', '.join(lidars)}" if lidars else "")
        raise InvalidInputError(
            f"{dataset.name}: none of these files is told by its name to be {what}: "
            f"{_names(files)}; get them as they are with --archives-only --part all"
        )
    return chosen


def _names(files: Sequence[RemoteFile], most: int = 5) -> str:
    more = f" and {len(files) - most} more" if len(files) > most else ""
    return ", ".join(file.name for file in files[:most]) + more


def _local(folder: Path, file: RemoteFile, *, fetched: bool = False) -> LocalFile:
    return LocalFile(file.name, folder / file.name, file.size, file.checksum, fetched)


def _is_there(folder: Path, file: RemoteFile) -> bool:
    path = folder / file.name
    if not path.exists():
        return False
    if not path.is_file() or path.stat().st_size != file.size or not matches(path, file):
        raise ChecksumError(
            f"{path}: is not the file of {file.size} bytes with {file.checksum}; "
            "move it away, and run this again"
        )
    return True


def _check_space(folder: Path, missing: Iterable[RemoteFile]) -> None:
    parts = ((file, Partial(folder / file.name, file.checksum)) for file in missing)
    needed = sum(max(file.size - part.kept_bytes(), 0) for file, part in parts)
    free = shutil.disk_usage(folder).free
    if needed and free < needed + _FREE_BYTES_KEPT:
        raise WriteError(
            f"{folder}: {free:,} bytes are free, and {needed + _FREE_BYTES_KEPT:,} are needed; "
            "make room, choose another folder (--to), or fewer files (--only)"
        )


def _fetch_once(
    session: requests.Session, file: RemoteFile, folder: Path, locations: Locations
) -> None:
    """Get a file unless another process just did."""
    target = folder / file.name
    with alone(target):  # saves work; that partial files have names of their own keeps it right
        if not _is_there(folder, file):
            _fetch(session, file, target, locations.of(file))


def _fetch(session: requests.Session, file: RemoteFile, target: Path, urls: Iterable[str]) -> None:
    """Get one file from the first place that delivers it."""
    failures: list[str] = []
    error: type[Semantic2DError] = DownloadError
    with Partial(target, file.checksum) as partial:
        if partial.size > file.size:
            partial.path.write_bytes(b"")
        for url in urls:
            for _ in range(_TRIES_FOR_CONTENT):
                try:
                    _receive(session, url, file, partial)
                except AttemptError as err:
                    failures.append(str(err))
                    break
                if partial.size == file.size and matches(partial.path, file):
                    partial.publish()
                    return
                partial.path.write_bytes(b"")
                failures.append(f"{url}: other content than {file.checksum}")
                error = ChecksumError
    raise error(f"{file.name}: could not be had: {'; '.join(dict.fromkeys(failures))}")


def _receive(session: requests.Session, url: str, file: RemoteFile, partial: Partial) -> None:
    with tqdm(
        total=file.size,
        initial=partial.size,
        unit="B",
        unit_scale=True,
        desc=file.name,
        disable=None,
    ) as bar:
        persist(lambda: _receive_once(session, url, file, partial, bar), lambda: partial.size)


def _receive_once(
    session: requests.Session, url: str, file: RemoteFile, partial: Partial, bar: tqdm[Never]
) -> None:
    offset = partial.size
    if offset == file.size:
        return
    with open_url(session, url, offset) as response, partial.path.open("ab") as stream:
        skipped = _check_answer(response, url, file, offset)
        arrived = offset - skipped
        for chunk in response.iter_content(_CHUNK):
            fresh = chunk[max(offset - arrived, 0) :]
            arrived += len(chunk)
            if arrived > file.size:
                raise AttemptError(f"{url}: sends more than {file.size} bytes", again=False)
            try:
                stream.write(fresh)
                stream.flush()
            except OSError as err:
                raise WriteError(f"{partial.path}: {(err.strerror or str(err)).lower()}") from err
            bar.update(len(fresh))
    if arrived < file.size:
        raise AttemptError(f"{url}: broke off after {arrived} of {file.size} bytes")


def _check_answer(response: requests.Response, url: str, file: RemoteFile, offset: int) -> int:
    """Return how many bytes will come that are here already."""
    kind = response.headers.get("Content-Type", "")
    if kind.startswith("text/html") and not file.name.endswith((".html", ".htm")):
        raise AttemptError(f"{url}: a web page came instead of the file")
    if response.status_code == 206:
        said = response.headers.get("Content-Range", "")
        start, _, end = said.removeprefix("bytes ").partition("-")
        total = end.rpartition("/")[2]
        if start != str(offset) or total not in (str(file.size), "*"):
            raise AttemptError(
                f"{url}: expected bytes {offset}-{file.size - 1}/{file.size}, found {said!r}",
                again=False,
            )
        return 0
    length = response.headers.get("Content-Length", str(file.size))
    if length != str(file.size):
        raise AttemptError(f"{url}: expected {file.size} bytes, found {length}", again=False)
    return offset


def matches(path: Path, file: RemoteFile) -> bool:
    """Tell whether the bytes of a file, of the size listed, have the digest that its list gives."""
    kind, _, digits = file.checksum.partition(":")
    name = "sha1" if kind == "git" else kind
    digest = hashlib.new(name, usedforsecurity=kind == "sha256")
    if kind == "git":
        digest.update(f"blob {file.size}\0".encode())
    with (
        path.open("rb") as stream,
        tqdm(
            total=file.size,
            unit="B",
            unit_scale=True,
            desc=f"checking {file.name}",
            disable=None,
            delay=1,
            leave=False,
        ) as bar,
    ):
        while chunk := stream.read(1 << 20):
            digest.update(chunk)
            bar.update(len(chunk))
    return digest.hexdigest() == digits


def _keep_list(dataset: KnownDataset, folder: Path, files: Iterable[RemoteFile]) -> None:
    said = {"dataset": dataset.name, "files": [asdict(file) for file in files]}
    write_text_atomically(folder / LIST_NAME, json.dumps(said, indent=1) + "\n")


def _read_list(dataset: KnownDataset, folder: Path) -> list[RemoteFile]:
    """Return the list that was kept; none where it is missing, of something else or damaged."""
    path = folder / LIST_NAME
    try:
        said = load_json(path.read_bytes())
        if said["dataset"] != dataset.name:
            return []
        files = [RemoteFile(**each | {"urls": tuple(each["urls"])}) for each in said["files"]]
        return check_files(str(path), files)
    except (OSError, Semantic2DError, KeyError, TypeError, ValueError):
        return []
