"""The commands about split schemes: ``semantic2d splits list`` and ``audit``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from semantic2d_dataset.cli_options import AsJson

if TYPE_CHECKING:
    from semantic2d_dataset.access.registry import OpenDataset
    from semantic2d_dataset.format.splits import SplitScheme

splits = typer.Typer(no_args_is_help=True, help="Say how a data set is divided, and what leaks.")

_Dataset = Annotated[str, typer.Argument(help="Data set folder or name.")]
_Schemes = Annotated[list[str] | None, typer.Option(help="A scheme; all if not given.")]


@splits.command(name="list")
def list_schemes(dataset: _Dataset, *, as_json: AsJson = False) -> None:
    """Say how each scheme was made, and how many scans its splits have."""
    from semantic2d_dataset.access.registry import open_dataset

    data = open_dataset(dataset)
    said = [
        {
            "scheme": scheme.name,
            "made_by": scheme.made_by,
            "scans": scheme.sizes,
            "digest": scheme.digest,
        }
        for scheme in _schemes_of(data, None)
    ]
    if as_json:
        typer.echo(json.dumps(said, indent=1))
        return
    for each in said:
        sizes = ", ".join(f"{split} {n:,}" for split, n in each["scans"].items())  # type: ignore[attr-defined]
        typer.echo(f"{each['scheme']}: {sizes}\n  {each['made_by']}")


@splits.command()
def audit(
    dataset: _Dataset,
    *,
    scheme: _Schemes = None,
    lidar: Annotated[
        str | None, typer.Option(help="Whose test scans to look at; all lidars if not given.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Picture to write.")] = None,
    as_json: AsJson = False,
) -> None:
    """Measure what schemes leak: the nearest train scan of each test scan, in time and in pose."""
    from semantic2d_dataset.access.registry import open_dataset
    from semantic2d_dataset.format.leakage import audit_schemes, read_tracks
    from semantic2d_dataset.format.leakage_report import describe_audit, format_audit

    data = open_dataset(dataset)
    schemes = _schemes_of(data, scheme)
    name = None if lidar is None else data.sequences(lidar)[0].lidar
    if out is not None:
        from semantic2d_dataset.plotting import check_picture_name

        check_picture_name(out)
    audits = audit_schemes(schemes, read_tracks(data.root, data.manifest), lidar=name)
    said = [describe_audit(each) for each in audits]
    if out is not None:
        from semantic2d_dataset.plotting import save
        from semantic2d_dataset.plotting_splits import plot_audits

        save(plot_audits(audits), out)
    typer.echo(json.dumps(said, indent=1) if as_json else "\n\n".join(map(format_audit, said)))


def _schemes_of(data: OpenDataset, names: list[str] | None) -> list[SplitScheme]:
    chosen = sorted(data.manifest.splits) if names is None else dict.fromkeys(names)
    return [data.scheme(name) for name in chosen]
