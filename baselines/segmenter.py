"""Label scans by an exported model: numpy in, numpy out, without torch."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from baselines.descriptions import Description
from baselines.onnx_files import open_session, read_sealed, said_of
from baselines.sampled_labels import SampledLabels, check_draw, choose, elect, summarise
from semantic2d_dataset.access.features import features_of
from semantic2d_dataset.errors import CorruptFileError, InvalidInputError
from semantic2d_dataset.scene.taxonomy import UNLABELLED

_DECODED_AT_ONCE = 8  # samples whose hidden layers fit the cache of one core


class Segmenter:
    """A model that labels scans of its lidar.

    A beam without a return, by the limits of the model's lidar, is labelled 255: nothing was
    measured there. A scan gets the same labels alone, in a batch, and again.

    Parameters
    ----------
    path
        A file that ``semantic2d baseline export`` wrote.
    samples
        Latents to draw for each scan, whose majority is its label; with 1, the latent's mean is
        decoded. A model without a latent has one sample.
    threads
        Threads of ONNX Runtime.
    seed
        Of the latents.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    CorruptFileError, FormatVersionError
        If it is damaged or something else, or of a newer major format.
    InvalidInputError
        If there is no sample or no thread, or the seed is out of range.
    ImportError
        If ONNX Runtime is not installed.

    Examples
    --------
    >>> segmenter = Segmenter("model.onnx")  # doctest: +SKIP
    >>> labels = segmenter(scan.ranges, scan.intensities)  # doctest: +SKIP
    """

    def __init__(
        self, path: str | Path, *, samples: int = 1, threads: int = 1, seed: int = 0
    ) -> None:
        check_draw(samples, seed)
        self.path = Path(path)
        self._session = open_session(self.path, read_sealed(self.path), threads)
        self.description = self._describe()
        self._noise = self._draw(samples, seed)
        nothing = np.zeros(self.description.lidar.beams, np.float32)
        self(nothing, nothing)  # compiles and allocates now, not at the first scan

    def __call__(
        self, ranges: ArrayLike, intensities: ArrayLike | None = None
    ) -> NDArray[np.uint8]:
        """Label one scan or several.

        Parameters
        ----------
        ranges
            (B,) or (N, B), m; beams without a return may be inf, nan or 0.
        intensities
            As many, in the units of the lidar; needed if the model has the feature I.

        Returns
        -------
        (B,) or (N, B) u1
            Class ids, 255 for beams without a return.

        Raises
        ------
        InvalidInputError
            If the beams are not those of the model's lidar, or intensities are missing.
        """
        scans = self._as_scans("ranges", ranges)
        classes = len(self.description.taxonomy)
        labels = [
            elect(np.concatenate([choose(part) for part in self._run(one)]), classes)
            for one in self._features(scans, intensities)
        ]
        found = self._mask(scans, np.concatenate(labels) if labels else np.empty(scans.shape, "u1"))
        return found if np.ndim(ranges) == 2 else found[0]

    def sample(self, ranges: ArrayLike, intensities: ArrayLike | None = None) -> SampledLabels:
        """Label one scan (N = 1) or several, and say how sure that is; as calling it otherwise.

        Probabilities, entropy and samples are the model's for beams without a return as well.
        """
        scans = self._as_scans("ranges", ranges)
        each = [
            summarise(np.concatenate(self._run(one))) for one in self._features(scans, intensities)
        ]
        if not each:
            raise InvalidInputError("ranges: expected at least one scan, found none")
        return SampledLabels(
            self._mask(scans, np.concatenate([one.labels for one in each])),
            np.concatenate([one.probabilities for one in each]),
            np.concatenate([one.entropy for one in each]),
            np.concatenate([one.mutual_information for one in each]),
            np.concatenate([one.samples for one in each], axis=1),
        )

    def _describe(self) -> Description:
        said = said_of(self._session, self.path)
        try:
            return Description.from_json(said)
        except (KeyError, TypeError, ValueError, AttributeError) as err:
            raise CorruptFileError(f"{self.path}: not the description of a model: {err!r}") from err

    def _draw(self, samples: int, seed: int) -> list[dict[str, NDArray[np.float32]]]:
        """Return the noise of all scans, in parts that are decoded together."""
        shapes = {one.name: one.shape for one in self._session.get_inputs()}
        if not {"features"} <= set(shapes) <= {"features", "noise"}:
            raise CorruptFileError(
                f"{self.path}: expected the inputs features and noise, found {', '.join(shapes)}"
            )
        if "noise" not in shapes:
            return [{}]
        shape = (samples, *shapes["noise"][1:])
        drawn = np.random.default_rng(seed).standard_normal(shape, np.float32)
        noise = drawn if samples > 1 else np.zeros_like(drawn)
        parts = range(0, samples, _DECODED_AT_ONCE)
        return [{"noise": noise[start : start + _DECODED_AT_ONCE]} for start in parts]

    def _as_scans(self, name: str, values: ArrayLike) -> NDArray[np.float32]:
        """Return (B,) or (N, B) numbers as (N, B) f4."""
        lidar = self.description.lidar
        scans = np.asarray(values, np.float32)
        if scans.ndim not in (1, 2) or scans.shape[-1] != lidar.beams:
            raise InvalidInputError(
                f"{name}: expected ({lidar.beams},) or (N, {lidar.beams}), the beams of "
                f"{lidar.name}, found {scans.shape}"
            )
        return np.atleast_2d(scans)

    def _features(
        self, scans: NDArray[np.float32], intensities: ArrayLike | None
    ) -> NDArray[np.float32]:
        about = self.description
        if "I" not in about.features:
            return features_of(scans, None, about.lidar, about.features, about.statistics)
        if intensities is None:
            raise InvalidInputError(
                f"{self.path}: a model of the features {about.features} needs intensities; give "
                "them, or train one without I"
            )
        strengths = self._as_scans("intensities", intensities)
        return features_of(scans, strengths, about.lidar, about.features, about.statistics)

    def _run(self, features: NDArray[np.float32]) -> list[NDArray[np.float32]]:
        """Return the logits (S, 1, K, B) of features (C, B), in parts of S."""
        feed = {"features": features[None]}
        return [self._session.run(None, feed | noise)[0] for noise in self._noise]

    def _mask(self, scans: NDArray[np.float32], labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return np.where(self.description.lidar.has_return(scans), labels, np.uint8(UNLABELLED))
