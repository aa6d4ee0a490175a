"""The commands that get, check and keep data sets: ``semantic2d download``, ``verify``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from semantic2d_dataset.cli_options import AsJson


def verify(
    dataset: Annotated[str, typer.Argument(help="Data set folder or name.")],
    *,
    full: Annotated[bool, typer.Option("--full", help="Hash every byte, read it all.")] = False,
    as_json: AsJson = False,
) -> None:
    """Check the files of a data set against its manifest."""
    from semantic2d_dataset.access.registry import open_dataset
    from semantic2d_dataset.format.manifest import find_problems

    data = open_dataset(dataset)
    problems = [str(problem) for problem in find_problems(data.root, full=full)]
    files = len(data.manifest.files)
    if as_json:
        typer.echo(json.dumps({"files": files, "full": full, "problems": problems}, indent=1))
    else:
        for problem in problems:
            typer.echo(problem)
        typer.echo(f"{data.root}: {files} files, {len(problems) or 'no'} problem(s)")
    if problems:
        raise typer.Exit(1)


def download(
    dataset: Annotated[str, typer.Argument(metavar="ID[@VERSION]", help="Known data set.")],
    *,
    to: Annotated[
        Path | None, typer.Option(help="Folder; below SEMANTIC2D_HOME or the user's cache if none.")
    ] = None,
    only: Annotated[
        list[str] | None, typer.Option(help="Glob pattern of files to get; all if not given.")
    ] = None,
    list_only: Annotated[
        bool, typer.Option("--list", help="Say what there is and how large, and get nothing.")
    ] = False,
    registry: Annotated[
        Path | None, typer.Option(help="Data sets of your own; SEMANTIC2D_REGISTRY if not given.")
    ] = None,
    offline: Annotated[
        bool, typer.Option("--offline", help="Ask no host: check what is there.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Get the files of a published data set as they are, checked.

    Run it again after an interruption: it goes on where it stopped. Raw recordings and processed
    data are files of their own: look with --list, and choose with --only.
    """
    from semantic2d_dataset.access import download as downloads
    from semantic2d_dataset.access.known_datasets import find_known

    known = find_known(dataset, registry)
    folder = to or downloads.download_folder(known)
    if list_only:
        listed = downloads.find_files(known, folder, only=only or (), offline=offline)
        said = downloads.describe(known, listed)
    else:
        try:
            got = downloads.download(known, folder, only=only or (), offline=offline)
        except KeyboardInterrupt:
            typer.echo(
                "what has arrived is kept under a hidden name; run this again to go on", err=True
            )
            raise
        said = downloads.describe(known, got) | {"folder": str(folder)}
    typer.echo(json.dumps(said, indent=1) if as_json else downloads.format_description(said))
