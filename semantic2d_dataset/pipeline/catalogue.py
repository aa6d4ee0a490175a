"""Which data sets there are, here and elsewhere, and removing those that are here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from semantic2d_dataset.access.installed import datasets_home, installed, is_installed
from semantic2d_dataset.access.known_datasets import KnownDataset, find_known, known_datasets
from semantic2d_dataset.access.places import home
from semantic2d_dataset.errors import DatasetNotFoundError, InvalidInputError, Semantic2DError
from semantic2d_dataset.format.locks import alone
from semantic2d_dataset.format.manifest import read_manifest
from semantic2d_dataset.pipeline.staging import discard, left_of, size_of, tidy


def list_datasets(registry: Path | str | None = None) -> list[dict[str, Any]]:
    """Return what is known and what is installed, as plain values.

    Returns
    -------
    list
        For each its ``dataset`` (id and version), ``title`` and ``license`` where known,
        ``lidars``, and where it is installed its ``folder``, ``bytes``, ``sequences`` and
        ``scans``, or ``problem`` where its manifest cannot be read.
    """
    known = {each.name: each for each in known_datasets(registry)}
    names = [*known, *(name for name, _ in installed() if name not in known)]
    return [_describe(name, known.get(name)) for name in names]


def describe_known(name: str, registry: Path | str | None = None) -> dict[str, Any]:
    """Return all that is known of a data set, as plain values.

    Raises
    ------
    DatasetNotFoundError
        If it is neither known nor installed.
    """
    known = known_datasets(registry)
    try:
        found = find_known(name, registry)
    except DatasetNotFoundError:
        here = [each for each, _ in installed() if name in (each, each.partition("@")[0])]
        if not here:
            raise
        return _describe(here[0], None) | {"versions": [n.partition("@")[2] for n in here]}
    said = asdict(found)
    return _describe(found.name, found) | {
        "doi": found.doi,
        "citation": found.citation,
        "versions": [each.version for each in known if each.id == found.id],
        "sources": [{"kind": type(s).__name__, **asdict(s)} for s in found.sources],
        "parts": said["parts"],
        "downloads": _present(_downloads(found.name)),
    }


def remove(
    name: str, *, archives_too: bool = False, registry: Path | str | None = None
) -> dict[str, int]:
    """Remove a data set that is installed, and what unfinished runs have left of it.

    Parameters
    ----------
    name
        ``ID@VERSION``, or ``ID`` where one version is here.
    archives_too
        Whether the files that were downloaded go, too.
    registry
        As for `known_datasets`.

    Returns
    -------
    dict
        Bytes that were freed, by folder.

    Raises
    ------
    DatasetNotFoundError
        If it is unknown, or nothing of it is here.
    InvalidInputError
        If several versions are here, or its folder is a link to somewhere else.
    """
    full = _name_here(name, registry)
    folder, downloads = _folder(full), _downloads(full)
    freed = {}
    with alone(folder):
        tidy(folder)
        present = [folder] if is_installed(folder) else []
        present += left_of(folder)
        present += [downloads] if archives_too and downloads.is_dir() else []
        for each in present:
            if each.is_symlink():
                raise InvalidInputError(f"{each}: is a link; what it leads to is yours to remove")
        for each in present:
            freed[str(each)] = discard(each, each)
    if not freed:
        kept = f"; its archives are in {downloads}: --archives-too" if downloads.is_dir() else ""
        raise DatasetNotFoundError(f"{full}: not installed{kept}")
    return freed


def _name_here(name: str, registry: Path | str | None) -> str:
    here = [each for each, _ in installed()]
    if name in here:
        return name
    versions = [each for each in here if each.partition("@")[0] == name]
    if len(versions) > 1:
        raise InvalidInputError(f"{name}: say which: {', '.join(versions)}")
    return versions[0] if versions else find_known(name, registry).name


def _describe(name: str, known: KnownDataset | None) -> dict[str, Any]:
    said: dict[str, Any] = {"dataset": name}
    if known is not None:
        said |= {"title": known.title, "license": known.license, "lidars": list(known.lidars)}
    folder = _folder(name)
    if not is_installed(folder):
        return said
    said |= {"folder": str(folder), "bytes": size_of(folder)}
    try:
        manifest = read_manifest(folder)
    except Semantic2DError as err:
        return said | {"problem": str(err)}
    return (
        {"title": manifest.name, "license": manifest.license}
        | said
        | {
            "lidars": sorted({entry.lidar for entry in manifest.sequences}),
            "sequences": len(manifest.sequences),
            "scans": sum(manifest.lengths.values()),
        }
    )


def format_line(said: Mapping[str, Any]) -> str:
    """Return one data set of `list_datasets` as text."""
    where = "not installed"
    if "problem" in said:
        where = f"damaged, in {said['folder']}"
    elif "folder" in said:
        where = f"{said['bytes'] / 1e6:,.1f} MB in {said['folder']}"
    lidars = ", ".join(said.get("lidars", ())) or "not told"
    return f"{said['dataset']}: {said.get('title', 'unknown')}\n    lidars: {lidars}\n    {where}"


def format_known(said: Mapping[str, Any]) -> str:
    """Return what `describe_known` says as text."""
    lines = [format_line(said), f"    license: {said.get('license', 'unknown')}"]
    lines += [f"    cite: {said['citation']}"] if said.get("citation") else []
    lines += [f"    https://doi.org/{said['doi']}"] if said.get("doi") else []
    lines.append(f"    versions: {', '.join(said['versions'])}")
    for source in said.get("sources", ()):
        place = source.get("record") or source.get("repository") or f"{len(source['files'])} files"
        lines.append(f"    from: {source['kind']} {place} {source.get('host', '')}".rstrip())
    if not said.get("sources"):
        lines.append("    from: made on this machine" if "sources" in said else "    from: unknown")
    if said.get("downloads"):
        lines.append(f"    archives: {said['downloads']}")
    return "\n".join(lines)


def _folder(name: str) -> Path:
    return datasets_home() / name.replace("@", "-")


def _downloads(name: str) -> Path:
    return home() / "downloads" / name.replace("@", "-")


def _present(folder: Path) -> str | None:
    return str(folder) if folder.is_dir() else None
