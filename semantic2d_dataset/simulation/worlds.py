"""Worlds: what stands in a building, and the map of it that a robot would have been given."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.geometry import Pose2, transform
from semantic2d_dataset.scene.maps import FREE, OCCUPIED, UNKNOWN, SemanticMap
from semantic2d_dataset.scene.taxonomy import UNLABELLED
from semantic2d_dataset.simulation import sensors as material
from semantic2d_dataset.simulation.furniture import (
    CHAIR,
    DOOR,
    ELEVATOR,
    OTHER,
    PERSON,
    PILLAR,
    SOFA,
    TABLE,
    TRASH_BIN,
    WALL,
    Drafter,
    Primitives,
)
from semantic2d_dataset.simulation.plans import PLANS

Float = NDArray[np.float64]
MAP_RESOLUTION = 0.05  # m, as mapping packages choose it by default
_MARGIN = 1.0  # m of unknown space around a map
_GRID = 1e-4  # m, as in `furniture`
_LONG_WALL = 0.3  # m
# what a surface of each class is made of where only its class is known
_USUAL_MATERIAL = {
    OTHER: material.CARDBOARD,
    CHAIR: material.PLASTIC,
    DOOR: material.WOOD,
    ELEVATOR: material.METAL,
    PERSON: material.CLOTH,
    PILLAR: material.CONCRETE,
    SOFA: material.FABRIC,
    TABLE: material.LAMINATE,
    TRASH_BIN: material.SHEET_STEEL,
    WALL: material.DRYWALL,
}


@dataclass(frozen=True)
class World:
    """A building without its people.

    Parameters
    ----------
    name
        The environment's name.
    primitives
        Everything that stands in it; primitives of class Other are clutter.
    scene_map
        The map that a mapping package made of it, annotated: it knows no clutter, and none of
        the changes of `perturb`.
    tour
        (K, 2) f8, m: the places that a robot visits, in order and then again from the first.
    """

    name: str
    primitives: Primitives
    scene_map: SemanticMap
    tour: Float


def draw_world(name: str, seed: int, *, clutter: bool = True) -> World:
    """Draw one of the six floor plans; sizes, furniture and shades follow the seed.

    Parameters
    ----------
    name
        One of `PLANS`: lobby, corridor, office, lounge, pillar-hall, cafeteria.
    seed
        Any whole number from 0 on.
    clutter
        Whether things stand about that the map does not know.

    Raises
    ------
    InvalidInputError
        If there is no such floor plan.
    """
    check_plan(name)
    pen = Drafter(np.random.Generator(np.random.PCG64([seed, *name.encode()])))
    tour = np.array(PLANS[name](pen), np.float64)
    everything = pen.primitives()
    mapped = select(everything, everything.labels != OTHER)
    scene_map = rasterise(mapped, tour[0])
    return World(name, everything if clutter else mapped, scene_map, tour)


def check_plan(name: str) -> None:
    """Check that there is a floor plan of that name.

    Raises
    ------
    InvalidInputError
        If there is none.
    """
    if name not in PLANS:
        raise InvalidInputError(f"unknown floor plan {name!r}; known are {', '.join(PLANS)}")


def world_from_map(name: str, scene_map: SemanticMap, tour: Float) -> World:
    """Build a world whose solid things are the occupied cells of a map.

    Each edge between an occupied and another cell becomes a segment of the cell's class. Cells
    without one are Other, as labelling calls them; walls where no cell has a class. Cells of one
    class that touch each other are one object.

    Parameters
    ----------
    tour
        (K, 2) f8, m, map frame: places in free space that a robot visits.
    """
    segments, cells = _cell_edges(scene_map)
    unlabelled = scene_map.labels == UNLABELLED
    labels = np.where(unlabelled, WALL if unlabelled.all() else OTHER, scene_map.labels)
    objects = _number_objects(labels, scene_map.occupancy == OCCUPIED)[tuple(cells.T)]
    labels = labels[tuple(cells.T)].astype(np.uint8)
    usual = np.array([_USUAL_MATERIAL[k] for k in range(len(_USUAL_MATERIAL))], np.uint8)
    surfaces = material.Surfaces(labels, usual[labels], np.ones(len(labels)))
    primitives = Primitives(segments, np.zeros((0, 3)), surfaces, objects)
    return World(name, primitives, scene_map, np.asarray(tour, np.float64))


def perturb(
    world: World,
    seed: int,
    *,
    moved_share: float = 0.3,
    clutter_per_m2: float = 0.1,
    warp_m: float = 0.04,
) -> World:
    """Change a world behind the back of its map.

    Parameters
    ----------
    moved_share
        Share of the chairs and tables that are moved by 0.3 to 1 m and turned.
    clutter_per_m2
        Unmapped objects for each square metre of free space; about 20 cm wide, near
        mapped ones.
    warp_m
        Each wall is displaced as a whole by between 0.75 and 1.25 of this, either way; walls that
        consist of short pieces, as those of `world_from_map`, are bent by as much.

    Returns
    -------
    World
        With the same map and tour.
    """
    rng = np.random.Generator(np.random.PCG64([seed, 1]))
    changed = _warp_walls(_move_furniture(world.primitives, rng, moved_share), rng, warp_m)
    pen = Drafter(rng)
    for x, y in _clutter_spots(world, rng, clutter_per_m2):
        pen.clutter(x, y, 2 * math.pi * float(rng.random()), size=0.5)
    return replace(world, primitives=join(changed, pen.primitives()))


def select(primitives: Primitives, keep: NDArray[np.bool_]) -> Primitives:
    """Return the primitives where `keep` (S + C,) is true."""
    split = len(primitives.segments)
    old = primitives.surfaces
    return Primitives(
        primitives.segments[keep[:split]],
        primitives.circles[keep[split:]],
        material.Surfaces(old.labels[keep], old.materials[keep], old.shades[keep]),
        primitives.objects[keep],
    )


def join(first: Primitives, second: Primitives) -> Primitives:
    """Return the primitives of both; objects of the second get numbers of their own."""
    s, t = len(first.segments), len(second.segments)

    def both(a: NDArray[np.generic], b: NDArray[np.generic]) -> NDArray[np.generic]:
        return np.concatenate((a[:s], b[:t], a[s:], b[t:]))

    a, b = first.surfaces, second.surfaces
    surfaces = material.Surfaces(
        both(a.labels, b.labels).astype(np.uint8),
        both(a.materials, b.materials).astype(np.uint8),
        both(a.shades, b.shades).astype(np.float64),
    )
    numbers = second.objects + (first.objects.max(initial=-1) + 1)
    return Primitives(
        np.concatenate((first.segments, second.segments)),
        np.concatenate((first.circles, second.circles)),
        surfaces,
        both(first.objects, numbers).astype(np.int32),
    )


def sample_outlines(primitives: Primitives, spacing: float) -> tuple[Float, NDArray[np.int64]]:
    """Return points (P, 2) along all outlines, `spacing` m apart at most, and their primitives."""
    start, end = primitives.segments[:, :2], primitives.segments[:, 2:]
    lengths = np.hypot(*(end - start).T)
    counts = np.ceil(lengths / spacing).astype(np.int64) + 1
    which = np.repeat(np.arange(len(start)), counts)
    step = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
    share = (step / (counts[which] - 1).clip(1))[:, None]
    along = start[which] + share * (end - start)[which]
    turns = 2 * math.pi * np.arange(64) / 64
    rims = np.stack((np.cos(turns), np.sin(turns)), axis=-1)
    rounds = primitives.circles[:, None, :2] + primitives.circles[:, None, 2:] * rims
    circle_ids = np.repeat(np.arange(len(rounds)) + len(start), 64)
    return np.concatenate((along, rounds.reshape(-1, 2))), np.concatenate((which, circle_ids))


def rasterise(primitives: Primitives, seen_from: Float) -> SemanticMap:
    """Make the annotated occupancy grid that a mapping package would: outlines and free space.

    Free is what can be reached from the point `seen_from` (2,) without crossing an outline;
    the insides of furniture and whatever lies behind walls stay unknown. A cell has the class
    with the longest outline in it.
    """
    points, which = sample_outlines(primitives, MAP_RESOLUTION / 5)
    # whole numbers of cells from the world's origin, which many walls are on, to middles of cells
    corner = np.rint((points.min(axis=0) - _MARGIN) / MAP_RESOLUTION).astype(np.int64)
    cells = np.floor(points / MAP_RESOLUTION + 0.5 + 1e-6).astype(np.int64) - corner
    width, height = cells.max(axis=0) + round(_MARGIN / MAP_RESOLUTION)
    occupancy = np.full((height, width), UNKNOWN, np.uint8)
    occupancy[cells[:, 1], cells[:, 0]] = OCCUPIED
    flat = cells[:, 1] * width + cells[:, 0]
    votes = np.zeros((occupancy.size, int(primitives.labels.max(initial=0)) + 1), np.int32)
    np.add.at(votes, (flat, primitives.labels[which]), 1)
    labels = np.where(
        occupancy == OCCUPIED, votes.argmax(axis=-1).reshape(height, width), UNLABELLED
    )
    regions, _ = ndimage.label(occupancy != OCCUPIED)
    here = np.rint(seen_from / MAP_RESOLUTION).astype(np.int64) - corner
    occupancy[(regions == regions[here[1], here[0]]) & (occupancy != OCCUPIED)] = FREE
    x, y = (corner - 0.5) * MAP_RESOLUTION
    origin = Pose2(round(float(x), 6), round(float(y), 6), 0.0)
    return SemanticMap(occupancy, labels.astype(np.uint8), MAP_RESOLUTION, origin)


def _number_objects(labels: NDArray[np.uint8], solid: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Give connected cells (H, W) of one class a number of their own; 0 where nothing is."""
    objects = np.zeros(labels.shape, np.int32)
    for label in np.unique(labels[solid]):
        parts, _ = ndimage.label(solid & (labels == label), np.ones((3, 3)))
        objects = np.where(parts > 0, parts + objects.max(), objects).astype(np.int32)
    return objects


def _cell_edges(scene: SemanticMap) -> tuple[Float, NDArray[np.int64]]:
    """Edges of occupied cells that face other cells, (M, 4), and their cells (M, 2)."""
    solid = np.pad(scene.occupancy == OCCUPIED, 1)
    found, cells = [], []
    for row, column, edge in (
        (-1, 0, (0, 0, 1, 0)), (1, 0, (1, 1, 0, 1)), (0, -1, (0, 1, 0, 0)), (0, 1, (1, 0, 1, 1)),
    ):  # fmt: skip
        facing = solid & ~np.roll(solid, (-row, -column), (0, 1))
        rows, columns = np.nonzero(facing[1:-1, 1:-1])
        found.append(np.stack((columns, rows, columns, rows), axis=-1) + np.array(edge))
        cells.append(np.stack((rows, columns), axis=-1))
    corners = np.concatenate(found).reshape(-1, 2, 2) * scene.resolution
    origin = np.array((scene.origin.x, scene.origin.y, scene.origin.yaw))
    return transform(origin, corners).reshape(-1, 4), np.concatenate(cells)


def _move_furniture(
    primitives: Primitives, rng: np.random.Generator, moved_share: float
) -> Primitives:
    """Move a share of the chairs and tables by 0.3 to 1 m, and turn them around their middle."""
    segments, circles = primitives.segments.copy(), primitives.circles.copy()
    split = len(segments)
    movable = np.isin(primitives.labels, (CHAIR, TABLE))
    for number in np.unique(primitives.objects[movable]):
        if rng.random() >= moved_share:
            continue
        mine = primitives.objects == number
        ends, centres = segments[mine[:split]].reshape(-1, 2), circles[mine[split:], :2]
        middle = np.concatenate((ends, centres)).mean(axis=0)
        way, turn = 2 * math.pi * rng.random(2)
        shift = (0.3 + 0.7 * rng.random()) * np.array((math.cos(way), math.sin(way)))
        pose = np.array((*(middle + shift), turn))
        segments[mine[:split]] = _snap(transform(pose, ends - middle)).reshape(-1, 4)
        circles[mine[split:], :2] = _snap(transform(pose, centres - middle))
    return replace(primitives, segments=segments, circles=circles)


def _clutter_spots(
    world: World, rng: np.random.Generator, per_m2: float
) -> list[tuple[float, float]]:
    """Choose places 0.3 to 0.9 m from mapped things and not on the robot's tour."""
    scene = world.scene_map
    free = scene.occupancy == FREE
    gap = ndimage.distance_transform_edt(scene.occupancy != OCCUPIED) * scene.resolution
    cells = np.argwhere(free & (gap > 0.3) & (gap < 0.9))
    points = scene.centres_of(cells)
    off_tour = np.min(np.sum((points[:, None] - world.tour) ** 2, axis=-1), axis=-1) > 0.8**2
    count = round(np.count_nonzero(free) * scene.resolution**2 * per_m2)
    chosen = _snap(points[off_tour])[rng.integers(np.count_nonzero(off_tour), size=count)]
    return [(float(x), float(y)) for x, y in chosen]


def _warp_walls(primitives: Primitives, rng: np.random.Generator, warp_m: float) -> Primitives:
    """Displace every long wall across its direction, and bend those made of short pieces."""
    segments = primitives.segments.copy()
    along = segments[:, 2:] - segments[:, :2]
    lengths = np.hypot(*along.T)
    is_wall = primitives.labels[: len(segments)] == WALL
    walls = is_wall & (lengths > _LONG_WALL)
    across = np.stack((-along[:, 1], along[:, 0]), axis=-1) / np.maximum(lengths, _GRID)[:, None]
    size = warp_m * (0.75 + 0.5 * rng.random(len(segments)))
    size *= np.where(rng.random(len(segments)) < 0.5, -1.0, 1.0) * walls
    segments += np.tile(across * size[:, None], 2)
    short = is_wall & (lengths <= _LONG_WALL)
    ends = segments[short].reshape(-1, 2)
    segments[short] = (ends + _bend(ends, rng, warp_m)).reshape(-1, 4)
    return replace(primitives, segments=_snap(segments))


def _bend(points: Float, rng: np.random.Generator, warp_m: float) -> Float:
    """Return displacements (P, 2) whose direction and size change over metres."""
    waves = 2 * math.pi * rng.random((2, 3))
    x, y = points.T
    way = waves[0, 0] + 2 * np.sin(x / 2 + waves[0, 1]) + 2 * np.sin(y / 2 + waves[0, 2])
    size = warp_m * (1 + 0.25 * np.sin(x + waves[1, 0]) * np.sin(y + waves[1, 1]))
    bent: Float = size[:, None] * np.stack((np.cos(way), np.sin(way)), axis=-1)
    return bent


def _snap(values: Float) -> Float:
    snapped: Float = np.rint(values / _GRID) * _GRID
    return snapped
