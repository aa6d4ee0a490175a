"""One self-contained HTML page about a predictions file: scores, confusion, scans, a map."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
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
from semantic2d_dataset.scoring.metrics import class_names, percent
from semantic2d_dataset.scoring.predictions import PredictionsReader
from semantic2d_dataset.scoring.submission import score_predictions
from semantic2d_dataset.summaries import labels_of, points_in_map

_MEANS = ("mIoU", "mCA")


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
        title="How good are these labels?",
        method=method,
        said=result["submission"],
        result=result,
        means=[(name, percent(result[name])) for name in _MEANS],
        rows=_rows(result, taxonomy),
        bars=_embed(plotting_scores.plot_class_bars(result)),
        confusion=_embed(plotting_scores.plot_confusion(result)),
        scans=[_show(*each, taxonomy) for each in shown],
        on_map_id=shown[0][0],
        on_map=_embed(_on_map(data, *shown[0][:2], taxonomy)),
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


def _show(
    scan_id: str, scan: Scan, labels: NDArray[np.uint8], taxonomy: Taxonomy
) -> tuple[str, str, str]:
    truth = labels_of(scan)
    scored = scan.valid & (truth != UNLABELLED)
    right = float((labels == truth)[scored].mean()) if scored.any() else None
    figure = plotting.plot_prediction_beside_truth(scan, labels, taxonomy=taxonomy)
    return _embed(figure), scan_id, percent(right)


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


def _rows(result: Mapping[str, Any], taxonomy: Taxonomy) -> list[dict[str, Any]]:
    return [
        {
            "name": name,
            "colour": colour,
            "iou": percent(result[name]["iou"]),
            "ca": percent(result[name]["ca"]),
            "support": f"{result[name]['support']:,}",
        }
        for name, colour in zip(class_names(result), taxonomy.colours, strict=True)
    ]


def _embed(figure: Figure) -> str:
    """Turn a figure into a data URL."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=110)
    return f"data:image/png;base64,{base64.b64encode(stream.getvalue()).decode()}"
