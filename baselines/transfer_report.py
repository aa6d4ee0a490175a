"""What a transfer study found, as JSON, as a Markdown table and as a picture."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from numpy.typing import NDArray

from baselines.transfer import Result, Transfer, TransferStudy
from semantic2d_dataset.format.writing import write_bytes_atomically, write_text_atomically
from semantic2d_dataset.scoring.metrics import EVALUATOR_VERSION, class_names, percent

_SMALLEST = "Person"  # the class that suffers most from reprojection (paper, on retrained models)
_COLOURS = ("#1f4e79", "#d98032", "#5b9a68", "#8a6bab", "#9a9a9a")

_Runs = Mapping[tuple[str, str, bool], Result]


def write_transfer(folder: Path, study: TransferStudy, transfers: Sequence[Transfer]) -> list[Path]:
    """Write ``transfer.json``, ``transfer.md`` and ``transfer.png`` into a folder.

    Parameters
    ----------
    folder
        Where to; files of those names are replaced.
    study
        What was measured.
    transfers
        As `measure_transfer` returns them.

    Returns
    -------
    list of Path
        The three files.

    Raises
    ------
    WriteError
        If the folder is missing or the disk is full.
    """
    paths = [Path(folder) / f"transfer.{ending}" for ending in ("json", "md", "png")]
    said = describe_transfer(study, transfers)
    write_text_atomically(paths[0], json.dumps(said, indent=2) + "\n")
    write_text_atomically(paths[1], format_transfer(study, transfers))
    picture = io.BytesIO()
    plot_transfer(study, transfers).savefig(picture, dpi=150, format="png")
    write_bytes_atomically(paths[2], picture.getvalue())
    return paths


def describe_transfer(study: TransferStudy, transfers: Sequence[Transfer]) -> dict[str, Any]:
    """Return settings and all scores as plain values for JSON."""
    manifest = study.data.manifest
    return {
        "dataset": {"name": manifest.name, "version": manifest.version, "scheme": study.scheme},
        "lidars": list(study.lidars),
        "training": asdict(study.config),
        "fine_tuning": asdict(study.fine_tuning),
        "samples": study.samples,
        "evaluator_version": EVALUATOR_VERSION,
        "runs": [asdict(run) | {"out_of_view": run.out_of_view} for run in transfers],
    }


def format_transfer(study: TransferStudy, transfers: Sequence[Transfer]) -> str:
    """Lay the scores out as Markdown: matrices, and the classes of the first lidar's models."""
    manifest, config, tuning = study.data.manifest, study.config, study.fine_tuning
    runs = _by_pair(transfers)
    first = study.lidars[0]
    about = (
        f"{config.model}, features {config.features}, {config.epochs} epochs, seed {config.seed}, "
        f"{study.samples} samples a scan. In percent, over the test split, on the beams of the "
        "lidar tested that lie in view of the one trained on. Where they differ: the model as it "
        f"is, and fine-tuned on the validation split ({tuning.epochs} epochs)."
    )
    matrices = [_matrix(study, name, pick) for name, pick in _figures(runs).items()]
    return "\n".join(
        (
            f"# Across lidars: {manifest.name} {manifest.version}, scheme {study.scheme}",
            "",
            about,
            "",
            *chain.from_iterable(matrices),
            *_class_table(study, runs, f"Classes: models of {first}, fine-tuned", tuned=True),
            *_class_table(study, runs, "Classes: retrained models", tuned=False),
            *_view_table(transfers),
        )
    )


def plot_transfer(study: TransferStudy, transfers: Sequence[Transfer]) -> Figure:
    """Draw the matrices, and CA and IoU of every class (paper, figures on lidar types)."""
    runs = _by_pair(transfers)
    figure = Figure((15.0, 13.0), layout="constrained")
    parts = figure.subfigures(3, 1, squeeze=False, height_ratios=(1.25, 1.0, 1.0))
    top, middle, bottom = parts[:, 0]
    top.suptitle(f"{study.data.manifest.name}: percent by lidar trained on and tested on")
    figures = _figures(runs)
    names = [name for name in ("mIoU", f"{_SMALLEST} IoU") if name in figures]
    axes = top.subplots(1, 2 * len(names), squeeze=False)[0]
    for i, (name, tuned) in enumerate((name, tuned) for name in names for tuned in (False, True)):
        matrix = _values(study, figures[name], tuned=tuned)
        title = f"{name}, {'fine-tuned' if tuned else 'as it is'}"
        _draw_matrix(axes[i], study.lidars, matrix, title, named=i == 0)
    _draw_bars(middle, study, runs, f"Models of {study.lidars[0]}, fine-tuned", tuned=True)
    _draw_bars(bottom, study, runs, "Models trained on each lidar's own scans", tuned=False)
    return figure


_Pick = Callable[[str, str, bool], float | None]
"""A figure by the lidar trained on, the lidar tested on, and whether it was fine-tuned."""


def _by_pair(transfers: Sequence[Transfer]) -> _Runs:
    return {(run.trained_on, run.tested_on, run.fine_tuned): run.in_view for run in transfers}


def _figures(runs: _Runs) -> dict[str, _Pick]:
    """Return the figures that have a matrix, by name; a lidar's own model is never fine-tuned."""

    def result(trained: str, tested: str, tuned: bool) -> Result:  # noqa: FBT001 - a _Pick
        return runs[trained, tested, tuned and trained != tested]

    found: dict[str, _Pick] = {
        "mIoU": lambda *run: result(*run)["mIoU"],
        "mCA": lambda *run: result(*run)["mCA"],
    }
    if _SMALLEST in class_names(next(iter(runs.values()))):
        found[f"{_SMALLEST} IoU"] = lambda *run: result(*run)[_SMALLEST]["iou"]
    return found


def _values(study: TransferStudy, pick: _Pick, *, tuned: bool) -> NDArray[np.float64]:
    """Return a matrix in percent, rows trained on; NaN where there is no figure."""
    rows = [[pick(a, b, tuned) for b in study.lidars] for a in study.lidars]
    return 100 * np.array(rows, np.float64)


def _matrix(study: TransferStudy, name: str, pick: _Pick) -> list[str]:
    def cell(trained: str, tested: str) -> str:
        figures = [pick(trained, tested, tuned) for tuned in (False, True)]
        return " → ".join(percent(figure) for figure in figures[: 1 + (trained != tested)])

    lidars = study.lidars
    rows = [[trained, *(cell(trained, tested) for tested in lidars)] for trained in lidars]
    return [f"## {name}", "", *_table(["trained on \\ tested on", *lidars], rows)]


def _columns(study: TransferStudy, runs: _Runs, *, tuned: bool) -> dict[str, Result]:
    """Return the results of the first lidar's models by the lidar tested, or of each one's own."""
    first = study.lidars[0]
    if tuned:
        return {b: runs[first, b, b != first] for b in study.lidars}
    return {b: runs[b, b, False] for b in study.lidars}


def _class_table(study: TransferStudy, runs: _Runs, title: str, *, tuned: bool) -> list[str]:
    columns = _columns(study, runs, tuned=tuned)
    rows = [
        [name, *(percent(c[name][key]) for c in columns.values() for key in ("iou", "ca"))]
        for name in class_names(next(iter(columns.values())))
    ]
    rows.append(["Mean", *(percent(c[key]) for c in columns.values() for key in ("mIoU", "mCA"))])
    head = [f"{lidar} {key}" for lidar in columns for key in ("IoU", "CA")]
    return [f"## {title}", "", *_table(["class", *head], rows)]


def _view_table(transfers: Sequence[Transfer]) -> list[str]:
    """Tell what lies out of view, and what the scores are with those points as background."""
    rows = [
        [
            run.trained_on,
            run.tested_on,
            "yes" if run.fine_tuned else "no",
            percent(run.out_of_view),
            percent(run.in_view["mIoU"]),
            percent(run.all_beams["mIoU"]),
        ]
        for run in transfers
        if run.out_of_view > 0
    ]
    if not rows:
        return []
    head = ["trained on", "tested on", "fine-tuned", "points out of view"]
    head += ["mIoU in view", "mIoU of all, out of view as background"]
    return ["## Out of view", "", *_table(head, rows)]


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return [*("| " + " | ".join(line) + " |" for line in lines), ""]


def _draw_matrix(
    ax: Axes, lidars: Sequence[str], matrix: NDArray[np.float64], title: str, *, named: bool
) -> None:
    ax.imshow(np.nan_to_num(matrix), cmap="Blues", vmin=0, vmax=100)
    for (row, column), value in np.ndenumerate(matrix):
        text = "-" if np.isnan(value) else f"{value:.1f}"
        colour = "white" if value > 55 else "black"
        ax.text(column, row, text, ha="center", va="center", color=colour)
    ax.set_title(title, fontsize=11)
    ax.set_xticks(range(len(lidars)), lidars, rotation=30, ha="right", rotation_mode="anchor")
    ax.set_yticks(range(len(lidars)), lidars if named else [""] * len(lidars))
    ax.set_xlabel("Tested on")
    if named:
        ax.set_ylabel("Trained on")


def _draw_bars(
    figure: SubFigure, study: TransferStudy, runs: _Runs, title: str, *, tuned: bool
) -> None:
    columns = _columns(study, runs, tuned=tuned)
    names = class_names(next(iter(columns.values())))
    width = 0.8 / len(columns)
    figure.suptitle(title)
    for ax, key in zip(figure.subplots(1, 2, sharey=True), ("ca", "iou"), strict=True):
        for i, (lidar, result) in enumerate(columns.items()):
            at = np.arange(len(names)) + (i - (len(columns) - 1) / 2) * width
            heights = [100 * (result[name][key] or 0.0) for name in names]
            ax.bar(at, heights, 0.92 * width, color=_COLOURS[i % len(_COLOURS)], label=lidar)
        ax.set_xticks(range(len(names)), names, rotation=30, ha="right", rotation_mode="anchor")
        ax.set_ylim(0, 100)
        ax.set_ylabel(f"{'CA' if key == 'ca' else 'IoU'} (%)")
        ax.spines[["top", "right"]].set_visible(False)
    handles, labels = ax.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", frameon=False)
