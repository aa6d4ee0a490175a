"""The manifest ``dataset.json``: the files of a data set with their sizes and digests."""

from __future__ import annotations

import datetime
import json
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

import jsonschema
from tqdm import tqdm

import semantic2d_dataset
from semantic2d_dataset.errors import (
    ChecksumError,
    CorruptFileError,
    DatasetNotFoundError,
    InvalidInputError,
    Semantic2DError,
)
from semantic2d_dataset.format.checksums import (
    CHECKSUMS_NAME,
    check_checksums,
    size_and_digest,
    write_checksums,
)
from semantic2d_dataset.format.container import check_version, load_json
from semantic2d_dataset.format.schema import FORMAT_MINOR, FORMAT_VERSION
from semantic2d_dataset.format.sequence import SequenceReader, slug
from semantic2d_dataset.format.split_schemes import schemes_of
from semantic2d_dataset.format.splits import SplitScheme, read_scheme, write_scheme
from semantic2d_dataset.format.writing import write_text_atomically

MANIFEST_NAME = "dataset.json"
_KIND = "semantic2d-dataset"


@dataclass(frozen=True)
class FileEntry:
    """One file of a data set: its path in the folder, size in bytes and SHA-256, hex."""

    file: str
    bytes: int
    sha256: str


@dataclass(frozen=True)
class SequenceEntry(FileEntry):
    """One sequence: its file, and what it holds."""

    id: str
    content_digest: str
    scans: int
    lidar: str
    environment: str
    recording: str


@dataclass(frozen=True)
class Manifest:
    """What belongs to one version of a data set.

    Parameters
    ----------
    name
        Lower-case id, such as ``semantic2d-mini``.
    version
        ``MAJOR.MINOR.PATCH`` of the data.
    license
        Licence of the data, ``unknown`` where nobody said.
    sequences
        Entries ordered by id.
    splits
        Split files by scheme.
    documents
        Files about the data: card, statistics, lists.
    """

    name: str
    version: str
    license: str
    sequences: tuple[SequenceEntry, ...]
    splits: Mapping[str, FileEntry]
    documents: tuple[FileEntry, ...] = ()

    @property
    def lengths(self) -> dict[str, int]:
        """Number of scans by sequence id."""
        return {entry.id: entry.scans for entry in self.sequences}

    @property
    def files(self) -> tuple[FileEntry, ...]:
        """Every file that the manifest names."""
        return (*self.sequences, *self.splits.values(), *self.documents)


@cache
def _schema() -> Any:
    text = resources.files(__package__).joinpath("manifest.schema.json").read_text("utf-8")
    return json.loads(text)


def read_manifest(folder: Path) -> Manifest:
    """Read ``dataset.json`` of a folder.

    Raises
    ------
    DatasetNotFoundError
        If the folder or the file does not exist.
    CorruptFileError
        If it is not a valid manifest.
    FormatVersionError
        If it was written in a newer major format.
    """
    path = Path(folder) / MANIFEST_NAME
    if not path.is_file():
        raise DatasetNotFoundError(f"{folder}: no data set here (there is no {MANIFEST_NAME})")
    try:
        said = load_json(path.read_bytes())
    except InvalidInputError as err:
        raise CorruptFileError(f"{path}: {err}") from err
    if isinstance(said, dict) and isinstance(said.get("format_version"), str):
        check_version(path, said["format_version"])
    problem = jsonschema.exceptions.best_match(_breaches(said))
    if problem is not None:
        raise CorruptFileError(f"{path}: {problem.json_path}: {problem.message}")
    sequences = tuple(_entry(SequenceEntry, entry) for entry in said["sequences"])
    if len({entry.id for entry in sequences}) != len(sequences):
        raise CorruptFileError(f"{path}: names a sequence twice")
    splits = {name: _entry(FileEntry, entry) for name, entry in said["splits"].items()}
    documents = tuple(_entry(FileEntry, entry) for entry in said.get("documents", ()))
    return Manifest(said["name"], said["version"], said["license"], sequences, splits, documents)


def _breaches(said: Any) -> Iterator[Any]:
    """Yield what breaks the schema; what a newer minor format adds breaks nothing."""
    version = said.get("format_version") if isinstance(said, dict) else None
    minor = re.fullmatch(r"[0-9]+\.([0-9]{1,9})", version) if isinstance(version, str) else None
    is_newer = minor is not None and int(minor[1]) > FORMAT_MINOR
    for error in jsonschema.Draft202012Validator(_schema()).iter_errors(said):
        if not (is_newer and error.validator == "additionalProperties"):
            yield error


_Entry = TypeVar("_Entry", bound=FileEntry)


def _entry(kind: type[_Entry], said: Mapping[str, Any]) -> _Entry:
    return kind(**{each.name: said[each.name] for each in fields(kind)})


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write ``dataset.json`` into a folder, and remove the digests that held it as it was."""
    documents = [asdict(entry) for entry in manifest.documents]
    said = {
        "format": _KIND,
        "format_version": FORMAT_VERSION,
        "name": manifest.name,
        "version": manifest.version,
        "license": manifest.license,
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "generator": f"semantic2d-dataset {semantic2d_dataset.__version__}",
        "sequences": [asdict(entry) for entry in manifest.sequences],
        "splits": {name: asdict(entry) for name, entry in sorted(manifest.splits.items())},
    } | ({"documents": documents} if documents else {})
    try:
        jsonschema.validate(said, _schema())
    except jsonschema.ValidationError as err:
        raise InvalidInputError(f"{folder}: {err.json_path}: {err.message}") from err
    (Path(folder) / CHECKSUMS_NAME).unlink(missing_ok=True)
    write_text_atomically(Path(folder) / MANIFEST_NAME, json.dumps(said, indent=1) + "\n")


def write_digests(folder: Path, manifest: Manifest) -> None:
    """Write ``SHA256SUMS`` beside a manifest: of it, and of every file that it names."""
    write_checksums(Path(folder), _digests(Path(folder), manifest))


def check_digests(folder: Path, manifest: Manifest) -> None:
    """Check that ``SHA256SUMS``, where there is one, is what `write_digests` writes.

    Raises
    ------
    ChecksumError
        If it is not.
    """
    check_checksums(Path(folder), _digests(Path(folder), manifest))


def describe_document(folder: Path, name: str) -> FileEntry:
    """Return the entry of a file about the data, by its relative name."""
    return FileEntry(name, *size_and_digest(Path(folder) / name))


def _digests(folder: Path, manifest: Manifest) -> dict[str, str]:
    own = size_and_digest(folder / MANIFEST_NAME)[1]
    return {MANIFEST_NAME: own} | {entry.file: entry.sha256 for entry in manifest.files}


def publish(
    folder: Path,
    *,
    name: str,
    version: str,
    license: str = "unknown",  # noqa: A002 - the field's name in the format
    schemes: Iterable[SplitScheme] | None = None,
) -> Manifest:
    """Turn the sequences in ``folder/sequences`` into a data set: splits, digests, manifest.

    Parameters
    ----------
    folder
        The data set's folder.
    name, version, license
        What the manifest says of the data set.
    schemes
        Split schemes; the standard ones where not given.

    Raises
    ------
    DatasetNotFoundError
        If there is no sequence.
    CorruptFileError, UnsafeFileError
        If a sequence cannot be read whole.
    """
    folder = Path(folder)
    paths = sorted((folder / "sequences").glob("*.h5"))
    check_names(name, version, paths)
    if not paths:
        raise DatasetNotFoundError(f"{folder / 'sequences'}: no sequences (*.h5) here")
    entries: list[SequenceEntry] = []
    stamps = {}
    for path in tqdm(paths, desc="hashing sequences", unit="file", disable=None, leave=False):
        with SequenceReader(path) as reader:
            sequence_id = reader.header.sequence_id
            if sequence_id in stamps:
                twin = next(e.file for e in entries if e.id == sequence_id)
                raise InvalidInputError(
                    f"{path}: is the sequence {sequence_id}, and so is {twin}; keep one of them"
                )
            entries.append(_describe(path, reader))
            stamps[sequence_id] = reader.read("scans/stamps_ns")
    splits = {}
    (folder / "splits").mkdir(exist_ok=True)
    for scheme in schemes_of(stamps) if schemes is None else schemes:
        path = folder / "splits" / f"{scheme.name}.h5"
        write_scheme(path, scheme)
        splits[scheme.name] = FileEntry(f"splits/{path.name}", *size_and_digest(path))
    manifest = Manifest(name, version, license, tuple(entries), splits)
    write_manifest(folder, manifest)
    return manifest


def check_names(name: str, version: str, paths: Iterable[Path] = ()) -> None:
    """Check what a manifest says of a data set, before work is spent on it.

    Raises
    ------
    InvalidInputError
        If the name, the version or a file's name is not of the form that a manifest may hold.
    """
    properties = _schema()["properties"]
    if not re.search(properties["name"]["pattern"], name):
        raise InvalidInputError(
            f"data set name {name!r}: expected lower-case letters and digits with single '-', "
            f"'.' or '_' between them, such as {slug(name)!r}"
        )
    if not re.search(properties["version"]["pattern"], version):
        raise InvalidInputError(f"data set version {version!r}: expected one like 1.0.0")
    for path in paths:
        if not re.search(_schema()["$defs"]["file"]["properties"]["file"]["pattern"], _file(path)):
            raise InvalidInputError(f"{path}: give the file a name like {slug(path.stem)}.h5")


def _file(path: Path) -> str:
    return f"sequences/{path.name}"


def _describe(path: Path, reader: SequenceReader) -> SequenceEntry:
    header = reader.header
    size, digest = size_and_digest(path)
    return SequenceEntry(
        file=_file(path),
        bytes=size,
        sha256=digest,
        id=header.sequence_id,
        content_digest=reader.content_digest(),
        scans=len(reader),
        lidar=header.lidar.name,
        environment=header.environment,
        recording=header.recording,
    )


def find_problems(folder: Path, *, full: bool = False) -> list[Semantic2DError]:
    """Verify a data set and return what is wrong with it, file by file; nothing where all is well.

    Every file must exist with its size, open under the format's rules and be what the manifest
    says of it; ``SHA256SUMS`` must agree, where there is one. With `full`, every byte is hashed,
    every chunk read and every content digest compared.

    Raises
    ------
    DatasetNotFoundError, CorruptFileError, FormatVersionError
        If there is no manifest that can be read.
    """
    folder = Path(folder)
    manifest = read_manifest(folder)
    problems = [*check_files(folder, manifest, full=full).values()]
    try:
        check_digests(folder, manifest)
    except ChecksumError as err:
        problems.append(err)
    return problems


def check_files(folder: Path, manifest: Manifest, *, full: bool) -> dict[str, Semantic2DError]:
    """Return what is wrong with the files of a manifest, by file; it may lie elsewhere."""
    problems: dict[str, Semantic2DError] = {}
    bar = tqdm(manifest.files, desc="verifying", unit="file", disable=None, leave=False)
    for entry in bar:
        try:
            _verify(folder, manifest, entry, full=full)
        except Semantic2DError as err:
            problems[entry.file] = err
    return problems


def _verify(folder: Path, manifest: Manifest, entry: FileEntry, *, full: bool) -> None:
    path = find_file(folder, entry)
    if full and size_and_digest(path)[1] != entry.sha256:
        raise ChecksumError(f"{path}: its SHA-256 is not the one in {MANIFEST_NAME}")
    if not isinstance(entry, SequenceEntry):
        for name in (name for name, split in manifest.splits.items() if split is entry):
            read_scheme(path, name, manifest.lengths)
        return
    with SequenceReader(path) as reader:
        check_sequence(reader, entry)
        if full:
            reader.check_values()
        if full and reader.content_digest() != entry.content_digest:
            raise ChecksumError(f"{path}: its content digest is not the one in {MANIFEST_NAME}")


def find_file(folder: Path, entry: FileEntry) -> Path:
    """Return where a file of a manifest lies.

    Raises
    ------
    DatasetNotFoundError
        If it is missing.
    ChecksumError
        If it has another size than the manifest tells.
    """
    path = Path(folder) / entry.file
    remedy = "get it again, or publish the data set again"
    if not path.is_file():
        raise DatasetNotFoundError(f"{path}: missing, though {MANIFEST_NAME} names it: {remedy}")
    found = path.stat().st_size
    if found != entry.bytes:
        raise ChecksumError(
            f"{path}: expected {entry.bytes} bytes, found {found}; it was changed since "
            f"{MANIFEST_NAME} was written: {remedy}"
        )
    return path


def check_sequence(reader: SequenceReader, entry: SequenceEntry) -> None:
    """Check that a sequence is the one that its manifest tells.

    Raises
    ------
    ChecksumError
        If it is another one.
    """
    header = reader.header
    said = (entry.id, entry.scans, entry.lidar, entry.environment, entry.recording)
    parts = (header.lidar.name, header.environment, header.recording)
    found = (header.sequence_id, len(reader), *parts)
    if found != said:
        raise ChecksumError(f"{reader.path}: expected {said}, found {found}")
