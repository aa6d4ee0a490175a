"""The commands about scores: ``semantic2d score``, ``score-part``, ``report``, ``compare``."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from semantic2d_dataset.cli_options import (
    AsJson,
    Data,
    Jobs,
    Scheduler,
    SchemeName,
    SplitName,
    check_out,
    open_for,
)


def score(
    predictions: Annotated[
        list[Path], typer.Argument(help="Predictions file, or one for each seed of a method.")
    ],
    *,
    data: Data = None,
    scheme: SchemeName = None,
    split: SplitName = None,
    jobs: Jobs = 1,
    scheduler: Scheduler = None,
    out: Annotated[Path | None, typer.Option(help="Write the result as JSON.")] = None,
    as_json: AsJson = False,
) -> None:
    """Score predictions: IoU and CA, by class, mean and condition, with intervals.

    Several files are seeds of one method: each is scored, and mean and deviation are printed.
    """
    from semantic2d_dataset.executors import open_executor
    from semantic2d_dataset.scoring import spreads
    from semantic2d_dataset.scoring import submission as scoring

    check_out(out, *predictions)
    found, paths = open_for(predictions[0], data), predictions
    if scheduler is not None:  # its workers have working folders of their own
        found, paths = replace(found, root=found.root.resolve()), [p.resolve() for p in paths]
    with open_executor(jobs=jobs, scheduler=scheduler) as executor:
        results = [
            scoring.score_predictions(path, found, scheme=scheme, split=split, executor=executor)
            for path in paths
        ]
    said: dict[str, Any] = results[0]
    if len(results) > 1:
        said = {"spread": spreads.spread_of_seeds(results), "results": results}
    _tell(said, zip(predictions, results, strict=True), out, as_json=as_json)


def score_part(
    predictions: Annotated[Path, typer.Argument(help="Predictions file.")],
    part: Annotated[
        str, typer.Argument(metavar="K/N", help="Part K of N of the sequences, such as 2/4.")
    ],
    out: Annotated[Path, typer.Argument(help="File of counts to write.")],
    *,
    data: Data = None,
    scheme: SchemeName = None,
    split: SplitName = None,
    jobs: Jobs = 1,
) -> None:
    """Score a part of the sequences, for several machines to share; see score-merge."""
    from semantic2d_dataset.executors import open_executor
    from semantic2d_dataset.scoring.counts import write_counts
    from semantic2d_dataset.scoring.submission import count_predictions

    if not (found := re.fullmatch(r"([0-9]{1,6})/([0-9]{1,6})", part)):
        raise typer.BadParameter(f"expected K/N, such as 2/4, found {part!r}")
    check_out(out, predictions)
    with open_executor(jobs=jobs) as executor:
        counts = count_predictions(
            predictions,
            open_for(predictions, data),
            scheme=scheme,
            split=split,
            part=(int(found[1]), int(found[2])),
            executor=executor,
        )
    write_counts(counts, out)
    did, of = len(counts.tallies), len(counts.sequences)
    typer.echo(f"wrote {out}: counts of {did} of {of} sequences")


def score_merge(
    parts: Annotated[list[Path], typer.Argument(help="Files of counts, of all parts.")],
    *,
    out: Annotated[Path | None, typer.Option(help="Write the result as JSON.")] = None,
    as_json: AsJson = False,
) -> None:
    """Put the parts of score-part together: the result that score gives, to the byte."""
    from semantic2d_dataset.scoring.counts import read_counts
    from semantic2d_dataset.scoring.submission import score_counts

    check_out(out, *parts)
    result = score_counts(map(read_counts, parts))
    _tell(result, [(parts[0], result)], out, as_json=as_json)


def report(
    predictions: Annotated[Path, typer.Argument(help="Predictions file.")],
    *,
    data: Data = None,
    scheme: SchemeName = None,
    split: SplitName = None,
    out: Annotated[Path, typer.Option(help="Page to write.")] = Path("report.html"),
) -> None:
    """Write an HTML page about predictions."""
    from semantic2d_dataset.reports import write_report

    check_out(out, predictions)
    write_report(out, predictions, open_for(predictions, data), scheme=scheme, split=split)
    typer.echo(f"wrote {out}")


def compare(
    a: Annotated[Path, typer.Argument(metavar="A", help="Predictions file.")],
    b: Annotated[Path, typer.Argument(metavar="B", help="Another one for the same split.")],
    *,
    data: Data = None,
    jobs: Jobs = 1,
    out: Annotated[Path | None, typer.Option(help="Picture to write.")] = None,
    as_json: AsJson = False,
) -> None:
    """Say which of two submissions is better, how surely, and where they differ."""
    from semantic2d_dataset.executors import open_executor
    from semantic2d_dataset.scoring.comparison import compare_predictions, format_comparison

    if out is not None:
        from semantic2d_dataset.plotting import check_picture_name

        check_picture_name(out)
        check_out(out, a, b)
    with open_executor(jobs=jobs) as executor:
        found = compare_predictions(a, b, open_for(a, data), executor=executor)
    if out is not None:
        from semantic2d_dataset.comparing import plot_comparison
        from semantic2d_dataset.plotting import save

        save(plot_comparison(found), out)
    typer.echo(json.dumps(found.as_dict(), indent=1) if as_json else format_comparison(found))
    if out is not None and not as_json:
        typer.echo(f"wrote {out}")


def _tell(
    said: Mapping[str, Any],
    results: Iterable[tuple[Path, Mapping[str, Any]]],
    out: Path | None,
    *,
    as_json: bool,
) -> None:
    """Write a result, or the spread of several, and print it; each comes with its file."""
    from semantic2d_dataset.format.writing import write_text_atomically
    from semantic2d_dataset.scoring import submission as scoring

    text = scoring.result_to_json(said)
    if out is not None:
        write_text_atomically(out, text)
    if as_json:
        typer.echo(text)
        return
    several = "spread" in said
    for path, result in results:
        typer.echo(f"{path}\n" if several else "", nl=False)
        typer.echo(scoring.format_score(result))
    if several:
        count = said["spread"]["count"]
        typer.echo(f"\nMean and standard deviation over {count} seeds, percent")
        typer.echo(scoring.format_spread(said["spread"]))
