"""Entries of the board: one method on one track, with the digests of all that its figures rest on.

An entry is a JSON file. Its ``seals`` are short checksums of its parts: they tell which part a
slip or an edit has changed. They are no signature; what proves an entry is scoring its
predictions again (`leaderboard.checking`).
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import jsonschema

from semantic2d_dataset.errors import CorruptFileError, InvalidInputError
from semantic2d_dataset.format.container import check_version, read_json_file
from semantic2d_dataset.format.sequence import slug
from semantic2d_dataset.scene.taxonomy import Taxonomy
from semantic2d_dataset.scoring.metrics import Evaluator
from semantic2d_dataset.scoring.predictions import metadata_problems

FORMAT = "semantic2d-leaderboard-entry"
FORMAT_VERSION = "1.0"
SCORED, SANITY, PUBLISHED = "scored", "sanity", "published"

_MAX_BYTES = 1 << 24
_NUMBERS = re.compile(r"\[\n(?:\s*-?[0-9][0-9.e+-]*,?\n)+\s*\]")  # no text holds a line break
_SEALED = dict.fromkeys(
    ("track", "metadata", "digests", "taxonomy", "source", "figures", "result"), 1
) | {"seeds": 3}  # how deep a part is sealed by its members: every digest has a seal of its own


@dataclass(frozen=True, order=True)
class Track:
    """What can be ranked together: one lidar on one split, scored by one evaluator.

    The digests are those of the split scheme and of the classes; empty, as is the evaluator's
    version, for figures that were only published.
    """

    dataset: str
    dataset_version: str
    scheme: str
    split: str
    lidar: str
    evaluator_version: str = ""
    split_digest: str = ""
    taxonomy_digest: str = ""


@dataclass(frozen=True)
class Source:
    """A predictions file that an entry rests on.

    Parameters
    ----------
    field
        JSON path of its digest.
    digest
        Its SHA-256.
    url
        Where it is, or None.
    seeds
        What it says of the seeds of its training, None where it does not.
    run
        What the entry says of this training, None where there is one only.
    """

    field: str
    digest: str
    url: str | None
    seeds: Any
    run: Mapping[str, Any] | None = None


@dataclass(frozen=True)
class Entry:
    """One entry.

    Parameters
    ----------
    path
        Its file; the name follows from what it says, see `file_name`.
    said
        The JSON document.
    """

    path: Path
    said: Mapping[str, Any]

    @property
    def kind(self) -> str:
        """``scored``, ``sanity`` or ``published``."""
        return str(self.said["kind"])

    @property
    def method(self) -> str:
        """Name of the method, with the letters of its features where it says them."""
        return name_of(self.said["metadata"])

    @property
    def digest(self) -> str:
        """SHA-256 of the predictions that are shown, "" for what was only published."""
        return str(self.said.get("digests", {}).get("predictions", ""))

    @property
    def runs(self) -> Sequence[Mapping[str, Any]]:
        """What is said of every training; empty where there is one only."""
        runs: Sequence[Mapping[str, Any]] = self.said.get("seeds", {}).get("runs", ())
        return runs

    @property
    def sources(self) -> tuple[Source, ...]:
        """The predictions files of all seeds; none for what was only published."""
        if self.runs:
            return tuple(
                Source(
                    f"seeds.runs[{i}].predictions",
                    run["predictions"],
                    run.get("url"),
                    run.get("seeds"),
                    run,
                )
                for i, run in enumerate(self.runs)
            )
        if self.kind == PUBLISHED:
            return ()
        seeds, url = self.said["metadata"].get("seeds"), self.said.get("predictions_url")
        return (Source("digests.predictions", self.digest, url, seeds),)

    def files(self) -> Iterator[Entry]:
        """Yield an entry for each predictions file, which says where it is and no more."""
        for source in self.sources:
            said: dict[str, Any] = {"digests": {"predictions": source.digest}}
            yield Entry(self.path, said | ({"predictions_url": source.url} if source.url else {}))

    @property
    def taxonomy(self) -> Taxonomy:
        """The classes."""
        return taxonomy_of(self.said)

    def tracks(self) -> Iterator[Track]:
        """Yield the track of each lidar that was predicted."""
        said, digests = self.said["track"], self.said.get("digests", {})
        for lidar in said["lidars"]:
            yield Track(
                said["dataset"],
                said["dataset_version"],
                said["scheme"],
                said["split"],
                lidar,
                self.said.get("evaluator_version", ""),
                digests.get("split", ""),
                digests.get("taxonomy", ""),
            )


def name_of(metadata: Mapping[str, Any]) -> str:
    """Return a method's name, with its features: two sets of features are two methods."""
    method, features = str(metadata["method"]), features_of(metadata)
    return f"{method} ({features})" if features and features not in method.split() else method


def features_of(metadata: Mapping[str, Any]) -> str:
    """Return the letters of the features that a method was given, "" where it does not say."""
    track = metadata.get("track")
    said = track.get("features") if isinstance(track, Mapping) else None
    return str(said or metadata.get("features", ""))


def file_name(said: Mapping[str, Any]) -> str:
    """Return the name that the file of an entry must have."""
    track = said["track"]
    name = name_of(said["metadata"])
    # names without a Latin letter would all be one file
    plain = slug(name) if name.isascii() else f"{slug(name)}-{_sha256(name)[:8]}"
    where = "--".join(
        (
            f"{track['dataset']}-{track['dataset_version']}",
            track["scheme"],
            track["split"],
            "-".join(track["lidars"]),
        )
    )
    return f"{where}--{plain[:80]}.json"


def taxonomy_of(said: Mapping[str, Any]) -> Taxonomy:
    """Return the classes that an entry names.

    Raises
    ------
    InvalidInputError
        If they are none.
    """
    return Taxonomy.from_dict(said["taxonomy"])


def seal(said: Mapping[str, Any]) -> dict[str, Any]:
    """Return a document with the seals that belong to it."""
    parts = {name: value for name, value in said.items() if name != "seals"}
    return parts | {"seals": seals_of(parts)}


def seals_of(said: Mapping[str, Any]) -> dict[str, str]:
    """Return the checksum of every part by its JSON path: of members, where they are figures."""
    parts = [part for name in said for part in _parts(said[name], name, _SEALED.get(name, 0))]
    return {path: _checksum(value) for path, value in sorted(parts, key=lambda part: part[0])}


def schema_problems(said: Any) -> list[tuple[str, str]]:
    """List where a document is no entry: JSON path, and what is wrong there."""
    validator = jsonschema.Draft202012Validator(_schema())
    found = [
        (error.json_path.removeprefix("$").removeprefix(".") or "the file", _cut(error.message))
        for error in validator.iter_errors(said)
    ]
    if not found and said["kind"] != PUBLISHED:
        found += [
            (where, _cut(what))
            for where, _, what in (p.partition(": ") for p in metadata_problems(said["metadata"]))
        ]
        try:
            Evaluator(taxonomy_of(said))
        except InvalidInputError as err:
            found.append(("taxonomy", str(err)))
    return found


def read_entry(path: Path) -> Entry:
    """Read an entry, and check its form; `leaderboard.checking` checks what it says.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    CorruptFileError
        If it is not an entry.
    FormatVersionError
        If it was written in a newer major format.
    """
    path = Path(path)
    if os.path.lexists(path) and not path.is_file():  # a pipe would be waited for
        raise CorruptFileError(f"{path}: expected a file")
    said = read_json_file(path, _MAX_BYTES)
    if isinstance(said, dict) and isinstance(said.get("format_version"), str):
        check_version(path, said["format_version"])
    problems = schema_problems(said)
    if problems:
        where, what = problems[0]
        raise CorruptFileError(f"{path}: not an entry of the leaderboard: {where}: {what}")
    return Entry(path, said)


def list_entries(folder: Path) -> list[Path]:
    """Return the entry files of a folder, by name.

    Raises
    ------
    InvalidInputError
        If it is no folder.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InvalidInputError(f"{folder}: expected a folder of entries (*.json)")
    return sorted(folder.glob("*.json"))


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file, hex."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def to_json(said: Mapping[str, Any]) -> str:
    """Return an entry as JSON text, rows of numbers on one line each."""
    text = json.dumps(said, indent=1, allow_nan=False, ensure_ascii=False)
    return _NUMBERS.sub(lambda rows: " ".join(rows[0].split()), text) + "\n"


def _parts(value: Any, path: str, depth: int) -> Iterator[tuple[str, Any]]:
    if not depth or not isinstance(value, Mapping | list):
        yield path, value
    elif isinstance(value, Mapping):
        for name, member in value.items():
            yield from _parts(member, f"{path}.{name}", depth - 1)
    else:
        for i, member in enumerate(value):
            yield from _parts(member, f"{path}[{i}]", depth - 1)


def _checksum(value: Any) -> str:
    return _sha256(json.dumps(value, sort_keys=True, ensure_ascii=False))[:16]


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _cut(message: str) -> str:
    return message if len(message) <= 200 else f"{message[:200]} ..."


@cache
def _schema() -> Any:
    text = resources.files(__package__).joinpath("entry.schema.json").read_text("utf-8")
    return json.loads(text)
