"""Ways through free space: the floor, shortest paths on it, and a robot's drive at 20 Hz."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse import csgraph

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.geometry import wrap_angle
from semantic2d_dataset.scene.maps import FREE
from semantic2d_dataset.simulation.worlds import World, sample_outlines

Float = NDArray[np.float64]
RATE_HZ = 20.0
_CELL = 0.1  # m
_STEP = 0.05  # m between the points of a path
_TURN_RATE = 1.2  # rad/s
_ACCELERATION = 0.8  # m/s^2
_NEIGHBOURS = ((0, 1, 10), (1, 0, 10), (1, 1, 14), (1, -1, 14))  # row, column, length x 10


@dataclass(frozen=True)
class Floor:
    """Where one can go in a world.

    Parameters
    ----------
    clearance
        (H, W) f8 distance to the nearest obstacle, m; 0 where nobody can be.
    corner
        (2,) f8 x, y of the lower left corner of cell (0, 0), m.
    """

    clearance: Float
    corner: Float

    def cells_of(self, points: Float) -> NDArray[np.int64]:
        """Return row and column (..., 2) of points (..., 2)."""
        cells = np.floor((points - self.corner) / _CELL).astype(np.int64)[..., ::-1]
        return np.clip(cells, 0, np.array(self.clearance.shape) - 1)

    def points_of(self, cells: NDArray[np.int64]) -> Float:
        """Return the middles (..., 2) of cells (..., 2) row, column."""
        points: Float = (cells[..., ::-1] + 0.5) * _CELL + self.corner
        return points

    def clearance_at(self, points: Float) -> Float:
        """Return the clearance (...,) in m at points (..., 2)."""
        rows, columns = np.moveaxis(self.cells_of(points), -1, 0)
        found: Float = self.clearance[rows, columns]
        return found


def floor_of(world: World) -> Floor:
    """Find the free space of a world, its clutter included, that its map knows as free."""
    scene = world.scene_map
    corner = np.array((scene.origin.x, scene.origin.y))
    ratio = round(_CELL / scene.resolution)
    if scene.origin.yaw != 0 or abs(ratio * scene.resolution - _CELL) > 1e-9:
        raise InvalidInputError(
            f"world {world.name!r}: expected an unrotated map of cells that divide {_CELL} m, "
            f"found {scene.resolution} m and yaw {scene.origin.yaw}"
        )
    rows, columns = (n // ratio for n in scene.occupancy.shape)
    blocks = scene.occupancy[: rows * ratio, : columns * ratio] == FREE
    free = blocks.reshape(rows, ratio, columns, ratio).all(axis=(1, 3))
    floor = Floor(free.astype(np.float64), corner)
    solid, _ = sample_outlines(world.primitives, _CELL / 2)
    inside = ((solid > corner) & (solid < corner + _CELL * np.array((columns, rows)))).all(axis=-1)
    at = floor.cells_of(solid[inside])
    free[at[:, 0], at[:, 1]] = False
    return Floor(ndimage.distance_transform_edt(free) * _CELL, corner)


def spread_places(floor: Floor, start: Float, count: int, clearance: float) -> Float:
    """Choose places (count, 2) far from each other that can be reached from `start` (2,)."""
    reach = _distances(floor, snap_places(floor, start[None], clearance), clearance)[0]
    cells = np.argwhere(np.isfinite(reach))
    points = floor.points_of(cells)
    chosen = [int(np.argmin(np.sum((points - start) ** 2, axis=-1)))]
    gaps = np.full(len(points), np.inf)
    while len(chosen) < count:
        gaps = np.minimum(gaps, np.sum((points - points[chosen[-1]]) ** 2, axis=-1))
        chosen.append(int(np.argmax(np.rint(gaps * 1e4))))
    return points[chosen]


def snap_places(floor: Floor, places: Float, clearance: float) -> Float:
    """Move places (K, 2) to the nearest cells of the largest region that has the clearance in m.

    Raises
    ------
    InvalidInputError
        If no cell has it.
    """
    regions, count = ndimage.label(floor.clearance >= clearance, np.ones((3, 3)))
    if count == 0:
        raise InvalidInputError(f"no place has {clearance} m of free space around it")
    largest = 1 + np.argmax(np.bincount(regions.ravel())[1:])
    points = floor.points_of(np.argwhere(regions == largest))
    away = np.sum((places[:, None] - points) ** 2, axis=-1)
    nearest: Float = points[np.argmin(np.rint(away * 1e6), axis=-1)]
    return nearest


def find_paths(
    floor: Floor, places: Float, legs: NDArray[np.int64], clearance: float
) -> list[Float]:
    """Find smooth paths between places, rather through the middle of free space than along walls.

    Parameters
    ----------
    places
        (K, 2) m; each is moved to the nearest cell that has the clearance.
    legs
        (M, V) indices of the places that each path visits in turn.
    clearance
        Least distance to obstacles, m; rounding corners takes a little of it.

    Returns
    -------
    list of M arrays (P, 2), points 5 cm apart.
    """
    snapped = snap_places(floor, places, clearance)
    fields = _distances(floor, snapped, clearance)
    cells = floor.cells_of(snapped)
    walks: dict[tuple[int, int], NDArray[np.int64]] = {}
    paths = []
    for visits in legs.tolist():
        for pair in pairwise(visits):
            if pair not in walks:
                walks[pair] = _descend(fields[pair[1]], cells[pair[0]])
        steps = [walks[pair] for pair in pairwise(visits)]
        paths.append(_smooth(floor.points_of(np.concatenate(steps))))
    return paths


def _distances(floor: Floor, places: Float, clearance: float) -> Float:
    """Cost (K, H, W) of the way from every cell to each place; whole numbers, inf where none."""
    shape = floor.clearance.shape
    open_ = floor.clearance >= clearance
    # up to 1 m from an obstacle a step costs more: whole numbers sum alike on every machine
    price = 1 + np.rint(4 * np.clip(1.0 - floor.clearance, 0, 1)).astype(np.int64)
    numbers = np.arange(open_.size).reshape(shape)
    starts, ends, costs = [], [], []
    for row, column, length in _NEIGHBOURS:
        here = (slice(0, shape[0] - row), slice(max(0, -column), shape[1] - max(0, column)))
        there = (slice(row, shape[0]), slice(max(0, column), shape[1] - max(0, -column)))
        both = open_[here] & open_[there]
        starts.append(numbers[here][both])
        ends.append(numbers[there][both])
        costs.append(length * (price[here] + price[there])[both])
    graph = sparse.coo_array(
        (np.concatenate(costs).astype(np.float64), (np.concatenate(starts), np.concatenate(ends))),
        shape=(open_.size, open_.size),
    ).tocsr()
    rows, columns = floor.cells_of(places).T
    found = csgraph.dijkstra(graph, directed=False, indices=numbers[rows, columns])
    return np.asarray(found, np.float64).reshape(-1, *shape)


def _descend(field: Float, start: NDArray[np.int64]) -> NDArray[np.int64]:
    """Walk downhill from a cell to the place where the field is 0; cells (P, 2)."""
    padded = np.pad(field, 1, constant_values=np.inf)
    cell = start + 1
    walk = [cell]
    while padded[tuple(cell)] > 0:
        around = padded[cell[0] - 1 : cell[0] + 2, cell[1] - 1 : cell[1] + 2]
        cell = cell + np.array(divmod(int(np.argmin(around)), 3)) - 1
        walk.append(cell)
    return np.array(walk) - 1


def _smooth(points: Float) -> Float:
    """Resample a path of cells every 5 cm and round its corners."""
    even = resample(points, _STEP)
    rounded = ndimage.gaussian_filter1d(even, 0.3 / _STEP, axis=0, mode="nearest")
    return resample(rounded, _STEP)


def resample(points: Float, spacing: float) -> Float:
    """Return points (P, 2) every `spacing` m along a polyline (Q, 2)."""
    along = arc_lengths(points)
    at = np.arange(0.0, along[-1] + spacing / 2, spacing)
    return np.stack([np.interp(at, along, points[:, k]) for k in (0, 1)], axis=-1)


def arc_lengths(points: Float) -> Float:
    """Return the way (P,) from the first point of a polyline (P, 2) to each, m."""
    steps = np.hypot(*np.diff(points, axis=0).T)
    return np.concatenate(((0.0,), np.cumsum(steps)))


@dataclass(frozen=True)
class Drive:
    """A robot's drive.

    Parameters
    ----------
    poses
        (N, 3) f8 x y yaw of the base in the map, true.
    initial_poses
        (N, 3) f8 as a particle filter would estimate them.
    velocity
        (N, 2) f8 vx m/s, wz rad/s.
    """

    poses: Float
    initial_poses: Float
    velocity: Float


def drive(
    floor: Floor, tour: Float, scans: int, rng: np.random.Generator, *, speed: float = 0.9
) -> Drive:
    """Drive along a tour, over again where it is short, slower in bends, sampled at 20 Hz."""
    path = tour_path(floor, tour, speed * scans / RATE_HZ + 2.0, rng)
    way = _progress(path, scans, speed)
    x, y = (np.interp(way, arc_lengths(path), path[:, k]) for k in (0, 1))
    yaw = np.interp(way, arc_lengths(path), _headings(path))
    vx, wz = (np.gradient(v) * RATE_HZ if scans > 1 else np.zeros(1) for v in (way, yaw))
    poses = np.rint(np.stack((x, y, wrap_angle(yaw)), axis=-1) * 1e6) / 1e6
    velocity = np.rint(np.stack((vx, wz), axis=-1) * 1e6) / 1e6
    return Drive(poses, _drifted(poses, rng), velocity)


def tour_path(floor: Floor, tour: Float, length: float, rng: np.random.Generator) -> Float:
    """Return a path (P, 2) of at least `length` m that starts at a random place of the tour."""
    first = int(rng.integers(len(tour)))
    rounds = 2
    while True:
        visits = (first + np.arange(rounds * len(tour) + 1)) % len(tour)
        path = find_paths(floor, tour, visits[None], 0.45)[0]
        if arc_lengths(path)[-1] >= length:
            return path
        rounds *= 2


def _headings(path: Float) -> Float:
    ahead = np.gradient(path, axis=0)
    headings: Float = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    return headings


def _progress(path: Float, scans: int, speed: float) -> Float:
    """Way driven (N,) in m at each scan, from rest; slow in bends, turning almost on the spot."""
    along = arc_lengths(path)
    steps = np.maximum(np.diff(along), 1e-6)
    bend = np.abs(np.diff(_headings(path))) / steps  # rad/m
    square = np.minimum(speed / (1 + 0.35 * bend), _TURN_RATE / np.maximum(bend, 1e-9)) ** 2
    square[0] = min(square[0], 0.2**2)
    # v^2 may change by 2 a s only: backward along the path for braking, forward for starting
    climb = 2 * _ACCELERATION * along[:-1]
    square = np.minimum.accumulate((square + climb)[::-1])[::-1] - climb
    square = np.minimum.accumulate(square - climb) + climb
    arrival = np.concatenate(((0.0,), np.cumsum(steps / np.sqrt(square))))
    times = np.arange(scans) / RATE_HZ
    way: Float = np.interp(times, arrival, along)
    return way


def _drifted(poses: Float, rng: np.random.Generator) -> Float:
    """Add a smoothly drifting error of 8 cm and 2 degrees root mean square."""
    drift = ndimage.gaussian_filter1d(
        rng.standard_normal((len(poses), 3)), 1.5 * RATE_HZ, axis=0, mode="reflect"
    )
    rms = np.sqrt(np.mean(drift**2, axis=0))
    wanted = np.array((0.08 / np.sqrt(2), 0.08 / np.sqrt(2), np.deg2rad(2.0)))
    found = poses + drift / np.maximum(rms, 1e-12) * wanted
    found[:, 2] = wrap_angle(found[:, 2])
    rounded: Float = np.rint(found * 1e6) / 1e6
    return rounded
