"""The ``semantic2d salsa`` commands."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from salsa.sequences import Summary

app = typer.Typer(
    name="salsa",
    help="Label sequences from one annotated map.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


@app.callback()
def commands() -> None:
    """Label sequences from one annotated map."""


@app.command()
def label(
    sequence: Annotated[Path, typer.Argument(help="Sequence (.h5) with rough poses.")],
    *,
    map_yaml: Annotated[Path, typer.Option("--map", help="map_server YAML file.")],
    annotation: Annotated[Path, typer.Option(help="labelme JSON or label image of that map.")],
    out: Annotated[Path, typer.Option(help="Labelled sequence to write.")],
    force: Annotated[bool, typer.Option("--force", help="Replace what exists.")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print JSON for a program to read.")
    ] = False,
    static_after: Annotated[
        int,
        typer.Option(
            min=0,
            help="Take what is seen to stay in free space for this many seconds, and has no legs, "
            "for a thing and not a person; 0 calls all of it Person.",
        ),
    ] = 5,
    ignore_no_return: Annotated[
        bool,
        typer.Option(
            "--ignore-no-return", help="Leave beams without a return unlabelled, not Other."
        ),
    ] = False,
    jobs: Annotated[
        int, typer.Option(min=1, help="Processes; one already uses all cores for most of it.")
    ] = 1,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler, such as tcp://host:8786.")
    ] = None,
    plot: Annotated[
        Path | None, typer.Option(help="Picture of all labelled points over the map, to write.")
    ] = None,
) -> None:
    """Align a sequence with its map and write a labelled copy."""
    from salsa.labelling import Transfer
    from salsa.sequences import check_target, input_files, label_sequence
    from salsa.settings import Settings
    from salsa.things import Persistence
    from semantic2d_dataset.executors import open_executor

    if plot is not None:  # before hours of work
        from semantic2d_dataset.plotting import check_picture_name

        check_picture_name(plot)
        inputs = input_files(sequence, map_yaml, annotation).values()
        check_target(plot, (*inputs, out), force=force)
    settings = Settings(
        persistence=Persistence(min_seconds=static_after) if static_after else None,
        transfer=Transfer(ignore_no_return=ignore_no_return),
    )
    with open_executor(jobs=jobs, scheduler=scheduler) as executor:
        summary = label_sequence(
            sequence,
            map_yaml,
            annotation,
            out,
            settings=settings,
            force=force,
            executor=executor,
        )
    typer.echo(json.dumps(asdict(summary), indent=1) if as_json else _describe(summary, out))
    if plot is not None:
        from salsa.pictures import plot_labelled_sequence

        plot_labelled_sequence(out, plot)


def _describe(summary: Summary, out: Path) -> str:
    total = max(sum(summary.points.values()), 1)
    before, after = 100 * summary.near_before, 100 * summary.near_after
    scans = f"{summary.scans} scans, {summary.scans_with_pose} with a pose"
    near = f"{before:.1f} % before, {after:.1f} % after"
    lines = [
        f"{out}: {scans}, {summary.scans_accepted} accepted",
        f"points within 10 cm of the map (median scan): {near}",
        f"rms distance of these: {100 * summary.median_residual_m:.1f} cm",
    ]
    if summary.things or summary.standing:
        lines.append(
            f"unmapped and staying: {summary.things} things, {summary.things_moved} of them mapped "
            f"objects that were moved; {summary.standing} legs or pairs of legs of people who stand"
        )
    lines.append("points:")
    lines += [
        f"  {name:<11}{count:>10}  {100 * count / total:5.1f} %"
        for name, count in summary.points.items()
        if count
    ]
    return "\n".join(lines)
