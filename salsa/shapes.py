"""labelme shapes: what a file says, and which pixels of the image each shape covers.

labelme 6 exports no label images any more, so the shapes of its JSON files are drawn here.
"""

from __future__ import annotations

import base64
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, UNLABELLED, Taxonomy

_STROKE_PIXELS = 3  # width of drawn lines and points; they mark objects, they have no area
_MAX_DIAGONALS = 10
_FEWEST_POINTS = {  # of every shape type that labelme 5 and 6 write
    "polygon": 3,
    "rectangle": 2,
    "oriented_rectangle": 4,
    "circle": 2,
    "line": 2,
    "linestrip": 2,
    "point": 1,
    "points": 1,
    "mask": 1,
}

Points = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Shape:
    """One shape of a labelme file, and the pixels that it covers; row 0 is the top of the image.

    Parameters
    ----------
    number
        Its place in the file and in labelme's list, from 1.
    label
        Class id.
    kind
        labelme's shape type.
    points
        x, y of its points, pixels.
    bounds
        Smallest x and y, largest x and y, pixels; they may lie outside the image.
    corner
        Row and column of the image where `mask` begins.
    mask
        (h, w) bool: the covered pixels of the part that lies in the image.
    """

    number: int
    label: int
    kind: str
    points: Points
    bounds: tuple[float, float, float, float]
    corner: tuple[int, int]
    mask: NDArray[np.bool_]

    @property
    def place(self) -> tuple[slice, slice]:
        """Rows and columns of the image that `mask` covers."""
        (row, column), (height, width) = self.corner, self.mask.shape
        return slice(row, row + height), slice(column, column + width)


def read_shapes(
    path: Path, size: tuple[int, ...], taxonomy: Taxonomy = SEMANTIC2D
) -> tuple[Shape, ...]:
    """Read the shapes of a labelme file in their order, which is the order of drawing.

    Labels, points, shape types and bitmaps count; groups, flags, descriptions and the image that
    the file names or holds do not.

    Parameters
    ----------
    path
        labelme JSON.
    size
        Height and width of the image that must have been annotated.
    taxonomy
        Classes that labels are matched to, whatever their case.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    InvalidInputError
        If the file or a shape cannot be understood, labels are not classes, or the size differs.
    """
    content = _read_labelme(path)
    check_size(path, (content.get("imageHeight"), content.get("imageWidth")), size)
    outlines = [
        _read_outline(f"{path}: shape {number}", item, size)
        for number, item in enumerate(content["shapes"], start=1)
    ]
    labels = _ids_of(path, [outline.name for outline in outlines], taxonomy)
    return tuple(
        _lay(number, label, outline, size)
        for number, (label, outline) in enumerate(zip(labels, outlines, strict=True), start=1)
    )


def paint(shapes: Sequence[Shape], size: tuple[int, ...]) -> NDArray[np.uint8]:
    """Draw shapes over each other, the later ones on top, as labelme shows them.

    Returns
    -------
    (H, W) u1 class ids, 255 where no shape is; row 0 is the top of the image.
    """
    labels = np.full(size, UNLABELLED, np.uint8)
    for shape in shapes:
        labels[shape.place][shape.mask] = shape.label
    return labels


def check_size(path: Path, found: tuple[Any, Any], size: tuple[int, ...]) -> None:
    """Check that an annotation belongs to an image of a size (height, width).

    Raises
    ------
    InvalidInputError
        If it does not, or does not say whole numbers.
    """
    if not all(type(value) is int for value in found):
        raise InvalidInputError(
            f"{path}: expected imageHeight and imageWidth as whole numbers, found {found[0]!r} and "
            f"{found[1]!r}; save it with labelme again"
        )
    if found != tuple(size):
        raise InvalidInputError(
            f"{path}: annotates an image of {found[1]} x {found[0]} pixels, but the map has "
            f"{size[1]} x {size[0]}; annotate the image that the map's YAML file names, as it is: "
            f"neither cropped nor scaled"
        )


@dataclass(frozen=True)
class _Outline:
    """A shape as the file says it."""

    name: str
    kind: str
    points: Points
    bitmap: Image.Image | None

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        if self.kind == "circle":
            (x, y), radius = self.points[0], math.dist(self.points[0], self.points[1])
            return x - radius, y - radius, x + radius, y + radius
        if self.bitmap is not None:
            left, top = map(round, self.points[0])
            return left, top, left + self.bitmap.width, top + self.bitmap.height
        xs, ys = zip(*self.points, strict=True)
        return min(xs), min(ys), max(xs), max(ys)


def _read_labelme(path: Path) -> Mapping[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as err:
        raise InvalidInputError(f"{path}: not a labelme JSON file: {err}") from err
    if not isinstance(content, dict) or not isinstance(content.get("shapes"), list):
        raise InvalidInputError(f"{path}: expected a labelme file with a list of `shapes`")
    return content


def _read_outline(where: str, item: Any, size: tuple[int, ...]) -> _Outline:
    try:
        name, kind = item["label"], item.get("shape_type") or "polygon"
        points = tuple((float(x), float(y)) for x, y in item["points"])
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as err:
        raise InvalidInputError(
            f"{where}: expected a label and points [[x, y], ...] ({err!r})"
        ) from err
    if not isinstance(kind, str) or kind not in _FEWEST_POINTS:
        known = ", ".join(_FEWEST_POINTS)
        raise InvalidInputError(f"{where}: unknown shape type {kind!r}; known are {known}")
    if len(points) < _FEWEST_POINTS[kind] or not np.isfinite(points).all():
        raise InvalidInputError(
            f"{where}: expected {_FEWEST_POINTS[kind]} or more finite points in a shape of type "
            f"{kind}, found {[list(point) for point in points]}"
        )
    bitmap = _decode_bitmap(where, item, size) if kind == "mask" else None
    outline = _Outline(str(name), kind, points, bitmap)
    _check_reach(where, outline, size)
    return outline


def _check_reach(where: str, outline: _Outline, size: tuple[int, ...]) -> None:
    """Refuse what lies so far beyond the image that drawing it would overflow or take ages."""
    limit = _MAX_DIAGONALS * math.hypot(*size)
    farthest = max(abs(value) for point in outline.points for value in point)
    if outline.kind == "circle":
        farthest = max(farthest, math.dist(outline.points[0], outline.points[1]))
    if farthest > limit:
        raise InvalidInputError(
            f"{where}: expected coordinates and radii up to {limit:.0f} pixels, {_MAX_DIAGONALS} "
            f"diagonals of the image, found {farthest:g}"
        )


def _ids_of(path: Path, names: Sequence[str], taxonomy: Taxonomy) -> list[int]:
    """Class ids of names; every name that is no class is told at once."""
    ids: dict[str, int] = {}
    unknown: dict[str, list[int]] = {}
    for number, name in enumerate(names, start=1):
        try:
            ids[name] = taxonomy.id_of(name)
        except InvalidInputError:
            unknown.setdefault(name, []).append(number)
    if unknown:
        found = "; ".join(f"{name!r} in {_shapes(at)}" for name, at in unknown.items())
        raise InvalidInputError(
            f"{path}: labels that are no class: {found}; known are {', '.join(taxonomy.names)}; "
            f"rename these shapes in labelme, or delete them"
        )
    return [ids[name] for name in names]


def _shapes(numbers: Sequence[int]) -> str:
    shown = ", ".join(map(str, numbers[:5])) + (", ..." if len(numbers) > 5 else "")
    return f"shape {shown}" if len(numbers) == 1 else f"shapes {shown}"


def _lay(number: int, label: int, outline: _Outline, size: tuple[int, ...]) -> Shape:
    """Draw one shape on the part of the image that it can touch."""
    x1, y1, x2, y2 = outline.bounds
    left, top = (max(0, math.floor(value) - _STROKE_PIXELS) for value in (x1, y1))
    right = min(size[1], math.ceil(x2) + _STROKE_PIXELS + 1)
    bottom = min(size[0], math.ceil(y2) + _STROKE_PIXELS + 1)
    if right <= left or bottom <= top:  # beside the image
        corner, mask = (0, 0), np.zeros((0, 0), np.bool_)
    else:
        image = Image.new("L", (right - left, bottom - top), 0)
        _draw(image, outline, left, top)
        corner, mask = (top, left), np.asarray(image) > 0
    return Shape(number, label, outline.kind, outline.points, outline.bounds, corner, mask)


def _draw(image: Image.Image, outline: _Outline, left: int, top: int) -> None:
    canvas = ImageDraw.Draw(image)
    points = [(x - left, y - top) for x, y in outline.points]
    match outline.kind:
        case "polygon" | "oriented_rectangle":
            canvas.polygon(points, fill=1, outline=1)
        case "rectangle":
            xs, ys = zip(*points, strict=True)  # two opposite corners, or all four
            canvas.rectangle((min(xs), min(ys), max(xs), max(ys)), fill=1)
        case "circle":
            _dot(canvas, *points[0], math.dist(points[0], points[1]))
        case "line" | "linestrip":
            canvas.line(points, fill=1, width=_STROKE_PIXELS)
        case "mask":
            column, row = map(round, outline.points[0])
            image.paste(1, (column - left, row - top), outline.bitmap)
        case _:
            for x, y in points:
                _dot(canvas, x, y, _STROKE_PIXELS / 2)


def _dot(canvas: ImageDraw.ImageDraw, x: float, y: float, radius: float) -> None:
    canvas.ellipse((x - radius, y - radius, x + radius, y + radius), fill=1)


def _decode_bitmap(where: str, item: Mapping[str, Any], size: tuple[int, ...]) -> Image.Image:
    """Return the bitmap, a PNG cut out of the image, that labelme stores with shapes of type mask.

    Its size is looked at before it is decompressed.
    """
    try:
        data = base64.b64decode(item["mask"], validate=True)
        with Image.open(io.BytesIO(data), formats=("PNG",)) as mask:
            _check_bitmap(mask, size)
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


def _check_bitmap(mask: Image.Image, size: tuple[int, ...]) -> None:
    if mask.height > size[0] or mask.width > size[1]:
        raise ValueError(
            f"{mask.width} x {mask.height} pixels, more than the image of {size[1]} x {size[0]}"
        )
