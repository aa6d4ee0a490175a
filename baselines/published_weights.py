"""S3-Net's published weights: a ``.pth`` file made a model of the project.

Such a file is a pickle. It is read by torch's restricted reader, which makes tensors and plain
containers and runs nothing.
"""

from __future__ import annotations

import hashlib
import io
import pickle
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from baselines.checkpoints import Checkpoint
from baselines.s3net import S3Net
from semantic2d_dataset.access.features import Statistics, channel_count, normalise_features
from semantic2d_dataset.errors import CorruptFileError, InvalidInputError, UnsafeFileError
from semantic2d_dataset.scene.lidars import HOKUYO_UTM_30LX_EW, LidarSpec
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, Taxonomy

# Mean and standard deviation over the Hokuyo training set, as in the published code
# (github.com/TempleRAIL/s3_net): m, sensor units, rad.
HOKUYO_STATISTICS: Mapping[str, tuple[float, float]] = {
    "R": (4.518406, 8.2914915),
    "I": (3081.8167, 1529.4413),
    "A": (0.5959513, 0.4783924),
}

_WEIGHTS = ("model", "model_state_dict")
_LARGEST = 64 << 20  # bytes; with its optimiser the network takes less than 1 MiB
_NAMED = 3  # problems that a message names


def published_statistics(features: str) -> Statistics:
    """Return the published statistics of the Hokuyo for features out of R, I and A.

    Raises
    ------
    InvalidInputError
        If the features have others, or are unknown.
    """
    letters = normalise_features(features)
    if not set(letters) <= set(HOKUYO_STATISTICS):
        raise InvalidInputError(
            f"features {letters}: statistics were published for R, I and A only; give others, or "
            "a data set to compute them from (--data)"
        )
    mean, std = zip(*(HOKUYO_STATISTICS[letter] for letter in letters), strict=True)
    return Statistics(mean, std)


def load_published(
    path: Path,
    *,
    lidar: LidarSpec = HOKUYO_UTM_30LX_EW,
    features: str = "RIA",
    statistics: Statistics | None = None,
    taxonomy: Taxonomy = SEMANTIC2D,
) -> Checkpoint:
    """Read the weights of an S3-Net in the form of the published code.

    Parameters
    ----------
    path
        What ``torch.save`` wrote: a dict with the weights under ``model`` or
        ``model_state_dict``.
    lidar
        The sensor of the scans to label.
    features
        Letters of the input channels.
    statistics
        What standardises them; the published ones of the Hokuyo where not given.
    taxonomy
        The classes of the network.

    Returns
    -------
    Checkpoint
        Its network in evaluation mode.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    InvalidInputError
        If there are no published statistics for the lidar and features.
    CorruptFileError
        If it is no such file, is damaged, or holds another network.
    UnsafeFileError
        If it holds more than tensors and plain values, or is far too large.
    """
    path, letters = Path(path), normalise_features(features)
    if statistics is None:
        if lidar != HOKUYO_UTM_30LX_EW:
            raise InvalidInputError(
                f"statistics were published for {HOKUYO_UTM_30LX_EW.name} only; for {lidar.name} "
                "give others, or a data set to compute them from (--data)"
            )
        statistics = published_statistics(letters)
    content = _read(path)
    network = S3Net(channel_count(letters), len(taxonomy))
    network.load_state_dict(_fitting(path, _weights_of(path, _unpickle(path, content)), network))
    source = {"file": path.name, "sha256": hashlib.sha256(content).hexdigest()}
    training = {"imported": source}
    return Checkpoint(network.eval(), letters, statistics, lidar, taxonomy, training=training)


def _read(path: Path) -> bytes:
    size = path.stat().st_size
    if path.is_dir() or size == 0:
        found = "a folder" if path.is_dir() else "an empty file"
        raise CorruptFileError(f"{path}: expected weights that torch.save wrote, found {found}")
    if size > _LARGEST:
        raise UnsafeFileError(f"{path}: {size} bytes; an S3-Net never takes above {_LARGEST}")
    content = path.read_bytes()
    unpacked = _unpacked_size(content)
    if unpacked > _LARGEST:
        raise UnsafeFileError(
            f"{path}: unpacks to {unpacked} bytes; an S3-Net never takes above {_LARGEST}"
        )
    return content


def _unpacked_size(content: bytes) -> int:
    """Bytes that torch's reader would take: it inflates what is compressed, of any size."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            return sum(entry.file_size for entry in archive.infolist())
    except (zipfile.BadZipFile, NotImplementedError, ValueError):
        return len(content)  # an older form, or damaged, as its reader will tell


def _unpickle(path: Path, content: bytes) -> Any:
    """Return what torch.save was given, if that is tensors and plain values."""
    try:
        return torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as err:
        # torch's own message goes on to suggest reading the file with its code
        raise UnsafeFileError(
            f"{path}: refused, because it is damaged or holds more than tensors and plain values; "
            "nothing of it was run"
        ) from err
    except Exception as err:  # a damaged pickle raises almost anything
        raise CorruptFileError(
            f"{path}: not a file that torch.save wrote, or truncated; get it again ({err!r:.120})"
        ) from err


def _weights_of(path: Path, held: object) -> dict[str, Tensor]:
    """Return the weights by their names in S3Net."""
    for key in _WEIGHTS:
        weights = held.get(key) if isinstance(held, dict) else None
        if isinstance(weights, dict) and all(_has_values(w) for w in weights.values()):
            # a network that was spread over several GPUs carries a prefix
            return {str(name).removeprefix("module."): w for name, w in weights.items()}
    found = (
        f"the keys {_first([str(key) for key in held])}"
        if isinstance(held, dict)
        else type(held).__name__
    )
    raise CorruptFileError(
        f"{path}: expected a dict with tensors under {' or '.join(_WEIGHTS)}, found {found}"
    )


def _has_values(weight: object) -> bool:
    """Tell whether something is a tensor whose plain numbers are in memory."""
    return (
        isinstance(weight, Tensor)
        and weight.layout == torch.strided
        and weight.device.type == "cpu"
        and not weight.is_quantized
        and not weight.is_complex()
    )


def _fitting(path: Path, weights: dict[str, Tensor], network: S3Net) -> dict[str, Tensor]:
    """Return the weights, all of which the network must take."""
    expected = network.state_dict()
    problems = [f"{name} is missing" for name in expected if name not in weights]
    problems += [f"{name} is unknown" for name in weights if name not in expected]
    problems += [
        f"{name} is {tuple(weights[name].shape)} instead of {tuple(value.shape)}"
        for name, value in expected.items()
        if name in weights and weights[name].shape != value.shape
    ]
    # a tensor of another shape may be one number, said to be repeated beyond all memory
    problems = problems or [
        f"{name} is not finite" for name, w in weights.items() if not w.isfinite().all()
    ]
    if problems:
        raise CorruptFileError(
            f"{path}: not the weights of an S3-Net of {network.channels} channels and "
            f"{network.classes} classes: {_first(problems)}"
        )
    return weights


def _first(words: Sequence[str]) -> str:
    rest = len(words) - _NAMED
    return ", ".join(words[:_NAMED]) + (f" and {rest} more" if rest > 0 else "")
