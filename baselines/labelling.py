"""Label a sequence by a model, in place of an annotated map."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

import semantic2d_dataset
from baselines.descriptions import Description
from baselines.sampled_labels import SampledLabels
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.sequence import SequenceReader, SequenceWriter
from semantic2d_dataset.format.writing import check_target
from semantic2d_dataset.scene.lidars import LidarSpec
from semantic2d_dataset.scene.taxonomy import UNLABELLED

_BLOCK_SCANS = 256
_OURS = ("scans/labels", "scans/confidence", "provenance", "map/")

_Sampler = Callable[[NDArray[np.float32], NDArray[np.float32] | None], SampledLabels]


@dataclass(frozen=True)
class Summary:
    """What came of labelling a sequence.

    Parameters
    ----------
    scans
        How many there are.
    points
        Points (beams with a return) by class name.
    """

    scans: int
    points: dict[str, int]


def label_sequence(
    source: Path,
    model: Path,
    out: Path,
    *,
    samples: int = 32,
    seed: int = 0,
    device: str = "cpu",
    force: bool = False,
) -> Summary:
    """Write a copy of a sequence with the labels of a model.

    All else is copied as it is; labels and confidence that were there are replaced, and the
    provenance names the model. Beams without a return, by the limits of the model's lidar, get no
    label (255). Confidence is 255 times the model's probability of the label.

    Parameters
    ----------
    source
        A sequence whose lidar has the beams of the model's; its name, mount and limits may differ.
    model
        Folder that training left, or a file that ``semantic2d baseline export`` wrote.
    out
        The file to write.
    samples, seed
        As for `baselines.segmenter.Segmenter`.
    device
        Where to run a folder's model; ONNX files run on the CPU.
    force
        Replace `out` where it exists.

    Raises
    ------
    FileNotFoundError, DatasetNotFoundError, CorruptFileError
        If an input is missing, or not what it should be.
    InvalidInputError
        If the scans do not fit the model, or `out` exists or is an input.
    WriteError
        If `out` cannot be written.
    """
    source, model, out = Path(source), Path(model), Path(out)
    check_target(out, [source, model], force=force)
    sample, about = _open_model(model, samples, seed, device)
    with SequenceReader(source) as reader:
        _check_fit(reader, about)
        facts = {
            "inputs": {"sequence": _identity(source), "model": _identity(_file_of(model))},
            "model": {"features": about.features, "dataset": dict(about.dataset)},
            "parameters": {"samples": samples, "seed": seed},
            "versions": {"semantic2d-dataset": semantic2d_dataset.__version__},
        }
        provenance = dict(reader.header.provenance) | {"baseline": facts}
        header = replace(reader.header, taxonomy=about.taxonomy, provenance=provenance)
        with SequenceWriter(out, header) as writer:
            writer.copy(reader, [name for name in reader.names if not name.startswith(_OURS)])
            scene = reader.read_map()
            if scene is not None:
                writer.set_map(scene)
            counts = _write_labels(reader, writer, sample, intensities="I" in about.features)
        points = {name: int(counts[i]) for i, name in enumerate(about.taxonomy.names)}
        return Summary(len(reader), points)


def _open_model(model: Path, samples: int, seed: int, device: str) -> tuple[_Sampler, Description]:
    """Return what samples labels of scans, and what the model says of itself."""
    if model.is_dir():
        from baselines.torch_segmenter import TorchSegmenter

        trained = TorchSegmenter(model, samples=samples, seed=seed, device=device)
        return trained.sample, trained.description
    from baselines.segmenter import Segmenter

    exported = Segmenter(model, samples=samples, seed=seed)
    return exported.sample, exported.description


def _write_labels(
    reader: SequenceReader, writer: SequenceWriter, sample: _Sampler, *, intensities: bool
) -> NDArray[np.int64]:
    """Label block by block; return points by label (256,)."""
    counts = np.zeros(256, np.int64)
    with tqdm(total=len(reader), desc="labelling", unit="scan", disable=None) as bar:
        for start in range(0, len(reader), _BLOCK_SCANS):
            rows = (start, min(start + _BLOCK_SCANS, len(reader)))
            ranges = reader.read("scans/ranges", *rows)
            strengths = reader.read("scans/intensities", *rows) if intensities else None
            found = sample(ranges, strengths)
            writer.append({"scans/labels": found.labels, "scans/confidence": _confidence(found)})
            counts += np.bincount(found.labels.ravel(), minlength=256)
            bar.update(len(ranges))
    return counts


def _confidence(found: SampledLabels) -> NDArray[np.uint8]:
    is_labelled = found.labels != UNLABELLED
    chosen = np.where(is_labelled, found.labels, 0)[..., None]
    probability = np.take_along_axis(found.probabilities, chosen, 2)[..., 0]
    confidence: NDArray[np.uint8] = np.rint(255 * probability * is_labelled).astype(np.uint8)
    return confidence


def _check_fit(reader: SequenceReader, about: Description) -> None:
    differences = _differences(about.lidar, reader.lidar)
    if differences:
        raise InvalidInputError(
            f"{reader.path}: the model is for {about.lidar.name}, and these scans are of "
            f"{reader.lidar.name}: expected {', '.join(differences)}; take a model of that lidar"
        )
    if "I" in about.features and "scans/intensities" not in reader:
        raise InvalidInputError(
            f"{reader.path}: has no intensities, which a model of the features {about.features} "
            "needs; train one without I"
        )
    if "map/labels" in reader and reader.header.taxonomy.digest != about.taxonomy.digest:
        raise InvalidInputError(
            f"{reader.path}: its map is annotated with other classes than the model's; label the "
            "recording as it was converted, without the map"
        )


def _differences(expected: LidarSpec, found: LidarSpec) -> list[str]:
    """Say in which beams two lidars differ: none if every bearing is within a tenth of a step."""
    if found.beams != expected.beams:
        return [f"{expected.beams} beams, found {found.beams}"]
    away = np.abs(found.bearings - expected.bearings)[[0, -1]].max()
    if away <= expected.angle_increment / 10:
        return []
    return [
        f"{name} {getattr(expected, name):.6g} rad, found {getattr(found, name):.6g}"
        for name in ("angle_min", "angle_increment")
        if getattr(expected, name) != getattr(found, name)
    ]


def _file_of(model: Path) -> Path:
    """Return the file whose digest tells which model it is; a folder's names its weights' own."""
    return model / "model.json" if model.is_dir() else model


def _identity(path: Path) -> dict[str, Any]:
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return {"name": path.name, "sha256": digest}
