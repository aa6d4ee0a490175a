"""Model inputs: any subset of ranges, intensities, points and angles of incidence."""

from __future__ import annotations

import functools
import multiprocessing
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.access.buffers import Buffers
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.geometry import beam_directions, incidence_between
from semantic2d_dataset.scene.lidars import LidarSpec
from semantic2d_dataset.scene.scans import check_array

FEATURES = "RIPA"
"""Features by letter as in the paper: ranges, intensities, points (two channels), incidence."""

_SHARED_ROWS = 64
_CHANNELS = {"R": (0,), "I": (1,), "P": (2, 3), "A": (4,)}


_Limits = tuple[np.float32, np.float32]


@dataclass(frozen=True)
class Statistics:
    """Mean and standard deviation of each channel, for standardising.

    Parameters
    ----------
    mean, std
        (C,) numbers in the channels' units; every std is above 0.
    """

    mean: tuple[float, ...]
    std: tuple[float, ...]

    def __post_init__(self) -> None:
        fits = len(self.mean) == len(self.std)
        if not fits or not np.isfinite(self.mean).all() or not (np.array(self.std) > 0).all():
            raise InvalidInputError(
                f"expected one mean and one std above 0 a channel, found {self}"
            )


def normalise_features(which: str) -> str:
    """Put feature letters into the order R, I, P, A.

    >>> normalise_features("a+r")
    'RA'

    Raises
    ------
    InvalidInputError
        If a letter is unknown or repeated, or there is none.
    """
    letters = which.upper().replace("+", "").replace(",", "")
    if not letters or set(letters) - set(FEATURES) or len(set(letters)) != len(letters):
        raise InvalidInputError(
            f"unknown features {which!r}; expected some of R (ranges), I (intensities), "
            "P (points), A (incidence), such as RIA"
        )
    return "".join(letter for letter in FEATURES if letter in letters)


def channel_count(which: str) -> int:
    """Return the number of channels C of some features; points have two."""
    return sum(len(_CHANNELS[letter]) for letter in normalise_features(which))


def features_of(
    ranges: NDArray[np.float32],
    intensities: NDArray[np.float32] | None,
    lidar: LidarSpec,
    which: str = "RIA",
    statistics: Statistics | None = None,
    rows: NDArray[np.int64] | None = None,
    *,
    buffers: Buffers | None = None,
) -> NDArray[np.float32]:
    """Compute model inputs of scans.

    A beam without a return counts as range 0 and intensity 0, as in the published arrays, and
    so has incidence 0; next to one, the equations of the paper give pi/2.

    Parameters
    ----------
    ranges
        (N, B) f4, m.
    intensities
        (N, B) f4, sensor units; needed for I only.
    lidar
        The sensor.
    which
        Feature letters; channels come in the order R, I, P (x, y in the lidar frame), A.
    statistics
        Standardises each channel; raw units where not given.
    rows
        (n,) i8: the scans to compute; all where not given.
    buffers
        Where the result's memory comes from; fresh where not given.

    Returns
    -------
    (n, C, B) f4

    Raises
    ------
    InvalidInputError
        If a shape does not fit, or intensities are asked for and there are none.
    """
    letters = normalise_features(which)
    check_array("ranges", ranges, np.float32, (None, lidar.beams))
    if "I" in letters and intensities is None:
        raise InvalidInputError(
            f"features {letters}: {lidar.name} gives no intensities; leave I out"
        )
    if intensities is not None:
        check_array("intensities", intensities, np.float32, ranges.shape)
    codes = np.array([code for letter in letters for code in _CHANNELS[letter]], np.int64)
    chosen = statistics or Statistics((0.0,) * len(codes), (1.0,) * len(codes))
    if len(chosen.mean) != len(codes):
        raise InvalidInputError(
            f"features {letters} have {len(codes)} channels, the statistics {len(chosen.mean)}"
        )
    picked = np.arange(len(ranges)) if rows is None else np.ascontiguousarray(rows, np.int64)
    if picked.size and not (picked.min() >= 0 and picked.max() < len(ranges)):
        raise InvalidInputError(f"rows must lie in 0..{len(ranges) - 1}")
    out = (buffers or Buffers()).take((len(picked), len(codes), lidar.beams), np.float32)
    step = (np.cos(lidar.angle_increment), np.sin(lidar.angle_increment))
    inputs = (
        np.ascontiguousarray(ranges),
        np.ascontiguousarray(ranges if intensities is None else intensities),
        _directions_of(lidar),
        codes,
        np.array((chosen.mean, 1.0 / np.array(chosen.std)), np.float32),
        _limits_of(lidar),
        (np.float32(step[0]), np.float32(step[1])),
    )
    share_rows(lambda part: _fill(*inputs, picked[part], out[part]), len(picked))
    return out


def targets_of(
    ranges: NDArray[np.float32],
    labels: NDArray[np.uint8],
    lidar: LidarSpec,
    rows: NDArray[np.int64],
    *,
    buffers: Buffers | None = None,
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Gather labels as losses want them, and which beams have a return.

    Parameters
    ----------
    ranges, labels
        (N, B) f4 m, (N, B) u1.
    lidar
        The sensor.
    rows
        (n,) i8: the scans to gather.
    buffers
        Where the results' memory comes from; fresh where not given.

    Returns
    -------
    labels, valid
        (n, B) i8 and (n, B) bool.
    """
    source = buffers or Buffers()
    found = source.take((len(rows), lidar.beams), np.int64)
    valid = source.take((len(rows), lidar.beams), np.bool_)
    limits = _limits_of(lidar)
    share_rows(
        lambda part: _gather(ranges, labels, limits, rows[part], found[part], valid[part]),
        len(rows),
    )
    return found, valid


def share_rows(work: Callable[[slice], None], count: int) -> None:
    """Run work on the rows of a batch, in two threads where they are many.

    A loader's worker has one core. Threads of OpenMP, which `numba.prange` starts, would stall
    each batch while a training uses the cores, and do not survive a fork.
    """
    if count < _SHARED_ROWS or multiprocessing.parent_process():
        work(slice(0, count))
    else:
        halves = (slice(0, count // 2), slice(count // 2, count))
        list(_threads(os.getpid()).map(work, halves))


@functools.cache
def _threads(pid: int) -> ThreadPoolExecutor:  # noqa: ARG001 - a fork gets threads of its own
    return ThreadPoolExecutor(2)


@functools.lru_cache(maxsize=64)
def _directions_of(lidar: LidarSpec) -> NDArray[np.float32]:
    """Return cosines and sines of all beams (2, B); they take as long as a scan's features."""
    return np.ascontiguousarray(beam_directions(lidar.bearings).T, np.float32)


def _limits_of(lidar: LidarSpec) -> _Limits:
    """Range limits for kernels; a range of 0 is no return, whatever the lower one is."""
    least = np.nextafter(np.float32(0.0), np.float32(1.0))
    return max(np.float32(lidar.range_min), least), np.float32(lidar.range_max)


class Moments:
    """Mean and standard deviation of feature channels, over blocks of scans."""

    def __init__(self) -> None:
        self._count = 0
        self._sums: NDArray[np.float64] = np.zeros(1)
        self._squares: NDArray[np.float64] = np.zeros(1)

    def update(self, features: NDArray[np.float32], valid: NDArray[np.bool_]) -> None:
        """Add the valid beams of some scans.

        Parameters
        ----------
        features
            (N, C, B) f4, raw.
        valid
            (N, B) bool.
        """
        kept = np.where(valid[:, None], features, np.float32(0.0)).astype(np.float64)
        self._sums = self._sums + kept.sum(axis=(0, 2))
        self._squares = self._squares + (kept**2).sum(axis=(0, 2))
        self._count += int(valid.sum())

    def compute(self) -> Statistics:
        """Return the statistics; a channel that never varies gets a tiny deviation."""
        mean = self._sums / max(self._count, 1)
        variance = np.maximum(self._squares / max(self._count, 1) - mean**2, 1e-12)
        return Statistics(tuple(mean.tolist()), tuple(np.sqrt(variance).tolist()))


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _gather(
    ranges: NDArray[np.float32],
    labels: NDArray[np.uint8],
    limits: _Limits,
    rows: NDArray[np.int64],
    found: NDArray[np.int64],
    valid: NDArray[np.bool_],
) -> None:
    for n in range(len(rows)):
        r, label = ranges[rows[n]], labels[rows[n]]
        for k in range(len(r)):
            found[n, k] = label[k]
            valid[n, k] = r[k] >= limits[0] and r[k] < limits[1]


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _fill(
    ranges: NDArray[np.float32],
    intensities: NDArray[np.float32],
    directions: NDArray[np.float32],
    codes: NDArray[np.int64],
    scaling: NDArray[np.float32],
    limits: _Limits,
    step: _Limits,
    rows: NDArray[np.int64],
    out: NDArray[np.float32],
) -> None:
    for n in range(len(rows)):
        i = rows[n]
        _fill_scan(ranges[i], intensities[i], directions, codes, scaling, limits, step, out[n])


@numba.njit(error_model="numpy")
def _fill_scan(
    ranges: NDArray[np.float32],
    intensities: NDArray[np.float32],
    directions: NDArray[np.float32],
    codes: NDArray[np.int64],
    scaling: NDArray[np.float32],
    limits: _Limits,
    step: _Limits,
    out: NDArray[np.float32],
) -> None:
    """Compute and standardise every channel of one scan."""
    r = _ranges_or_zero(ranges, limits[0], limits[1])
    for c in range(len(codes)):
        channel, code = out[c], codes[c]
        if code == 0:
            channel[:] = r[:-1]
        elif code == 1:
            _copy_known(intensities, r, channel)
        elif code == 4:
            _incidence(r, step[0], step[1], channel)
        else:
            _scale(r, directions[code - 2], channel)
        _standardise(channel, scaling[0, c], scaling[1, c])


# One simple loop each, so that the compiler vectorises it.


@numba.njit(error_model="numpy")
def _ranges_or_zero(
    ranges: NDArray[np.float32], range_min: np.float32, range_max: np.float32
) -> NDArray[np.float32]:
    """Ranges with 0 for no return, and one more behind the last: its neighbour on the surface."""
    r = np.empty(len(ranges) + 1, np.float32)
    for k in range(len(ranges)):
        value = ranges[k]
        r[k] = value if value >= range_min and value < range_max else np.float32(0.0)
    r[len(ranges)] = r[len(ranges) - 2]
    return r


@numba.njit(error_model="numpy")
def _copy_known(
    values: NDArray[np.float32], r: NDArray[np.float32], out: NDArray[np.float32]
) -> None:
    for k in range(len(out)):
        known = r[k] > np.float32(0.0) and abs(values[k]) < np.float32(np.inf)
        out[k] = values[k] if known else np.float32(0.0)


@numba.njit(error_model="numpy")
def _incidence(
    r: NDArray[np.float32], cos_step: np.float32, sin_step: np.float32, out: NDArray[np.float32]
) -> None:
    for k in range(len(out)):
        alpha = incidence_between(r[k], r[k + 1], cos_step, sin_step)
        out[k] = alpha if r[k] > np.float32(0.0) else np.float32(0.0)


@numba.njit(error_model="numpy")
def _scale(r: NDArray[np.float32], factor: NDArray[np.float32], out: NDArray[np.float32]) -> None:
    for k in range(len(out)):
        out[k] = r[k] * factor[k]


@numba.njit(error_model="numpy")
def _standardise(channel: NDArray[np.float32], mean: np.float32, inverse_std: np.float32) -> None:
    for k in range(len(channel)):
        channel[k] = (channel[k] - mean) * inverse_std
