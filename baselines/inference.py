"""Stochastic inference: encode a scan once, decode many latents, and vote."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from baselines.checkpoints import Checkpoint
from baselines.networks import Latent, SegmentationNetwork
from baselines.s3net import S3Net
from baselines.sampled_labels import SampledLabels, check_draw
from baselines.steps import keep_freed_memory
from semantic2d_dataset.access.torch_batches import Batch
from semantic2d_dataset.access.torch_datasets import LidarDataset
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scoring.submission import PredictionsWriter

SAMPLES = 32
"""Latents drawn for each scan (paper, section on the results of S3-Net)."""

_DECODED_AT_ONCE = 32  # latents whose hidden layers fit a CPU's cache
_ENCODED_AT_ONCE = 32
_WRITTEN_AT_ONCE = 256

_Sampled = tuple[Tensor, Tensor, Tensor, Tensor]


def infer(
    network: SegmentationNetwork, features: Tensor, *, samples: int = SAMPLES, seed: int = 0
) -> SampledLabels:
    """Label scans by the majority of decoded samples of the latent.

    Parameters
    ----------
    network
        In evaluation mode.
    features
        (N, C, B) f4, standardised.
    samples
        Latents drawn for each scan, S; a network without a latent gives one sample, S = 1.
    seed
        Of the latents.

    Raises
    ------
    InvalidInputError
        If there is no sample to draw, the seed is out of range, or the features have another shape.
    """
    check_draw(samples, seed)
    with torch.inference_mode():
        if isinstance(network, S3Net):
            chosen, votes, probabilities, own = _sample(network, features, samples, seed)
        else:
            chosen, votes, probabilities, own = _label_once(network, features)
        entropy = _entropy(probabilities, 2)
        information = (entropy - own).clamp_(min=0.0)  # it is, but for rounding
    return SampledLabels(
        votes.argmax(2).to(torch.uint8).numpy(force=True),
        probabilities.numpy(force=True),
        entropy.numpy(force=True),
        information.numpy(force=True),
        chosen.numpy(force=True),
    )


def _label_once(network: SegmentationNetwork, features: Tensor) -> _Sampled:
    """Return as `_sample` what a network without a latent gives: one sample of each scan."""
    logits = [network.expected_logits(part) for part in torch.split(features, _ENCODED_AT_ONCE)]
    probabilities = torch.cat(logits).softmax(1).transpose(1, 2)
    labels = probabilities.argmax(2).to(torch.uint8)
    return labels[None], probabilities, probabilities, _entropy(probabilities, 2)


def _sample(network: S3Net, features: Tensor, samples: int, seed: int) -> _Sampled:
    """Return what S samples give.

    Returns
    -------
    labels (S, N, B) u1 of every sample, votes (N, B, K) i4, mean probabilities (N, B, K) f4, mean
    entropies of the samples (N, B) f4
    """
    noise = torch.Generator().manual_seed(seed)
    laws = [network.encode(part) for part in torch.split(features, _ENCODED_AT_ONCE)]
    law = Latent(*(torch.cat(parts) for parts in zip(*laws, strict=True)))
    latents = _draw(law, samples, noise)  # (N, S, 1, L)
    per_scan = [_decode_scan(network, drawn, features.shape[-1]) for drawn in latents]
    chosen, votes, probabilities, own = (torch.stack(p) for p in zip(*per_scan, strict=True))
    return chosen.transpose(0, 1), votes, probabilities, own


def infer_scans(
    checkpoint: Checkpoint, dataset: LidarDataset, *, samples: int = SAMPLES, seed: int = 0
) -> Iterator[tuple[Batch, SampledLabels]]:
    """Label every scan of a data set's split, one batch after the other.

    Parameters
    ----------
    checkpoint, dataset, samples, seed
        As for `predict`.

    Yields
    ------
    batch
        As the loader of the data set gives it.
    found
        What the samples say of its scans.

    Raises
    ------
    InvalidInputError
        If the data set does not fit the model, there is no sample to draw, or the seed is out of
        range.
    """
    check_draw(samples, seed)
    _check_dataset(checkpoint, dataset)
    keep_freed_memory()
    device = next(checkpoint.network.parameters()).device
    for i, batch in enumerate(dataset.loader(_WRITTEN_AT_ONCE)):
        own_seed = int(np.random.SeedSequence((seed, i)).generate_state(1)[0])
        features = batch["features"].to(device)
        yield batch, infer(checkpoint.network, features, samples=samples, seed=own_seed)


def predict(
    checkpoint: Checkpoint,
    dataset: LidarDataset,
    path: Path,
    *,
    samples: int = SAMPLES,
    seed: int = 0,
    method: str | None = None,
    with_probabilities: bool = False,
    with_samples: bool = False,
) -> int:
    """Label every scan of a data set's split, and write a predictions file.

    Parameters
    ----------
    checkpoint
        A trained model.
    dataset
        Scans of its lidar with its features, standardised by its statistics.
    path
        The file to make.
    samples, seed
        As for `infer`.
    method
        What the file calls the method; the network's title where not given.
    with_probabilities
        Write class probabilities too (20 bytes a beam).
    with_samples
        Write the label of every sample too (S bytes a beam, which stay in memory until the end).

    Returns
    -------
    int
        Number of scans labelled.

    Raises
    ------
    InvalidInputError
        If the data set does not fit the model, there is no sample to draw, or the seed is out of
        range.
    WriteError
        If the file cannot be written.
    """
    check_draw(samples, seed)
    _check_dataset(checkpoint, dataset)
    source = dataset.source
    with (
        PredictionsWriter(
            path,
            dataset=source.data.manifest.name,
            dataset_version=source.data.manifest.version,
            scheme=source.scheme,
            split=source.split or "all",
            taxonomy=checkpoint.taxonomy,
            metadata=_metadata(checkpoint, method or checkpoint.network.title, seed),
        ) as writer,
        tqdm(total=len(dataset), desc="predicting", unit="scan", disable=None) as bar,
    ):
        for batch, found in infer_scans(checkpoint, dataset, samples=samples, seed=seed):
            _write(
                writer,
                batch["scan_id"],
                found,
                with_probabilities=with_probabilities,
                with_samples=with_samples,
            )
            bar.update(len(found.labels))
    return len(dataset)


def _write(
    writer: PredictionsWriter,
    scan_ids: Sequence[str],
    found: SampledLabels,
    *,
    with_probabilities: bool,
    with_samples: bool,
) -> None:
    """Write a batch, one call for each run of scans of a sequence."""
    start = 0
    parts = (scan_id.rpartition("/") for scan_id in scan_ids)
    for sequence_id, run in groupby(parts, key=lambda part: part[0]):
        scan_index = np.array([int(index) for _, _, index in run], np.int64)
        rows = slice(start, start + len(scan_index))
        probabilities = found.probabilities[rows].astype(np.float16) if with_probabilities else None
        samples = found.samples[:, rows] if with_samples else None
        writer.add(sequence_id, scan_index, found.labels[rows], probabilities, samples)
        start = rows.stop


def _metadata(checkpoint: Checkpoint, method: str, seed: int) -> dict[str, Any]:
    trained_on = " ".join(str(value) for value in checkpoint.dataset.values())
    said = {
        "method": method,
        "features": checkpoint.features,
        "training_data": trained_on or "unknown",
        "parameters": sum(p.numel() for p in checkpoint.network.parameters()),
    }
    if "seed" in checkpoint.training:
        said["seeds"] = [checkpoint.training["seed"]]
    if isinstance(checkpoint.network, S3Net):
        said["sampling_seed"] = seed
    return said


def _check_dataset(checkpoint: Checkpoint, dataset: LidarDataset) -> None:
    name = dataset.source.data.manifest.name
    if dataset.lidar != checkpoint.lidar:
        raise InvalidInputError(
            f"{name}: the model was trained on {checkpoint.lidar.name} "
            f"({checkpoint.lidar.beams} beams), and these scans are of {dataset.lidar.name} "
            f"({dataset.lidar.beams} beams); choose scans of the same lidar"
        )
    if dataset.taxonomy.digest != checkpoint.taxonomy.digest:
        raise InvalidInputError(f"{name}: the model was trained on other classes")
    if dataset.features != checkpoint.features or dataset.statistics != checkpoint.statistics:
        raise InvalidInputError(
            f"{name}: load it with features={checkpoint.features!r} and the model's statistics"
        )


def _draw(law: Latent, samples: int, noise: torch.Generator) -> Tensor:
    """Draw latents (N, S, 1, L); on the CPU, so that every device gets the same."""
    n, _, positions = law.mean.shape
    drawn = torch.randn((n, samples, 1, positions), generator=noise).to(law.mean.device)
    return law.mean[:, None] + law.log_sd.exp()[:, None] * drawn


def _entropy(probabilities: Tensor, dim: int) -> Tensor:
    """Entropy along a dimension, nats."""
    entropy: Tensor = torch.special.entr(probabilities).sum(dim)
    return entropy


def _decode_scan(network: S3Net, latents: Tensor, beams: int) -> _Sampled:
    """Decode latents (S, 1, L) of one scan.

    Returns
    -------
    labels (S, B) u1 of every sample, votes (B, K) i4, mean probabilities (B, K) f4, mean
    entropy of the samples (B,) f4
    """
    parts = torch.split(latents, _DECODED_AT_ONCE)
    logits = torch.cat([network.decode(part, beams) for part in parts])
    labels = logits.max(1).indices  # (S, B); argmax takes 5 times longer
    votes = torch.zeros((network.classes, beams), dtype=torch.int32, device=labels.device)
    votes.scatter_add_(0, labels, torch.ones_like(labels, dtype=torch.int32))
    logs = logits.log_softmax(1)  # (S, K, B); with their exponentials faster than entr
    probabilities = logs.exp()
    own = logs.mul_(probabilities).sum((0, 1)) / -len(logs)
    return labels.to(torch.uint8), votes.t(), probabilities.mean(0).t(), own
