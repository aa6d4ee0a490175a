"""Label transfer: from aligned scans and an annotated map to a class per point (paper, step 3).

A point on a mapped object takes its class, a point in free space is a person (nothing else moved
in the recordings) unless it belongs to a thing that stays there, and everything else is Other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from salsa.fields import MapField, as_field, has_labels
from salsa.residuals import beams_of
from semantic2d_dataset.errors import AlignmentError, InvalidInputError
from semantic2d_dataset.scene.geometry import compose, invert
from semantic2d_dataset.scene.maps import SemanticMap
from semantic2d_dataset.scene.scans import ScanBatch
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, UNLABELLED, Taxonomy

Float = NDArray[np.float64]
Labels = NDArray[np.uint8]


@dataclass(frozen=True)
class Transfer:
    """How labels pass from the map to the points.

    Parameters
    ----------
    object_m
        A point this near to an occupied cell's centre belongs to that object, m.
    sure_m
        Distance beyond which a doubt about a label is over, m: of a person from the nearest
        object, and of a point on an object from the next object of another class.
    ignore_no_return
        Leave beams without a return unlabelled (255) instead of calling them Other.
    """

    object_m: float = 0.15
    sure_m: float = 0.3
    ignore_no_return: bool = False

    def __post_init__(self) -> None:
        if not all(0 < value <= 5 for value in (self.object_m, self.sure_m)):
            raise InvalidInputError(f"transfer distances must lie in (0, 5] m, found {self}")


DEFAULT_TRANSFER = Transfer()
"""The distances used unless others are given."""


def transfer_labels(
    batch: ScanBatch,
    poses: Float,
    scene: SemanticMap | MapField,
    accepted: NDArray[np.bool_],
    *,
    quality: NDArray[np.floating] | None = None,
    things: Labels | None = None,
    transfer: Transfer = DEFAULT_TRANSFER,
    taxonomy: Taxonomy = SEMANTIC2D,
) -> tuple[Labels, Labels]:
    """Label every beam of every accepted scan.

    Parameters
    ----------
    batch
        N scans.
    poses
        (N, 3) f8 x y yaw of the base in the map, as aligned.
    scene
        The annotated map, or its `MapField` where many batches share one map.
    accepted
        (N,) bool: scans to label; all beams of the others stay 255.
    quality
        (N,) share 0..1 of each scan that fits the map; 1 unless given.
    things
        (H, W) u1 class of what stays in free cells of the map, 255 elsewhere
        (`salsa.things.Things.layer`).
    transfer
        Distances.
    taxonomy
        Classes of the map.

    Returns
    -------
    labels, confidence
        (N, B) u1 class ids and (N, B) u1. Confidence is 255 times the product of the scan's
        quality, of how near the point is to its object (1 on it, 1/2 at `object_m`; for Person
        1/2 at `object_m` and 1 from `sure_m` beyond it on; 1/2 for things that stay), and of how
        far the next object of another class is (1/2 on the border, 1 from `sure_m` on; mapped
        classes only). Other is as sure as the scan; beams without a return and scans not accepted
        have 0.

    Raises
    ------
    AlignmentError
        If no cell of the map carries a class.
    """
    field = as_field(scene)
    if not has_labels(field):
        raise AlignmentError("no occupied cell of the map carries a class; annotate the map first")
    labels = np.full(batch.ranges.shape, UNLABELLED, np.uint8)
    confidence = np.zeros_like(labels)
    no_return = UNLABELLED if transfer.ignore_no_return else taxonomy.background_id
    _transfer(
        *beams_of(batch, batch.valid),
        compose(invert(field.origin.as_array()), poses),
        accepted & np.isfinite(poses).all(axis=-1),
        np.ones(len(batch)) if quality is None else np.asarray(quality, np.float64),
        field.distance_m,
        field.border_m,
        field.nearest_label,
        field.free,
        np.full(field.free.shape, UNLABELLED, np.uint8) if things is None else things,
        field.resolution,
        np.array((transfer.object_m, transfer.sure_m)),
        np.array((no_return, taxonomy.background_id, taxonomy.id_of("Person")), np.uint8),
        labels,
        confidence,
    )
    return labels, confidence


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _transfer(
    ranges: NDArray[np.float32],
    valid: NDArray[np.bool_],
    directions: Float,
    offset: Float,
    poses: Float,
    accepted: NDArray[np.bool_],
    quality: Float,
    distance_m: NDArray[np.float32],
    border_m: NDArray[np.float32],
    nearest_label: Labels,
    free: NDArray[np.bool_],
    things: Labels,
    resolution: float,
    limits: Float,
    special: Labels,
    labels: Labels,
    confidence: Labels,
) -> None:
    object_m, sure_m = limits
    per_object, per_sure = 0.5 / object_m, 1.0 / sure_m
    no_return, other, person = special
    rows, columns = free.shape
    for n in numba.prange(ranges.shape[0]):
        if not accepted[n]:
            continue
        labels[n] = no_return
        best = 255.0 * min(max(quality[n], 0.0), 1.0)
        cos, sin = np.cos(poses[n, 2]) / resolution, np.sin(poses[n, 2]) / resolution
        x0, y0 = poses[n, 0] / resolution, poses[n, 1] / resolution
        for k in range(ranges.shape[1]):
            if not valid[n, k]:
                continue
            r = np.float64(ranges[n, k])
            bx, by = offset[0] + r * directions[k, 0], offset[1] + r * directions[k, 1]
            x, y = x0 + cos * bx - sin * by, y0 + sin * bx + cos * by
            labels[n, k] = other
            sure = 1.0
            if x >= 0.0 and y >= 0.0 and x < columns and y < rows:
                row, column = int(y), int(x)
                away = distance_m[row, column]
                if away <= object_m:
                    if nearest_label[row, column] != UNLABELLED:
                        labels[n, k] = nearest_label[row, column]
                        border = min(1.0, border_m[row, column] * per_sure)
                        sure = (1.0 - away * per_object) * (0.5 + 0.5 * border)
                elif things[row, column] != UNLABELLED:
                    labels[n, k] = things[row, column]
                    sure = 0.5
                elif free[row, column]:
                    labels[n, k] = person
                    sure = 0.5 + 0.5 * min(1.0, (away - object_m) * per_sure)
            confidence[n, k] = np.uint8(best * sure)
