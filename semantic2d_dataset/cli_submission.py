"""The commands about predictions: ``semantic2d score``, ``compare``, ``submission`` and others."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from semantic2d_dataset.cli_options import AsJson, Jobs, Scheduler, open_for
from semantic2d_dataset.errors import InvalidInputError, WriteError

submission = typer.Typer(no_args_is_help=True, add_completion=False, rich_markup_mode=None)

Data = Annotated[str | None, typer.Option(help="Data set folder or name; else as the file says.")]
SchemeName = Annotated[str | None, typer.Option(help="Split scheme; else as the file says.")]
SplitName = Annotated[str | None, typer.Option(help="Split; else as the file says.")]
_KINDS = "range-noise, dropout, dimming, coarse, short-range or rain; all if not given."
Force = Annotated[bool, typer.Option("--force", help="Replace what exists.")]


@submission.callback()
def _submission() -> None:
    """Describe a method, check its predictions as the scorer will, and show them."""


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

    _check_out(out, *predictions)
    found = open_for(predictions[0], data)
    with open_executor(jobs=jobs, scheduler=scheduler) as executor:
        results = [
            scoring.score_predictions(
                path.resolve() if scheduler else path,
                found,
                scheme=scheme,
                split=split,
                executor=executor,
            )
            for path in predictions
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
    _check_out(out, predictions)
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

    _check_out(out, *parts)
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

    _check_out(out, predictions)
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
        _check_out(out, a, b)
    with open_executor(jobs=jobs) as executor:
        found = compare_predictions(a, b, open_for(a, data), executor=executor)
    if out is not None:
        from semantic2d_dataset.comparing import plot_comparison
        from semantic2d_dataset.plotting import save

        save(plot_comparison(found), out)
    typer.echo(json.dumps(found.as_dict(), indent=1) if as_json else format_comparison(found))
    if out is not None and not as_json:
        typer.echo(f"wrote {out}")


def corrupt(
    dataset: Annotated[str, typer.Argument(help="Labelled data set, folder or name.")],
    out: Annotated[Path, typer.Argument(help="Folder that gets a data set KIND-SEVERITY each.")],
    *,
    kind: Annotated[list[str] | None, typer.Option(help=_KINDS)] = None,
    severity: Annotated[
        list[int] | None, typer.Option(min=1, max=5, help="1 to 5; all if not given.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="The same one gives the same scans.")] = 0,
    scheme: Annotated[str, typer.Option(help="Split scheme.")] = "block",
    split: Annotated[str, typer.Option(help="Whose scans.")] = "test",
    jobs: Jobs = 1,
) -> None:
    """Make test sets as a worse sensor, or worse weather, would have recorded them.

    What is there already is kept: run it again to go on.
    """
    from functools import partial

    from semantic2d_dataset import corruption
    from semantic2d_dataset.access.registry import open_dataset
    from semantic2d_dataset.executors import open_executor

    chosen = [(k, s) for k in kind or corruption.KINDS for s in severity or corruption.SEVERITIES]
    for each in chosen:
        corruption.corruption(*each)
    data = open_dataset(dataset)
    _check_folder(out)
    make = partial(corruption.corrupt_into, data, out, seed=seed, scheme=scheme, split=split)
    try:
        with open_executor(jobs=jobs) as executor:
            for folder in executor.map(make, chosen):
                typer.echo(folder)
    finally:  # processes that were ended had no time to
        corruption.remove_partials(out, chosen, seed)


def robustness(
    clean: Annotated[Path, typer.Argument(help="Result for the test set as it is.")],
    corrupted: Annotated[
        list[Path], typer.Argument(help="Results of the same method for corrupted sets.")
    ],
    *,
    as_json: AsJson = False,
) -> None:
    """Say what is left of a score on corrupted test sets, by kind and severity."""
    from semantic2d_dataset.scoring.robustness import format_robustness, summarise_robustness

    said = summarise_robustness(clean, corrupted)
    typer.echo(json.dumps(said, indent=1) if as_json else format_robustness(said))


@submission.command()
def new(
    predictions: Annotated[Path, typer.Argument(help="Predictions file.")],
    about: Annotated[Path, typer.Argument(help="YAML file to make, for you to fill in.")],
    *,
    force: Force = False,
) -> None:
    """Begin the description of a method, with what its predictions say already."""
    from semantic2d_dataset.format.writing import check_target, write_text_atomically
    from semantic2d_dataset.scoring.about import write_template

    check_target(about, (predictions,), force=force)
    write_text_atomically(about, write_template(predictions))
    typer.echo(f"wrote {about}; fill it in, then: semantic2d submission pack {predictions} {about}")


@submission.command()
def pack(
    predictions: Annotated[Path, typer.Argument(help="Predictions file.")],
    about: Annotated[Path, typer.Argument(help="YAML file about the method.")],
    *,
    out: Annotated[Path, typer.Option(help="Submission to write.")] = Path("submission.h5"),
    force: Force = False,
) -> None:
    """Put predictions and description into one file."""
    from semantic2d_dataset.format.writing import check_target
    from semantic2d_dataset.scoring import about as descriptions

    check_target(out, (predictions, about), force=force)
    said = descriptions.read_about(about)
    descriptions.pack(predictions, said, out)
    for remark in descriptions.remarks_on(said):
        typer.echo(f"note: {about}: {remark}", err=True)
    typer.echo(f"wrote {out}; check it with: semantic2d submission validate {out}")


@submission.command()
def validate(
    path: Annotated[Path, typer.Argument(metavar="FILE", help="Predictions file.")],
    *,
    data: Data = None,
    scheme: SchemeName = None,
    split: SplitName = None,
    jobs: Jobs = 1,
    as_json: AsJson = False,
) -> None:
    """List every reason why a file cannot be scored; the scorer asks the same."""
    from semantic2d_dataset.executors import open_executor
    from semantic2d_dataset.scoring import validation

    with open_executor(jobs=jobs) as executor:
        problems = validation.validate(
            path, open_for(path, data), scheme=scheme, split=split, executor=executor
        )
    if as_json:
        typer.echo(json.dumps({"problems": problems}, indent=1))
    else:
        for problem in problems:
            typer.echo(problem)
        typer.echo(f"{path}: {len(problems) or 'no'} problem(s)")
    if problems:
        raise typer.Exit(1)


@submission.command()
def show(
    path: Annotated[Path, typer.Argument(metavar="FILE", help="Predictions file.")],
    *,
    as_json: AsJson = False,
) -> None:
    """Say what a file holds and what it says of its method."""
    from semantic2d_dataset.summaries import describe_predictions, format_summary

    said = describe_predictions(path)
    typer.echo(json.dumps(said, indent=1) if as_json else format_summary(said))


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


def _check_out(out: Path | None, *sources: Path) -> None:
    """Refuse, before any work, an output that cannot be written or would replace an input."""
    from semantic2d_dataset.format.writing import check_target

    if out is not None:
        check_target(out, sources, force=True)


def _check_folder(folder: Path) -> None:
    """Refuse, before any work, a folder that cannot be made or used."""
    if folder.exists() and not folder.is_dir():
        raise InvalidInputError(f"{folder}: is a file; give the name of a folder")
    if not folder.absolute().parent.is_dir():
        raise WriteError(f"{folder}: the folder {folder.absolute().parent} does not exist")
