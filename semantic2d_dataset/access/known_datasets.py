"""Data sets that can be downloaded: where from, under what licence, how to cite them."""

from __future__ import annotations

import fnmatch
import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import jsonschema

from semantic2d_dataset.errors import DatasetNotFoundError, InvalidInputError
from semantic2d_dataset.format.container import check_version, load_json, newer_minor_hint
from semantic2d_dataset.scene.documents import hint
from semantic2d_dataset.scene.lidars import find_lidar

REGISTRY_VARIABLE = "SEMANTIC2D_REGISTRY"
RAW, PROCESSED, ALL = "raw", "processed", "all"
PARTS = (PROCESSED, RAW, ALL)


@dataclass(frozen=True)
class ZenodoRecord:
    """A record whose files the host lists with sizes and MD5 digests."""

    record: str
    host: str = "https://zenodo.org"


@dataclass(frozen=True)
class HuggingFaceFolder:
    """A folder of a data set repository, listed with sizes and SHA-256 or git digests."""

    repository: str
    folder: str = ""
    revision: str = "main"
    host: str = "https://huggingface.co"


@dataclass(frozen=True)
class RemoteFile:
    """A file that can be fetched.

    Parameters
    ----------
    name
        Relative name, with ``/`` between folders.
    size
        Bytes.
    checksum
        ``sha256:``, ``md5:`` or ``git:`` (a blob's SHA-1) and hexadecimal digits.
    urls
        Where it lies, in the order to try.
    """

    name: str
    size: int
    checksum: str
    urls: tuple[str, ...]


@dataclass(frozen=True)
class FileTable:
    """Files that the registry itself lists."""

    files: tuple[RemoteFile, ...]


Source = ZenodoRecord | HuggingFaceFolder | FileTable


@dataclass(frozen=True)
class KnownDataset:
    """An entry of a registry.

    Parameters
    ----------
    id, version
        Together they name it: ``semantic2d@2``.
    title, license, doi, citation
        What it is; the last two where known.
    sources
        The first that answers is used, the others are its mirrors; none if it is generated.
    checksums
        Digests by file name, which count more than what a source says.
    parts
        Glob patterns of the names of ``raw`` and ``processed`` files. What fits no pattern of
        ``raw`` is processed, where there are no patterns of ``processed``.
    lidars
        The lidars that it has, and glob patterns of the names of files that hold scans of each.
        What fits no pattern may hold any.
    """

    id: str
    version: str
    title: str
    license: str
    sources: tuple[Source, ...]
    doi: str | None = None
    citation: str | None = None
    checksums: Mapping[str, str] | None = None
    parts: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    lidars: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Id and version."""
        return f"{self.id}@{self.version}"

    def belongs(self, file: str, part: str) -> bool:
        """Tell by its name whether a file is of a part: one of `PARTS`."""
        if part == ALL:
            return True
        is_raw = _fits(file, self.parts.get(RAW, ()))
        if part == PROCESSED:
            patterns = self.parts.get(PROCESSED, ())
            return not is_raw and (not patterns or _fits(file, patterns))
        return is_raw

    def may_hold(self, file: str, lidars: Iterable[str]) -> bool:
        """Tell by its name whether a file may hold scans of one of these lidars."""
        told = {name for name, patterns in self.lidars.items() if _fits(file, patterns)}
        return not told or not told.isdisjoint(lidars)

    def lidar_names(self, given: Iterable[str]) -> tuple[str, ...]:
        """Return the full names of lidars.

        Raises
        ------
        InvalidInputError
            If it is told which lidars there are, and one is none of them.
        """
        return tuple(dict.fromkeys(map(self._lidar_name, given)))

    def _lidar_name(self, given: str) -> str:
        try:
            name = given if given in self.lidars else find_lidar(given).name
        except InvalidInputError:
            name = given
        if self.lidars and name not in self.lidars:
            raise InvalidInputError(
                f"{self.name}: has no lidar {given!r}; it has {', '.join(self.lidars)}"
            )
        return name


def known_datasets(registry: Path | str | None = None) -> list[KnownDataset]:
    """Return the data sets of a registry file and those that are known without, in that order.

    Parameters
    ----------
    registry
        A file like ``registry.json`` of this package, or its URL; ``SEMANTIC2D_REGISTRY`` where
        not given, if set.

    Raises
    ------
    FileNotFoundError
        If the registry is not there.
    DownloadError, OfflineError
        If it cannot be had from its host, and was not before.
    InvalidInputError, FormatVersionError
        If it cannot be read.
    """
    own = _read_own(str(registry or os.environ.get(REGISTRY_VARIABLE) or ""))
    names = {dataset.name for dataset in own}
    return own + [dataset for dataset in _built_in() if dataset.name not in names]


def find_known(name: str, registry: Path | str | None = None) -> KnownDataset:
    """Return a data set by ``ID@VERSION``, or by its id: the first version that is listed.

    >>> find_known("semantic2d").name
    'semantic2d@2'

    Raises
    ------
    DatasetNotFoundError
        If there is none.
    """
    known = known_datasets(registry)
    for dataset in known:
        if name in (dataset.id, dataset.name):
            return dataset
    raise DatasetNotFoundError(
        f"{name}: not a known data set{hint(name, [dataset.name for dataset in known])}"
    )


def _read_own(chosen: str) -> list[KnownDataset]:
    if not chosen:
        return []
    if "://" in chosen:
        from semantic2d_dataset.access.remote_registry import fetch_registry, keep_registry

        text = fetch_registry(chosen)
        found = _read(chosen, text)
        keep_registry(chosen, text)
        return found
    return _read(chosen, Path(chosen).read_bytes())


@cache
def _built_in() -> tuple[KnownDataset, ...]:
    path = resources.files(__package__).joinpath("registry.json")
    return tuple(_read("registry.json", path.read_bytes()))


@cache
def _schema() -> Any:
    return json.loads(
        resources.files(__package__).joinpath("registry.schema.json").read_text("utf-8")
    )


def _read(path: str, text: bytes) -> list[KnownDataset]:
    try:
        said = load_json(text)
    except InvalidInputError as err:
        raise InvalidInputError(f"{path}: {err}") from err
    if isinstance(said, dict) and isinstance(said.get("format_version"), str):
        check_version(Path(path), said["format_version"])
    problem = jsonschema.exceptions.best_match(
        jsonschema.Draft202012Validator(_schema()).iter_errors(said)
    )
    if problem is not None:
        newer = newer_minor_hint(said.get("format_version")) if isinstance(said, dict) else ""
        raise InvalidInputError(f"{path}: {problem.json_path}: {problem.message}{newer}")
    found = [_entry(each) for each in said["datasets"]]
    if len({dataset.name for dataset in found}) != len(found):
        raise InvalidInputError(f"{path}: lists a data set twice")
    return found


def _entry(said: Mapping[str, Any]) -> KnownDataset:
    patterns = {
        key: {name: tuple(each) for name, each in said.get(key, {}).items()}
        for key in ("parts", "lidars")
    }
    return KnownDataset(**{**said, "sources": tuple(map(_source, said["sources"])), **patterns})


def _fits(name: str, patterns: Iterable[str]) -> bool:
    """Tell whether a name fits a pattern, whatever the case."""
    return any(fnmatch.fnmatchcase(name.lower(), pattern.lower()) for pattern in patterns)


def _source(said: Mapping[str, Any]) -> Source:
    options = {key: value for key, value in said.items() if key != "kind"}
    if said["kind"] == "zenodo":
        return ZenodoRecord(**options)
    if said["kind"] == "huggingface":
        return HuggingFaceFolder(**options)
    return FileTable(
        tuple(RemoteFile(f["name"], f["size"], f["checksum"], (f["url"],)) for f in said["files"])
    )
