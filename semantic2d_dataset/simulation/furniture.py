"""Walls, doors and furniture as a lidar near the ground sees them: outlines, legs and columns."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semantic2d_dataset.scene.geometry import transform
from semantic2d_dataset.simulation import sensors as material

Float = NDArray[np.float64]
OTHER, CHAIR, DOOR, ELEVATOR, PERSON, PILLAR, SOFA, TABLE, TRASH_BIN, WALL = range(10)
_REVEAL = 0.05  # m of wall between its face and the frame of a door
_GRID = 1e-4  # m: geometry is rounded to it, so that every machine draws the same building


@dataclass(frozen=True)
class Primitives:
    """Segments and circles with what they belong to.

    Parameters
    ----------
    segments
        (S, 4) f8 x1 y1 x2 y2, m.
    circles
        (C, 3) f8 x y radius, m.
    surfaces
        Class, material and shade of the S segments, then of the C circles.
    objects
        (S + C,) i4: primitives of one piece of furniture share a number.
    """

    segments: Float
    circles: Float
    surfaces: material.Surfaces
    objects: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.segments) + len(self.circles)

    @property
    def labels(self) -> NDArray[np.uint8]:
        """Class of each primitive, (S + C,) u1."""
        return self.surfaces.labels


def rectangle(length: float, width: float) -> Float:
    """Return the corners (5, 2) of a closed rectangle around the origin, m."""
    x, y = length / 2, width / 2
    return np.array(((-x, -y), (x, -y), (x, y), (-x, y), (-x, -y)))


def ring(count: int, radius: float) -> Float:
    """Return `count` points (count, 2) on a circle around the origin."""
    angles = 2 * math.pi * np.arange(count) / count
    return radius * np.stack((np.cos(angles), np.sin(angles)), axis=-1)


class Drafter:
    """Collects the primitives of a floor plan, one object after the other.

    Parameters
    ----------
    rng
        Decides sizes, variants and shades.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self._segments: list[tuple[float, ...]] = []
        self._circles: list[tuple[float, ...]] = []
        self._segment_tags: list[tuple[float, ...]] = []
        self._circle_tags: list[tuple[float, ...]] = []
        self._tag: tuple[float, ...] = (WALL, material.DRYWALL, 1.0, -1)

    def primitives(self) -> Primitives:
        """Return everything drawn so far."""
        tags = np.array(self._segment_tags + self._circle_tags).reshape(-1, 4)
        surfaces = material.Surfaces(
            tags[:, 0].astype(np.uint8), tags[:, 1].astype(np.uint8), tags[:, 2].copy()
        )
        return Primitives(
            np.array(self._segments, np.float64).reshape(-1, 4),
            np.array(self._circles, np.float64).reshape(-1, 3),
            surfaces,
            tags[:, 3].astype(np.int32),
        )

    def begin(self, label: int, surface: int, spread: float = 0.1) -> None:
        """Start an object; its shade lies within `spread` around 1."""
        shade = round(1 + spread * (2 * self.rng.random() - 1), 3)
        self._tag = (label, surface, shade, self._tag[3] + 1)

    def path(self, points: ArrayLike, at: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """Draw segments through points (P, 2), given in the frame `at` x y yaw."""
        placed = np.rint(transform(at, points) / _GRID) * _GRID
        for start, end in pairwise(placed):
            self._segments.append((*start, *end))
            self._segment_tags.append(self._tag)

    def discs(self, points: ArrayLike, radius: float, at: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """Draw circles of one radius around points (P, 2), given in the frame `at`."""
        for centre in np.rint(transform(at, points) / _GRID) * _GRID:
            self._circles.append((*centre, round(radius, 4)))
            self._circle_tags.append(self._tag)

    def wall(self, *points: tuple[float, float]) -> None:
        """Draw a wall along corner points."""
        self.begin(WALL, material.DRYWALL, 0.04)
        self.path(points)

    def partition(self, x: float, y: float, yaw: float, length: float) -> None:
        """Draw a free-standing wall 12 cm thick around its middle."""
        self.begin(WALL, material.DRYWALL, 0.04)
        self.path(rectangle(length, 0.12), (x, y, yaw))

    def door(self, at: ArrayLike, width: float, *, leaves: int = 1) -> None:
        """Draw a closed door whose leaves lie 12 cm deep in the wall; `at` +y points outward."""
        half = width / 2
        self.frame(at, half, 0.14)
        self.begin(DOOR, material.WOOD)
        edges = np.linspace(-half, half, leaves + 1)
        depths = 0.12 + 0.01 * (np.arange(leaves) % 2) + 0.005 * self.rng.random(leaves)
        self.path(np.stack((np.repeat(edges, 2)[1:-1], np.repeat(depths, 2)), axis=-1), at)

    def open_door(self, at: ArrayLike, width: float) -> None:
        """Draw a door that stands open into a small room behind the wall."""
        half = width / 2
        self.frame(at, half, 0.12)
        self.wall_path(
            ((half, 0.12), (half + 0.7, 0.12), (half + 0.7, 2.4), (-half - 0.9, 2.4),
             (-half - 0.9, 0.12), (-half, 0.12)), at,
        )  # fmt: skip
        self.begin(DOOR, material.WOOD)
        swing = math.radians(70 + 35 * self.rng.random())
        tip = (-half + width * math.cos(swing), 0.14 + width * math.sin(swing))
        self.path(((-half, 0.14), tip), at)

    def elevator(self, at: ArrayLike, width: float) -> None:
        """Draw a pair of metal doors in a niche 22 cm deep with a metal frame."""
        half = width / 2
        self.frame(at, half, 0.24, ELEVATOR)
        self.begin(ELEVATOR, material.METAL)
        self.path(((-half, 0.22), (0.0, 0.22), (0.0, 0.24), (half, 0.24)), at)

    def passage(self, at: ArrayLike, width: float, length: float) -> None:
        """Draw a corridor that leaves through the wall and ends at a double door."""
        half = width / 2
        for side in (-half, half):
            self.wall_path(((side, 0.0), (side, length)), at)
        leaf = width - 0.3
        for side in (-1, 1):
            self.wall_path(((side * half, length), (side * leaf / 2, length)), at)
        end = transform(at, ((0.0, length),))[0]
        self.door((*end, np.asarray(at)[2]), leaf, leaves=2)

    def wall_path(self, points: ArrayLike, at: ArrayLike) -> None:
        """Draw walls along points given in the frame `at`."""
        self.begin(WALL, material.DRYWALL, 0.04)
        self.path(points, at)

    def frame(self, at: ArrayLike, half: float, depth: float, label: int = DOOR) -> None:
        """Draw both sides of an opening: the edge of the wall, then the frame of what closes it."""
        for side in (-half, half):
            self.wall_path(((side, 0.0), (side, _REVEAL)), at)
            self.begin(label, material.WOOD if label == DOOR else material.METAL)
            self.path(((side, _REVEAL), (side, depth)), at)

    def pillar(self, x: float, y: float, size: float, *, round_: bool) -> None:
        """Draw a round pillar of that diameter or a square one of that edge."""
        self.begin(PILLAR, material.CONCRETE, 0.05)
        if round_:
            self.discs(((x, y),), size / 2)
        else:
            self.path(rectangle(size, size), (x, y, 0.0))

    def sofa(self, x: float, y: float, yaw: float, length: float = 2.0) -> None:
        """Draw a sofa as its plinth: a box with bevelled front corners; +y is the front."""
        self.begin(SOFA, material.FABRIC, 0.25)
        w, d, bevel = length / 2, 0.43, 0.08
        outline = (
            (-w, -d), (w, -d), (w, d - bevel), (w - bevel, d), (-w + bevel, d), (-w, d - bevel),
            (-w, -d),
        )  # fmt: skip
        self.path(outline, (x, y, yaw))

    def armchair(self, x: float, y: float, yaw: float) -> None:
        """Draw an upholstered tub chair, which the classes count as a sofa: straight front."""
        self.begin(SOFA, material.FABRIC, 0.25)
        angles = np.linspace(0.2 * math.pi, -1.2 * math.pi, 9)
        back = 0.44 * np.stack((np.cos(angles), np.sin(angles)), axis=-1)
        self.path(np.vstack((back, back[:1])), (x, y, yaw))

    def table(self, x: float, y: float, yaw: float, length: float, width: float) -> None:
        """Draw a table on four square legs."""
        self.begin(TABLE, material.LAMINATE)
        for leg_x, leg_y in rectangle(length - 0.12, width - 0.12)[:4]:
            corner = transform((x, y, yaw), ((leg_x, leg_y),))[0]
            self.path(rectangle(0.07, 0.07), (*corner, yaw))

    def round_table(self, x: float, y: float) -> None:
        """Draw a round table on one column."""
        self.begin(TABLE, material.LAMINATE)
        self.discs(((x, y),), 0.11)

    def desk(self, x: float, y: float, yaw: float, length: float = 1.6) -> None:
        """Draw a desk or counter: side panels and a front panel; its open side is -y."""
        self.begin(TABLE, material.LAMINATE)
        w = length / 2
        self.path(((-w, -0.35), (-w, 0.35), (w, 0.35), (w, -0.35)), (x, y, yaw))

    def chair(self, x: float, y: float, yaw: float) -> None:
        """Draw a chair on four legs."""
        self.begin(CHAIR, material.PLASTIC)
        self.discs(rectangle(0.42, 0.42)[:4], 0.022, (x, y, yaw))

    def office_chair(self, x: float, y: float, yaw: float) -> None:
        """Draw a swivel chair: column and five castors."""
        self.begin(CHAIR, material.PLASTIC)
        self.discs(((0.0, 0.0),), 0.045, (x, y, yaw))
        self.discs(ring(5, 0.29), 0.03, (x, y, yaw))

    def shell_chair(self, x: float, y: float, yaw: float) -> None:
        """Draw a moulded chair as the outline of its seat shell; +y is the open front."""
        self.begin(CHAIR, material.PLASTIC)
        angles = np.linspace(0.1 * math.pi, -1.1 * math.pi, 7)
        shell = 0.25 * np.stack((np.cos(angles), np.sin(angles)), axis=-1)
        self.path(np.vstack((shell, shell[:1])), (x, y, yaw))

    def bin(self, x: float, y: float, yaw: float = 0.0, *, boxes: int = 0) -> None:
        """Draw a round trash bin, or that many boxes in a row."""
        self.begin(TRASH_BIN, material.SHEET_STEEL)
        if boxes:
            self.path(rectangle(0.46 * boxes, 0.44), (x, y, yaw))
        else:
            self.discs(((x, y),), 0.24)

    def clutter(self, x: float, y: float, yaw: float, *, size: float = 1.0) -> None:
        """Draw a thing that no map knows: a suitcase, a carton or a potted plant."""
        kind = self.rng.integers(3)
        self.begin(OTHER, material.FOLIAGE if kind == 2 else material.CARDBOARD, 0.3)
        if kind == 2:
            self.discs(ring(4, 0.09 * size), 0.07 * size, (x, y, yaw))
        else:
            length, width = ((0.4, 0.22), (0.45, 0.3))[kind]
            self.path(rectangle(length * size, width * size), (x, y, yaw))
