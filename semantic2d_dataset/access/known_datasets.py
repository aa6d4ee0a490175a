"""Data sets that can be downloaded: where from, under what licence, how to cite them."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import jsonschema

from semantic2d_dataset.errors import DatasetNotFoundError, InvalidInputError
from semantic2d_dataset.format.container import check_version, load_json, newer_minor_hint
from semantic2d_dataset.scene.documents import hint

REGISTRY_VARIABLE = "SEMANTIC2D_REGISTRY"


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
    """

    id: str
    version: str
    title: str
    license: str
    sources: tuple[Source, ...]
    doi: str | None = None
    citation: str | None = None
    checksums: Mapping[str, str] | None = None

    @property
    def name(self) -> str:
        """Id and version."""
        return f"{self.id}@{self.version}"


def known_datasets(registry: Path | None = None) -> list[KnownDataset]:
    """Return the data sets of a registry file and those that are known without, in that order.

    Parameters
    ----------
    registry
        Like ``registry.json`` of this package; ``SEMANTIC2D_REGISTRY`` where not given, if set.

    Raises
    ------
    FileNotFoundError
        If the registry is not there.
    InvalidInputError, FormatVersionError
        If it cannot be read.
    """
    chosen = registry or os.environ.get(REGISTRY_VARIABLE)
    own = _read(Path(chosen), Path(chosen).read_bytes()) if chosen else []
    names = {dataset.name for dataset in own}
    return own + [dataset for dataset in _built_in() if dataset.name not in names]


def find_known(name: str, registry: Path | None = None) -> KnownDataset:
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


@cache
def _built_in() -> tuple[KnownDataset, ...]:
    path = resources.files(__package__).joinpath("registry.json")
    return tuple(_read(Path("registry.json"), path.read_bytes()))


@cache
def _schema() -> Any:
    return json.loads(
        resources.files(__package__).joinpath("registry.schema.json").read_text("utf-8")
    )


def _read(path: Path, text: bytes) -> list[KnownDataset]:
    try:
        said = load_json(text)
    except InvalidInputError as err:
        raise InvalidInputError(f"{path}: {err}") from err
    if isinstance(said, dict) and isinstance(said.get("format_version"), str):
        check_version(path, said["format_version"])
    problem = jsonschema.exceptions.best_match(
        jsonschema.Draft202012Validator(_schema()).iter_errors(said)
    )
    if problem is not None:
        newer = newer_minor_hint(said.get("format_version")) if isinstance(said, dict) else ""
        raise InvalidInputError(f"{path}: {problem.json_path}: {problem.message}{newer}")
    found = [
        KnownDataset(**entry | {"sources": tuple(map(_source, entry["sources"]))})
        for entry in said["datasets"]
    ]
    if len({dataset.name for dataset in found}) != len(found):
        raise InvalidInputError(f"{path}: lists a data set twice")
    return found


def _source(said: Mapping[str, Any]) -> Source:
    options = {key: value for key, value in said.items() if key != "kind"}
    if said["kind"] == "zenodo":
        return ZenodoRecord(**options)
    if said["kind"] == "huggingface":
        return HuggingFaceFolder(**options)
    return FileTable(
        tuple(RemoteFile(f["name"], f["size"], f["checksum"], (f["url"],)) for f in said["files"])
    )
