"""The command that writes what is known of every scan: ``semantic2d table``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def table(
    dataset: Annotated[str, typer.Argument(help="Data set folder or name.")],
    *,
    out: Annotated[Path, typer.Option(help="File to write, .csv or .parquet.")],
    lidar: Annotated[str | None, typer.Option(help="One lidar; all if not given.")] = None,
    beams: Annotated[bool, typer.Option(help="Count returns and classes, which reads all.")] = True,
    force: Annotated[bool, typer.Option("--force", help="Replace what exists.")] = False,
) -> None:
    """Write a table with one row for each scan: place, time, pose, splits, beams by class."""
    from semantic2d_dataset.access.scan_tables import check_table_name, scan_table, write_table
    from semantic2d_dataset.format.writing import check_target

    check_table_name(out)
    check_target(out, (), force=force)
    found = scan_table(dataset, lidar=lidar, beams=beams)
    write_table(out, found)
    typer.echo(f"wrote {out}: {len(found)} scans, {len(found.columns)} columns")
