"""The commands ``semantic2d leaderboard private``: test labels that only a maintainer holds."""

from __future__ import annotations

import typer

app = typer.Typer(
    help="Score against labels that only the maintainer holds.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
)


@app.callback()
def private() -> None:
    """Divide a data set into public scans and private labels, and score against those."""
