"""Confusion by condition: how far, how steep, beside what, and among whom a point was measured.

Every scored beam falls into one band of each condition:

- ``range_m``: its range;
- ``incidence_deg``: its angle of incidence, as the features have it (on the segment to the next
  beam's endpoint); ``unknown`` where the next beam has no return;
- ``border``: whether a scored beam of another true class is within two beams of it;
- ``people``: whether the scan sees a person at all;
- ``motion``: whether what it hit can move by itself. The classes say so of people alone, moving
  or not; no other class can be told to move, so that a chair being pushed counts as static.

The bands of a condition are disjoint, and together they are all scored points.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.lidars import LidarSpec
from semantic2d_dataset.scene.scans import check_array
from semantic2d_dataset.scene.taxonomy import UNLABELLED, Taxonomy
from semantic2d_dataset.scoring.metrics import MEANS, Evaluator

RANGE_EDGES_M = (1.0, 2.0, 4.0, 8.0, 16.0)
INCIDENCE_EDGES_DEG = (30.0, 60.0, 75.0)
BORDER_BEAMS = 2
MOVING_CLASS = "Person"

BANDS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "people": ("none in the scan", "in the scan"),
        "range_m": ("0-1", "1-2", "2-4", "4-8", "8-16", "16+"),
        "incidence_deg": ("0-30", "30-60", "60-75", "75-90", "unknown"),
        "border": ("inside", "border"),
        "motion": ("static", "moving"),
    }
)
"""Labels of the bands by condition, in the order of their counts."""

_COUNTED = ("people", "range_m", "incidence_deg", "border")  # axes of the joint table
_SHAPE = tuple(len(BANDS[name]) for name in _COUNTED)
_NO_CLASS = 256

ByCondition = dict[str, NDArray[np.int64]]
"""By condition, confusion (bands, C, C) i8."""


def count_conditions(
    truth: NDArray[np.uint8],
    prediction: NDArray[np.uint8],
    ranges: NDArray[np.float32],
    lidar: LidarSpec,
    taxonomy: Taxonomy,
) -> ByCondition:
    """Count points by true and predicted class in every band of every condition, in one pass.

    Parameters
    ----------
    truth, prediction
        (N, B) u1 class ids; truth 255 is not scored, nor is a beam without a return.
    ranges
        (N, B) f4, m.
    lidar
        The sensor.
    taxonomy
        The C classes.

    Returns
    -------
    dict
        By condition of `BANDS`, (bands, C, C) i8, rows truth.

    Raises
    ------
    InvalidInputError
        If shapes or dtypes do not fit, or a scored point holds an id that is no class.
    """
    for name, array, dtype in (
        ("ranges", ranges, np.float32),
        ("truth", truth, np.uint8),
        ("prediction", prediction, np.uint8),
    ):
        check_array(name, array, dtype, (len(ranges), lidar.beams))
    classes, moving = len(taxonomy), moving_id(taxonomy)
    joint: NDArray[np.int64] = np.zeros((*_SHAPE, classes, classes), np.int64)
    strange = _count(
        truth,
        prediction,
        ranges,
        _limits_of(lidar),
        (np.float32(np.cos(lidar.angle_increment)), np.float32(np.sin(lidar.angle_increment))),
        np.array(RANGE_EDGES_M, np.float32),
        np.tan(np.deg2rad(np.array(INCIDENCE_EDGES_DEG))).astype(np.float32),
        _NO_CLASS if moving is None else moving,
        joint.reshape(-1, classes, classes),
    )
    if strange:
        raise InvalidInputError(
            f"expected class ids 0 to {classes - 1} at scored points, found others at {strange}"
        )
    found = {
        name: joint.sum(axis=tuple(i for i in range(len(_COUNTED)) if i != axis))
        for axis, name in enumerate(_COUNTED)
    }
    return found | {"motion": _by_motion(found["border"].sum(axis=0), moving)}


def moving_id(taxonomy: Taxonomy) -> int | None:
    """Return the id of the class of what moves, None where the classes have none."""
    try:
        return taxonomy.id_of(MOVING_CLASS)
    except InvalidInputError:
        return None


def figure_of(condition: str) -> str:
    """Return the mean that tells the bands of a condition apart.

    Bands of ``motion`` are chosen by true class: IoU would only count what is taken for classes
    that a band cannot hold.
    """
    return "mCA" if condition == "motion" else "mIoU"


def describe_bands(
    counts: Mapping[str, NDArray[np.int64]],
    taxonomy: Taxonomy,
    bands: Mapping[str, tuple[str, ...]] = BANDS,
) -> dict[str, dict[str, Any]]:
    """Score every band that holds a point, as plain values for JSON.

    Parameters
    ----------
    counts
        Confusion (bands, C, C) by condition.
    taxonomy
        The C classes.
    bands
        Labels of the bands by condition.

    Returns
    -------
    dict
        By condition and band, what `summarise` returns.
    """
    return {
        name: {
            band: summarise(matrix, taxonomy)
            for band, matrix in zip(bands[name], matrices, strict=True)
            if matrix.any()
        }
        for name, matrices in counts.items()
    }


def summarise(confusion: NDArray[np.int64], taxonomy: Taxonomy) -> dict[str, Any]:
    """Return the means of a confusion matrix, its points, and ``iou`` and ``ca`` by class."""
    evaluator = Evaluator(taxonomy)
    evaluator.confusion = confusion
    result = evaluator.compute()
    by_class = {key: {name: result[name][key] for name in taxonomy.names} for key in ("iou", "ca")}
    return {key: result[key] for key in (*MEANS, "points", "classes_averaged")} | by_class


def _by_motion(confusion: NDArray[np.int64], moving: int | None) -> NDArray[np.int64]:
    """Divide a confusion matrix by true class."""
    both = np.stack((confusion, np.zeros_like(confusion)))
    if moving is not None:
        both[1, moving], both[0, moving] = confusion[moving], 0
    return both


def _limits_of(lidar: LidarSpec) -> tuple[np.float32, np.float32]:
    """Limits for the kernel that accept what `LidarSpec.has_return` accepts of f4 ranges."""
    least = np.nextafter(np.float32(0.0), np.float32(1.0))
    return max(np.float32(lidar.range_min), least), np.float32(lidar.range_max)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _count(
    truth: NDArray[np.uint8],
    prediction: NDArray[np.uint8],
    ranges: NDArray[np.float32],
    limits: tuple[np.float32, np.float32],
    step: tuple[np.float32, np.float32],
    range_edges: NDArray[np.float32],
    tangents: NDArray[np.float32],
    moving: int,
    table: NDArray[np.int64],
) -> int:
    """Count into (people * range * incidence * border, C, C); return how many ids are no class."""
    scans, beams = ranges.shape
    classes, strange = table.shape[1], 0
    half = len(table) // 2  # scans with people
    r = np.zeros(beams + 1, np.float32)
    labels = np.full(beams + 2 * BORDER_BEAMS, np.uint8(UNLABELLED))
    inner = labels[BORDER_BEAMS : BORDER_BEAMS + beams]
    bands = np.zeros(beams, np.uint8)
    for n in range(scans):
        people = _scored_labels(truth[n], ranges[n], limits, moving, r, inner)
        _bands_of(r, labels, step, range_edges, tangents, bands)
        start = half if people else 0
        for k in range(beams):
            t = inner[k]
            if t == UNLABELLED:
                continue
            p = prediction[n, k]
            if t >= classes or p >= classes:
                strange += 1
            else:
                table[start + bands[k], t, p] += 1
    return strange


# One simple loop each, so that the compiler vectorises it.


@numba.njit(nogil=True, error_model="numpy")
def _scored_labels(
    truth: NDArray[np.uint8],
    ranges: NDArray[np.float32],
    limits: tuple[np.float32, np.float32],
    moving: int,
    r: NDArray[np.float32],
    labels: NDArray[np.uint8],
) -> bool:
    """Fill in ranges, 0 without return, and labels of scored beams; tell whether one moves.

    Behind the last range stands the one before it: its neighbour on the surface.
    """
    found = 0
    for k in range(len(ranges)):
        there = ranges[k] >= limits[0] and ranges[k] < limits[1]
        r[k] = ranges[k] if there else np.float32(0.0)
        labels[k] = truth[k] if there else np.uint8(UNLABELLED)
        found += labels[k] == moving
    r[len(ranges)] = r[len(ranges) - 2]
    return found > 0


@numba.njit(nogil=True, error_model="numpy")
def _bands_of(
    r: NDArray[np.float32],
    labels: NDArray[np.uint8],
    step: tuple[np.float32, np.float32],
    range_edges: NDArray[np.float32],
    tangents: NDArray[np.float32],
    bands: NDArray[np.uint8],
) -> None:
    """Fill in the joint band of every beam: range, incidence, border.

    The tangent of incidence is |r - q cos| / (q sin), see `geometry.incidence_between`.
    """
    for k in range(len(bands)):
        band = np.uint8(0)
        for edge in range_edges:
            band += r[k] >= edge
        across, along = abs(r[k] - r[k + 1] * step[0]), r[k + 1] * step[1]
        incidence = np.uint8(0)
        for tangent in tangents:
            incidence += across >= tangent * along
        incidence += r[k + 1] <= np.float32(0.0)
        bands[k] = np.uint8(band * np.uint8(len(tangents) + 2) + incidence)
    for k in range(len(bands)):
        own = labels[k + BORDER_BEAMS]
        other = np.uint8(0)
        for offset in range(2 * BORDER_BEAMS + 1):
            near = labels[k + offset]
            other |= np.uint8((near != own) & (near != UNLABELLED))
        bands[k] = np.uint8(bands[k] * np.uint8(2) + other)
