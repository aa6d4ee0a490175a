"""Which files a data set has, asked of the hosts that keep it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import PurePosixPath
from typing import Any
from urllib.parse import quote

import requests

from semantic2d_dataset.access.known_datasets import (
    FileTable,
    HuggingFaceFolder,
    KnownDataset,
    RemoteFile,
    Source,
    ZenodoRecord,
)
from semantic2d_dataset.access.web import check_scheme, get_json
from semantic2d_dataset.errors import DownloadError

_MOST_PAGES = 1000
_DIGITS = {"sha256": 64, "md5": 32, "git": 40}


def list_files(session: requests.Session, source: Source) -> list[RemoteFile]:
    """Return the files of a source, by name; those whose name starts with a dot are left out.

    Raises
    ------
    DownloadError
        If the host does not answer, or with something else than a list of files.
    """
    if isinstance(source, FileTable):
        where, found = "registry", list(source.files)
    elif isinstance(source, ZenodoRecord):
        where = f"{source.host}/api/records/{source.record}"
        found = _checked(where, lambda: _list_zenodo(session, where, source))
    else:
        where = f"{source.host}/api/datasets/{source.repository}/tree/{source.revision}"
        found = _checked(where, lambda: _list_hugging_face(session, where, source))
    return check_files(where, found)


class Locations:
    """Where the files of a data set lie: at its main source, then at its mirrors.

    Parameters
    ----------
    session
        Asks the hosts.
    dataset
        The data set.
    kept
        The list of an earlier time, for when no source answers.

    Raises
    ------
    DownloadError
        If no source answers, and there is no such list.
    """

    def __init__(
        self, session: requests.Session, dataset: KnownDataset, kept: Sequence[RemoteFile] = ()
    ) -> None:
        self._session = session
        self._unasked = list(dataset.sources)
        self._mirrors: list[list[RemoteFile]] = []
        found = self._list_first(dataset, kept)
        known = dataset.checksums or {}
        self.files = [replace(file, checksum=known.get(file.name, file.checksum)) for file in found]

    def of(self, file: RemoteFile) -> Iterator[str]:
        """Yield URLs of a file; a mirror is asked only when all before it were tried."""
        yield from file.urls
        for files in self._mirrored():
            same = (f for f in files if (f.name, f.size) == (file.name, file.size))
            yield from (url for f in same for url in f.urls)

    def _list_first(
        self, dataset: KnownDataset, kept: Sequence[RemoteFile]
    ) -> Sequence[RemoteFile]:
        failures = []
        while self._unasked:
            try:
                return list_files(self._session, self._unasked.pop(0))
            except DownloadError as err:
                failures.append(str(err))
        if not kept:
            raise DownloadError(f"{dataset.name}: no host lists its files: {'; '.join(failures)}")
        return kept

    def _mirrored(self) -> Iterator[list[RemoteFile]]:
        yield from list(self._mirrors)
        while self._unasked:
            try:
                files = list_files(self._session, self._unasked.pop(0))
            except DownloadError:
                continue
            self._mirrors.append(files)
            yield files


def check_files(where: str, files: Sequence[RemoteFile]) -> list[RemoteFile]:
    """Return files by name, those left out whose name starts with a dot.

    Raises
    ------
    DownloadError
        If a name could leave its folder or is there twice, or a size or digest is none.
    """
    kept = [file for file in files if not _is_hidden(file.name)]
    for file in kept:
        if not isinstance(file.name, str) or not is_safe_name(file.name):
            raise DownloadError(f"{where}: refused a file named {file.name!r}")
        if type(file.size) is not int or file.size < 0 or not is_checksum(file.checksum):
            raise DownloadError(f"{where}: {file.name}: without a size and a digest as known")
    names = [file.name.casefold() for file in kept]
    clash = set(names) & {str(parent) for name in names for parent in _parents(name)}
    if len(set(names)) != len(names) or clash:
        raise DownloadError(f"{where}: two files have one name")
    return sorted(kept, key=lambda file: file.name)


def is_checksum(text: object) -> bool:
    """Tell whether a text is a digest of a kind that can be checked."""
    kind, _, digits = str(text).partition(":")
    return len(digits) == _DIGITS.get(kind) and not set(digits) - set("0123456789abcdef")


def is_safe_name(name: str) -> bool:
    """Tell whether a relative name stays in its folder on any system, and is not hidden."""
    plain = name.isprintable() and not set(name) & set('\\:*?"<>|')
    parts = name.split("/")
    return plain and all(part and part.strip() == part and part[0] != "." for part in parts)


def _list_zenodo(session: requests.Session, url: str, source: ZenodoRecord) -> list[RemoteFile]:
    said, _ = get_json(session, url)
    files = []
    for each in said["files"]:
        # the page's address serves ranges, that of the interface may not
        page = f"{source.host}/records/{source.record}/files/{quote(each['key'])}"
        urls = (page, each["links"]["self"])
        check_scheme(url, urls[1])
        files.append(RemoteFile(each["key"], each["size"], each["checksum"], urls))
    return files


def _list_hugging_face(
    session: requests.Session, url: str, source: HuggingFaceFolder
) -> list[RemoteFile]:
    folder = PurePosixPath(source.folder)
    page: str | None = f"{url}/{quote(source.folder)}".rstrip("/") + "?recursive=true"
    entries: list[Any] = []
    for _ in range(_MOST_PAGES):
        if page is None:
            break
        said, following = get_json(session, page)
        if following is not None:
            check_scheme(page, following)
        entries += said
        page = following
    base = f"{source.host}/datasets/{source.repository}/resolve/{source.revision}"
    return [
        RemoteFile(
            str(PurePosixPath(each["path"]).relative_to(folder)),
            each["size"],
            f"sha256:{each['lfs']['oid']}" if each.get("lfs") else f"git:{each['oid']}",
            (f"{base}/{quote(each['path'])}",),
        )
        for each in entries
        if each["type"] == "file"
    ]


def _checked(where: str, ask: Callable[[], list[RemoteFile]]) -> list[RemoteFile]:
    try:
        return ask()
    except (KeyError, TypeError, ValueError, AttributeError) as err:
        raise DownloadError(f"{where}: the answer is not a list of files as known") from err


def _is_hidden(name: object) -> bool:
    parts = str(name).split("/")
    return any(part.startswith(".") and part.strip(".") for part in parts)


def _parents(name: str) -> Iterable[PurePosixPath]:
    return PurePosixPath(name).parents
