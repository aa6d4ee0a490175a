"""What a scan is compared with: per cell, how far the nearest mapped object is and what it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from semantic2d_dataset.errors import AlignmentError
from semantic2d_dataset.scene.geometry import Pose2
from semantic2d_dataset.scene.maps import FREE, OCCUPIED, SemanticMap
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, UNLABELLED, Taxonomy


@dataclass(frozen=True)
class MapField:
    """A map made ready for alignment and label transfer; row 0 is the smallest y.

    Parameters
    ----------
    distance_m
        (H, W) f4: from the centre of each cell to that of the nearest occupied one.
    surface
        (H, W, 4) f4: the same, interpolated bilinearly between the centres of cell (row, column)
        and its neighbours above and to the right: value at the cell's centre, change to the
        right, change upward, and the change of these; see `salsa.residuals`.
    nearest_label
        (H, W) u1: class of that occupied cell, 255 where it has none.
    border_m
        (H, W) f4: to the nearest cell whose `nearest_label` differs.
    free
        (H, W) bool: cells known to be free.
    resolution
        Edge of a cell, m.
    origin
        Pose in the map frame of the lower left corner of cell (0, 0).
    """

    distance_m: NDArray[np.float32]
    surface: NDArray[np.float32]
    nearest_label: NDArray[np.uint8]
    border_m: NDArray[np.float32]
    free: NDArray[np.bool_]
    resolution: float
    origin: Pose2


def map_field(scene: SemanticMap, taxonomy: Taxonomy = SEMANTIC2D) -> MapField:
    """Measure a map once, for any number of scans.

    Cells labelled Person count as free: a person who stood there during mapping is not an object.

    Raises
    ------
    AlignmentError
        If no cell of the map is occupied.
    """
    person = taxonomy.id_of("Person")
    people = scene.labels == person
    occupied = (scene.occupancy == OCCUPIED) & ~people
    if not occupied.any():
        raise AlignmentError(
            "the map has no occupied cell, so no scan can be aligned with it; check its "
            "thresholds and its `negate` setting"
        )
    distance, indices = ndimage.distance_transform_edt(~occupied, return_indices=True)
    label = scene.labels[tuple(indices)]
    distance_m = (distance * scene.resolution).astype(np.float32)
    return MapField(
        distance_m=distance_m,
        surface=_surface(distance_m),
        nearest_label=label,
        border_m=_border_distance(label) * np.float32(scene.resolution),
        free=(scene.occupancy == FREE) | people,
        resolution=scene.resolution,
        origin=scene.origin,
    )


def as_field(scene: SemanticMap | MapField) -> MapField:
    """Return a field as it is, and measure a map."""
    return scene if isinstance(scene, MapField) else map_field(scene)


def has_labels(field: MapField) -> bool:
    """Tell whether any object of the map carries a class."""
    return bool((field.nearest_label != UNLABELLED).any())


def _surface(distance_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the bilinear surface through the values at the centres of the cells."""
    padded = np.pad(distance_m, ((0, 1), (0, 1)), mode="edge")
    right, up = np.diff(padded[:-1], axis=1), np.diff(padded[:, :-1], axis=0)
    both = np.diff(np.diff(padded, axis=1), axis=0)
    return np.stack((distance_m, right, up, both), axis=-1)


def _border_distance(label: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Cells from each cell to the nearest one beside a different label; 1e6 where there is none."""
    border = np.zeros(label.shape, np.bool_)
    for axis in (0, 1):
        first, second = _neighbours(border.ndim, axis)
        differs = label[first] != label[second]
        border[first] |= differs
        border[second] |= differs
    if not border.any():
        return np.full(label.shape, 1e6, np.float32)
    return ndimage.distance_transform_edt(~border).astype(np.float32)


def _neighbours(ndim: int, axis: int) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    whole = [slice(None)] * ndim
    first, second = list(whole), list(whole)
    first[axis], second[axis] = slice(None, -1), slice(1, None)
    return tuple(first), tuple(second)
