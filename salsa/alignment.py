"""Scan alignment: from rough poses to poses whose scans lie on the map (paper, SALSA, step 2).

In place of point-to-point ICP, the distances of the points to the mapped objects are minimised
directly: Gauss-Newton on a bilinearly interpolated distance field, with Geman-McClure weights
whose scale shrinks, so that people and other unmapped things lose their say. Where a scan still
does not fit, its neighbourhood is searched; and since the rough poses of a recording drift slowly,
a scan that fits its map helps the scans before and after it.
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from salsa import registration
from salsa.features import points_near_lines
from salsa.fields import MapField, as_field
from salsa.residuals import Beams, beams_of
from semantic2d_dataset.errors import AlignmentError, InvalidInputError
from semantic2d_dataset.scene.geometry import compose, invert, rotation_matrix, to_points
from semantic2d_dataset.scene.lines import FAST, extract_lines
from semantic2d_dataset.scene.maps import SemanticMap
from semantic2d_dataset.scene.scans import ScanBatch

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Alignment:
    """Where N scans were taken, and how sure that is.

    Parameters
    ----------
    poses
        (N, 3) f8 x y yaw of the base in the map; NaN where the rough pose was unknown.
    residual_m
        (N,) f4: root mean square distance to the map of the points that count as inliers.
    inlier_ratio
        (N,) f4: share of the points with a return that are inliers.
    accepted
        (N,) bool: the pose can be trusted with labels.
    covariance
        (N, 3, 3) f8 of x, y (m) and yaw (rad) in the map frame, from the normal equations;
        NaN where the pose is.
    """

    poses: Float
    residual_m: NDArray[np.float32]
    inlier_ratio: NDArray[np.float32]
    accepted: NDArray[np.bool_]
    covariance: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.poses)


@dataclass(frozen=True)
class Acceptance:
    """When an alignment is trusted.

    Parameters
    ----------
    inlier_m
        A point this near to a mapped object is an inlier, m.
    min_inlier_ratio
        Least share of inliers among the points with a return. (A search finds poses with 50 to
        60 % in maps of other places; among 34 people in a lobby 1 % of the scans have less.)
    max_residual_m
        Largest root mean square distance of the inliers, m.
    min_points_ratio
        Least share of the lidar's beams that have a return.
    max_correction_m
        Largest distance between the rough pose and the refined one, m. (In the map of another
        place, chains of scans end up where they happen to fit, many metres away.)
    """

    inlier_m: float = 0.1
    min_inlier_ratio: float = 0.6
    max_residual_m: float = 0.06
    min_points_ratio: float = 0.05
    max_correction_m: float = 2.0

    def __post_init__(self) -> None:
        *limits, correction_m = astuple(self)
        if not (all(0 < value <= 1 for value in limits) and 0 < correction_m < math.inf):
            raise InvalidInputError(
                f"acceptance limits must lie in (0, 1], max_correction_m above 0; found {self}"
            )


TRUSTED = Acceptance()
"""The limits used unless others are given."""


def align(
    batch: ScanBatch,
    scene: SemanticMap | MapField,
    *,
    points: Literal["all", "lines"] = "all",
    acceptance: Acceptance = TRUSTED,
    before: Float | None = None,
) -> Alignment:
    """Refine the pose of every scan so that its points lie on the map.

    Parameters
    ----------
    batch
        N scans in the order of time, with rough poses; NaN poses stay unknown.
    scene
        The map, or its `MapField` where many batches are aligned with one map.
    points
        Take all points (robust weights disarm people), or those near extracted lines only.
    acceptance
        When an alignment is trusted.
    before
        Refined and rough pose (2, 3) of an accepted scan just before the batch: so that blocks of
        a long recording follow each other as its scans do.

    Returns
    -------
    Alignment

    Raises
    ------
    AlignmentError
        If the map has no occupied cell.
    """
    field = as_field(scene)
    use = batch.valid if points == "all" else _near_lines(batch)
    grid = field.origin.as_array()
    starts = compose(invert(grid), batch.poses)  # NaN stays NaN
    poses = _register(beams_of(batch, use), starts, _in_grid(before, grid), field)
    return judge(batch, compose(grid, poses), field, acceptance=acceptance)


def judge(
    batch: ScanBatch,
    poses: Float,
    scene: SemanticMap | MapField,
    *,
    acceptance: Acceptance = TRUSTED,
) -> Alignment:
    """Measure how scans fit at refined poses (N, 3); none far from its rough one is accepted."""
    field = as_field(scene)
    found = measure(batch, poses, field, acceptance=acceptance)
    near = corrections(batch.poses, poses) <= acceptance.max_correction_m
    inside = _inside(compose(invert(field.origin.as_array()), poses), field)
    return replace(found, accepted=found.accepted & near & inside)


def measure(
    batch: ScanBatch,
    poses: Float,
    scene: SemanticMap | MapField,
    *,
    acceptance: Acceptance = TRUSTED,
) -> Alignment:
    """Say how well scans fit a map at given poses (N, 3), which stay as they are."""
    field = as_field(scene)
    grid = field.origin.as_array()
    residual_m, inlier_ratio = np.full(len(batch), np.inf, np.float32), np.zeros(len(batch), "f4")
    covariance = np.full((len(batch), 3, 3), np.nan)
    registration.measure_each(
        *beams_of(batch, batch.valid),
        compose(invert(grid), poses),
        field.surface,
        field.resolution,
        acceptance.inlier_m,
        residual_m,
        inlier_ratio,
        covariance,
    )
    accepted = (
        (inlier_ratio >= acceptance.min_inlier_ratio)
        & (residual_m <= acceptance.max_residual_m)
        & (batch.valid.mean(axis=-1) >= acceptance.min_points_ratio)
    )
    turn = rotation_matrix(0.0, 0.0, grid[2])
    covariance = turn @ covariance @ turn.T
    return Alignment(poses, residual_m, inlier_ratio, accepted, covariance)


def fit(
    batch: ScanBatch, poses: Float, field: MapField, inlier_m: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return residual_m and inlier_ratio, each (N,) f4, as in `Alignment`, at poses (N, 3)."""
    residual_m, inlier_ratio = np.full(len(batch), np.inf, np.float32), np.zeros(len(batch), "f4")
    registration.fit_each(
        *beams_of(batch, batch.valid),
        compose(invert(field.origin.as_array()), poses),
        field.surface,
        field.resolution,
        inlier_m,
        residual_m,
        inlier_ratio,
    )
    return residual_m, inlier_ratio


def corrections(rough: Float, refined: Float) -> Float:
    """Return how far poses (N, 3) moved, (N,) in m; NaN where they are unknown."""
    return np.asarray(np.hypot(*(refined - rough)[:, :2].T))


def check_inside(poses: Float, field: MapField) -> None:
    """Refuse poses (N, 3) that all say that the robot was elsewhere; NaN poses say nothing.

    Raises
    ------
    AlignmentError
        If every pose that is known lies outside the map.
    """
    known = poses[np.isfinite(poses).all(axis=-1)]
    if len(known) and not _inside(compose(invert(field.origin.as_array()), known), field).any():
        width, height = _size(field)
        raise AlignmentError(
            f"all {len(known)} poses lie outside the map, which spans {width:.1f} x "
            f"{height:.1f} m from x {field.origin.x:.1f}, y {field.origin.y:.1f}; the first is "
            f"at x {known[0, 0]:.1f}, y {known[0, 1]:.1f}: is it the map of this recording?"
        )


def _inside(in_grid: Float, field: MapField) -> NDArray[np.bool_]:
    """Tell which poses (N, 3) in the frame of the grid lie on it."""
    place = in_grid[:, :2]
    return np.asarray(((place >= 0) & (place < _size(field))).all(axis=-1))


def _size(field: MapField) -> Float:
    rows, columns = field.distance_m.shape
    return np.array((columns, rows)) * field.resolution


def _register(beams: Beams, starts: Float, before: Float, field: MapField) -> Float:
    """Align each scan by itself, then let neighbours help, forward and backward in time."""
    grid = field.surface, field.resolution
    poses, costs = starts.copy(), np.full(len(starts), np.inf)
    registration.register_each(*beams, starts, *grid, poses, costs)
    order = np.arange(len(starts))
    registration.chain(*beams, starts, order, before, *grid, poses, costs)
    none = np.full((2, 3), np.nan)
    registration.chain(*beams, starts, order[::-1].copy(), none, *grid, poses, costs)
    return poses


def _in_grid(before: Float | None, grid: Float) -> Float:
    """Return pose and start (2, 3) in the frame of the grid, NaN where there is none."""
    if before is None:
        return np.full((2, 3), np.nan)
    return compose(invert(grid), before)


def _near_lines(batch: ScanBatch) -> NDArray[np.bool_]:
    lidar = batch.lidar
    segments, offsets = extract_lines(
        batch.ranges, lidar.bearings, FAST, range_min=lidar.range_min, range_max=lidar.range_max
    )
    points = to_points(batch.ranges, lidar.bearings)
    return batch.valid & points_near_lines(points, segments, offsets)
