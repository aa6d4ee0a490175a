"""The commands about corrupted test sets: ``semantic2d corrupt`` and ``robustness``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from semantic2d_dataset.cli_options import AsJson, Jobs
from semantic2d_dataset.errors import InvalidInputError, WriteError

_KINDS = "range-noise, dropout, dimming, coarse, short-range or rain; all if not given."


def corrupt(
    dataset: Annotated[str, typer.Argument(help="Labelled data set, folder or name.")],
    out: Annotated[Path, typer.Argument(help="Folder that gets a data set KIND-SEVERITY each.")],
    *,
    kind: Annotated[list[str] | None, typer.Option(help=_KINDS)] = None,
    severity: Annotated[
        list[int] | None, typer.Option(min=1, max=5, help="1 to 5; all if not given.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="The same one gives the same scans.")] = 0,
    scheme: Annotated[str, typer.Option(help="Split scheme.")] = "block",
    split: Annotated[str, typer.Option(help="Whose scans.")] = "test",
    jobs: Jobs = 1,
) -> None:
    """Make test sets as a worse sensor, or worse weather, would have recorded them.

    What is there already is kept: run it again to go on.
    """
    from functools import partial

    from semantic2d_dataset import corruption
    from semantic2d_dataset.access.registry import open_dataset
    from semantic2d_dataset.executors import open_executor

    chosen = [(k, s) for k in kind or corruption.KINDS for s in severity or corruption.SEVERITIES]
    for each in chosen:
        corruption.corruption(*each)
    data = open_dataset(dataset)
    _check_folder(out)
    make = partial(corruption.corrupt_into, data, out, seed=seed, scheme=scheme, split=split)
    try:
        with open_executor(jobs=jobs) as executor:
            for folder in executor.map(make, chosen):
                typer.echo(folder)
    finally:  # processes that were ended had no time to
        corruption.remove_partials(out, chosen, seed)


def robustness(
    clean: Annotated[Path, typer.Argument(help="Result for the test set as it is.")],
    corrupted: Annotated[
        list[Path], typer.Argument(help="Results of the same method for corrupted sets.")
    ],
    *,
    as_json: AsJson = False,
) -> None:
    """Say what is left of a score on corrupted test sets, by kind and severity."""
    from semantic2d_dataset.scoring.robustness import format_robustness, summarise_robustness

    said = summarise_robustness(clean, corrupted)
    typer.echo(json.dumps(said, indent=1) if as_json else format_robustness(said))


def _check_folder(folder: Path) -> None:
    """Refuse, before any work, a folder that cannot be made or used."""
    if folder.exists() and not folder.is_dir():
        raise InvalidInputError(f"{folder}: is a file; give the name of a folder")
    if not folder.absolute().parent.is_dir():
        raise WriteError(f"{folder}: the folder {folder.absolute().parent} does not exist")
