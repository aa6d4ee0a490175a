"""What an annotation of a map holds, and what its author seems to have forgotten or misplaced."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from salsa.annotation import Annotation, label_cells
from salsa.shapes import Shape
from semantic2d_dataset.scene.maps import FREE, OCCUPIED, UNKNOWN, SemanticMap
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, UNLABELLED, Taxonomy

_LARGEST = 10  # clusters that a report lists
_OUTSIDE_PIXELS = 1.0  # a point on the border is not outside
_TOUCHING = np.ones((3, 3), np.bool_)


@dataclass(frozen=True)
class Cluster:
    """Occupied cells without a class that touch each other.

    Parameters
    ----------
    cells
        How many they are.
    column, row
        One of them near their middle: pixel of the map's image, row 0 at the top.
    x_m, y_m
        The same cell in the map frame.
    size_m
        Longer edge of the box around them, m.
    """

    cells: int
    column: int
    row: int
    x_m: float
    y_m: float
    size_m: float


@dataclass(frozen=True)
class ShapeCheck:
    """One shape against its map.

    Parameters
    ----------
    number
        Its place in labelme's list, from 1.
    name
        Its class.
    pixels
        Pixels of the image that it covers.
    occupied
        Those of them that are occupied.
    kept
        Those that have its class once all shapes are drawn.
    outside_px
        How far it reaches beyond the image, pixels; 0 if it does not.
    """

    number: int
    name: str
    pixels: int
    occupied: int
    kept: int
    outside_px: float


@dataclass(frozen=True)
class Overlap:
    """Occupied cells that lie in shapes of two classes; the one drawn later has them."""

    earlier: str
    later: str
    cells: int


@dataclass(frozen=True)
class MapReport:
    """What an annotated map holds.

    Parameters
    ----------
    width, height
        Of the map's image, pixels.
    resolution_m
        Edge of a cell.
    occupied, free, unknown
        Cells of the map as it was read.
    classes
        Occupied cells by class name, for all classes; Person has none.
    unlabelled
        Occupied cells without a class.
    clusters
        The largest groups of those, and
    cluster_count
        how many groups there are.
    people, people_occupied
        Cells annotated as Person, which count as free, and those that the map has as occupied.
    not_occupied_share
        Share of the labelled pixels that is not occupied: how generous the shapes are.
    shapes
        Every shape; none for a label image.
    overlaps
        Pairs of classes that share occupied cells.
    warnings
        What should be looked at, in words.
    """

    width: int
    height: int
    resolution_m: float
    occupied: int
    free: int
    unknown: int
    classes: dict[str, int]
    unlabelled: int
    clusters: tuple[Cluster, ...]
    cluster_count: int
    people: int
    people_occupied: int
    not_occupied_share: float
    shapes: tuple[ShapeCheck, ...]
    overlaps: tuple[Overlap, ...]
    warnings: tuple[str, ...]


def check_map(
    scene: SemanticMap, annotation: Annotation, taxonomy: Taxonomy = SEMANTIC2D
) -> MapReport:
    """Compare an annotation with its map.

    Parameters
    ----------
    scene
        The map as `semantic2d_dataset.scene.maps.read_map` reads it.
    annotation
        As `salsa.annotation.read_annotation` reads it.
    taxonomy
        Names of the classes.
    """
    labelled = label_cells(scene, annotation.regions, taxonomy)
    occupied = scene.occupancy == OCCUPIED
    person = taxonomy.id_of("Person")
    people = annotation.regions == person
    forgotten = (labelled.occupancy == OCCUPIED) & (labelled.labels == UNLABELLED)
    clusters, cluster_count = _clusters(scene, forgotten)
    counts = np.bincount(labelled.labels[labelled.labels != UNLABELLED], minlength=len(taxonomy))
    said = annotation.regions != UNLABELLED
    known = {
        "occupied": int(occupied.sum()),
        "free": int((scene.occupancy == FREE).sum()),
        "unknown": int((scene.occupancy == UNKNOWN).sum()),
        "unlabelled": int(forgotten.sum()),
        "people": int(people.sum()),
        "people_occupied": int((people & occupied).sum()),
    }
    shapes = _check_shapes(annotation, occupied, taxonomy)
    return MapReport(
        width=scene.occupancy.shape[1],
        height=scene.occupancy.shape[0],
        resolution_m=scene.resolution,
        classes=dict(zip(taxonomy.names, counts.tolist(), strict=True)),
        clusters=clusters,
        cluster_count=cluster_count,
        not_occupied_share=float((said & ~occupied).sum() / max(said.sum(), 1)),
        shapes=shapes,
        overlaps=_overlaps(annotation.shapes, occupied[::-1], taxonomy),
        warnings=(*_map_warnings(**known), *_shape_warnings(shapes, taxonomy.names[person])),
        **known,
    )


def _clusters(scene: SemanticMap, cells: NDArray[np.bool_]) -> tuple[tuple[Cluster, ...], int]:
    """Return the largest groups of touching cells, and how many groups there are."""
    groups, count = ndimage.label(cells, _TOUCHING)
    sizes = np.bincount(groups.ravel(), minlength=count + 1)[1:]
    boxes = ndimage.find_objects(groups)
    largest = np.argsort(-sizes, kind="stable")[:_LARGEST]
    return tuple(_cluster(scene, groups, boxes[i], i + 1) for i in largest.tolist()), int(count)


def _cluster(
    scene: SemanticMap, groups: NDArray[np.integer], box: tuple[slice, slice], number: int
) -> Cluster:
    members = np.argwhere(groups[box] == number)  # row, column
    members += [edge.start for edge in box]
    middle = members.mean(axis=0)
    row, column = members[np.square(members - middle).sum(axis=1).argmin()].tolist()
    x, y = scene.centres_of((row, column)).tolist()
    return Cluster(
        cells=len(members),
        column=column,
        row=scene.occupancy.shape[0] - 1 - row,
        x_m=round(x, 3),
        y_m=round(y, 3),
        size_m=round(float(np.ptp(members, axis=0).max() + 1) * scene.resolution, 3),
    )


def _check_shapes(
    annotation: Annotation, occupied: NDArray[np.bool_], taxonomy: Taxonomy
) -> tuple[ShapeCheck, ...]:
    regions, occupied = annotation.regions[::-1], occupied[::-1]  # as the image, row 0 on top
    return tuple(
        ShapeCheck(
            number=shape.number,
            name=taxonomy.names[shape.label],
            pixels=int(shape.mask.sum()),
            occupied=int((on := shape.mask & occupied[shape.place]).sum()),
            kept=int((on & (regions[shape.place] == shape.label)).sum()),
            outside_px=_outside(shape, regions.shape),
        )
        for shape in annotation.shapes
    )


def _outside(shape: Shape, size: tuple[int, ...]) -> float:
    x1, y1, x2, y2 = shape.bounds
    beyond = max(-x1, -y1, x2 - size[1], y2 - size[0])
    return round(beyond, 1) if beyond > _OUTSIDE_PIXELS else 0.0


def _overlaps(
    shapes: Sequence[Shape], occupied: NDArray[np.bool_], taxonomy: Taxonomy
) -> tuple[Overlap, ...]:
    """Paint shape over shape and count what each takes from other classes."""
    painted = np.full(occupied.shape, UNLABELLED, np.uint8)
    taken = np.zeros((len(taxonomy), 256), np.int64)  # later, earlier
    for shape in shapes:
        below = painted[shape.place]
        taken[shape.label] += np.bincount(below[shape.mask & occupied[shape.place]], minlength=256)
        below[shape.mask] = shape.label
    taken = taken[:, : len(taxonomy)]
    np.fill_diagonal(taken, 0)
    return tuple(
        Overlap(taxonomy.names[earlier], taxonomy.names[later], int(taken[later, earlier]))
        for later, earlier in np.argwhere(taken).tolist()
    )


def _map_warnings(
    *, occupied: int, free: int, unknown: int, unlabelled: int, people: int, people_occupied: int
) -> Iterator[str]:
    if occupied > free:
        yield (
            f"more cells are occupied ({occupied:,}) than free ({free:,}): "
            f"are `negate` and the thresholds in the map's YAML file right?"
        )
    if not unknown:
        yield (
            "no cell is unknown, so points outside the walls become Person; where the map's image "
            "is grey (205) for unknown, set free_thresh to 0.196 in its YAML file"
        )
    if unlabelled:
        share = 100 * unlabelled / max(occupied - people_occupied, 1)
        yield (
            f"{unlabelled:,} occupied cells ({share:.1f} %) have no class: points on them become "
            f"Other"
        )
    if people:
        yield (
            f"{people:,} cells are called Person, {people_occupied:,} of them occupied: they count "
            f"as free, since a person who stood there during mapping is no object"
        )


def _shape_warnings(shapes: Sequence[ShapeCheck], person: str) -> Iterator[str]:
    for shape in shapes:
        where = f"shape {shape.number} ({shape.name})"
        if shape.outside_px and not shape.pixels:
            yield f"{where} lies outside the image"
            continue
        if shape.outside_px:
            yield f"{where} reaches {shape.outside_px:.0f} pixels beyond the image"
        if not shape.occupied:
            if shape.name != person:
                yield f"{where} covers no occupied cell"
        elif not shape.kept:
            yield (
                f"{where} is hidden by later shapes: move it below them in labelme's list, or "
                f"draw it again"
            )
