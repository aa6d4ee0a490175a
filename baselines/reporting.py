"""From results of runs to tables and pictures, published figures beside them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from statistics import fmean, median, stdev
from typing import Any

from baselines.charts import plot_classes, plot_features
from baselines.experiments import MAIN_FEATURES, Experiment, Method
from baselines.reproduction import RunResult, Settings, describe_dataset
from baselines.s3net import S3Net
from baselines.tables import Row, Table, to_latex, to_markdown, to_text
from semantic2d_dataset.format.writing import write_text_atomically
from semantic2d_dataset.plotting import save
from semantic2d_dataset.scoring.published import METRICS, ClassFigures, published_segmentation

Results = Mapping[Method, Sequence[RunResult]]


def write_report(
    experiment: Experiment, settings: Settings, results: Results, folder: Path
) -> Table:
    """Write ``table.txt``, ``table.md``, ``table.tex``, ``results.json`` and pictures.

    Parameters
    ----------
    experiment, settings, results
        What was run, and what it gave.
    folder
        Made where missing.

    Raises
    ------
    WriteError
        If `folder` cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    table = make_table(experiment, settings, results)
    for name, write in (("txt", to_text), ("md", to_markdown), ("tex", to_latex)):
        write_text_atomically(folder / f"table.{name}", write(table))
    said = _to_json(experiment, settings, results, table)
    write_text_atomically(folder / "results.json", json.dumps(said, indent=1) + "\n")
    _draw(results, table, folder)
    return table


def make_table(experiment: Experiment, settings: Settings, results: Results) -> Table:
    """Lay out a row for each method, and below it what was published of it."""
    runs = [run for of_method in results.values() for run in of_method]
    rows = [
        row
        for of_method in results.values()
        for row in (_row(of_method), _published_row(of_method[0]))
        if row is not None
    ]
    return Table(experiment.title, runs[0].classes, tuple(rows), _notes(settings, runs))


def _row(runs: Sequence[RunResult]) -> Row:
    """Merge the trainings of a method."""
    seeds = f", {len(runs)} seeds" if len(runs) > 1 else ""
    speed = median(run.speed["one_pass"] for run in runs)
    figures = {metric: _merge([run.figures[metric] for run in runs]) for metric in METRICS}
    return Row(_title(runs[0]) + seeds, speed, figures, ranked=bool(runs[0].spec.features))


def _title(run: RunResult) -> str:
    features = "+".join(run.spec.features)
    return f"{run.title} ({features})" if features else run.title


def _merge(rows: Sequence[ClassFigures]) -> ClassFigures:
    """Mean and spread over trainings; of a single one the spread over its samples stays."""
    if len(rows) == 1:
        return rows[0]
    merged = {}
    for name in dict.fromkeys(name for row in rows for name in row):
        means = [row[name][0] for row in rows if name in row]
        merged[name] = (fmean(means), stdev(means) if len(means) > 1 else None)
    return merged


def _published_row(run: RunResult) -> Row | None:
    row = published_segmentation().find(run.title, run.spec.features or None)
    if row is None:
        return None
    return Row(_title(run), row.frames_per_second, row.figures, published=True, ranked=False)


def _notes(settings: Settings, runs: Sequence[RunResult]) -> tuple[str, ...]:
    dataset, published = describe_dataset(settings), published_segmentation()
    processors = ", ".join(sorted({str(run.speed["processor"]) for run in runs}))
    beside = max(run.beside for run in runs)
    data = (
        f"Data: {dataset['name']} {dataset['version']}, {settings.lidar}, scheme "
        f"{settings.scheme}. Trained on train for {settings.config.epochs} epochs, of which the "
        "best on val counts; scored on test."
    )
    spread = (
        f"±: standard deviation over {settings.samples} samples of the latent of one model, or, "
        "where a row says how many seeds, over the models trained with them."
    )
    speed = f"FPS: one pass of one scan; {processors}, one thread, {beside} run(s) at a time."
    source = (
        f"† As published in {published.paper!r}: {published.measured_on}; FPS on "
        f"{published.processor}. Other data, so not ranked here."
    )
    return data, spread, speed, source


def _to_json(
    experiment: Experiment, settings: Settings, results: Results, table: Table
) -> dict[str, Any]:
    """Say everything as plain values; figures are fractions."""
    return {
        "experiment": experiment.name,
        "dataset": describe_dataset(settings) | {"lidar": settings.lidar},
        "seeds": settings.seeds,
        "samples": settings.samples,
        "config": asdict(settings.config) | {"time_limit_s": None},
        "rows": [asdict(row) for row in table.rows],
        "runs": [asdict(run) for of_method in results.values() for run in of_method],
        "notes": table.notes,
    }


def _draw(results: Results, table: Table, folder: Path) -> None:
    by_features = {
        "+".join(method.features): runs
        for method, runs in results.items()
        if method.model == S3Net.name
    }
    ours = {name: _row(runs) for name, runs in by_features.items()}
    published = {
        name: row for name, runs in by_features.items() if (row := _published_row(runs[0]))
    }
    save(plot_features(ours, published), folder / "miou_by_features.png")
    main = [_row(runs) for method, runs in results.items() if method.features in MAIN_FEATURES]
    best = published.get("+".join(MAIN_FEATURES[-1]))
    save(plot_classes([*main, *filter(None, [best])], table.classes), folder / "iou_by_class.png")
