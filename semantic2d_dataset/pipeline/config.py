"""What ``semantic2d run`` is told: recordings, maps and splits, in one YAML file."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.manifest import check_names
from semantic2d_dataset.format.schema_check import check_document
from semantic2d_dataset.format.sequence import slug
from semantic2d_dataset.pipeline.siblings import load_sibling
from semantic2d_dataset.scene.documents import hint, read_yaml
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, Taxonomy, read_taxonomy

_FILE_OPTIONS = ("poses", "lidar")
"""Options of the conversion that may name a file."""


@dataclass(frozen=True)
class RecordingConfig:
    """One recording, and what is to become of it.

    Parameters
    ----------
    paths
        Its file or folder, or its several files.
    environment, name
        Parts of the ids of its sequences; the conversion adds to the name where a recording
        becomes several.
    map_yaml, annotation
        The map, and its annotation.
    convert
        `conversion.options.Options`, checked.
    salsa
        `salsa.sequences.Settings`, checked.
    sightings
        `salsa.sightings.Sightings` of its camera, or None.
    taxonomy
        Classes of the labels; None takes those of the sequence.
    drop
        A list of scans that belong to no split, see `semantic2d_dataset.pipeline.drops`.
    """

    paths: tuple[Path, ...]
    environment: str
    name: str
    map_yaml: Path
    annotation: Path
    convert: Any
    salsa: Any
    sightings: Any
    taxonomy: Taxonomy | None
    drop: Path | None

    @property
    def id(self) -> str:
        """``<environment>--<recording>``, the start of the ids of its sequences."""
        return f"{self.environment}--{self.name}"


@dataclass(frozen=True)
class Config:
    """A data set to be made.

    Parameters
    ----------
    path
        The configuration file.
    name, version, license
        What the manifest says.
    out
        The data set's folder.
    recordings
        At least one.
    splits
        Parameters of each scheme by its name; None makes the standard ones.
    """

    path: Path
    name: str
    version: str
    license: str
    out: Path
    recordings: tuple[RecordingConfig, ...]
    splits: Mapping[str, Mapping[str, Any]] | None

    def select(self, names: Collection[str]) -> tuple[RecordingConfig, ...]:
        """Return the recordings of these names or ids; all where none is given.

        Raises
        ------
        InvalidInputError
            If there is none of a name.
        """
        known = {name for each in self.recordings for name in (each.id, each.name)}
        for name in names:
            if name not in known:
                raise InvalidInputError(f"{self.path}: no recording {name!r}{hint(name, known)}")
        return tuple(
            each for each in self.recordings if not names or {each.id, each.name} & {*names}
        )


def read_config(path: Path) -> Config:
    """Read and check a configuration; paths in it are relative to its folder.

    Raises
    ------
    FileNotFoundError
        If it does not exist.
    InvalidInputError
        If it is not valid, or names files that do not exist.
    """
    path = Path(path).resolve()
    said = read_yaml(path)
    check_document(path, said, _schema())
    try:
        check_names(said["name"], said["version"])
        recordings = tuple(
            recording
            for number, each in enumerate(said["recordings"])
            for recording in _recordings(each, f"recordings[{number}]", said, path.parent)
        )
        _check_distinct(recordings)
        _check_maps(recordings)
        _check_environments(said.get("splits", {}), {each.environment for each in recordings})
    except InvalidInputError as err:
        raise InvalidInputError(f"{path}: {err}") from err
    return Config(
        path=path,
        name=said["name"],
        version=said["version"],
        license=said.get("license", "unknown"),
        out=path.parent / Path(said["out"]).expanduser(),
        recordings=recordings,
        splits=said.get("splits"),
    )


@cache
def _schema() -> Any:
    text = resources.files(__package__).joinpath("config.schema.json").read_text("utf-8")
    return json.loads(text)


def _recordings(
    said: Mapping[str, Any], where: str, whole: Mapping[str, Any], folder: Path
) -> Iterator[RecordingConfig]:
    """Yield every recording that an entry names."""
    maps = whole["maps"]
    if said["map"] not in maps:
        raise InvalidInputError(f"{where}.map: no map {said['map']!r}{hint(said['map'], maps)}")
    at, scene = f"maps.{said['map']}", maps[said["map"]]
    environment = said.get("environment", slug(said["map"]))
    found = _find(said, where, folder)
    if "recording" in said and len(found) > 1:
        raise InvalidInputError(
            f"{where}.recording: {len(found)} recordings cannot share the name "
            f"{said['recording']!r}; leave it out, or give each an entry of its own"
        )
    salsa = _settings(_merged(whole.get("salsa", {}), said.get("salsa", {})), f"{where}.salsa")
    sightings = _sightings(said["camera"], f"{where}.camera", folder) if "camera" in said else None
    taxonomy = (
        read_taxonomy(_file(whole["taxonomy"], "taxonomy", folder)) if "taxonomy" in whole else None
    )
    for paths in found:
        yield RecordingConfig(
            paths=paths,
            environment=environment,
            name=said.get("recording", _stem(paths[0])),
            map_yaml=_file(scene["map"], f"{at}.map", folder),
            annotation=_file(scene["annotation"], f"{at}.annotation", folder),
            convert=_options(
                _merged(whole.get("convert", {}), said.get("convert", {})),
                f"{where}.convert",
                folder,
                environment=environment,
                recording=said.get("recording"),
                license=whole.get("license", "unknown"),
            ),
            salsa=salsa,
            sightings=sightings,
            taxonomy=taxonomy,
            drop=_file(said["drop"], f"{where}.drop", folder) if "drop" in said else None,
        )


def _find(said: Mapping[str, Any], where: str, folder: Path) -> list[tuple[Path, ...]]:
    if ("path" in said) == ("parts" in said):
        raise InvalidInputError(
            f"{where}: expected either 'path' (a recording, a folder of them or a pattern) or "
            "'parts' (the files of one recording)"
        )
    if "parts" in said:
        parts = enumerate(said["parts"])
        return [tuple(_path(part, f"{where}.parts[{n}]", folder) for n, part in parts)]
    place = folder / Path(said["path"]).expanduser()
    top = Path(place.anchor)
    paths = [place] if place.exists() else sorted(top.glob(str(place.relative_to(top))))
    if not paths:
        raise InvalidInputError(f"{where}.path: nothing is at {place}")
    found = load_sibling("conversion", "sources").find_recordings(paths)
    return [tuple(each) for each in found]


def _path(text: str, where: str, folder: Path) -> Path:
    path = folder / Path(text).expanduser()
    if not path.exists():
        raise InvalidInputError(f"{where}: nothing is at {path}")
    return path


def _file(text: str, where: str, folder: Path) -> Path:
    path = _path(text, where, folder)
    if not path.is_file():
        raise InvalidInputError(f"{where}: expected a file, found the folder {path}")
    return path


def _stem(path: Path) -> str:
    """Name a recording as the conversion does."""
    return slug(path.name if path.is_dir() else path.name.split(".")[0] or path.name)


def _options(said: Mapping[str, Any], where: str, folder: Path, **given: Any) -> Any:
    said = {
        key: str(folder / value)
        if key in _FILE_OPTIONS and isinstance(value, str) and (folder / value).is_file()
        else value
        for key, value in said.items()
    }
    twice = sorted(given.keys() & said.keys())
    if twice:
        raise InvalidInputError(f"{where}: {twice[0]!r} does not belong here, but one level up")
    try:
        return load_sibling("conversion", "options").options_from({**said, **given})
    except InvalidInputError as err:
        raise InvalidInputError(f"{where}: {err}") from err


def _settings(said: Mapping[str, Any], where: str) -> Any:
    try:
        return load_sibling("salsa", "settings").settings_from(said)
    except InvalidInputError as err:
        raise InvalidInputError(f"{where}: {str(err).removeprefix('salsa: ')}") from err


def _sightings(said: Mapping[str, Any], where: str, folder: Path) -> Any:
    at = said["detections"]
    if not at.startswith("stream:"):
        at = str(_file(at, f"{where}.detections", folder))
    return load_sibling("salsa", "sightings").sightings_of(
        _file(said["calibration"], f"{where}.calibration", folder),
        at,
        _file(said["names"], f"{where}.names", folder) if "names" in said else None,
        clock_offset_s=float(said.get("clock_offset_s", 0.0)),
    )


def _merged(base: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """Return what is said of all, with what is said of one in its place, key by key."""
    merged = dict(base)
    for key, value in own.items():
        both = isinstance(value, Mapping) and isinstance(base.get(key), Mapping)
        merged[key] = _merged(base[key], value) if both else value
    return merged


def _check_maps(recordings: Collection[RecordingConfig]) -> None:
    """Read every map and its annotation, before hours of conversion."""
    annotate_map = load_sibling("salsa", "annotation").annotate_map
    for map_yaml, annotation, taxonomy in {
        (each.map_yaml, each.annotation, each.taxonomy) for each in recordings
    }:
        annotate_map(map_yaml, annotation, taxonomy or SEMANTIC2D)


def _check_distinct(recordings: Collection[RecordingConfig]) -> None:
    seen: dict[str, RecordingConfig] = {}
    for each in recordings:
        twin = seen.setdefault(each.id, each)
        if twin is not each:
            raise InvalidInputError(
                f"{twin.paths[0]} and {each.paths[0]} are both {each.id}; give them names with "
                "'recording', or other environments"
            )


def _check_environments(splits: Mapping[str, Any], environments: Collection[str]) -> None:
    for split, names in splits.get("environment", {}).items():
        for name in names:
            if name not in environments:
                raise InvalidInputError(
                    f"splits.environment.{split}: no environment {name!r}{hint(name, environments)}"
                )
    if "environment" in splits and len(environments) < 3:
        raise InvalidInputError(
            f"splits.environment: needs 3 environments, found {', '.join(sorted(environments))}"
        )
