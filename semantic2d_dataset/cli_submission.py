"""The commands ``semantic2d submission``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from semantic2d_dataset.cli_options import AsJson, Data, Jobs, SchemeName, SplitName, open_for

submission = typer.Typer(no_args_is_help=True, add_completion=False, rich_markup_mode=None)

Force = Annotated[bool, typer.Option("--force", help="Replace what exists.")]


@submission.callback()
def _submission() -> None:
    """Describe a method, check its predictions as the scorer will, and show them."""


@submission.command()
def new(
    predictions: Annotated[Path, typer.Argument(help="Predictions file.")],
    about: Annotated[Path, typer.Argument(help="YAML file to make, for you to fill in.")],
    *,
    force: Force = False,
) -> None:
    """Begin the description of a method, with what its predictions say already."""
    from semantic2d_dataset.format.writing import check_target, write_text_atomically
    from semantic2d_dataset.scoring.about import write_template

    check_target(about, (predictions,), force=force)
    write_text_atomically(about, write_template(predictions))
    typer.echo(f"wrote {about}; fill it in, then: semantic2d submission pack {predictions} {about}")


@submission.command()
def pack(
    predictions: Annotated[Path, typer.Argument(help="Predictions file.")],
    about: Annotated[Path, typer.Argument(help="YAML file about the method.")],
    *,
    out: Annotated[Path, typer.Option(help="Submission to write.")] = Path("submission.h5"),
    force: Force = False,
) -> None:
    """Put predictions and description into one file."""
    from semantic2d_dataset.format.writing import check_target
    from semantic2d_dataset.scoring import about as descriptions

    check_target(out, (predictions, about), force=force)
    said = descriptions.read_about(about)
    descriptions.pack(predictions, said, out)
    for remark in descriptions.remarks_on(said):
        typer.echo(f"note: {about}: {remark}", err=True)
    typer.echo(f"wrote {out}; check it with: semantic2d submission validate {out}")


@submission.command()
def validate(
    path: Annotated[Path, typer.Argument(metavar="FILE", help="Predictions file.")],
    *,
    data: Data = None,
    scheme: SchemeName = None,
    split: SplitName = None,
    jobs: Jobs = 1,
    as_json: AsJson = False,
) -> None:
    """List every reason why a file cannot be scored; the scorer asks the same."""
    from semantic2d_dataset.executors import open_executor
    from semantic2d_dataset.scoring import validation

    with open_executor(jobs=jobs) as executor:
        problems = validation.validate(
            path, open_for(path, data), scheme=scheme, split=split, executor=executor
        )
    if as_json:
        typer.echo(json.dumps({"problems": problems}, indent=1))
    else:
        for problem in problems:
            typer.echo(problem)
        typer.echo(f"{path}: {len(problems) or 'no'} problem(s)")
    if problems:
        raise typer.Exit(1)


@submission.command()
def show(
    path: Annotated[Path, typer.Argument(metavar="FILE", help="Predictions file.")],
    *,
    as_json: AsJson = False,
) -> None:
    """Say what a file holds and what it says of its method."""
    from semantic2d_dataset.summaries import describe_predictions, format_summary

    said = describe_predictions(path)
    typer.echo(json.dumps(said, indent=1) if as_json else format_summary(said))
