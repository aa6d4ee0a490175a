"""The command ``semantic2d leaderboard``."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from leaderboard.cli_private import app as private_app
from semantic2d_dataset.cli_options import AsJson, open_for
from semantic2d_dataset.errors import InvalidInputError

app = typer.Typer(no_args_is_help=True, add_completion=False, rich_markup_mode=None)
app.add_typer(private_app, name="private")

_Entries = Annotated[Path, typer.Option("--entries", help="Folder of the board's entries.")]
_Data = Annotated[
    list[str] | None,
    typer.Option("--data", help="Data set folder or name to check against; may be repeated."),
]
_Predictions = Annotated[
    Path | None,
    typer.Option("--predictions", help="Folder of predictions files; found by their digests."),
]
_ENTRIES = Path("leaderboard/entries")


@app.callback()
def leaderboard() -> None:
    """Keep a board of methods: add entries, check them, build its pages."""


@app.command()
def add(
    predictions: Annotated[
        list[Path], typer.Argument(help="Predictions file; several are seeds of one method.")
    ],
    *,
    entries: _Entries = _ENTRIES,
    data: Annotated[
        str | None, typer.Option(help="Data set folder or name; else as the file says.")
    ] = None,
    scheme: Annotated[str | None, typer.Option(help="Split scheme; else as it says.")] = None,
    split: Annotated[str | None, typer.Option(help="Split; else as the file says.")] = None,
    url: Annotated[
        list[str] | None,
        typer.Option(help="Where others get this very file (https); repeat it in their order."),
    ] = None,
    sanity_row: Annotated[
        bool, typer.Option("--sanity", help="A row to compare with, not to rank.")
    ] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Replace this method's earlier entry.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Score predictions, and write their entry.

    Several files are seeds of one method: it is ranked by their mean, and the one with the median
    mIoU is shown in full.
    """
    from leaderboard.adding import add_entry, make_entry, make_entry_of_seeds
    from leaderboard.entries import SANITY, SCORED

    urls, several = url or [], len(predictions) > 1
    if urls and len(urls) != len(predictions):
        raise typer.BadParameter(
            f"{len(predictions)} predictions and {len(urls)} addresses: give one --url for each, "
            "in their order, or none"
        )
    if sanity_row and several:
        raise typer.BadParameter("--sanity is for one file: a sanity row has no seeds")
    _check_entries(entries)
    found, asked = open_for(predictions[0], data), {"scheme": scheme, "split": split}
    if several:
        entry = make_entry_of_seeds(predictions, found, urls=urls, **asked)
    else:
        kind, place = SANITY if sanity_row else SCORED, urls[0] if urls else None
        entry = make_entry(predictions[0], found, kind=kind, url=place, **asked)
    path = add_entry(entry, entries, force=force)
    typer.echo(_say_added(path, entry, as_json=as_json))


def _say_added(path: Path, entry: Mapping[str, Any], *, as_json: bool) -> str:
    from semantic2d_dataset.scoring.metrics import percent

    means, std = {mean: entry["result"][mean] for mean in ("mIoU", "mCA")}, {}
    count = len(entry["seeds"]["runs"]) if "seeds" in entry else 1
    if count > 1:
        spreads = {mean: entry["seeds"]["spread"][mean] or {} for mean in means}
        std = {mean: spread.get("std") for mean, spread in spreads.items()}
        means = {mean: spread.get("mean") for mean, spread in spreads.items()}
    if as_json:
        more = {"seeds": count, "std": std} if std else {}
        return json.dumps({"entry": str(path), **means, **more}, indent=1)
    figures = ", ".join(
        f"{mean} {percent(figure)}" + (f" ± {percent(std[mean])}" if std else "")
        for mean, figure in means.items()
    )
    return f"{path}: {figures}" + (f" over {count} seeds" if std else "")


@app.command()
def check(
    *,
    entries: _Entries = _ENTRIES,
    data: _Data = None,
    predictions: _Predictions = None,
    strict: Annotated[
        bool, typer.Option("--strict", help="Fail also where an entry is unverified.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Check every entry: digests, figures, and the score again where predictions are at hand."""
    from leaderboard.at_hand import AtHand
    from leaderboard.checking import UNVERIFIED, WRONG, check_entries, format_check

    found = check_entries(entries, AtHand(data or (), _folder(predictions)))
    if as_json:
        said = [
            {
                "entry": each.path.name,
                "status": each.status,
                "reason": each.reason,
                "problems": [{"field": name, "problem": what} for name, what in each.problems],
                "notes": each.notes,
            }
            for each in found
        ]
        typer.echo(json.dumps(said, indent=1))
    else:
        typer.echo(format_check(found) or f"{entries}: no entries")
    failing = {WRONG, UNVERIFIED} if strict else {WRONG}
    if any(each.status in failing for each in found):
        raise typer.Exit(1)


@app.command()
def fetch(
    to: Annotated[Path, typer.Option("--to", help="Folder for the predictions files.")],
    *,
    entries: _Entries = _ENTRIES,
    most_mb: Annotated[int, typer.Option(min=1, help="Largest file to get, MB.")] = 500,
    host: Annotated[
        list[str] | None, typer.Option(help="The only host to ask; may be repeated.")
    ] = None,
) -> None:
    """Get the predictions that entries point to; each must have the digest that was scored."""
    from leaderboard.entries import list_entries, read_entry
    from leaderboard.fetching import fetch_predictions
    from semantic2d_dataset.errors import Semantic2DError

    paths, failed = list_entries(entries), 0
    to.mkdir(parents=True, exist_ok=True)
    for path in paths:
        for each in read_entry(path).files():
            try:
                found = fetch_predictions(
                    each, to, most_bytes=most_mb * 1_000_000, hosts=host or ()
                )
            except Semantic2DError as err:
                failed += 1
                typer.echo(f"error: {err}", err=True)
            else:
                typer.echo(f"{path.name}: {found or 'points to no predictions'}")
    if failed:
        raise typer.Exit(1)


@app.command()
def build(
    out: Annotated[Path, typer.Argument(help="Folder of the pages; an earlier one is replaced.")],
    *,
    entries: _Entries = _ENTRIES,
    data: _Data = None,
    predictions: _Predictions = None,
) -> None:
    """Write the pages of the board: a folder that any web server can show, or none."""
    from leaderboard.at_hand import AtHand
    from leaderboard.site import build_site

    count = build_site(out, entries, AtHand(data or (), _folder(predictions)))
    typer.echo(f"wrote {out / 'index.html'}: {count} entries")


@app.command()
def published(*, entries: _Entries = _ENTRIES) -> None:
    """Write the rows of the published table as entries, marked as published."""
    from leaderboard.adding import add_entry
    from leaderboard.published import published_entries

    _check_entries(entries)
    paths = [add_entry(entry, entries, force=True) for entry in published_entries()]
    typer.echo(f"wrote {len(paths)} entries into {entries}")


@app.command()
def sanity(
    kind: Annotated[str, typer.Argument(help="majority or perfect.")],
    out: Annotated[Path, typer.Option("--out", help="Predictions file to write.")],
    *,
    data: Annotated[str, typer.Option(help="Data set folder or name.")] = "semantic2d-mini",
    lidar: Annotated[str, typer.Option(help="Whose scans to label.")] = "hokuyo",
    scheme: Annotated[str, typer.Option(help="How the data set is divided.")] = "block",
    split: Annotated[str, typer.Option(help="train, val or test.")] = "test",
    force: Annotated[bool, typer.Option("--force", help="Replace the file --out.")] = False,
) -> None:
    """Write predictions to compare with: the majority class, or the truth itself."""
    from leaderboard.sanity import predict_sanity
    from semantic2d_dataset.access.registry import open_dataset
    from semantic2d_dataset.format.writing import check_target

    check_target(out, (), force=force)
    predict_sanity(kind, open_dataset(data), out, lidar=lidar, scheme=scheme, split=split)
    command = shlex.join(("semantic2d", "leaderboard", "add", str(out), "--sanity"))
    typer.echo(f"wrote {out}; add it with: {command}")


@app.command()
def table(
    results: Annotated[
        list[Path], typer.Argument(help="Files that `semantic2d score --out` wrote.")
    ],
    *,
    markdown: Annotated[bool, typer.Option("--markdown", help="Print a Markdown table.")] = False,
    as_json: AsJson = False,
) -> None:
    """Print a table of results, best mIoU first."""
    from leaderboard.table import rank, to_json, to_markdown, to_text

    if markdown and as_json:
        raise typer.BadParameter("choose one of --markdown and --json")
    layout = to_markdown if markdown else to_json if as_json else to_text
    typer.echo(layout(rank(results)))


def _check_entries(entries: Path) -> None:
    if not entries.is_dir():
        raise InvalidInputError(f"{entries}: no such folder; make it, or say another --entries")


def _folder(predictions: Path | None) -> Path | None:
    if predictions is not None and not predictions.is_dir():
        raise InvalidInputError(f"{predictions}: expected a folder of predictions files")
    return predictions
