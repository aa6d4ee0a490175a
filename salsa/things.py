"""Unmapped things that stay: told from people by how long they stay and by their shape.

Free space of the map may hold more than people: boxes that were put down, chairs that were moved.
What is hit whenever the lidar looks there is a thing, unless it has the two legs of somebody who
stands. A thing of the size of a mapped object that is gone, and near to where that was, is that
object; any other is of no class.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from salsa.evidence import Ledger, coarse
from salsa.fields import MapField
from salsa.legs import Outline, find_standing, principal_axis
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, UNLABELLED, Taxonomy

Float = NDArray[np.float64]
Labels = NDArray[np.uint8]
Cells = tuple[NDArray[np.int64], NDArray[np.int64]]

_ALL_AROUND = np.ones((3, 3), np.bool_)
_SIZE_M = 0.08  # difference in size between an object and the cells it was mapped as
_SIZE_SHARES = (0.45, 1.35)  # of the mapped size: a thing may be seen from one side only
_GONE_LOOKS = 3
_HELD_SHARE = 0.15  # of the looks met by a group: things have 0.2 and more, crowds 0.08 and less
_STILL_SHARE = 0.3  # of the looks: a mapped cell that is hit as often is still there


@dataclass(frozen=True)
class Persistence:
    """When something in free space is a thing and not a person.

    Parameters
    ----------
    min_seconds
        The lidar saw it in at least this many seconds.
    min_share
        In at least this share of the seconds in which the lidar looked there.
    moved_m
        How far a mapped object may have been moved to be found again, m; half its size more, since
        it may be seen in part.
    movable
        Names of the classes whose objects may have been moved.
    """

    min_seconds: int = 5
    min_share: float = 0.5
    moved_m: float = 1.0
    movable: tuple[str, ...] = ("Chair", "Table", "Sofa", "Trash bin")

    def __post_init__(self) -> None:
        if not (self.min_seconds >= 1 and 0 < self.min_share <= 1 and 0 <= self.moved_m < math.inf):
            raise InvalidInputError(
                "persistence: expected min_seconds from 1 on, min_share in (0, 1] and moved_m from "
                f"0 on, found {self}"
            )


@dataclass(frozen=True)
class Things:
    """What stays in free space.

    Parameters
    ----------
    cells, labels
        (K,) i8 flat indices of map cells, and (K,) u1 class of what stays there.
    things, moved, standing
        How many things there are, how many of them are mapped objects found again, and how many
        outlines were left to be people who stand.
    """

    cells: NDArray[np.int64]
    labels: Labels
    things: int
    moved: int
    standing: int

    def layer(self, shape: tuple[int, ...]) -> Labels:
        """Return the class of every cell (H, W) that holds a thing, 255 elsewhere."""
        layer = np.full(shape, UNLABELLED, np.uint8)
        layer.flat[self.cells] = self.labels
        return layer


DEFAULT_PERSISTENCE = Persistence()
"""The limits used unless others are given."""

NO_THINGS = Things(np.zeros(0, np.int64), np.zeros(0, np.uint8), 0, 0, 0)


def find_things(
    ledger: Ledger, field: MapField, object_m: float, persistence: Persistence, taxonomy: Taxonomy
) -> Things:
    """Find what stays in free space, farther than `object_m` from what is mapped."""
    ratio, _ = coarse(field)
    stays = _staying(ledger, field, object_m, persistence)
    numbers, count = _held_groups(ledger, stays)
    outlines = _outlines(ledger, numbers, count, ratio * field.resolution)
    standing = find_standing(outlines)
    gone = _gone_objects(ledger, field, persistence, taxonomy)
    labels = np.full(count + 1, UNLABELLED, np.uint8)  # by number; 0 is the rest
    for number in np.flatnonzero(~standing):
        labels[number + 1] = _find_again(outlines[number], gone, persistence, taxonomy)
    cells = _beside(numbers, labels)
    fine = np.repeat(np.repeat(cells, ratio, axis=0), ratio, axis=1)
    fine = fine[: field.free.shape[0], : field.free.shape[1]]
    at = np.flatnonzero(fine != UNLABELLED)
    moved = int((labels[1:][~standing] != taxonomy.background_id).sum())
    return Things(at, fine.flat[at], int((~standing).sum()), moved, int(standing.sum()))


def _staying(
    ledger: Ledger, field: MapField, object_m: float, persistence: Persistence
) -> NDArray[np.bool_]:
    """Tell which coarse cells hold something in free space that stays."""
    looked = np.maximum(ledger.met + ledger.passed, 1)
    stays = (ledger.met * ledger.look_s >= persistence.min_seconds) & (
        ledger.met >= persistence.min_share * looked
    )
    rows, columns = np.nonzero(stays)
    cells = _middles(ledger, rows, columns) * coarse(field)[0]  # of the map, x y
    column, row = np.minimum(cells.astype(np.int64), np.array(field.free.shape)[::-1] - 1).T
    stays[rows, columns] = field.free[row, column] & (field.distance_m[row, column] > object_m)
    return np.asarray(stays)


def _held_groups(ledger: Ledger, stays: NDArray[np.bool_]) -> tuple[NDArray[np.int32], int]:
    """Give a number to each group of cells that something held from begin to end of looks.

    Where many people walk, cells are met in many looks, by one foot after the other; each is gone
    before a look is over.
    """
    numbers, count = _number(stays)
    index = np.arange(1, count + 1)
    met, held = (ndimage.sum_labels(each, numbers, index) for each in (ledger.met, ledger.held))
    gone = np.concatenate(((False,), held < _HELD_SHARE * met))
    return _number(stays & ~gone[numbers])


def _number(cells: NDArray[np.bool_]) -> tuple[NDArray[np.int32], int]:
    """Give each group of connected cells (H, W) a number from 1 on; also say how many there are."""
    numbers, count = ndimage.label(cells, _ALL_AROUND)
    return numbers.astype(np.int32), int(count)


def _middles(ledger: Ledger, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> Float:
    """Return where the beams ended on average, (K, 2) x y in coarse cells."""
    mean = ledger.offsets[rows, columns] / ledger.hits[rows, columns, None]
    return np.stack((columns, rows), axis=-1) + 0.5 + mean


def _outlines(
    ledger: Ledger, numbers: NDArray[np.int32], count: int, edge_m: float
) -> list[Outline]:
    return [
        Outline(_middles(ledger, *cells) * edge_m, ledger.hits[cells].astype(np.float64))
        for cells in _groups(numbers, count)
    ]


def _groups(numbers: NDArray[np.int32], count: int) -> list[Cells]:
    """Return rows and columns of the cells of each number from 1 to `count`."""
    rows, columns = np.nonzero(numbers)
    of = numbers[rows, columns]
    order = np.argsort(of, kind="stable")
    borders = np.searchsorted(of[order], np.arange(2, count + 1))
    return [(rows[part], columns[part]) for part in np.split(order, borders) if len(part)]


@dataclass(frozen=True)
class _Gone:
    """Mapped objects that are no longer there: middles (K, 2) m, sizes (K,) m, labels (K,)."""

    middles: Float
    sizes: Float
    labels: Labels


def _gone_objects(
    ledger: Ledger, field: MapField, persistence: Persistence, taxonomy: Taxonomy
) -> _Gone:
    """Find the mapped objects that the lidar looked through."""
    ratio, shape = coarse(field)
    held = ndimage.maximum_filter(ledger.met, size=3)  # walls and poses are not exact
    gone = (ledger.passed >= _GONE_LOOKS) & (held < _STILL_SHARE * ledger.passed)
    middles, sizes, labels = [], [], []
    for label in movable_ids(persistence, taxonomy):
        mapped = _coarse_any((field.distance_m == 0) & (field.nearest_label == label), ratio, shape)
        numbers, count = _number(gone & mapped)
        for rows, columns in _groups(numbers, count):
            cells = np.stack((columns, rows), axis=-1).astype(np.float64) + 0.5
            cells *= ratio * field.resolution
            middles.append(cells.mean(axis=0))
            sizes.append(_span(Outline(cells, np.ones(len(cells)))))
            labels.append(label)
    return _Gone(np.array(middles).reshape(-1, 2), np.array(sizes), np.array(labels, np.uint8))


def movable_ids(persistence: Persistence, taxonomy: Taxonomy) -> list[int]:
    """Return the ids of the movable classes; published ones that the taxonomy lacks are left out.

    Raises
    ------
    InvalidInputError
        If a name is neither in the taxonomy nor a published one.
    """
    found = []
    for name in persistence.movable:
        try:
            found.append(taxonomy.id_of(name))
        except InvalidInputError as err:
            with suppress(InvalidInputError):
                SEMANTIC2D.id_of(name)
                continue
            raise InvalidInputError(f"persistence: movable: {err}") from err
    return found


def _coarse_any(cells: NDArray[np.bool_], ratio: int, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Tell which coarse cells hold any of the cells (H, W)."""
    found = np.zeros(shape, np.bool_)
    found[tuple(index // ratio for index in np.nonzero(cells))] = True
    return found


def _find_again(outline: Outline, gone: _Gone, persistence: Persistence, taxonomy: Taxonomy) -> int:
    """Return the class of the nearest object that is gone and of this size, else no class."""
    size = _span(outline)
    away = np.hypot(*(gone.middles - outline.weights @ outline.points / outline.weights.sum()).T)
    smallest = np.minimum(_SIZE_SHARES[0] * gone.sizes, gone.sizes - _SIZE_M)
    largest = np.maximum(_SIZE_SHARES[1] * gone.sizes, gone.sizes + _SIZE_M)
    fits = (smallest <= size) & (size <= largest) & (away <= persistence.moved_m + gone.sizes / 2)
    if not fits.any():
        return taxonomy.background_id
    return int(gone.labels[np.argmin(np.where(fits, away, np.inf))])


def _span(outline: Outline) -> float:
    return float(np.ptp(principal_axis(outline)))


def _beside(numbers: NDArray[np.int32], labels: Labels) -> Labels:
    """Give each thing's class to its cells and those around: the edges of things are hit less."""
    cells = labels[numbers]
    things = cells != UNLABELLED
    around = ndimage.binary_dilation(things, _ALL_AROUND) & (numbers == 0)
    nearest = ndimage.distance_transform_edt(~things, return_distances=False, return_indices=True)
    return np.where(around, cells[tuple(nearest)], cells).astype(np.uint8)
