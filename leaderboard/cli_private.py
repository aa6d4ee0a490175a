"""The commands ``semantic2d leaderboard private``: test labels that only a maintainer holds."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from semantic2d_dataset.cli_options import AsJson

app = typer.Typer(no_args_is_help=True, add_completion=False, rich_markup_mode=None)


@app.callback()
def private() -> None:
    """Score against labels that only the maintainer holds, telling little of them."""


@app.command()
def make(
    data: Annotated[str, typer.Argument(help="Data set folder or name, with all labels.")],
    out_public: Annotated[Path, typer.Argument(help="Folder for participants.")],
    out_private: Annotated[Path, typer.Argument(help="Folder for nobody else.")],
    *,
    scheme: Annotated[str, typer.Option(help="The split scheme of the two.")] = "block",
) -> None:
    """Divide a data set into public scans and private labels of its test split."""
    from leaderboard.hiding import hide_labels
    from semantic2d_dataset.access.registry import open_dataset

    hidden = hide_labels(open_dataset(data), out_public, out_private, scheme=scheme)
    typer.echo(f"made {out_public}: labels of {hidden} scans are hidden, and every map")
    typer.echo(f"made {out_private}: keep it to yourself")


@app.command()
def score(
    predictions: Annotated[Path, typer.Argument(help="Predictions file.")],
    labels: Annotated[Path, typer.Option("--labels", help="Folder of the private labels.")],
    ledger: Annotated[Path, typer.Option("--ledger", help="What was told; made if missing.")],
    submitter: Annotated[str, typer.Option("--submitter", help="Who asks.")],
    *,
    step: Annotated[
        float | None, typer.Option(help="A new mIoU is told only where better by this fraction.")
    ] = None,
    per_day: Annotated[
        int | None, typer.Option(min=1, help="Submissions that each has on a day (UTC).")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Score predictions, and say only what the ledger lets be told."""
    from leaderboard.ladder import STEP, score_privately
    from semantic2d_dataset.access.registry import open_dataset
    from semantic2d_dataset.scoring.metrics import percent

    step = STEP if step is None else step
    line = score_privately(
        predictions, open_dataset(labels), ledger, submitter, step=step, per_day=per_day
    )
    if as_json:
        typer.echo(json.dumps(line, indent=1))
        return
    news = "new" if line["better"] else f"as before: not better by {percent(step)}"
    typer.echo(f"{submitter}: mIoU {percent(line['mIoU'])}, mCA {percent(line['mCA'])} ({news})")


@app.command()
def ledger(
    path: Annotated[Path, typer.Argument(help="The ledger.")],
    *,
    head: Annotated[
        str | None, typer.Option(help="Digest of a line that was published: it must be there.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Check that no line of a ledger was changed, and print the best of each submitter."""
    from leaderboard.ladder import bests_of, read_ledger
    from semantic2d_dataset.errors import InvalidInputError
    from semantic2d_dataset.scoring.metrics import percent

    if not path.is_file():
        raise InvalidInputError(f"{path}: there is no ledger")
    lines = read_ledger(path, head=head)
    bests = bests_of(lines)
    if as_json:
        names = ("task", "submitter", "mIoU", "mCA", "at")
        typer.echo(json.dumps([{name: line[name] for name in names} for line in bests], indent=1))
        return
    for line in bests:
        figures = f"mIoU {percent(line['mIoU'])}, mCA {percent(line['mCA'])}"
        typer.echo(f"{line['task']}: {line['submitter']}: {figures}")
    last = lines[-1]["digest"] if lines else "none"
    typer.echo(f"{len(lines)} lines, none was changed; last digest {last}")
