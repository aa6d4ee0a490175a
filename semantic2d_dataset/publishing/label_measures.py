"""How labels of a sequence look: what can be counted of labels that may be wrong."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.schema import CHUNK_ROWS
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.scene.geometry import to_base, to_points, transform
from semantic2d_dataset.scene.lidars import LidarSpec
from semantic2d_dataset.scene.maps import SemanticMap
from semantic2d_dataset.scene.scans import ScanBatch
from semantic2d_dataset.scene.taxonomy import UNLABELLED, Taxonomy

SAME_RANGE_M = 0.03
"""Ranges of one beam, or of neighbours, that differ by less are taken to be of one surface."""
ON_OBJECT_M = 0.1
FAR_FROM_OBJECTS_M = 0.5

_BLOCK = 4 * CHUNK_ROWS

Bools = NDArray[np.bool_]
Labels = NDArray[np.uint8]


@dataclass
class LabelMeasures:
    """Counts over a sequence; shares of them are what is judged.

    Parameters
    ----------
    scans, beams, returns
        Scans, beams, and beams with a return.
    labelled
        Of these, how many have a label.
    phantom
        Beams without a return that have a class other than background.
    plain_scans
        Scans with labels that are all of one class.
    labelled_scans
        Scans with any label.
    steady, flickering
        Labelled beams whose range is that of the scan before, and how many changed their class.
    inner, islands
        Labelled beams between two neighbours of one class at their range, and how many have
        another class than both.
    on_object, against_map
        Labelled beams on a mapped object, and how many have another class than it.
    of_object, nowhere
        Beams labelled as a class that the map has, and how many are far from all its objects.
    counts
        (256,) i8: labelled beams with a return by class id.
    """

    scans: int = 0
    beams: int = 0
    returns: int = 0
    labelled: int = 0
    phantom: int = 0
    plain_scans: int = 0
    labelled_scans: int = 0
    steady: int = 0
    flickering: int = 0
    inner: int = 0
    islands: int = 0
    on_object: int = 0
    against_map: int = 0
    of_object: int = 0
    nowhere: int = 0
    counts: NDArray[np.int64] | None = None

    def __add__(self, other: Self) -> Self:
        names = [each.name for each in fields(self) if each.name != "counts"]
        total = {name: getattr(self, name) + getattr(other, name) for name in names}
        parts = [each.counts for each in (self, other) if each.counts is not None]
        return type(self)(**total, counts=np.sum(parts, axis=0) if parts else None)


def measure_labels(reader: SequenceReader) -> LabelMeasures:
    """Count over a labelled sequence, a block of scans at a time.

    Raises
    ------
    CorruptFileError
        If a checksum does not fit.
    """
    taxonomy, total = reader.header.taxonomy, LabelMeasures()
    scene = _Objects.of(reader.read_map(), taxonomy)
    for block, is_accepted, fresh in _blocks(reader):
        total = total + _count(block, taxonomy, fresh)
        if scene is not None:
            total = total + scene.compare(block, is_accepted, fresh)
    return total


def _blocks(reader: SequenceReader) -> Iterator[tuple[ScanBatch, Bools, int]]:
    """Yield scans with the one before them, which scans were accepted, and where new ones start."""
    for start in range(0, len(reader), _BLOCK):
        first = max(0, start - 1)
        block = reader.batch(first, start + _BLOCK)
        is_accepted = np.asarray(np.isfinite(block.poses).all(axis=1))
        if "alignment/accepted" in reader:
            is_accepted = is_accepted & (
                reader.read("alignment/accepted", first, start + _BLOCK) != 0
            )
        yield block, is_accepted, start - first


def _count(block: ScanBatch, taxonomy: Taxonomy, fresh: int) -> LabelMeasures:
    if block.labels is None:
        raise InvalidInputError("expected labelled scans, found none")
    labels, valid = block.labels, block.valid
    is_labelled = valid & (labels != UNLABELLED)
    steady, flickering = _flicker(block.ranges, labels, is_labelled)
    inner, islands = _islands(block.ranges[fresh:], labels[fresh:], is_labelled[fresh:])
    has_class = (labels != UNLABELLED) & (labels != taxonomy.background_id)
    classes = _classes_of_scans(labels[fresh:], is_labelled[fresh:])
    return LabelMeasures(
        scans=len(labels) - fresh,
        beams=labels[fresh:].size,
        returns=int(valid[fresh:].sum()),
        labelled=int(is_labelled[fresh:].sum()),
        phantom=int((has_class & ~valid)[fresh:].sum()),
        plain_scans=int((classes == 1).sum()),
        labelled_scans=int((classes > 0).sum()),
        steady=steady,
        flickering=flickering,
        inner=inner,
        islands=islands,
        counts=np.bincount(labels[fresh:][is_labelled[fresh:]], minlength=256),
    )


def _flicker(ranges: NDArray[np.float32], labels: Labels, is_labelled: Bools) -> tuple[int, int]:
    steady = is_labelled[1:] & is_labelled[:-1] & _is_near(ranges[1:], ranges[:-1])
    return int(steady.sum()), int((steady & (labels[1:] != labels[:-1])).sum())


def _islands(ranges: NDArray[np.float32], labels: Labels, is_labelled: Bools) -> tuple[int, int]:
    left, here, right = labels[:, :-2], labels[:, 1:-1], labels[:, 2:]
    r, known = ranges, is_labelled
    inner = known[:, :-2] & known[:, 1:-1] & known[:, 2:] & (left == right)
    inner &= _is_near(r[:, :-2], r[:, 1:-1]) & _is_near(r[:, 1:-1], r[:, 2:])
    return int(inner.sum()), int((inner & (here != left)).sum())


def _is_near(one: NDArray[np.float32], other: NDArray[np.float32]) -> Bools:
    with np.errstate(invalid="ignore"):  # inf - inf
        is_near: Bools = np.abs(one - other) < SAME_RANGE_M
    return is_near


def _classes_of_scans(labels: Labels, is_labelled: Bools) -> NDArray[np.int64]:
    """Count the classes of each scan, (n,) i8."""
    scans, beams = np.nonzero(is_labelled)
    keys = scans * 256 + labels[scans, beams]
    seen = np.bincount(keys, minlength=len(labels) * 256).reshape(len(labels), 256) > 0
    classes: NDArray[np.int64] = seen.sum(axis=1)
    return classes


@dataclass(frozen=True)
class _Objects:
    """The objects of a map: how far each cell is from one, and which class it has."""

    scene: SemanticMap
    distance_m: NDArray[np.float32]
    nearest: Labels
    moving: tuple[int, ...]

    @classmethod
    def of(cls, scene: SemanticMap | None, taxonomy: Taxonomy) -> _Objects | None:
        if scene is None:
            return None
        names = [name.lower() for name in taxonomy.names]
        people = names.index("person") if "person" in names else UNLABELLED
        moving = (taxonomy.background_id, people, UNLABELLED)
        mapped = ~np.isin(scene.labels, moving)
        if not mapped.any():
            return None
        cells, where = ndimage.distance_transform_edt(~mapped, return_indices=True)
        distance = (cells * scene.resolution).astype(np.float32)
        return cls(scene, distance, scene.labels[where[0], where[1]], moving)

    def compare(self, block: ScanBatch, is_accepted: Bools, fresh: int) -> LabelMeasures:
        rows = np.flatnonzero(is_accepted[fresh:]) + fresh
        labels = block.labels
        if labels is None or not rows.size:
            return LabelMeasures()
        known = block.valid[rows] & (labels[rows] != UNLABELLED)
        cells = self.scene.cells_of(_points(block, rows, block.lidar)[known])
        inside = ((cells >= 0) & (cells < self.distance_m.shape)).all(axis=1)
        row, column = cells[inside].T
        said = labels[rows][known][inside]
        away = self.distance_m[row, column]
        on_object = away <= ON_OBJECT_M
        of_object = ~np.isin(said, self.moving)
        return LabelMeasures(
            on_object=int(on_object.sum()),
            against_map=int((on_object & (said != self.nearest[row, column])).sum()),
            of_object=int(of_object.sum()),
            nowhere=int((of_object & (away > FAR_FROM_OBJECTS_M)).sum()),
        )


def _points(block: ScanBatch, rows: NDArray[np.int64], lidar: LidarSpec) -> NDArray[np.float64]:
    """Return the ends of all beams in the map, (n, B, 2) m."""
    points = to_base(to_points(block.ranges[rows], lidar.bearings), lidar.base_T_lidar)
    return transform(block.poses[rows], points)
