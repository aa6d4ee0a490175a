"""What a labelled sequence is like, scan by scan: the figures that a review shows."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from tqdm import tqdm

from salsa.alignment import TRUSTED, corrections, fit
from salsa.dropping import dropped_before
from salsa.fields import map_field
from salsa.pictures import Colours, Sheet, points_in_grid
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.schema import CHUNK_ROWS
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.scene.maps import OCCUPIED, SemanticMap
from semantic2d_dataset.scene.scans import ScanBatch
from semantic2d_dataset.scene.taxonomy import UNLABELLED

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

BLOCK_SCANS = 8 * CHUNK_ROWS
"""Scans in memory at a time."""

_NEEDED = (
    "scans/labels",
    "scans/confidence",
    "poses/refined",
    "alignment/residual_m",
    "alignment/inlier_ratio",
    "alignment/accepted",
)
_LARGE_JUMP_M = 0.5  # a scan whose correction differs as much from the one before is suspect


@dataclass(frozen=True)
class Inspection:
    """Figures of N scans, and what their points show of the map.

    Parameters
    ----------
    seconds
        (N,) f8 since the first scan.
    rough, refined
        (N, 3) f8 x y yaw in the map, NaN where unknown.
    accepted, dropped
        (N,) bool: whose labels count, and who was taken out by hand.
    residual_m, inlier_ratio
        (N,) f4 as the alignment left them, NaN where there is no pose.
    near_before
        (N,) f4 share of points near (Acceptance.inlier_m) a mapped object at the rough poses.
    confidence
        (N,) f4 mean over the beams with a return, 0 to 1.
    counts
        (256,) i8 beams with a return, by label.
    canvas
        All labelled points, painted over the map.
    hit
        (H, W) bool: cells of the map that a point of an accepted scan met.
    """

    seconds: Float
    rough: Float
    refined: Float
    accepted: Mask
    dropped: Mask
    residual_m: NDArray[np.float32]
    inlier_ratio: NDArray[np.float32]
    near_before: NDArray[np.float32]
    confidence: NDArray[np.float32]
    counts: NDArray[np.int64]
    canvas: Colours
    hit: Mask

    def __len__(self) -> int:
        return len(self.seconds)

    @cached_property
    def known(self) -> Mask:
        """Which scans have a pose, (N,) bool."""
        return np.asarray(np.isfinite(self.refined).all(axis=-1))

    @cached_property
    def correction_m(self) -> Float:
        """How far alignment moved each scan, (N,) m, NaN where there is no pose."""
        return corrections(self.rough, self.refined)

    @cached_property
    def jump_m(self) -> Float:
        """How much each correction differs from that of the scan before, (N,) m, NaN unknown."""
        steps = np.diff((self.refined - self.rough)[:, :2], axis=0, prepend=np.nan)
        return np.asarray(np.hypot(*steps.T))

    @cached_property
    def badness(self) -> Float:
        """How much each scan asks to be looked at, (N,) from 0 to 5; NaN: there is no need.

        The sum of five parts from 0 to 1: not accepted; share of points that are no inliers;
        residual over Acceptance.inlier_m; jump of the correction over 0.5 m; lack of confidence.
        Scans without a pose have nothing to show, and dropped ones were seen already.
        """
        parts = (
            ~self.accepted,
            1.0 - np.nan_to_num(self.inlier_ratio, nan=0.0),
            np.minimum(np.nan_to_num(self.residual_m, nan=1.0) / TRUSTED.inlier_m, 1.0),
            np.minimum(np.nan_to_num(self.jump_m, nan=0.0) / _LARGE_JUMP_M, 1.0),
            1.0 - self.confidence,
        )
        return np.where(self.known & ~self.dropped, np.sum(parts, axis=0), np.nan)

    def worst(self, count: int) -> NDArray[np.int64]:
        """Return the indices of the scans with the most badness, worst first.

        Of scans that follow each other within a hundredth of the recording only the worst is
        taken, so that one bad stretch does not hide the others.
        """
        left = np.where(np.isfinite(self.badness), self.badness, -1.0)
        near = len(self) // 100
        chosen: list[int] = []
        while len(chosen) < count and left.max() >= 0.0:
            worst = int(left.argmax())
            chosen.append(worst)
            left[max(worst - near, 0) : worst + near + 1] = -1.0
        return np.array(chosen, np.int64)


def check_labelled(reader: SequenceReader) -> SemanticMap:
    """Return the map of a sequence that SALSA labelled.

    Raises
    ------
    InvalidInputError
        If it is not labelled, or holds no scan.
    """
    missing = [name for name in _NEEDED if name not in reader]
    scene = reader.read_map()
    if scene is None or missing:
        raise InvalidInputError(
            f"{reader.path}: has no {', '.join(missing or ['map'])}; label it first"
        )
    if not len(reader):
        raise InvalidInputError(f"{reader.path}: holds no scan")
    return scene


def inspect_sequence(reader: SequenceReader, scene: SemanticMap, sheet: Sheet) -> Inspection:
    """Go through a labelled sequence once, a block of scans at a time.

    Parameters
    ----------
    reader, scene
        The sequence and its map.
    sheet
        Where to paint its points.
    """
    taxonomy = reader.header.taxonomy
    field = map_field(scene, taxonomy)
    refined = reader.read("poses/refined")
    rough = reader.read("poses/initial") if "poses/initial" in reader else refined
    known = np.isfinite(refined).all(axis=-1)
    accepted = known & (reader.read("alignment/accepted") > 0)
    stamps = reader.read("scans/stamps_ns").astype(np.float64)
    canvas, cells = sheet.background(scene), np.zeros(scene.occupancy.shape, np.bool_)
    counts = np.zeros(256, np.int64)
    near, confidence = [], []
    with tqdm(total=len(reader), desc=reader.path.name, unit="scan", disable=None) as bar:
        for start in range(0, len(reader), BLOCK_SCANS):
            rows = slice(start, start + BLOCK_SCANS)
            batch = reader.batch(rows.start, rows.stop)
            before = replace(batch, poses=rough[rows])
            near.append(fit(before, before.poses, field, TRUSTED.inlier_m)[1])
            confidence.append(
                _mean_of_returns(reader.read("scans/confidence", rows.start, rows.stop), batch)
            )
            if batch.labels is not None:
                counts += np.bincount(batch.labels[batch.valid], minlength=256)
            sheet.paint(canvas, batch, scene, taxonomy)
            _mark(cells, batch, scene, accepted[rows])
            bar.update(len(batch))
    return Inspection(
        seconds=(stamps - stamps[0]) / 1e9,
        rough=rough,
        refined=refined,
        accepted=accepted,
        dropped=dropped_before(reader),
        residual_m=_finite(reader.read("alignment/residual_m"), known),
        inlier_ratio=_finite(reader.read("alignment/inlier_ratio"), known),
        near_before=np.concatenate(near),
        confidence=np.concatenate(confidence),
        counts=counts,
        canvas=canvas,
        hit=ndimage.binary_dilation(cells, iterations=_reach(scene)),
    )


def coverage(inspection: Inspection, scene: SemanticMap) -> dict[int, tuple[int, float]]:
    """Return by class how many cells the map has, and the share of them that was ever met."""
    mapped = (scene.occupancy == OCCUPIED) & (scene.labels != UNLABELLED)
    cells = np.bincount(scene.labels[mapped], minlength=256)
    hits = np.bincount(scene.labels[mapped & inspection.hit], minlength=256)
    return {int(i): (int(cells[i]), float(hits[i] / cells[i])) for i in np.flatnonzero(cells)}


def _mean_of_returns(confidence: NDArray[np.uint8], batch: ScanBatch) -> NDArray[np.float32]:
    """Mean over the beams with a return, (N,) f4 from 0 to 1; 0 where there is none."""
    returns = np.maximum(batch.valid.sum(axis=-1), 1)
    total = np.where(batch.valid, confidence, 0).sum(axis=-1, dtype=np.int64)
    return np.asarray(total / (255.0 * returns), np.float32)


def _mark(cells: Mask, batch: ScanBatch, scene: SemanticMap, accepted: Mask) -> None:
    """Mark the cells (H, W) in which points of accepted scans lie."""
    xy = points_in_grid(batch, scene)[batch.valid & accepted[:, None]]
    column, row = np.floor(xy.T / scene.resolution).astype(np.int64)
    inside = (row >= 0) & (row < cells.shape[0]) & (column >= 0) & (column < cells.shape[1])
    cells[row[inside], column[inside]] = True


def _reach(scene: SemanticMap) -> int:
    """How many cells a point may be off from what it met: as far as an inlier."""
    return max(1, round(TRUSTED.inlier_m / scene.resolution))


def _finite(values: NDArray[np.float32], known: Mask) -> NDArray[np.float32]:
    return np.asarray(np.where(known & np.isfinite(values), values, np.float32(np.nan)))
