"""The command ``semantic2d leaderboard``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(no_args_is_help=True, add_completion=False, rich_markup_mode=None)


@app.callback()
def leaderboard() -> None:
    """Rank methods by their results."""


@app.command()
def table(
    results: Annotated[
        list[Path], typer.Argument(help="Files that `semantic2d score --out` wrote.")
    ],
    *,
    markdown: Annotated[bool, typer.Option("--markdown", help="Print a Markdown table.")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print JSON for a program to read.")
    ] = False,
) -> None:
    """Print a table of results, best mIoU first."""
    from leaderboard.table import rank, to_json, to_markdown, to_text

    if markdown and as_json:
        raise typer.BadParameter("choose one of --markdown and --json")
    layout = to_markdown if markdown else to_json if as_json else to_text
    typer.echo(layout(rank(results)))
