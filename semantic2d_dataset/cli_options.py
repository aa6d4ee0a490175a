"""Options that several commands share."""

from __future__ import annotations

from typing import Annotated

import typer

AsJson = Annotated[bool, typer.Option("--json", help="Print JSON for a program to read.")]
Jobs = Annotated[int, typer.Option("--jobs", "-j", min=1, help="Processes to use.")]
Scheduler = Annotated[
    str | None,
    typer.Option(help="Dask scheduler (tcp://host:8786) whose workers see the same files."),
]
