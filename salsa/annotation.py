"""The annotated map: labelme shapes or a label image over a map_server map (paper, SALSA).

Shapes are drawn generously around objects, so they say where the objects of a class are, not that
every cell in them belongs to it: only occupied cells take a class.
"""

from __future__ import annotations

import base64
import io
import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy import ndimage

from semantic2d_dataset.errors import AlignmentError, InvalidInputError
from semantic2d_dataset.scene.maps import FREE, OCCUPIED, SemanticMap, read_map
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, UNLABELLED, Taxonomy

Labels = NDArray[np.uint8]

MARGIN_M = 0.1
"""An occupied cell this near to a labelled one takes its class: shapes often miss an edge."""

_STROKE_PIXELS = 3  # width of drawn lines and points; they mark objects, they have no area
_MAX_DIAGONALS = 10
_FEWEST_POINTS = {
    "polygon": 3,
    "rectangle": 2,
    "circle": 2,
    "line": 2,
    "linestrip": 2,
    "point": 1,
    "points": 1,
    "mask": 1,
}


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
        Occupied cells carry their class. Cells annotated as Person are free: a person who stood
        there during mapping is no object.

    Raises
    ------
    FileNotFoundError
        If a file is missing.
    InvalidInputError
        If a file cannot be understood, a class is unknown, or the sizes differ.
    AlignmentError
        If no occupied cell takes a class.
    """
    scene = read_map(Path(map_yaml))
    regions = read_annotation(Path(annotation), scene.occupancy.shape, taxonomy)
    labelled = label_cells(scene, regions, taxonomy)
    if (labelled.labels == UNLABELLED).all():
        raise AlignmentError(
            f"{annotation}: no occupied cell of {map_yaml} lies in a labelled shape, so there is "
            f"nothing to transfer; is it the annotation of this map?"
        )
    return labelled


def read_annotation(path: Path, shape: tuple[int, ...], taxonomy: Taxonomy = SEMANTIC2D) -> Labels:
    """Return the class of every pixel, (H, W) u1 with row 0 at the smallest y, 255 for none.

    Raises
    ------
    FileNotFoundError, InvalidInputError
        As `annotate_map`.
    """
    if path.suffix.lower() == ".json":
        regions = _rasterise(path, _read_labelme(path), shape, taxonomy)
    else:
        regions = _read_label_image(path, shape, taxonomy)
    return np.ascontiguousarray(regions[::-1])


def label_cells(
    scene: SemanticMap, regions: Labels, taxonomy: Taxonomy = SEMANTIC2D
) -> SemanticMap:
    """Give the occupied cells of a map the class of the region that they lie in, or just beside.

    Parameters
    ----------
    scene
        The map.
    regions
        (H, W) u1 class ids, 255 for none; row 0 is the smallest y.
    taxonomy
        Classes that the regions refer to.
    """
    occupied = scene.occupancy == OCCUPIED
    labels = np.where(occupied, regions, UNLABELLED).astype(np.uint8)
    people = labels == taxonomy.id_of("Person")  # exactly those: beside them a wall goes on
    objects = (labels != UNLABELLED) & ~people
    if objects.any():
        distance, indices = ndimage.distance_transform_edt(~objects, return_indices=True)
        beside = occupied & ~people & (distance * scene.resolution <= MARGIN_M)
        labels = np.where(beside, labels[tuple(indices)], labels)
    occupancy = np.where(people, FREE, scene.occupancy).astype(np.uint8)
    labels = np.where(people, UNLABELLED, labels).astype(np.uint8)
    return replace(scene, occupancy=occupancy, labels=labels)


def _read_labelme(path: Path) -> Mapping[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as err:
        raise InvalidInputError(f"{path}: not a labelme JSON file: {err}") from err
    if not isinstance(content, dict) or not isinstance(content.get("shapes"), list):
        raise InvalidInputError(f"{path}: expected a labelme file with a list of `shapes`")
    return content


def _rasterise(
    path: Path, content: Mapping[str, Any], shape: tuple[int, ...], taxonomy: Taxonomy
) -> Labels:
    """Draw the shapes in their order, the later ones on top, as labelme shows them."""
    size = content.get("imageHeight"), content.get("imageWidth")
    if not all(type(value) is int for value in size):
        raise InvalidInputError(
            f"{path}: expected imageHeight and imageWidth as whole numbers, found {size[0]!r} and "
            f"{size[1]!r}; save it with labelme again"
        )
    _check_size(path, size, shape)
    image = Image.new("L", (shape[1], shape[0]), UNLABELLED)
    for number, item in enumerate(content["shapes"], start=1):
        where = f"{path}: shape {number}"
        try:
            name, kind = item["label"], item.get("shape_type") or "polygon"
            points = [(float(x), float(y)) for x, y in item["points"]]
        except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as err:
            raise InvalidInputError(
                f"{where}: expected a label and points [[x, y], ...] ({err!r})"
            ) from err
        if not isinstance(kind, str) or kind not in _FEWEST_POINTS:
            known = ", ".join(_FEWEST_POINTS)
            raise InvalidInputError(f"{where}: unknown shape type {kind!r}; known are {known}")
        if len(points) < _FEWEST_POINTS[kind] or not np.isfinite(points).all():
            raise InvalidInputError(
                f"{where}: a {kind} needs {_FEWEST_POINTS[kind]} or more finite points, "
                f"found {points}"
            )
        _check_reach(where, kind, points, shape)
        try:
            label = taxonomy.id_of(str(name))
        except InvalidInputError as err:
            raise InvalidInputError(f"{where}: {err}") from err
        _draw(image, where, kind, points, label, item)
    return np.asarray(image)


def _check_reach(
    where: str, kind: str, points: list[tuple[float, float]], shape: tuple[int, ...]
) -> None:
    """Refuse what lies so far beyond the image that drawing it would overflow or take ages."""
    limit = _MAX_DIAGONALS * math.hypot(*shape)
    farthest = max(abs(value) for point in points for value in point)
    if kind == "circle":
        farthest = max(farthest, math.dist(points[0], points[1]))
    if farthest > limit:
        raise InvalidInputError(
            f"{where}: expected coordinates and radii up to {limit:.0f} pixels, {_MAX_DIAGONALS} "
            f"diagonals of the image, found {farthest:g}"
        )


def _draw(
    image: Image.Image,
    where: str,
    kind: str,
    points: list[tuple[float, float]],
    label: int,
    item: Mapping[str, Any],
) -> None:
    canvas = ImageDraw.Draw(image)
    radius = _STROKE_PIXELS / 2
    match kind:
        case "polygon":
            canvas.polygon(points, fill=label, outline=label)
        case "rectangle":
            xs, ys = zip(*points, strict=True)  # two opposite corners, or all four
            canvas.rectangle((min(xs), min(ys), max(xs), max(ys)), fill=label)
        case "circle":
            (x, y), edge = points[0], points[1]
            _dot(canvas, x, y, math.dist(points[0], edge), label)
        case "line" | "linestrip":
            canvas.line(points, fill=label, width=_STROKE_PIXELS)
        case "mask":
            x, y = points[0]
            image.paste(label, (round(x), round(y)), _decode_mask(where, item))
        case _:
            for x, y in points:
                _dot(canvas, x, y, radius, label)


def _dot(canvas: ImageDraw.ImageDraw, x: float, y: float, radius: float, label: int) -> None:
    canvas.ellipse((x - radius, y - radius, x + radius, y + radius), fill=label)


def _decode_mask(where: str, item: Mapping[str, Any]) -> Image.Image:
    """Return the bitmap that labelme stores with shapes of type mask."""
    try:
        data = base64.b64decode(item["mask"], validate=True)
        with Image.open(io.BytesIO(data)) as mask:
            return mask.convert("L").point(lambda value: 255 if value else 0)
    except (
        KeyError,
        TypeError,
        ValueError,
        OSError,
        SyntaxError,
        Image.DecompressionBombError,
    ) as err:
        raise InvalidInputError(f"{where}: its mask cannot be read ({err!r})") from err


def _read_label_image(path: Path, shape: tuple[int, ...], taxonomy: Taxonomy) -> Labels:
    """Read class ids from a grey or palette image, or class colours from any other.

    The background class means that nobody labelled the pixel.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: the annotation does not exist")
    try:
        with Image.open(path) as image:
            _check_size(path, (image.height, image.width), shape)
            by_id = image.mode in ("1", "L", "P")
            pixels = np.asarray(image if by_id else image.convert("RGB"))
    except (OSError, SyntaxError, Image.DecompressionBombError) as err:
        raise InvalidInputError(f"{path}: neither labelme JSON nor an image: {err}") from err
    labels = pixels.astype(np.uint8) if by_id else _ids_of_colours(path, pixels, taxonomy)
    unknown = np.unique(labels[(labels >= len(taxonomy)) & (labels != UNLABELLED)])
    if len(unknown):
        raise InvalidInputError(
            f"{path}: expected class ids 0 to {len(taxonomy) - 1}, or {UNLABELLED} for none, "
            f"found {unknown.tolist()}"
        )
    return np.where(labels == taxonomy.background_id, UNLABELLED, labels).astype(np.uint8)


def _ids_of_colours(path: Path, pixels: Labels, taxonomy: Taxonomy) -> Labels:
    labels = np.full(pixels.shape[:2], UNLABELLED, np.uint8)
    known = (pixels == 255).all(axis=-1)  # white paper
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


def _check_size(path: Path, found: tuple[Any, Any], shape: tuple[int, ...]) -> None:
    if found != tuple(shape):
        raise InvalidInputError(
            f"{path}: annotates an image of {found[1]} x {found[0]} pixels, but the map has "
            f"{shape[1]} x {shape[0]}; annotate the image that the map's YAML file names"
        )
