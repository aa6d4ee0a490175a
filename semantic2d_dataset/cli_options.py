"""Options that several commands share, and what they mean."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from semantic2d_dataset.errors import DatasetNotFoundError, InvalidInputError

if TYPE_CHECKING:
    from semantic2d_dataset.access.registry import OpenDataset

AsJson = Annotated[bool, typer.Option("--json", help="Print JSON for a program to read.")]
Jobs = Annotated[int, typer.Option("--jobs", "-j", min=1, help="Processes to use.")]
Scheduler = Annotated[
    str | None,
    typer.Option(help="Dask scheduler (tcp://host:8786) whose workers see the same files."),
]
Data = Annotated[str | None, typer.Option(help="Data set folder or name; else as the file says.")]
SchemeName = Annotated[str | None, typer.Option(help="Split scheme; else as the file says.")]
SplitName = Annotated[str | None, typer.Option(help="Split; else as the file says.")]


def open_for(predictions: Path, data: str | None) -> OpenDataset:
    """Open the data set that is given, or else the one that the predictions name."""
    from semantic2d_dataset.access.registry import open_dataset
    from semantic2d_dataset.scoring.predictions import PredictionsReader

    with PredictionsReader(predictions) as reader:
        name = data or reader.dataset
    if not name:
        raise InvalidInputError(f"{predictions}: does not name its data set; say it with --data")
    if data is None and "/" in name:  # a file from elsewhere chooses no folder of this machine
        raise InvalidInputError(
            f"{predictions}: names the data set {name!r}, which is a path; say it with --data"
        )
    try:
        return open_dataset(name)
    except DatasetNotFoundError as err:
        if data is not None:
            raise
        raise DatasetNotFoundError(
            f"{err}\n{predictions} names it; if you have it in a folder, add --data FOLDER"
        ) from err


def check_out(out: Path | None, *sources: Path) -> None:
    """Refuse, before any work, an output that cannot be written or would replace an input."""
    from semantic2d_dataset.format.writing import check_target

    if out is not None:
        check_target(out, sources, force=True)
