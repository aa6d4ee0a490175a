"""Occupancy grids with a class per cell, and the map_server files that they come from."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.documents import read_yaml
from semantic2d_dataset.scene.geometry import Pose2
from semantic2d_dataset.scene.scans import check_array
from semantic2d_dataset.scene.taxonomy import UNLABELLED

FREE, OCCUPIED, UNKNOWN = 0, 100, 255

# Those of map servers; others, such as EPS, would be handed to a program of their own.
_FORMATS = ("PPM", "PNG", "BMP", "GIF", "JPEG", "TIFF", "TGA", "PCX", "WEBP")


@dataclass(frozen=True)
class SemanticMap:
    """An occupancy grid whose cells may carry a class.

    Parameters
    ----------
    occupancy
        (H, W) u1: 0 free, 100 occupied, 255 unknown. Row 0 is the smallest y.
    labels
        (H, W) u1 class ids, 255 where a cell has none.
    resolution
        Edge of a cell, m.
    origin
        Pose in the map frame of the lower left corner of cell (0, 0).
    """

    occupancy: NDArray[np.uint8]
    labels: NDArray[np.uint8]
    resolution: float
    origin: Pose2

    def __post_init__(self) -> None:
        check_array("occupancy", self.occupancy, np.uint8, (None, None))
        check_array("labels", self.labels, np.uint8, self.occupancy.shape)
        if not (math.isfinite(self.resolution) and self.resolution > 0):
            raise InvalidInputError(f"expected a resolution above 0 m, found {self.resolution}")
        cells = self.occupancy
        if not ((cells == FREE) | (cells == OCCUPIED) | (cells == UNKNOWN)).all():
            raise InvalidInputError("occupancy: expected only 0 free, 100 occupied, 255 unknown")

    def cells_of(self, points: ArrayLike) -> NDArray[np.int64]:
        """Return row and column (..., 2) i8 of map points (..., 2) in m, also outside the grid."""
        p = np.asarray(points, np.float64) - (self.origin.x, self.origin.y)
        c, s = math.cos(self.origin.yaw), math.sin(self.origin.yaw)
        x, y = c * p[..., 0] + s * p[..., 1], c * p[..., 1] - s * p[..., 0]
        cells = np.floor(np.stack((y, x), axis=-1) / self.resolution)
        return cells.astype(np.int64)

    def centres_of(self, cells: ArrayLike) -> NDArray[np.float64]:
        """Return the map points (..., 2) in m at the centres of cells (..., 2) row, column."""
        rc = np.asarray(cells, np.float64)
        x = (rc[..., 1] + 0.5) * self.resolution
        y = (rc[..., 0] + 0.5) * self.resolution
        c, s = math.cos(self.origin.yaw), math.sin(self.origin.yaw)
        return np.stack((self.origin.x + c * x - s * y, self.origin.y + s * x + c * y), axis=-1)


def read_map(path: Path) -> SemanticMap:
    """Read a map_server map: a YAML file and the image that it names.

    Pixels become cells as map_server does it: with p the share of black (white where `negate`
    is set), cells with p above `occupied_thresh` are occupied, below `free_thresh` free, else
    unknown; mode `raw` takes 0 free, 100 occupied, others unknown. Transparent pixels are
    unknown in mode `scale`.

    Returns
    -------
    SemanticMap
        No cell carries a class yet.

    Raises
    ------
    FileNotFoundError
        If the YAML file or the image is missing.
    InvalidInputError
        If one of them cannot be understood.
    """
    path = Path(path)
    settings = _read_settings(path)
    try:
        resolution = float(settings["resolution"])
        origin = Pose2(*(float(value) for value in settings["origin"]))
        image = path.parent / _text(settings, "image")
        negate = bool(int(settings.get("negate", 0)))
        occupied = float(settings.get("occupied_thresh", 0.65))
        free = float(settings.get("free_thresh", 0.196))
        mode = _text({"mode": "trinary"} | settings, "mode")
    except (KeyError, TypeError, ValueError, OverflowError) as err:
        raise InvalidInputError(
            f"{path}: a map needs image, resolution and origin [x, y, yaw]; found "
            f"{', '.join(map(str, settings))} ({err!r})"
        ) from err
    if mode not in ("trinary", "scale", "raw"):
        raise InvalidInputError(f"{path}: mode must be trinary, scale or raw, found {mode!r}")
    levels, channels, opaque = _read_image(image)
    grey = np.arange(255 * channels + 1) / channels  # of every level there is
    if mode == "raw":
        cell_of = np.where((grey == FREE) | (grey == OCCUPIED), grey, UNKNOWN).astype(np.uint8)
    else:
        share = grey / 255.0 if negate else (255.0 - grey) / 255.0
        cell_of = np.full(grey.shape, UNKNOWN, np.uint8)
        cell_of[share > occupied] = OCCUPIED
        cell_of[share < free] = FREE
    # row by row, since NumPy widens indices to 8 bytes
    cells = np.stack([cell_of[row] for row in levels[::-1]])
    if mode == "scale":
        cells[~opaque[::-1]] = UNKNOWN
    labels = np.full(cells.shape, UNLABELLED, np.uint8)
    try:
        return SemanticMap(cells, labels, resolution, origin)
    except InvalidInputError as err:
        raise InvalidInputError(f"{path}: {err}") from err


def map_image(path: Path) -> Path:
    """Return the path of the image that a map_server YAML file names.

    Raises
    ------
    FileNotFoundError, InvalidInputError
        If there is no such YAML file, or it names no image.
    """
    path = Path(path)
    try:
        return path.parent / _text(_read_settings(path), "image")
    except (KeyError, TypeError) as err:
        raise InvalidInputError(f"{path}: a map needs an image; found none ({err!r})") from err


def write_map(path: Path, scene: SemanticMap) -> None:
    """Write the occupancy of a map as map_server YAML and a PGM image beside it."""
    path = Path(path)
    grey = np.full(scene.occupancy.shape, 205, np.uint8)
    grey[scene.occupancy == FREE] = 254
    grey[scene.occupancy == OCCUPIED] = 0
    image = path.with_suffix(".pgm")
    Image.fromarray(np.ascontiguousarray(grey[::-1])).save(image)
    settings = {
        "image": image.name,
        "resolution": scene.resolution,
        "origin": [scene.origin.x, scene.origin.y, scene.origin.yaw],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
    }
    path.write_text(yaml.safe_dump(settings), encoding="utf-8")


def _read_settings(path: Path) -> dict[str, Any]:
    settings = read_yaml(path, kind="a map_server YAML file")
    if not isinstance(settings, dict):
        raise InvalidInputError(f"{path}: expected a map_server YAML mapping")
    return settings


def _text(settings: dict[str, Any], key: str) -> str:
    value = settings[key]
    if not isinstance(value, str) or "\0" in value:
        raise TypeError(f"{key} is no text")
    return value


def _read_image(path: Path) -> tuple[NDArray[np.unsignedinteger], int, NDArray[np.bool_]]:
    """Levels (H, W), the sum of how many channels 0..255 they are, and which pixels are opaque.

    map_server averages the channels of a colour.
    """
    if not path.is_file():
        what = "is a folder, not a file" if path.is_dir() else "does not exist"
        raise FileNotFoundError(f"{path}: the image that the map names {what}")
    try:
        with Image.open(path, formats=_FORMATS) as image:
            channels = 1 if image.mode in ("1", "L", "LA") else 3
            pixels = np.asarray(image.convert("LA" if channels == 1 else "RGBA"))
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as err:
        raise InvalidInputError(f"{path}: not an image that can be read: {err}") from err
    levels = pixels[..., 0] if channels == 1 else pixels[..., :3].sum(axis=-1, dtype=np.uint16)
    return levels, channels, pixels[..., -1] > 0
