"""One self-contained HTML page about a predictions file: scores, confusion, scans, a map."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure
from numpy.typing import NDArray

from semantic2d_dataset import plotting, plotting_scores
from semantic2d_dataset.access.registry import OpenDataset
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.writing import write_text_atomically
from semantic2d_dataset.scene.geometry import Pose2
from semantic2d_dataset.scene.scans import Scan
from semantic2d_dataset.scene.taxonomy import UNLABELLED, Taxonomy
from semantic2d_dataset.scoring.conditions import figure_of
from semantic2d_dataset.scoring.metrics import class_names, percent
from semantic2d_dataset.scoring.predictions import PredictionsReader
from semantic2d_dataset.scoring.submission import score_predictions
from semantic2d_dataset.summaries import labels_of, points_in_map

_MEANS = ("mIoU", "mCA")
_FEW_BLOCKS = 20  # below about this many, intervals are too narrow: see `scoring.intervals`


@dataclass(frozen=True)
class Picture:
    """A figure as a data URL, with what it shows in words."""

    source: str
    alt: str
    title: str


def write_report(
    path: Path,
    predictions: Path,
    data: OpenDataset,
    *,
    scheme: str | None = None,
    split: str | None = None,
    scans: int = 6,
) -> None:
    """Score predictions and write a page about them.

    Parameters
    ----------
    path
        The HTML file to write; it refers to nothing outside itself.
    predictions
        The predictions file.
    data
        The data set that they are for.
    scheme, split
        What to score, where the file does not say.
    scans
        How many scans to show, evenly spaced over the sequences.

    Raises
    ------
    SubmissionError
        If the predictions cannot be scored.
    """
    if scans < 1:
        raise InvalidInputError(f"expected at least one scan to show, found {scans}")
    result = score_predictions(predictions, data, scheme=scheme, split=split)
    with PredictionsReader(predictions) as reader:
        shown = _choose_scans(reader, data, scans)
        taxonomy = _taxonomy_of(reader.sequence_ids[0], data)
        method = str(reader.metadata.get("method", "A method without a name"))
    template = Environment(
        loader=PackageLoader("semantic2d_dataset", ""), autoescape=True, undefined=StrictUndefined
    ).get_template("report.html")
    page = template.render(
        method=method,
        said=result["submission"],
        result=result,
        tiles=[_tile(result, mean) for mean in _MEANS],
        blocks=_about_blocks(result["intervals"]),
        classes=list(zip(class_names(result), taxonomy.colours, strict=True)),
        lidars=result["per_lidar"] if len(result["per_lidar"]) > 1 else {},
        percent=percent,
        span=_span,
        bars=_show_classes(result),
        confusion=_show_confusion(result),
        conditions=[_show_condition(result, name) for name in _divided(result)],
        undivided=_undivided(result),
        calibration=_show_calibration(result),
        scans=[_show_scan(*each, taxonomy) for each in shown],
        on_map=_show_map(data, *shown[0][:2], taxonomy),
    )
    write_text_atomically(path, page)


def _choose_scans(
    predictions: PredictionsReader, data: OpenDataset, count: int
) -> list[tuple[str, Scan, NDArray[np.uint8]]]:
    """Evenly spaced predicted scans with their ids and predicted labels."""
    sizes = [predictions.shape(i, "scan_index")[0] for i in predictions.sequence_ids]
    starts = np.cumsum([0, *sizes])
    chosen = np.unique(np.linspace(0, starts[-1] - 1, count + 2)[1:-1].astype(int))
    found = []
    for item in chosen.tolist():
        number = int(np.searchsorted(starts, item, side="right")) - 1
        sequence_id = predictions.sequence_ids[number]
        at = item - int(starts[number])
        index = int(predictions.read(sequence_id, "scan_index", at, at + 1)[0])
        labels = predictions.read(sequence_id, "labels", at, at + 1)[0]
        with data.reader(sequence_id) as reader:
            found.append((f"{sequence_id}/{index}", reader.batch(index, index + 1)[0], labels))
    return found


def _taxonomy_of(sequence_id: str, data: OpenDataset) -> Taxonomy:
    with data.reader(sequence_id) as reader:
        return reader.header.taxonomy


def _tile(result: Mapping[str, Any], mean: str) -> dict[str, Any]:
    """Say a mean, its interval, and its spread over samples where there are some."""
    spread = result["samples"][mean] if "samples" in result else None
    return {
        "name": mean,
        "value": percent(result[mean]),
        "interval": _span(result["intervals"][mean]),
        "spread": spread and f"{percent(spread['mean'])} ± {percent(spread['std'])} %",
    }


def _about_blocks(said: Mapping[str, Any]) -> str:
    """Say what intervals rest on, and whether that is enough."""
    blocks, of = said["blocks"], f"of {said['block_s']:g} s"
    if blocks < 2:
        return f"No intervals: they need at least two blocks {of}, and the split has {blocks}."
    text = f"Intervals hold {100 * said['level']:g} % of the scores of {said['draws']:,} draws "
    text += f"(bootstrap) from {blocks} blocks {of}."
    few = f" So few blocks make them too narrow: about {_FEW_BLOCKS} are needed."
    return text + few if blocks < _FEW_BLOCKS else text


def _span(limits: Sequence[float] | None) -> str:
    """Write an interval of fractions in percent, empty where there is none."""
    return "" if limits is None else f"{100 * limits[0]:.1f} to {100 * limits[1]:.1f}"


def _show_classes(result: Mapping[str, Any]) -> Picture:
    found = {name: result[name]["iou"] for name in class_names(result)}
    figures = ", ".join(f"{name} {percent(iou)}" for name, iou in found.items())
    alt = f"Bars of IoU with their intervals, and dots of CA, by class. IoU in percent: {figures}."
    return Picture(_embed(plotting_scores.plot_class_bars(result)), alt, "IoU and CA by class")


def _show_confusion(result: Mapping[str, Any]) -> Picture:
    """Draw the confusion matrix, and say what each class is mostly mistaken for."""
    names, matrix = class_names(result), np.asarray(result["confusion"], np.float64)
    mistakes = matrix - np.diag(np.diag(matrix))
    others, support = mistakes.argmax(axis=1), matrix.sum(axis=1)
    said = [
        f"{name} for {names[other]} ({100 * wrong[other] / total:.0f} %)"
        for name, other, wrong, total in zip(names, others, mistakes, support, strict=True)
        if wrong[other]
    ]
    alt = "Confusion matrix, rows are true classes. "
    alt += f"Most frequent mistakes: {', '.join(said)}." if said else "There is no mistake."
    return Picture(_embed(plotting_scores.plot_confusion(result)), alt, "What is taken for what")


def _divided(result: Mapping[str, Any]) -> list[str]:
    """List the conditions that divide the points, in the order in which they are shown."""
    return [name for name in plotting_scores.CONDITIONS if len(result["conditions"][name]) > 1]


def _undivided(result: Mapping[str, Any]) -> str:
    """List the conditions with one band, which holds all points."""
    return "; ".join(
        f"{title.lower()}: {plotting_scores.band_label(name, band)}"
        for name, title in plotting_scores.CONDITIONS.items()
        if len(result["conditions"][name]) == 1
        for band in result["conditions"][name]
    )


def _show_condition(result: Mapping[str, Any], name: str) -> Picture:
    mean, title = figure_of(name), plotting_scores.CONDITIONS[name]
    figures = ", ".join(
        f"{plotting_scores.band_label(name, band)} {percent(scores[mean])} "
        f"({scores['points']:,} points)"
        for band, scores in result["conditions"][name].items()
    )
    alt = f"{mean} in percent by band. {title}: {figures}."
    return Picture(_embed(plotting_scores.plot_condition(result, name)), alt, title)


def _show_calibration(result: Mapping[str, Any]) -> Picture | None:
    if "calibration" not in result:
        return None
    said = result["calibration"]
    figures = ", ".join(
        f"{percent(row['confidence'])} is right {percent(row['accuracy'])}"
        for row in said["confidence_bins"]
        if row["points"]
    )
    alt = (
        "Bars of accuracy by confidence beside the diagonal, and of errors by entropy. "
        f"In percent, mean confidence of {figures}."
    )
    return Picture(_embed(plotting_scores.plot_reliability(said)), alt, "Calibration")


def _show_scan(scan_id: str, scan: Scan, labels: NDArray[np.uint8], taxonomy: Taxonomy) -> Picture:
    truth = labels_of(scan)
    scored = scan.valid & (truth != UNLABELLED)
    right = float((labels == truth)[scored].mean()) if scored.any() else None
    figure = plotting.plot_prediction_beside_truth(scan, labels, taxonomy=taxonomy)
    title = f"{scan_id}: {percent(right)} % of its points are right."
    return Picture(_embed(figure), f"Truth beside prediction of scan {scan_id}", title)


def _show_map(data: OpenDataset, scan_id: str, scan: Scan, taxonomy: Taxonomy) -> Picture:
    figure = _on_map(data, scan_id, scan, taxonomy)
    title = f"{scan_id}, true labels over the occupancy grid."
    return Picture(_embed(figure), f"Scan {scan_id} with true labels over its map", title)


def _on_map(data: OpenDataset, scan_id: str, scan: Scan, taxonomy: Taxonomy) -> Figure:
    with data.reader(scan_id.rsplit("/", 1)[0]) as reader:
        scene = reader.read_map()
    if scene is None or not np.isfinite(scan.pose).all():
        return plotting.plot_scan(scan, taxonomy=taxonomy)
    return plotting.plot_labelled_scan_on_map(
        scene,
        points_in_map(scan)[scan.valid],
        labels_of(scan)[scan.valid],
        pose=Pose2(*scan.pose.tolist()),
        taxonomy=taxonomy,
    )


def _embed(figure: Figure) -> str:
    """Turn a figure into a data URL."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=110, bbox_inches="tight")
    return f"data:image/png;base64,{base64.b64encode(stream.getvalue()).decode()}"
