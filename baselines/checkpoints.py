"""Trained models on disk: safetensors weights, and a JSON file beside them that says what they are.

The JSON file names its weights with their SHA-256 and replaces its predecessor in one step, so
that a kill at any moment leaves the old pair or the new one. Nothing is ever unpickled.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from baselines.architectures import build_network, check_model
from baselines.descriptions import Description, check_format
from baselines.networks import SegmentationNetwork
from semantic2d_dataset.access.features import Statistics, channel_count
from semantic2d_dataset.errors import (
    CorruptFileError,
    DatasetNotFoundError,
    InvalidInputError,
)
from semantic2d_dataset.format.schema import FORMAT_VERSION
from semantic2d_dataset.format.writing import write_bytes_atomically, write_text_atomically
from semantic2d_dataset.scene.lidars import LidarSpec
from semantic2d_dataset.scene.taxonomy import Taxonomy

_KIND = "semantic2d-checkpoint"
_MODEL = "model"


@dataclass(frozen=True)
class Checkpoint:
    """A network, and what is needed to use it on scans.

    Parameters
    ----------
    network
        The trained network.
    features
        Letters of its input channels, in the order R, I, P, A.
    statistics
        What standardises them.
    lidar
        The sensor of the scans that it was trained on.
    taxonomy
        Its classes.
    dataset
        Where the scans came from: name, version, scheme; empty where not known.
    training
        The settings of the training, and what it reached.
    """

    network: SegmentationNetwork
    features: str
    statistics: Statistics
    lidar: LidarSpec
    taxonomy: Taxonomy
    dataset: Mapping[str, str] = field(default_factory=dict)
    training: Mapping[str, Any] = field(default_factory=dict)

    @property
    def description(self) -> Description:
        """All but the network."""
        parts = (self.features, self.statistics, self.lidar, self.taxonomy)
        return Description(*parts, self.dataset, self.training)


def save_checkpoint(folder: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint into a folder, replacing the one that is there.

    Raises
    ------
    WriteError
        If the folder is missing or the disk is full; the old checkpoint is then untouched.
    """
    network = checkpoint.network
    architecture = {"name": network.name, "channels": network.channels, "classes": network.classes}
    said = {"architecture": architecture} | checkpoint.description.as_json()
    write_state(folder, _MODEL, said, network.state_dict())


def load_checkpoint(folder: Path, *, device: str | torch.device = "cpu") -> Checkpoint:
    """Read a checkpoint, its network in evaluation mode.

    Parameters
    ----------
    folder
        Where training left it.
    device
        Where to put the network.

    Raises
    ------
    DatasetNotFoundError
        If the folder holds no checkpoint.
    CorruptFileError
        If it is damaged, or its parts do not fit each other.
    FormatVersionError
        If it was written in a newer major format.
    """
    said, tensors = read_state(folder, _MODEL)
    path = Path(folder) / f"{_MODEL}.json"
    try:
        with torch.random.fork_rng([]):  # building a network draws weights
            checkpoint = _understand(said)
        checkpoint.network.load_state_dict(tensors, strict=True)
    except (KeyError, TypeError, ValueError, AttributeError) as err:
        raise CorruptFileError(f"{path}: not the description of a model: {err!r}") from err
    except RuntimeError as err:
        raise CorruptFileError(f"{path}: the weights are of another architecture: {err}") from err
    checkpoint.network.to(device).eval()
    return checkpoint


def has_state(folder: Path, stem: str = _MODEL) -> bool:
    """Tell whether a folder holds a checkpoint, or another state by its stem."""
    return (Path(folder) / f"{stem}.json").exists()


def write_state(
    folder: Path, stem: str, said: Mapping[str, Any], tensors: Mapping[str, Tensor]
) -> None:
    """Write ``<stem>-<digest>.safetensors``, and ``<stem>.json`` with what is said of it.

    Raises
    ------
    WriteError
        If the folder is missing or the disk is full.
    """
    folder = Path(folder)
    content = safetensors.torch.save({name: t.contiguous().cpu() for name, t in tensors.items()})
    digest = hashlib.sha256(content).hexdigest()
    weights = folder / f"{stem}-{digest[:16]}.safetensors"
    write_bytes_atomically(weights, content)
    about = {"file": weights.name, "bytes": len(content), "sha256": digest}
    head = {"format": _KIND, "format_version": FORMAT_VERSION}
    write_text_atomically(
        folder / f"{stem}.json", json.dumps(head | dict(said) | {"weights": about}, indent=2) + "\n"
    )
    for old in folder.glob(f"{stem}-*.safetensors"):
        if old != weights:
            old.unlink(missing_ok=True)


def read_state(folder: Path, stem: str) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Read what `write_state` wrote, and check every byte of the tensors.

    Raises
    ------
    DatasetNotFoundError
        If it is not there.
    CorruptFileError, FormatVersionError
        If it is damaged, or of a newer major format.
    """
    path = Path(folder) / f"{stem}.json"
    if not path.is_file():
        raise DatasetNotFoundError(f"{folder}: no trained model here (there is no {path.name})")
    said = _read_json(path)
    try:
        about = said["weights"]
        name, size, digest = str(about["file"]), int(about["bytes"]), str(about["sha256"])
    except (KeyError, TypeError, ValueError) as err:
        raise CorruptFileError(f"{path}: does not say which weights belong to it") from err
    if Path(name).name != name or not name.endswith(".safetensors"):
        raise CorruptFileError(f"{path}: expected weights in a .safetensors file here: {name!r}")
    return said, _read_tensors(path.parent / name, size, digest)


def _read_json(path: Path) -> dict[str, Any]:
    try:
        said = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as err:
        raise CorruptFileError(f"{path}: not a JSON file: {err}") from err
    return check_format(path, said, _KIND)


def _read_tensors(path: Path, size: int, digest: str) -> dict[str, Tensor]:
    if not path.is_file():
        raise CorruptFileError(f"{path}: missing, though the model beside it names it")
    found = path.stat().st_size
    if found != size:
        raise CorruptFileError(f"{path}: expected {size} bytes, found {found}; train again")
    content = path.read_bytes()
    if hashlib.sha256(content).hexdigest() != digest:
        raise CorruptFileError(f"{path}: differs from its recorded SHA-256; train again")
    try:
        return safetensors.torch.load(content)
    except (safetensors.SafetensorError, ValueError) as err:
        raise CorruptFileError(f"{path}: not a safetensors file: {err}") from err


def _understand(said: Mapping[str, Any]) -> Checkpoint:
    """Build what a JSON file describes; the network has no weights yet."""
    check_model(said["architecture"]["name"])
    name, channels, classes = (said["architecture"][key] for key in ("name", "channels", "classes"))
    about = Description.from_json(said)
    if channel_count(about.features) != channels:
        raise InvalidInputError(f"features {about.features} are not {channels} channels")
    if len(about.taxonomy) != classes:
        raise InvalidInputError(f"{len(about.taxonomy)} names for {classes} classes")
    return Checkpoint(
        build_network(name, channels, classes, about.lidar),
        about.features,
        about.statistics,
        about.lidar,
        about.taxonomy,
        about.dataset,
        about.training,
    )
