"""People on two legs: walkers, people who stand, and groups who talk."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.simulation import sensors as material
from semantic2d_dataset.simulation.furniture import PERSON
from semantic2d_dataset.simulation.trajectories import (
    Floor,
    arc_lengths,
    find_paths,
    spread_places,
)

Float = NDArray[np.float64]
_WALK_CLEARANCE = 0.4  # m that walkers keep from obstacles
_STAND_CLEARANCE = 0.7  # m, for a group and its ring
_PERSONAL_SPACE = 0.55  # m: how far walkers step aside for the robot


@dataclass(frozen=True)
class Walker:
    """One person.

    Parameters
    ----------
    path
        (P, 2) f8, m: walked to its end and back again; one point for somebody who stands.
    speed
        m/s.
    start
        Way along the path at time 0, m.
    heading
        rad, of somebody who stands.
    stride
        Way from one step of a foot to its next, m.
    leg_radius, leg_gap
        Radius of a leg, and sideways distance of the two, m.
    shade
        Brightness of the clothes, relative.
    """

    path: Float
    speed: float
    start: float
    heading: float
    stride: float
    leg_radius: float
    leg_gap: float
    shade: float


def walk(walkers: tuple[Walker, ...], times: Float) -> Float:
    """Return where the legs are.

    Parameters
    ----------
    times
        (N,) f8, s.

    Returns
    -------
    (N, 2 P, 3) f8 x y radius in m; the legs of one person are neighbours.
    """
    if not walkers:
        return np.zeros((len(times), 0, 3))
    return np.concatenate([_legs(walker, times) for walker in walkers], axis=1)


def step_aside(legs: Float, robot: Float) -> Float:
    """Let people (N, 2 P, 3) give way to a robot at (N, 2), smoothly and both legs alike."""
    pairs = legs.reshape(len(legs), -1, 2, 3)
    away = pairs[..., :2].mean(axis=2) - robot[:, None]
    distance = np.maximum(np.sqrt(np.sum(away**2, axis=-1)), 1e-3)
    push = np.maximum(0.0, 2 * _PERSONAL_SPACE - distance) / 2
    moved = pairs.copy()
    moved[..., :2] += (away * (push / distance)[..., None])[:, :, None]
    return moved.reshape(legs.shape)


def populate(
    floor: Floor, robot_path: Float, count: int, rng: np.random.Generator
) -> tuple[Walker, ...]:
    """Fill a floor with people: half of them walk, the others stand alone or in groups.

    Parameters
    ----------
    robot_path
        (N, 2) m: nobody stands in the way of the robot.
    count
        How many people, at least 0.
    """
    walking = (count + 1) // 2
    walkers = _walkers(floor, robot_path[0], walking, rng)
    spots = _standing_spots(floor, robot_path)
    standing: list[Walker] = []
    while len(standing) < count - walking and len(spots):
        middle = spots[rng.integers(len(spots))]
        size = min(int(rng.integers(1, 4)), count - walking - len(standing))
        standing += _group(middle, size, rng)
        spots = spots[np.sum((spots - middle) ** 2, axis=-1) > 4.0]
    return (*walkers, *standing)


def clothes(walkers: tuple[Walker, ...]) -> material.Surfaces:
    """Return class, material and shade of the legs, in the order of `walk`."""
    count = 2 * len(walkers)
    shades = np.repeat([walker.shade for walker in walkers], 2).astype(np.float64)
    return material.Surfaces(
        np.full(count, PERSON, np.uint8), np.full(count, material.CLOTH, np.uint8), shades
    )


def _walkers(floor: Floor, start: Float, count: int, rng: np.random.Generator) -> list[Walker]:
    places = spread_places(floor, start, 12, _WALK_CLEARANCE)
    legs = np.array([rng.permutation(len(places))[:4] for _ in range(count)]).reshape(-1, 4)
    found = []
    for path in find_paths(floor, places, legs, _WALK_CLEARANCE):
        start_m = float(rng.random()) * 2 * arc_lengths(path)[-1]
        found.append(_person(path, 0.8 + 0.6 * float(rng.random()), start_m, 0.0, rng))
    return found


def _standing_spots(floor: Floor, robot_path: Float) -> Float:
    """Places (K, 2) from 1.6 to 3.2 m beside the robot's way with room to stand."""
    points = floor.points_of(np.argwhere(floor.clearance >= _STAND_CLEARANCE))
    coarse = robot_path[:: max(1, len(robot_path) // 200)]
    nearest = np.min(np.sum((points[:, None] - coarse) ** 2, axis=-1), axis=-1)
    spots: Float = points[(nearest > 1.6**2) & (nearest < 3.2**2)]
    return spots


def _group(middle: Float, size: int, rng: np.random.Generator) -> list[Walker]:
    """People who stand in a ring and look at its middle; one alone looks anywhere."""
    first = 2 * math.pi * rng.random()
    members = []
    for k in range(size):
        angle = first + 2 * math.pi * k / size
        spot = middle + (0.0 if size == 1 else 0.42) * np.array((math.cos(angle), math.sin(angle)))
        members.append(_person(spot[None], 0.0, 0.0, angle + math.pi, rng))
    return members


def _person(
    path: Float, speed: float, start: float, heading: float, rng: np.random.Generator
) -> Walker:
    stride, radius, gap, shade = rng.random(4).tolist()
    return Walker(
        path, speed, start, heading, 1.15 + 0.3 * stride, 0.058 + 0.014 * radius,
        0.19 + 0.07 * gap, 0.7 + 0.6 * shade,
    )  # fmt: skip


def _legs(walker: Walker, times: Float) -> Float:
    """Positions and radii (N, 2, 3) of one person's legs.

    A foot rests on the ground for half a stride while the body passes over it, then swings to
    the front at twice the speed; the other foot does the same half a stride later.
    """
    if len(walker.path) == 1:
        body = np.broadcast_to(walker.path[0], (len(times), 2))
        ahead = np.broadcast_to((math.cos(walker.heading), math.sin(walker.heading)), body.shape)
        swing = np.zeros(len(times))
    else:
        body, ahead, way = _stroll(walker, times)
        phase = way / walker.stride % 1.0
        swing = walker.stride * (np.abs(phase - 0.5) - 0.25)
    aside = np.stack((-ahead[:, 1], ahead[:, 0]), axis=-1) * (walker.leg_gap / 2)
    offset = ahead * swing[:, None]
    centres = np.stack((body + aside + offset, body - aside - offset), axis=1)
    radii = np.full((len(times), 2, 1), walker.leg_radius)
    return np.concatenate((centres, radii), axis=-1)


def _stroll(walker: Walker, times: Float) -> tuple[Float, Float, Float]:
    """Body (N, 2), direction (N, 2) and way (N,) of somebody who walks there and back."""
    along = arc_lengths(walker.path)
    way = walker.start + walker.speed * times
    place = along[-1] - np.abs(way % (2 * along[-1]) - along[-1])
    outward = np.where(way % (2 * along[-1]) < along[-1], 1.0, -1.0)

    def at(s: Float) -> Float:
        return np.stack([np.interp(s, along, walker.path[:, k]) for k in (0, 1)], axis=-1)

    tangent = at(place + 0.15) - at(place - 0.15)
    length = np.maximum(np.sqrt(np.sum(tangent**2, axis=-1)), 1e-9)
    return at(place), tangent * (outward / length)[:, None], way
