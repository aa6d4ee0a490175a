"""The annotated map: labelme shapes or a label image over a map_server map (paper, SALSA).

Shapes are drawn generously around objects, so they say where the objects of a class are, not that
every cell in them belongs to it: only occupied cells take a class.
"""

from __future__ import annotations

import io
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

from salsa.shapes import Shape, check_size, paint, read_shapes
from semantic2d_dataset.errors import AlignmentError, InvalidInputError
from semantic2d_dataset.format.writing import write_bytes_atomically
from semantic2d_dataset.scene.maps import FREE, OCCUPIED, SemanticMap, read_map
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, UNLABELLED, Taxonomy

Labels = NDArray[np.uint8]

MARGIN_M = 0.1
"""An occupied cell this near to a labelled one takes its class: shapes often miss an edge."""

_FORMATS = ("PNG", "BMP", "GIF", "PPM")  # those that keep every pixel as it was; PPM includes PGM
_ID_MODES = ("1", "L", "P", "I", "I;16", "I;16B")
_WHITE = (255, 255, 255)


@dataclass(frozen=True)
class Annotation:
    """What somebody said about the image of a map.

    Parameters
    ----------
    regions
        (H, W) u1 class ids, 255 where nothing was said; row 0 is the smallest y.
    shapes
        The labelme shapes that the regions were drawn from; none where they came from an image.
    """

    regions: Labels
    shapes: tuple[Shape, ...]


def annotate_map(map_yaml: Path, annotation: Path, taxonomy: Taxonomy = SEMANTIC2D) -> SemanticMap:
    """Read a map and its annotation.

    Parameters
    ----------
    map_yaml
        A map_server YAML file.
    annotation
        labelme JSON, or an image of the map's size whose pixels are class ids (grey or palette)
        or class colours.
    taxonomy
        Classes that the names or pixels refer to.

    Returns
    -------
    SemanticMap
        Occupied cells carry their class. Cells annotated as Person are free, whatever the map has
        there: a person who stood there during mapping is no object.

    Raises
    ------
    FileNotFoundError
        If a file is missing.
    InvalidInputError
        If a file cannot be understood, a class is unknown, or the sizes differ.
    AlignmentError
        If no cell is occupied, or none takes a class.
    """
    scene = read_map(Path(map_yaml))
    said = read_annotation(Path(annotation), scene.occupancy.shape, taxonomy)
    labelled = label_cells(scene, said.regions, taxonomy)
    check_labelled(labelled, map_yaml, annotation, taxonomy)
    return labelled


def read_annotation(
    path: Path, shape: tuple[int, ...], taxonomy: Taxonomy = SEMANTIC2D
) -> Annotation:
    """Read the annotation of a map image of a shape (height, width).

    Raises
    ------
    FileNotFoundError, InvalidInputError
        As `annotate_map`.
    """
    if path.suffix.lower() == ".json":
        shapes = read_shapes(path, shape, taxonomy)
        regions = paint(shapes, shape)
    else:
        shapes, regions = (), _read_label_image(path, shape, taxonomy)
    return Annotation(np.ascontiguousarray(regions[::-1]), shapes)


def label_cells(
    scene: SemanticMap, regions: Labels, taxonomy: Taxonomy = SEMANTIC2D
) -> SemanticMap:
    """Give the occupied cells of a map the class of the region that they lie in, or just beside.

    All cells of a Person region are free afterwards, whatever the map has there.

    Parameters
    ----------
    scene
        The map.
    regions
        (H, W) u1 class ids, 255 for none; row 0 is the smallest y.
    taxonomy
        Classes that the regions refer to.
    """
    people = regions == taxonomy.id_of("Person")  # exactly those: beside them a wall goes on
    occupied = (scene.occupancy == OCCUPIED) & ~people
    labels = np.where(occupied, regions, UNLABELLED).astype(np.uint8)
    objects = labels != UNLABELLED
    if objects.any():
        distance, indices = ndimage.distance_transform_edt(~objects, return_indices=True)
        beside = occupied & (distance * scene.resolution <= MARGIN_M)
        labels = np.where(beside, labels[tuple(indices)], labels).astype(np.uint8)
    occupancy = np.where(people, FREE, scene.occupancy).astype(np.uint8)
    return replace(scene, occupancy=occupancy, labels=labels)


def check_labelled(
    labelled: SemanticMap, map_yaml: Path, annotation: Path, taxonomy: Taxonomy = SEMANTIC2D
) -> None:
    """Check that a map has objects of some class, which is what label transfer rests on.

    Raises
    ------
    AlignmentError
        If no cell is occupied, or none has a class other than the background.
    """
    if not (labelled.occupancy == OCCUPIED).any():
        raise AlignmentError(
            f"{map_yaml}: no cell is occupied, so there is nothing to label; check the thresholds "
            f"and `negate` in it, and whether {annotation} calls everything a Person"
        )
    if np.isin(labelled.labels, (UNLABELLED, taxonomy.background_id)).all():
        raise AlignmentError(
            f"{annotation}: no occupied cell of {map_yaml} lies in a labelled shape, so there is "
            f"nothing to transfer; is it the annotation of this map?"
        )


def write_label_image(path: Path, regions: Labels, taxonomy: Taxonomy = SEMANTIC2D) -> None:
    """Write regions as a PNG palette image of class ids, which `read_annotation` reads back.

    Pixels that nothing was said about are 255 and transparent, unlike the background class.

    Parameters
    ----------
    path
        The file to write.
    regions
        (H, W) u1 class ids, 255 for none; row 0 is the smallest y.
    taxonomy
        Colours.

    Raises
    ------
    WriteError
        If the folder does not exist.
    """
    palette = taxonomy.palette
    palette[len(taxonomy) :] = _WHITE
    image = Image.fromarray(np.ascontiguousarray(regions[::-1]))
    image.putpalette(palette.tobytes())
    content = io.BytesIO()
    image.save(content, "PNG", transparency=UNLABELLED)
    write_bytes_atomically(path, content.getvalue())


def _read_label_image(path: Path, shape: tuple[int, ...], taxonomy: Taxonomy) -> Labels:
    """Read class ids from a grey or palette image, or class colours from any other.

    The background class means that nobody labelled the pixel, except in images whose id 255 is
    transparent, as `write_label_image` writes them: there 255 means it.
    """
    pixels, by_id, keeps_background = _load_image(path, shape)
    if by_id:
        _check_ids(path, pixels, taxonomy)
    labels = pixels.astype(np.uint8) if by_id else _ids_of_colours(path, pixels, taxonomy)
    if keeps_background:
        return labels
    return np.where(labels == taxonomy.background_id, UNLABELLED, labels).astype(np.uint8)


def _load_image(path: Path, shape: tuple[int, ...]) -> tuple[NDArray[Any], bool, bool]:
    """Pixels, whether they are ids, and whether 255 alone means that nothing was said."""
    if not path.is_file():
        what = "is a folder, not a file" if path.is_dir() else "does not exist"
        raise FileNotFoundError(f"{path}: the annotation {what}")
    try:
        image = Image.open(path, formats=_FORMATS)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as err:
        raise InvalidInputError(
            f"{path}: neither labelme JSON (.json) nor an image ({', '.join(_FORMATS)}): {err}"
        ) from err
    with image:
        check_size(path, (image.height, image.width), shape)
        by_id = image.mode in _ID_MODES
        marked = image.mode == "P" and image.info.get("transparency") == UNLABELLED
        try:
            return np.asarray(image if by_id else image.convert("RGB")), by_id, marked
        except (OSError, SyntaxError, ValueError) as err:
            raise InvalidInputError(f"{path}: not an image that can be read: {err}") from err


def _check_ids(path: Path, pixels: NDArray[Any], taxonomy: Taxonomy) -> None:
    found = np.unique(pixels)
    unknown = found[((found < 0) | (found >= len(taxonomy))) & (found != UNLABELLED)]
    if len(unknown):
        shown = ", ".join(map(str, unknown[:10].tolist())) + (", ..." if len(unknown) > 10 else "")
        raise InvalidInputError(
            f"{path}: expected class ids 0 to {len(taxonomy) - 1}, or {UNLABELLED} for none, "
            f"found {shown}; save class ids or class colours, not shades"
        )


def _ids_of_colours(path: Path, pixels: Labels, taxonomy: Taxonomy) -> Labels:
    labels = np.full(pixels.shape[:2], UNLABELLED, np.uint8)
    known = (pixels == _WHITE).all(axis=-1)  # white paper
    for label, colour in enumerate(taxonomy.colours):
        same = (pixels == colour).all(axis=-1)
        labels[same], known = label, known | same
    if not known.all():
        row, column = np.argwhere(~known)[0]
        raise InvalidInputError(
            f"{path}: colour {tuple(pixels[row, column].tolist())} at column {column}, row {row} "
            f"is no class; known are {dict(zip(taxonomy.names, taxonomy.colours, strict=True))}"
        )
    return labels
