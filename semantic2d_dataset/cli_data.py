"""The commands that get, check and keep data sets: ``download``, ``verify``, ``list`` and so on."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from semantic2d_dataset.cli_options import AsJson

_GO_ON = "interrupted; what has arrived and what is converted is kept: run this again to go on"

Registry = Annotated[
    str | None,
    typer.Option(help="File or URL of more data sets; SEMANTIC2D_REGISTRY if not given."),
]
Offline = Annotated[
    bool, typer.Option("--offline", help="Ask no host: use and check what is there.")
]


class Part(StrEnum):
    """Which of the files that are published."""

    processed = "processed"
    raw = "raw"
    all = "all"


def verify(
    dataset: Annotated[str, typer.Argument(help="Data set folder or name.")],
    *,
    full: Annotated[bool, typer.Option("--full", help="Hash every byte, read it all.")] = False,
    repair: Annotated[
        bool, typer.Option("--repair", help="Get again what is damaged; checks as --full does.")
    ] = False,
    registry: Registry = None,
    offline: Offline = False,
    as_json: AsJson = False,
) -> None:
    """Check the files of a data set against its manifest, and repair it."""
    from semantic2d_dataset.access.registry import find_folder
    from semantic2d_dataset.format.manifest import find_problems, read_manifest

    folder = find_folder(dataset, registry=registry)
    repaired = []
    if repair:
        from semantic2d_dataset.pipeline.repair import repair as repair_folder

        with _interruptible():
            repaired = repair_folder(folder, registry=registry, offline=offline)
    full = full or repair
    problems = [str(problem) for problem in find_problems(folder, full=full)]
    files = len(read_manifest(folder).files)
    if as_json:
        said = {"files": files, "full": full, "problems": problems}
        typer.echo(json.dumps(said | ({"repaired": repaired} if repair else {}), indent=1))
    else:
        for file in repaired:
            typer.echo(f"{folder / file}: repaired")
        for problem in problems:
            typer.echo(problem)
        typer.echo(f"{folder}: {files} files, {len(problems) or 'no'} problem(s)")
    if problems:
        raise typer.Exit(1)


def download(
    dataset: Annotated[str, typer.Argument(metavar="ID[@VERSION]", help="Known data set.")],
    *,
    version: Annotated[str | None, typer.Option(help="The other way to say it.")] = None,
    lidar: Annotated[
        list[str] | None, typer.Option(help="A lidar to get the scans of; all if not given.")
    ] = None,
    part: Annotated[
        Part | None, typer.Option(help="Which files: processed (default), raw or all.")
    ] = None,
    to: Annotated[
        Path | None, typer.Option(help="The folder to make; a place that names find if none.")
    ] = None,
    only: Annotated[
        list[str] | None, typer.Option(help="Glob pattern of files to get; all if not given.")
    ] = None,
    list_only: Annotated[
        bool, typer.Option("--list", help="Say what there is and how large, and get nothing.")
    ] = False,
    archives_only: Annotated[
        bool, typer.Option("--archives-only", help="Leave files as they are; so are raw ones.")
    ] = False,
    remove_archives: Annotated[
        bool, typer.Option("--remove-archives", help="Remove each when it is converted.")
    ] = False,
    registry: Registry = None,
    offline: Offline = False,
    as_json: AsJson = False,
) -> None:
    """Get a published data set, and make it one that load_dataset opens.

    Run it again after an interruption: it goes on where it stopped. Raw recordings are left as
    they are, as all files are with --archives-only.
    """
    from semantic2d_dataset.access import download as downloads
    from semantic2d_dataset.access.known_datasets import ALL, PROCESSED, find_known
    from semantic2d_dataset.pipeline.installation import describe, format_description, install

    known = find_known(dataset if version is None else f"{dataset}@{version}", registry)
    lidars = known.lidar_names(lidar or ())
    as_it_is = archives_only or part not in (None, Part.processed)
    if list_only or as_it_is:
        folder = to or downloads.download_folder(known)
        wanted = part or (ALL if list_only else PROCESSED)
        chosen: dict[str, Any] = {
            "only": only or (),
            "part": wanted,
            "lidars": lidars,
            "offline": offline,
        }
        if list_only:
            said = downloads.describe(known, downloads.find_files(known, folder, **chosen))
        else:
            with _interruptible():
                got = downloads.download(known, folder, **chosen)
            said = downloads.describe(known, got) | {"folder": str(folder)}
        typer.echo(json.dumps(said, indent=1) if as_json else downloads.format_description(said))
        return
    with _interruptible():
        done = install(
            known,
            to,
            lidars=lidars,
            only=only or (),
            remove_archives=remove_archives,
            offline=offline,
        )
    said = describe(known, done)
    typer.echo(json.dumps(said, indent=1) if as_json else format_description(said))


def list_(*, registry: Registry = None, as_json: AsJson = False) -> None:
    """Say which data sets are known, and which are installed where."""
    from semantic2d_dataset.pipeline.catalogue import format_line, list_datasets

    said = list_datasets(registry)
    typer.echo(json.dumps(said, indent=1) if as_json else "\n".join(map(format_line, said)))


def show(
    dataset: Annotated[str, typer.Argument(metavar="ID[@VERSION]", help="Data set.")],
    *,
    registry: Registry = None,
    as_json: AsJson = False,
) -> None:
    """Say what is known of a data set: licence, citation, versions, where it is from."""
    from semantic2d_dataset.pipeline.catalogue import describe_known, format_known

    said = describe_known(dataset, registry)
    typer.echo(json.dumps(said, indent=1) if as_json else format_known(said))


def remove(
    dataset: Annotated[str, typer.Argument(metavar="ID[@VERSION]", help="Installed data set.")],
    *,
    archives_too: Annotated[
        bool, typer.Option("--archives-too", help="Remove what was downloaded for it, too.")
    ] = False,
    registry: Registry = None,
    as_json: AsJson = False,
) -> None:
    """Remove an installed data set; one in a folder that you chose is yours to remove."""
    from semantic2d_dataset.pipeline.catalogue import remove as remove_dataset

    freed = remove_dataset(dataset, archives_too=archives_too, registry=registry)
    if as_json:
        typer.echo(json.dumps({"freed": freed}, indent=1))
        return
    for folder, size in freed.items():
        typer.echo(f"{folder}: removed, {size / 1e6:,.1f} MB freed")


@contextlib.contextmanager
def _interruptible() -> Iterator[None]:
    """Say, where it is interrupted, what is kept."""
    try:
        yield
    except KeyboardInterrupt as err:
        raise KeyboardInterrupt(_GO_ON) from err
