"""The commands that publish: ``semantic2d release``, ``card``, ``diff``, ``contribute``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from semantic2d_dataset.cli_options import AsJson


def release(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Holds sequences/*.h5, labelled.")],
    *,
    version: Annotated[str, typer.Option(help="MAJOR.MINOR.PATCH, such as 1.0.0.")],
    name: Annotated[str | None, typer.Option(help="Of the data set; as before if none.")] = None,
    license: Annotated[  # noqa: A002 - the option's name
        str | None, typer.Option(help="SPDX id, such as CC-BY-4.0; as before if none.")
    ] = None,
    previous: Annotated[
        Path | None, typer.Option(help="Folder of the version before; DIR itself if none.")
    ] = None,
    allow_unlabelled: Annotated[
        bool, typer.Option("--allow-unlabelled", help="Take sequences without labels.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Publish labelled sequences: splits, manifest, statistics, card, Croissant, digests.

    What nobody can count is read from DIR/release.yaml: title, description, authors, contact,
    url, funding, date, tags, how_it_was_made, intended_use, limits, known_label_errors,
    citation. Published files stay as they are: what changed tells which version comes next
    (MAJOR where data or splits are others, MINOR where data was added, else PATCH).
    """
    from semantic2d_dataset.publishing.release import release as make

    done = make(
        folder,
        version=version,
        name=name,
        license=license,
        previous=previous,
        allow_unlabelled=allow_unlabelled,
    )
    what = f"{done.manifest.name} {done.manifest.version}"
    if as_json:
        said = {
            "folder": str(folder),
            "name": done.manifest.name,
            "version": done.manifest.version,
            "license": done.manifest.license,
            "changed": done.changed,
            "differences": [
                {"change": each.change.name, "what": each.text} for each in done.differences
            ],
            "notices": list(done.notices),
            "documents": [entry.file for entry in done.manifest.documents],
        }
        typer.echo(json.dumps(said, indent=1))
        return
    for each in done.differences:
        typer.echo(str(each))
    for notice in done.notices:
        typer.echo(f"look at this: {notice}")
    typer.echo(
        f"{folder}: released {what}; read DATASET_CARD.md, then upload the folder"
        if done.changed
        else f"{folder}: {what} is released already"
    )


def card(
    dataset: Annotated[str, typer.Argument(help="Data set folder or name.")],
    *,
    out: Annotated[Path | None, typer.Option(help="File to write; else it is printed.")] = None,
) -> None:
    """Print the card of a data set, counted from its scans as they are."""
    from semantic2d_dataset.access.registry import open_dataset
    from semantic2d_dataset.format.checksums import CHECKSUMS_NAME
    from semantic2d_dataset.format.manifest import MANIFEST_NAME
    from semantic2d_dataset.format.writing import check_target, write_text_atomically
    from semantic2d_dataset.publishing.about import ABOUT_NAME, read_about
    from semantic2d_dataset.publishing.card import make_card
    from semantic2d_dataset.publishing.facts import gather_facts

    data = open_dataset(dataset)
    if out is not None:
        names = (MANIFEST_NAME, CHECKSUMS_NAME, ABOUT_NAME, *(f.file for f in data.manifest.files))
        check_target(out, [data.root / name for name in names], force=True)
    about = read_about(data.root, data.manifest.name)
    text = make_card(gather_facts(data), about)
    if out is None:
        typer.echo(text, nl=False)
    else:
        write_text_atomically(out, text)
        typer.echo(f"wrote {out}")


def diff(
    old: Annotated[str, typer.Argument(help="Data set folder or name.")],
    new: Annotated[str, typer.Argument(help="Data set folder or name.")],
    *,
    as_json: AsJson = False,
) -> None:
    """Say what changed from one version of a data set to another.

    Sequences, labels (old and new class of each beam), ranges, poses, splits and classes; at the
    end the version number that the change calls for. Exits 0 whatever differs.
    """
    from semantic2d_dataset.access.registry import open_dataset
    from semantic2d_dataset.publishing.dataset_diff import diff_datasets

    found = diff_datasets(open_dataset(old), open_dataset(new))
    typer.echo(json.dumps(found.as_dict(), indent=1) if as_json else str(found))


contribute = typer.Typer(
    help="Give recordings to a data set.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
)


@contribute.callback()
def _contribute() -> None:
    """Give recordings to a data set."""


@contribute.command()
def check(
    places: Annotated[
        list[Path], typer.Argument(metavar="FILE|DIR...", help="Sequences, or folders of them.")
    ],
    *,
    against: Annotated[
        str | None, typer.Option(help="Data set that they are to join: folder or name.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Check sequences: format, licence, names, classes, labels, stamps, poses, leakage.

    Every finding says where, what was found and expected, and what to do. Exits 1 if one of them
    is an error.
    """
    from semantic2d_dataset.access.registry import open_dataset
    from semantic2d_dataset.publishing.contribution import check_contribution

    data = None if against is None else open_dataset(against)
    found = check_contribution(places, data)
    typer.echo(json.dumps(found.as_dict(), indent=1) if as_json else str(found))
    if found.errors:
        raise typer.Exit(1)
