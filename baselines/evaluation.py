"""Score a model as the paper's table does: mean and spread over samples, and how sure it is.

The paper draws 32 samples of the latent for every scan, and gives each score as mean and standard
deviation over them (section on the results of S3-Net). So do we: sample s of all scans makes one
prediction of the whole split, which is scored by itself.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from baselines.checkpoints import Checkpoint
from baselines.inference import SAMPLES, infer_scans
from baselines.sampled_labels import SampledLabels
from baselines.speed import frames_per_second, processor_name
from semantic2d_dataset.access.torch_batches import Batch
from semantic2d_dataset.access.torch_datasets import LidarDataset
from semantic2d_dataset.format.writing import write_text_atomically
from semantic2d_dataset.scene.taxonomy import UNLABELLED, Taxonomy
from semantic2d_dataset.scoring.calibration import Calibration
from semantic2d_dataset.scoring.metrics import Evaluator, percent

ALL_CLASSES = "All classes"
"""The column of the means, mCA and mIoU, which leave the background out."""

METRICS: Mapping[str, tuple[str, str]] = {"CA": ("mCA", "ca"), "IoU": ("mIoU", "iou")}
"""Names in tables, and the keys of mean and class in a result of `Evaluator`."""

Spread = tuple[float, float]
"""Mean and standard deviation (of the population) over the samples, fractions."""

_TIMED_SCANS = 64
_TIMED_THREADS = 1


@dataclass(frozen=True)
class Evaluation:
    """How good, how sure and how fast a model is.

    Parameters
    ----------
    model, features
        Title of the network, and the letters of its input channels.
    lidar
        Name of the lidar whose scans were scored.
    dataset
        What was scored: name, version, scheme, split.
    scans
        How many.
    samples, seed
        Predictions of the whole split, S; 1 for a network without latent. And their seed.
    rows
        By metric (CA, IoU), then class name or `ALL_CLASSES`: mean and standard deviation over
        the samples, fractions; None where no sample has the figure.
    majority
        The result of `Evaluator.compute` for the labels that most samples chose.
    calibration
        The result of `Calibration.compute` for the mean probabilities.
    mutual_information
        Mean over scored points, nats: ``all``, ``right`` and ``wrong`` by the majority; None
        where there is none.
    speed
        Scans a second by ``one_pass`` and with all ``samples``, ``processor``, ``threads``, and
        ``how`` that was measured.
    """

    model: str
    features: str
    lidar: str
    dataset: Mapping[str, str]
    scans: int
    samples: int
    seed: int
    rows: Mapping[str, Mapping[str, Spread | None]]
    majority: Mapping[str, Any]
    calibration: Mapping[str, Any]
    mutual_information: Mapping[str, float | None]
    speed: Mapping[str, Any]

    def to_json(self) -> str:
        """Return everything as JSON text with a final line break."""
        return json.dumps(asdict(self), indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def evaluate(
    checkpoint: Checkpoint, dataset: LidarDataset, *, samples: int = SAMPLES, seed: int = 0
) -> Evaluation:
    """Score a model on a data set's split.

    Parameters
    ----------
    checkpoint
        A trained model.
    dataset
        Labelled scans of its lidar with its features, standardised by its statistics.
    samples, seed
        As for `infer`.

    Raises
    ------
    InvalidInputError
        If the data set does not fit the model, or there is no sample to draw.
    """
    counts = _Counts(dataset.taxonomy)
    with tqdm(total=len(dataset), desc="evaluating", unit="scan", disable=None) as bar:
        for batch, found in infer_scans(checkpoint, dataset, samples=samples, seed=seed):
            counts.add(batch, found)
            bar.update(len(found.labels))
    manifest, source = dataset.source.data.manifest, dataset.source
    return Evaluation(
        model=checkpoint.network.title,
        features=checkpoint.features,
        lidar=dataset.lidar.name,
        dataset={
            "name": manifest.name,
            "version": manifest.version,
            "scheme": source.scheme,
            "split": source.split or "all",
        },
        scans=len(dataset),
        samples=len(counts.by_sample),
        seed=seed,
        rows=_rows([one.compute() for one in counts.by_sample], dataset.taxonomy),
        majority=counts.majority.compute(),
        calibration=counts.calibration.compute(),
        mutual_information=counts.mutual_information(),
        speed=_speed(checkpoint, dataset, samples),
    )


def write_evaluation(evaluation: Evaluation, folder: Path) -> None:
    """Write ``reliability.png``, ``confusion.png`` and, last, ``evaluation.json``.

    Raises
    ------
    WriteError
        If the folder is missing or cannot be written.
    """
    from semantic2d_dataset.plotting import save
    from semantic2d_dataset.plotting_scores import plot_confusion, plot_reliability

    folder = Path(folder)
    save(plot_reliability(evaluation.calibration), folder / "reliability.png")
    save(plot_confusion(evaluation.majority), folder / "confusion.png")
    write_text_atomically(folder / "evaluation.json", evaluation.to_json())


def format_evaluation(evaluation: Evaluation) -> str:
    """Lay an evaluation out as text: by class, then how sure and how fast."""
    rows, majority = evaluation.rows, evaluation.majority
    several = evaluation.samples > 1
    spread = _spread if several else _mean
    names = list(rows["CA"])
    width = max(map(len, names))
    header = f"{'':{width}}  {'CA':>14} {'IoU':>14}   {'vote: CA':>8} {'IoU':>6}"
    lines = [
        f"{name:{width}}  {spread(rows['CA'][name]):>14} {spread(rows['IoU'][name]):>14}   "
        f"{percent(_voted(majority, name, 'CA')):>8} {percent(_voted(majority, name, 'IoU')):>6}"
        for name in names
    ]
    said, sure, speed = evaluation.dataset, evaluation.calibration, evaluation.speed
    information = evaluation.mutual_information
    title = (
        f"{evaluation.model} ({evaluation.features}) on {said['name']} {said['version']}, split "
        f"{said['split']} of {said['scheme']}: {evaluation.scans:,} scans of {evaluation.lidar}"
    )
    about = (
        f"In percent: mean and standard deviation over {evaluation.samples} samples of every scan, "
        "and the label that most of them chose."
        if several
        else "In percent: one sample of every scan."
    )
    errors = (
        f"Calibration error: expected {percent(sure['ece'])} %, largest {percent(sure['mce'])} %. "
        f"Wrong points: {_wrong(sure)}; area under risk and coverage {percent(sure['aurc'])} %."
    )
    disagreement = (
        f"Mutual information (nats): {_nats(information['all'])}, where right "
        f"{_nats(information['right'])}, where wrong {_nats(information['wrong'])}."
    )
    rate = (
        f"Scans a second: {speed['one_pass']:.0f} by one pass, {speed['sampled']:.1f} with all "
        f"samples and their entropy ({speed['processor']}; {speed['how']})."
    )
    return "\n".join((title, "", header, *lines, "", about, errors, disagreement, rate))


class _Counts:
    """What is counted scan by scan."""

    def __init__(self, taxonomy: Taxonomy) -> None:
        self.taxonomy = taxonomy
        self.by_sample: list[Evaluator] = []
        self.majority = Evaluator(taxonomy)
        self.calibration = Calibration(taxonomy)
        self._information: NDArray[np.float64] = np.zeros(2)  # of wrong and right points
        self._points: NDArray[np.int64] = np.zeros(2, np.int64)

    def add(self, batch: Batch, found: SampledLabels) -> None:
        truth, valid = batch["label"].numpy().astype(np.uint8), batch["valid"].numpy()
        self.by_sample = self.by_sample or [Evaluator(self.taxonomy) for _ in found.samples]
        for evaluator, labels in zip(self.by_sample, found.samples, strict=True):
            evaluator.update(truth, labels, valid)
        self.majority.update(truth, found.labels, valid)
        self.calibration.update(truth, found.probabilities, valid)
        scored = valid & (truth != UNLABELLED)
        right = (found.labels == truth)[scored].astype(np.int64)
        self._points += np.bincount(right, minlength=2)
        self._information += np.bincount(right, found.mutual_information[scored], minlength=2)

    def mutual_information(self) -> dict[str, float | None]:
        sums, points = (
            {"all": float(of.sum()), "right": float(of[1]), "wrong": float(of[0])}
            for of in (self._information, self._points)
        )
        return {name: sums[name] / points[name] if points[name] else None for name in sums}


def _rows(results: list[dict[str, Any]], taxonomy: Taxonomy) -> dict[str, dict[str, Spread | None]]:
    """Mean and spread over the results of the samples, by metric and class."""
    return {
        metric: {ALL_CLASSES: _mean_and_std([result[mean] for result in results])}
        | {
            name: _mean_and_std([result[name][key] for result in results])
            for name in taxonomy.names
        }
        for metric, (mean, key) in METRICS.items()
    }


def _mean_and_std(figures: list[float | None]) -> Spread | None:
    there = [figure for figure in figures if figure is not None]
    return (float(np.mean(there)), float(np.std(there))) if there else None


def _speed(checkpoint: Checkpoint, dataset: LidarDataset, samples: int) -> dict[str, Any]:
    network, device = checkpoint.network, next(checkpoint.network.parameters()).device
    features = next(iter(dataset.loader(_TIMED_SCANS)))["features"]
    threads = f"{_TIMED_THREADS} thread" if device.type == "cpu" else "GPU"
    return {
        "one_pass": frames_per_second(network, features, threads=_TIMED_THREADS),
        "sampled": frames_per_second(network, features, threads=_TIMED_THREADS, samples=samples),
        "processor": processor_name(device),
        "threads": _TIMED_THREADS,
        "how": f"{threads}, one scan at a time, from features to labels, median scan",
    }


def _voted(majority: Mapping[str, Any], name: str, metric: str) -> float | None:
    mean, key = METRICS[metric]
    figure: float | None = majority[mean] if name == ALL_CLASSES else majority[name][key]
    return figure


def _spread(figures: Spread | None) -> str:
    return "-" if figures is None else f"{percent(figures[0])} ± {percent(figures[1])}"


def _mean(figures: Spread | None) -> str:
    return "-" if figures is None else percent(figures[0])


def _wrong(calibration: Mapping[str, Any]) -> str:
    right = calibration["accuracy"]
    return "-" if right is None else f"{percent(1 - right)} %"


def _nats(figure: float | None) -> str:
    return "-" if figure is None else f"{figure:.4f}"
