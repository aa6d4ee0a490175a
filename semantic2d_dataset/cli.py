"""The ``semantic2d`` command.

Every command imports what it needs when it runs, so that ``semantic2d --help`` is quick. The
commands of the sibling packages are looked up by name when they are called.
"""

from __future__ import annotations

import contextlib
import json
import sys
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import semantic2d_dataset
from semantic2d_dataset.cli_corruption import corrupt, robustness
from semantic2d_dataset.cli_data import download, list_, remove, show, verify
from semantic2d_dataset.cli_options import AsJson, Jobs, Scheduler
from semantic2d_dataset.cli_publishing import card, contribute, diff, release
from semantic2d_dataset.cli_scoring import compare, report, score, score_merge, score_part
from semantic2d_dataset.cli_splits import splits
from semantic2d_dataset.cli_submission import submission
from semantic2d_dataset.cli_table import table
from semantic2d_dataset.errors import InvalidInputError, LeakageWarning, Semantic2DError
from semantic2d_dataset.pipeline.siblings import load_sibling

if TYPE_CHECKING:
    from semantic2d_dataset.access.registry import OpenDataset

app = typer.Typer(
    name="semantic2d",
    help="Semantic labels for 2D lidar scans: convert, label, load, train, score.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

_INTERRUPTED = 130
_EXTRAS = {
    "torch": ("PyTorch", "torch"),
    "safetensors": ("PyTorch", "torch"),
    "onnx": ("ONNX", "onnx"),
    "onnxscript": ("ONNX", "onnx"),
    "onnxruntime": ("ONNX Runtime", "onnx"),
}
"""What a command may need beside what is always installed, by the module that is missing."""
_FORWARDED = {"allow_extra_args": True, "ignore_unknown_options": True}


def main() -> None:
    """Run the command line: 0 done, 1 bad input, 2 wrong usage, 130 interrupted."""
    debug = "--debug" in sys.argv
    try:
        with _leaks_in_words():
            app(args=[word for word in sys.argv[1:] if word != "--debug"])
    except (Semantic2DError, OSError) as err:
        if debug:
            raise
        sys.stderr.write(f"error: {_message(err)}\n")
        sys.exit(1)
    except ImportError as err:
        if debug or err.name not in _EXTRAS:
            raise
        what, extra = _EXTRAS[err.name]
        sys.stderr.write(
            f"error: this command needs {what}: pip install 'semantic2d-dataset[{extra}]'\n"
        )
        sys.exit(1)
    except (KeyboardInterrupt, SystemExit) as end:
        if isinstance(end, SystemExit) and end.code != _INTERRUPTED:
            raise
        sys.stderr.write(f"{_farewell(end)}\n")
        sys.exit(_INTERRUPTED)


@contextlib.contextmanager
def _leaks_in_words() -> Iterator[None]:
    """Show the warning about leaks as a line, without the code that gave it."""
    with warnings.catch_warnings():
        show = warnings.showwarning

        def show_in_words(
            message: Warning | str, category: type[Warning], *where: Any, **more: Any
        ) -> None:
            if issubclass(category, LeakageWarning):
                sys.stderr.write(f"warning: {message}\n")
            else:
                show(message, category, *where, **more)

        warnings.showwarning = show_in_words
        yield


def _farewell(end: BaseException) -> str:
    """Return what an interrupted command says of itself, or what holds for any."""
    cause: BaseException | None = end
    while cause is not None:
        if isinstance(cause, KeyboardInterrupt) and cause.args:
            return str(cause.args[0])
        cause = cause.__cause__ or cause.__context__
    return "interrupted; nothing half done was left"


def _message(err: Exception) -> str:
    """Return the message of an error; names in files may hold what no terminal should get."""
    text = str(err)
    if isinstance(err, OSError) and not isinstance(err, Semantic2DError) and err.filename:
        text = f"{err.filename}: {(err.strerror or str(err)).lower()}"
    return "".join(c if c.isprintable() or c == "\n" else "?" for c in text)


def _print_version(wanted: bool) -> None:  # noqa: FBT001 - typer calls it
    if wanted:
        typer.echo(f"semantic2d-dataset {semantic2d_dataset.__version__}")
        raise typer.Exit


@app.callback()
def options(
    *,
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print it.")
    ] = False,
    debug: Annotated[
        bool, typer.Option("--debug", help="Show a traceback where there is an error.")
    ] = False,
) -> None:
    """Take the options that stand before a command."""


@app.command()
def info(
    path: Annotated[
        str, typer.Argument(help="Sequence or predictions file, data set folder or name.")
    ],
    *,
    as_json: AsJson = False,
) -> None:
    """Say what a file or a data set holds."""
    from semantic2d_dataset.summaries import describe_dataset, describe_file, format_summary

    file = Path(path)
    said = describe_file(file) if file.is_file() else describe_dataset(_open(path))
    typer.echo(json.dumps(said, indent=1) if as_json else format_summary(said))


for _command in (verify, download, list_, show, remove, table, release, card, diff):
    app.command(name=_command.__name__.rstrip("_"))(_command)
app.add_typer(splits, name="splits")
app.add_typer(contribute, name="contribute")


@app.command()
def simulate(
    out: Annotated[Path, typer.Argument(help="Folder to make.")],
    *,
    seed: Annotated[int, typer.Option(min=0, help="Another seed gives other buildings.")] = 0,
    environment: Annotated[
        list[str] | None, typer.Option(help="Floor plans; all if not given.")
    ] = None,
    recordings: Annotated[int, typer.Option(min=1, help="Recordings in each.")] = 1,
    scans: Annotated[int, typer.Option(min=1, help="Scans in each recording, at 20 Hz.")] = 340,
    lidar: Annotated[list[str] | None, typer.Option(help="Lidars; all three if not given.")] = None,
    name: Annotated[str, typer.Option(help="Name in the manifest.")] = "semantic2d-simulated",
) -> None:
    """Make a data set with exact truth, of any size."""
    from semantic2d_dataset.format.manifest import check_names
    from semantic2d_dataset.format.writing import make_folder
    from semantic2d_dataset.scene.lidars import LIDARS, find_lidar
    from semantic2d_dataset.simulation.mini import simulate_dataset

    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InvalidInputError(f"{out}: exists already; choose a new folder")
    lidars = [find_lidar(one).name for one in lidar or LIDARS]
    check_names(name, "1.0.0")

    def make(folder: Path) -> None:
        simulate_dataset(
            folder,
            seed=seed,
            environments=environment,
            recordings=recordings,
            scans=scans,
            lidars=lidars,
            name=name,
        )

    make_folder(out.resolve(), make, lambda: False)
    typer.echo(f"made {out}; look at it with: semantic2d info {out}")


app.command()(score)
app.command()(score_part)
app.command()(score_merge)
app.command()(report)
app.command()(compare)
app.command()(corrupt)
app.command()(robustness)
app.add_typer(submission, name="submission")


@app.command()
def plot(
    sequence: Annotated[Path, typer.Argument(help="Sequence file.")],
    *,
    scan: Annotated[int, typer.Option(min=0, help="Index of the scan.")] = 0,
    out: Annotated[Path, typer.Option(help="Picture to write.")] = Path("scan.png"),
) -> None:
    """Draw one scan of a sequence over its map."""
    from semantic2d_dataset.summaries import draw_scan

    draw_scan(sequence, scan, out)
    typer.echo(f"wrote {out}")


@app.command()
def view(
    sequence: Annotated[Path, typer.Argument(help="Sequence file.")],
    *,
    every: Annotated[int, typer.Option(min=1, help="Show one scan of so many.")] = 1,
    save: Annotated[
        Path | None, typer.Option(help="Rerun recording (.rrd) to write; no viewer is opened.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace what exists.")] = False,
) -> None:
    """Open a sequence in the Rerun viewer (extra 'view')."""
    from semantic2d_dataset.format.writing import check_target
    from semantic2d_dataset.viewing import view_sequence

    if save is not None:
        check_target(save, (sequence,), force=force)
    shown = view_sequence(sequence, every=every, save=save)
    typer.echo(f"{'showing' if save is None else f'wrote {save}:'} {shown} scans")


@app.command()
def run(
    config: Annotated[Path, typer.Argument(help="YAML file: recordings, maps and splits.")],
    *,
    jobs: Jobs = 1,
    scheduler: Scheduler = None,
    only: Annotated[
        list[str] | None,
        typer.Option(help="A recording to convert and label; nothing is published then."),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what would be done, and do nothing.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Make a data set: convert recordings, label them, publish them with splits.

    Run it again after an interruption or a change: what is done already, from the same files
    and settings, is kept. A recording that fails stops no other; nothing is published then.
    """
    from semantic2d_dataset.executors import open_executor
    from semantic2d_dataset.pipeline.config import read_config
    from semantic2d_dataset.pipeline.steps import plan_pipeline, run_pipeline

    said = read_config(config)
    if dry_run:
        plan = plan_pipeline(said, only=only or ())
        for each in plan if not as_json else ():
            what = each["error"] or ", ".join(each["steps"]) or "kept"
            typer.echo(f"{each['recording']}: {what}", err=each["error"] is not None)
        if as_json:
            typer.echo(json.dumps(plan, indent=1))
        raise typer.Exit(int(any(each["error"] for each in plan)))
    with open_executor(jobs=jobs, scheduler=scheduler) as executor:
        report = run_pipeline(said, executor, only=only or ())
    typer.echo(json.dumps(report.as_dict(), indent=1) if as_json else str(report))
    if report.failed:
        raise typer.Exit(1)


@app.command(context_settings=_FORWARDED, add_help_option=False)
def inspect(context: typer.Context) -> None:
    """Say what a recording holds, and how it would be converted."""
    _forward_conversion("inspect", context.args)


@app.command(context_settings=_FORWARDED, add_help_option=False)
def convert(context: typer.Context) -> None:
    """Convert recordings (ROS bags, CARMEN logs, published layouts, arrays) into sequences."""
    _forward_conversion("convert", context.args)


@app.command(context_settings=_FORWARDED, add_help_option=False)
def audit(context: typer.Context) -> None:
    """Count what is wrong in data of the published layout."""
    _forward_conversion("audit", context.args)


@app.command(context_settings=_FORWARDED, add_help_option=False)
def export(context: typer.Context) -> None:
    """Write a sequence as a ROS 2 recording, or in the published layout."""
    _forward_conversion("export", context.args)


@app.command(context_settings=_FORWARDED, add_help_option=False)
def salsa(context: typer.Context) -> None:
    """Label a sequence from one annotated map."""
    _forward(load_sibling("salsa").app, "salsa", context.args)


@app.command(context_settings=_FORWARDED, add_help_option=False)
def baseline(context: typer.Context) -> None:
    """Train S3-Net, and predict with it."""
    _forward(load_sibling("baselines").app, "baseline", context.args)


@app.command(context_settings=_FORWARDED, add_help_option=False)
def leaderboard(context: typer.Context) -> None:
    """Rank results."""
    _forward(load_sibling("leaderboard").app, "leaderboard", context.args)


def _forward_conversion(name: str, words: Sequence[str]) -> None:
    command = typer.Typer(add_completion=False, rich_markup_mode=None)
    command.command(name=name)(getattr(load_sibling("conversion"), name))
    _forward(command, name, words)


def _forward(command: typer.Typer, name: str, words: Sequence[str]) -> None:
    status = typer.main.get_command(command).main(
        args=list(words), prog_name=f"semantic2d {name}", standalone_mode=False
    )
    if status:
        raise typer.Exit(status)


def _open(name: str) -> OpenDataset:
    from semantic2d_dataset.access.registry import open_dataset

    return open_dataset(name)


if __name__ == "__main__":
    main()
