"""How many beams of each class a scan has, and how much a scan of rare classes counts."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.lidars import LidarSpec


def count_classes(
    ranges: NDArray[np.float32], labels: NDArray[np.uint8], lidar: LidarSpec, classes: int
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Count the labelled beams with a return of each scan by class id, and all with a return.

    Parameters
    ----------
    ranges, labels
        (N, B) f4 m, (N, B) u1.
    lidar
        The sensor.
    classes
        Number of classes K; labels from there on are not counted.

    Returns
    -------
    counts, returns
        (N, K) and (N,) i4.
    """
    counts = np.zeros((len(ranges), classes), np.int32)
    returns = np.zeros(len(ranges), np.int32)
    limits = np.float32(lidar.range_min), np.float32(lidar.range_max)
    _count(ranges, labels, limits, counts, returns)
    return counts, returns


def balancing_weights(counts: NDArray[np.integer], power: float) -> NDArray[np.float64]:
    """Return how often scans are to be drawn so that rare classes are seen more often.

    A beam counts by the inverse of its class's share of all beams, raised to a power, and a scan
    by the mean over its beams. The square root is that of repeat factor sampling (Gupta, Dollár
    and Girshick, LVIS, CVPR 2019, section on baselines), whose shares are those of images with
    a class; most scans hold most classes, so that beams are counted here.

    Parameters
    ----------
    counts
        (N, K) labelled beams of each scan by class.
    power
        0 draws every scan alike, 0.5 by the square root, 1 by the full inverse.

    Returns
    -------
    (N,) f8, whose mean is 1; 0 for a scan without labelled beams.

    Raises
    ------
    InvalidInputError
        If the power is not in 0 to 1, or no beam is labelled.
    """
    if not 0 <= power <= 1:
        raise InvalidInputError(f"balance: expected a power of 0 to 1, found {power}")
    total = counts.sum(axis=0, dtype=np.int64)
    if not total.any():
        raise InvalidInputError("balance: no beam of these scans is labelled; leave it out")
    rarity = (total.sum() / np.maximum(total, 1)) ** power
    weights = counts @ rarity / np.maximum(counts.sum(axis=1), 1)
    balanced: NDArray[np.float64] = weights / weights.mean()
    return balanced


@numba.njit(cache=True, nogil=True)
def _count(
    ranges: NDArray[np.float32],
    labels: NDArray[np.uint8],
    limits: tuple[np.float32, np.float32],
    counts: NDArray[np.int32],
    returns: NDArray[np.int32],
) -> None:
    for n in range(len(ranges)):
        for k in range(ranges.shape[1]):
            r, label = ranges[n, k], labels[n, k]
            if r > 0 and r >= limits[0] and r < limits[1]:
                returns[n] += 1
                if label < counts.shape[1]:
                    counts[n, label] += 1
