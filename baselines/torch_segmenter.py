"""Label scans by a trained model as training left it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from baselines.checkpoints import load_checkpoint
from baselines.inference import infer
from baselines.sampled_labels import SampledLabels, check_draw, summarise
from semantic2d_dataset.access.features import features_of
from semantic2d_dataset.scene.taxonomy import UNLABELLED


class TorchSegmenter:
    """What `baselines.segmenter.Segmenter` is for an exported model.

    Parameters
    ----------
    run
        Folder that training left.
    samples, seed
        As for `Segmenter`; latents are drawn for each scan on its own.
    device
        Where to run it.

    Raises
    ------
    DatasetNotFoundError, CorruptFileError, FormatVersionError
        As `load_checkpoint` does.
    InvalidInputError
        If there is no sample, or the seed is out of range.
    """

    def __init__(
        self, run: Path, *, samples: int = 1, seed: int = 0, device: str | torch.device = "cpu"
    ) -> None:
        check_draw(samples, seed)
        self.samples, self.seed, self.device = samples, seed, device
        checkpoint = load_checkpoint(run, device=device)
        self.network, self.description = checkpoint.network, checkpoint.description

    def sample(
        self, ranges: NDArray[np.float32], intensities: NDArray[np.float32] | None = None
    ) -> SampledLabels:
        """Label scans (N, B) f4 m, with their intensities (N, B) f4 where the model needs them.

        Raises
        ------
        InvalidInputError
            If a shape does not fit the model, or intensities are missing.
        """
        about = self.description
        given = features_of(ranges, intensities, about.lidar, about.features, about.statistics)
        features = torch.from_numpy(given).to(self.device)
        if self.samples == 1:
            with torch.inference_mode():
                found = summarise(self.network.expected_logits(features)[None].numpy(force=True))
        else:
            found = infer(self.network, features, samples=self.samples, seed=self.seed)
        has_return = about.lidar.has_return(ranges)
        return replace(found, labels=np.where(has_return, found.labels, np.uint8(UNLABELLED)))
