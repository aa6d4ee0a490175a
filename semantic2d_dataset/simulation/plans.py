"""Six floor plans, each with all nine classes in it.

A plan draws its rooms and furniture and returns the corners of the tour that a robot makes of
it. Sizes and places vary with the seed by some decimetres.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from semantic2d_dataset.simulation.furniture import Drafter

Point = tuple[float, float]
Tour = tuple[Point, ...]
_WIDTHS = {"door": 0.95, "double": 1.8, "open": 0.95, "elevator": 1.3, "passage": 2.2}
_UP, _LEFT, _DOWN, _RIGHT = 0.0, math.pi / 2, math.pi, -math.pi / 2  # where the front looks


def room(
    pen: Drafter, corners: Sequence[Point], openings: Mapping[int, Sequence[tuple[float, str]]]
) -> None:
    """Draw walls along counter-clockwise corners.

    `openings` gives for a wall (number of its first corner) the kind of each opening and how
    far its middle is from that corner, m.
    """
    for number, start in enumerate(corners):
        end = corners[(number + 1) % len(corners)]
        _wall_with_openings(pen, start, end, sorted(openings.get(number, ())))


def _wall_with_openings(
    pen: Drafter, start: Point, end: Point, openings: Sequence[tuple[float, str]]
) -> None:
    yaw = math.atan2(end[1] - start[1], end[0] - start[0])
    along = np.array((math.cos(yaw), math.sin(yaw)))
    here = start
    for middle, kind in openings:
        half = _WIDTHS[kind] / 2
        left, right = (tuple(start + along * (middle + s * half)) for s in (-1, 1))
        pen.wall(here, left)
        here = right
        # inside lies to the left of the wall, so outward (+y of the opening) is to its right
        _draw_opening(pen, kind, (*(start + along * middle), yaw + math.pi))
    pen.wall(here, end)


def _draw_opening(pen: Drafter, kind: str, at: tuple[float, float, float]) -> None:
    width = _WIDTHS[kind]
    if kind == "elevator":
        pen.elevator(at, width)
    elif kind == "passage":
        pen.passage(at, width, 5.0 + 3.0 * pen.rng.random())
    elif kind == "open":
        pen.open_door(at, width)
    else:
        pen.door(at, width, leaves=2 if kind == "double" else 1)


def _near(pen: Drafter, x: float, y: float, spread: float = 0.08) -> Point:
    dx, dy = spread * (2 * pen.rng.random(2) - 1)
    return x + dx, y + dy


def _turned(pen: Drafter, yaw: float, spread: float = 0.15) -> float:
    return yaw + spread * (2 * pen.rng.random() - 1)


def _seating(pen: Drafter, x: float, y: float, yaw: float) -> None:
    """Draw a sofa, an armchair and a low table between them."""
    c, s = math.cos(yaw), math.sin(yaw)

    def place(u: float, v: float) -> Point:
        return _near(pen, x + c * u - s * v, y + s * u + c * v)

    pen.sofa(*place(0.0, -1.25), yaw)
    pen.armchair(*place(0.3, 1.3), _turned(pen, yaw + math.pi, 0.5))
    pen.table(*place(0.0, 0.0), yaw, 1.1, 0.6)


def _dining(pen: Drafter, x: float, y: float, yaw: float) -> None:
    """Draw a table with four chairs."""
    if pen.rng.random() < 0.4:
        pen.round_table(*_near(pen, x, y))
    else:
        pen.table(*_near(pen, x, y), yaw, 1.2, 0.8)
    draw = (pen.chair, pen.shell_chair)[pen.rng.integers(2)]
    for k in range(4):
        angle = yaw + k * math.pi / 2 + math.pi / 4
        spot = _near(pen, x + 1.0 * math.cos(angle), y + 1.0 * math.sin(angle))
        draw(*spot, _turned(pen, angle + math.pi / 2, 0.4))


def _scatter(pen: Drafter, spots: Sequence[Point]) -> None:
    for x, y in spots:
        pen.clutter(*_near(pen, x, y, 0.15), float(2 * math.pi * pen.rng.random()))


def lobby(pen: Drafter) -> Tour:
    """Draw an entrance hall: elevators on the right, entrance doors on the left, seating inside."""
    w, h = 15.0 + pen.rng.random(), 11.5 + 0.6 * pen.rng.random()
    room(
        pen,
        ((0, 0), (w, 0), (w, h), (0, h)),
        {
            0: [(3.0, "double"), (7.8, "door"), (12.4, "passage")],
            1: [(2.2, "elevator"), (4.2, "elevator"), (6.2, "elevator"), (9.4, "double")],
            2: [(2.5, "door"), (6.4, "open"), (11.2, "double")],
            3: [(2.6, "double"), (5.4, "double"), (8.6, "passage")],
        },
    )
    _seating(pen, 4.6, 3.6, _UP)
    _seating(pen, 9.4, 7.6, _LEFT)
    for x, y in ((2.6, 5.8), (7.0, 5.2), (11.6, 5.4)):
        pen.pillar(*_near(pen, x, y), 0.44, round_=False)
    pen.desk(*_near(pen, 9.9, 1.1), _turned(pen, _UP), 1.3)
    pen.partition(10.3, 5.2, _LEFT, 1.6)
    pen.office_chair(*_near(pen, 9.6, 0.7), 0.0)
    _dining(pen, 4.4, h - 1.5, _turned(pen, 0.0))
    _dining(pen, 13.0, 10.0, _turned(pen, 0.5))
    pen.bin(5.2, 0.5, boxes=3)
    pen.bin(w - 0.4, 7.9)
    pen.bin(w - 0.4, 0.7)
    pen.bin(0.5, 7.0)
    pen.bin(8.3, h - 0.4, boxes=2)
    _scatter(pen, ((0.8, 0.8), (w - 0.6, 9.0), (7.3, 3.2), (0.8, h - 0.9)))
    return ((1.6, 4.4), (3.0, 7.3), (6.3, 7.0), (8.0, 4.6), (7.2, 2.2), (11.0, 3.0), (13.0, 4.0),
            (13.0, 8.0), (11.6, 9.9), (7.4, 10.0), (6.6, 7.6), (4.4, 6.0))  # fmt: skip


def corridor(pen: Drafter) -> Tour:
    """Draw a corridor with doors on both sides, elevators, and two alcoves to sit in."""
    w, h = 26.0 + pen.rng.random(), 3.0 + 0.3 * pen.rng.random()
    room(
        pen,
        ((0, 0), (8.6, 0), (8.6, -3.4), (14.6, -3.4), (14.6, 0), (w, 0), (w, h), (21.4, h),
         (21.4, h + 3.3), (16.4, h + 3.3), (16.4, h), (0, h)),
        {
            0: [(1.4, "door"), (4.0, "open"), (6.8, "door")],
            2: [(1.0, "door")],
            4: [(1.6, "elevator"), (3.6, "elevator"), (7.4, "door"), (9.8, "door")],
            5: [(h / 2, "double")],
            6: [(2.2, "door")],
            10: [(2.0, "door"), (5.2, "elevator"), (8.6, "door"), (11.2, "open"), (14.2, "door")],
            11: [(h / 2, "double")],
        },
    )  # fmt: skip
    pen.sofa(*_near(pen, 11.8, -2.85), _UP, 2.2)
    pen.armchair(*_near(pen, 13.9, -1.2), _LEFT)
    pen.table(*_near(pen, 11.5, -1.4), 0.0, 1.0, 0.6)
    pen.sofa(*_near(pen, 18.9, h + 2.8), _DOWN, 2.2)
    pen.armchair(*_near(pen, 20.8, h + 1.1), _LEFT)
    _dining(pen, 17.7, h + 1.1, 0.0)
    pen.sofa(7.5, h - 0.47, _DOWN, 1.6)
    for x in (1.6, 2.2, 2.8, 22.6, 23.2):
        pen.shell_chair(*_near(pen, x, h - 0.35, 0.03), _DOWN)
    for x in (8.6, 14.6):
        pen.pillar(x, 0.05, 0.42, round_=False)
    pen.pillar(16.4, h - 0.05, 0.42, round_=False)
    pen.pillar(21.4, h - 0.05, 0.42, round_=False)
    pen.bin(5.2, 0.33)
    pen.bin(13.4, h - 0.33, boxes=2)
    pen.bin(19.6, 0.33)
    pen.table(*_near(pen, 15.3, h - 0.42, 0.02), 0.0, 1.2, 0.5)
    _scatter(pen, ((0.5, h - 0.5), (13.9, -2.9), (w - 0.6, 0.5)))
    return ((1.4, 1.4), (7.0, 1.3), (11.5, 0.4), (15.6, 1.4), (18.9, h - 0.2), (22.0, 1.8),
            (w - 1.6, 1.6), (20.0, 1.5), (12.0, 1.4))  # fmt: skip


def office(pen: Drafter) -> Tour:
    """Draw an office floor: rows of desks between partitions, a waiting corner, two elevators."""
    w, h = 15.5 + pen.rng.random(), 12.0 + 0.6 * pen.rng.random()
    room(
        pen,
        ((0, 0), (w, 0), (w, h), (0, h)),
        {
            0: [(2.0, "door"), (5.0, "open"), (8.4, "door"), (12.6, "double")],
            1: [(2.4, "elevator"), (4.6, "elevator"), (7.6, "double")],
            2: [(2.6, "door"), (6.0, "door"), (9.6, "open"), (13.0, "door")],
            3: [(2.4, "elevator"), (6.0, "passage")],
        },
    )
    for row, y in enumerate((4.4, 7.4)):
        for x in (3.0, 5.2, 9.4):
            pen.partition(x, y, 0.0, 2.1)
            pen.table(*_near(pen, x, y + 0.5, 0.03), 0.0, 1.6, 0.75)
            pen.table(*_near(pen, x, y - 0.5, 0.03), 0.0, 1.6, 0.75)
            pen.office_chair(*_near(pen, x, y - 1.05), float(pen.rng.random()))
            pen.office_chair(*_near(pen, x, y + 1.05), float(pen.rng.random()))
        pen.pillar(7.2, y + 0.2 * row, 0.42, round_=False)
    pen.pillar(12.0, 4.6, 0.42, round_=False)
    pen.pillar(12.0, 8.4, 0.42, round_=False)
    pen.sofa(*_near(pen, w - 3.2, h - 0.6), _DOWN, 2.2)
    pen.sofa(*_near(pen, w - 0.6, h - 2.4), _LEFT, 2.0)
    pen.sofa(*_near(pen, w - 0.6, 1.0 + 5.2), _LEFT, 1.5)
    pen.sofa(*_near(pen, 10.6, 0.6), _UP, 2.0)
    pen.sofa(*_near(pen, 4.2, h - 0.6), _DOWN, 1.6)
    pen.sofa(*_near(pen, 6.8, 0.6), _UP, 1.6)
    pen.desk(*_near(pen, 0.9, 7.0 - 3.0), _LEFT, 1.4)
    pen.table(*_near(pen, w - 2.6, h - 2.2), 0.0, 1.2, 0.7)
    for x, y in ((7.6, h - 0.4), (w - 0.4, 1.0), (3.6, 0.4), (14.3, 0.4)):
        pen.bin(x, y)
    pen.bin(10.6, h - 0.4, boxes=2)
    pen.bin(0.4, 8.4, math.pi / 2, boxes=2)
    _scatter(pen, ((0.7, 0.7), (0.7, h - 0.7), (11.4, 6.0), (w - 0.7, 8.2)))
    return ((1.3, 6.0), (7.2, 5.9), (11.0, 3.4), (13.4, 3.6), (13.2, 7.6), (11.0, h - 1.8),
            (7.2, h - 2.4), (2.0, h - 2.4), (1.2, 2.6), (6.0, 2.2), (11.0, 2.4))  # fmt: skip


def lounge(pen: Drafter) -> Tour:
    """Draw a lounge: seating groups and chairs, a kitchen counter, round pillars."""
    w, h = 13.5 + pen.rng.random(), 10.5 + 0.6 * pen.rng.random()
    room(
        pen,
        ((0, 0), (w, 0), (w, h), (0, h)),
        {
            0: [(2.2, "double"), (6.6, "door"), (11.4, "open")],
            1: [(2.0, "elevator"), (4.0, "elevator"), (7.6, "double")],
            2: [(2.4, "door"), (5.6, "double"), (10.0, "door")],
            3: [(2.2, "open"), (5.4, "double"), (8.6, "door")],
        },
    )
    _seating(pen, 4.2, 2.8, _UP)
    _seating(pen, 9.2, 7.4, _UP)
    _dining(pen, 9.6, 2.6, 0.3)
    pen.partition(2.6, 6.6, 0.0, 2.4)
    pen.partition(7.7, 5.2, math.pi / 2, 1.8)
    pen.chair(*_near(pen, 2.2, 7.3), _turned(pen, _UP))
    for x, y in ((6.2, 5.0), (2.0, 5.0), (11.4, 5.4)):
        pen.pillar(*_near(pen, x, y), 0.42, round_=True)
    pen.desk(*_near(pen, 4.6, h - 0.9), _DOWN, 1.6)
    for x, y in ((8.4, 0.4), (0.4, 3.6), (w - 0.4, 5.6), (6.6, h - 0.4)):
        pen.bin(x, y)
    pen.bin(w - 0.4, 0.6, math.pi / 2, boxes=2)
    _scatter(pen, ((0.6, 0.6), (0.6, h - 0.6), (6.9, 8.6)))
    return ((1.4, 4.2), (4.6, 5.4), (6.7, 3.8), (7.6, 1.7), (11.6, 2.2), (12.2, 4.2), (9.4, 5.1),
            (6.4, 6.4), (5.4, 8.2), (1.6, 6.6), (4.4, 5.6))  # fmt: skip


def pillar_hall(pen: Drafter) -> Tour:
    """Draw a hall: two rows of round pillars, benches between them, doors all around."""
    w, h = 20.0 + pen.rng.random(), 11.0 + 0.6 * pen.rng.random()
    room(
        pen,
        ((0, 0), (w, 0), (w, h), (0, h)),
        {
            0: [
                (2.4, "double"),
                (6.2, "door"),
                (9.0, "elevator"),
                (11.0, "elevator"),
                (13.0, "elevator"),
                (16.6, "double"),
            ],
            1: [(3.0, "door"), (h / 2 + 1.2, "passage")],
            2: [(3.4, "double"), (8.0, "door"), (11.4, "open"), (16.8, "double")],
            3: [(3.0, "door"), (h / 2 + 1.0, "double")],
        },
    )
    for x in (3.4, 7.8, 12.2, 16.6):
        for y in (3.6, h - 3.6):
            pen.pillar(*_near(pen, x, y, 0.03), 0.44, round_=True)
    for x in (5.6, 14.4):
        pen.sofa(*_near(pen, x, 3.6), _UP, 2.0)
        pen.sofa(*_near(pen, x, h - 3.6), _DOWN, 2.0)
    pen.sofa(*_near(pen, 4.4, 0.6), _UP, 2.0)
    pen.sofa(*_near(pen, 13.9, h - 0.6), _DOWN, 2.0)
    pen.desk(*_near(pen, 9.4, h / 2), _turned(pen, 0.0), 1.6)
    pen.desk(*_near(pen, w - 0.8, 1.6), _LEFT, 1.4)
    _dining(pen, 13.6, h / 2, 0.0)
    pen.partition(6.6, h / 2, _LEFT, 2.2)
    _dining(pen, 1.6, h - 1.6, 0.4)
    for x, y in ((7.4, 0.4), (15.4, h - 0.4), (0.4, 4.2), (w - 0.4, 4.8)):
        pen.bin(x, y)
    pen.bin(w - 0.4, h - 1.6, math.pi / 2, boxes=2)
    pen.bin(0.4, 1.2, math.pi / 2, boxes=2)
    _scatter(pen, ((0.6, h / 2 - 2.6), (w - 2.0, 0.6), (5.6, h / 2), (10.6, h - 0.6)))
    return ((1.6, 2.2), (5.6, 2.1), (10.0, 2.1), (12.2, 4.8), (10.0, 5.0), (7.6, 4.6), (4.2, 6.6),
            (6.0, h - 2.1), (12.0, h - 2.1), (16.0, h - 2.0), (18.6, 6.6), (16.4, 2.1))  # fmt: skip


def cafeteria(pen: Drafter) -> Tour:
    """Draw a cafeteria: rows of tables with chairs, benches along the wall, a counter."""
    w, h = 15.0 + pen.rng.random(), 11.0 + 0.6 * pen.rng.random()
    room(
        pen,
        ((0, 0), (w, 0), (w, h - 3.4), (w - 4.4, h - 3.4), (w - 4.4, h), (0, h)),
        {
            0: [(2.4, "double"), (5.4, "double"), (7.8, "door"), (12.4, "double")],
            1: [(2.4, "elevator"), (4.6, "elevator")],
            2: [(2.2, "double")],
            3: [(1.8, "door")],
            4: [(2.6, "door"), (7.2, "open")],
            5: [(2.6, "passage"), (7.0, "double")],
        },
    )
    for x, y in ((3.4, 3.2), (6.6, 6.0)):
        _dining(pen, x, y, _turned(pen, 0.0))
    pen.partition(3.6, 5.2, 0.0, 2.6)
    pen.partition(9.4, 5.2, 0.0, 2.6)
    for x in (5.2, 7.8):
        pen.pillar(*_near(pen, x, 3.6 if x < 6 else 3.4, 0.04), 0.45, round_=x < 6)
    pen.pillar(w - 4.4, h - 3.4, 0.5, round_=False)
    pen.pillar(12.2, 4.6, 0.45, round_=True)
    pen.sofa(*_near(pen, 2.1, h - 0.5, 0.03), _DOWN, 2.2)
    pen.sofa(*_near(pen, 9.7, 0.5, 0.03), _UP, 2.0)
    pen.sofa(*_near(pen, 0.55, 5.0, 0.03), _RIGHT, 1.6)
    pen.sofa(*_near(pen, w - 0.6, 6.6, 0.03), _LEFT, 1.4)
    pen.desk(*_near(pen, 9.0, h - 1.5), _DOWN, 2.6)
    pen.bin(4.2, h - 0.4)
    pen.bin(6.6, h - 0.4, boxes=2)
    pen.bin(w - 0.4, 0.8, math.pi / 2, boxes=2)
    pen.bin(0.4, 1.0)
    pen.bin(0.4, h - 0.6)
    _scatter(pen, ((0.6, 3.4), (10.4, 7.3), (13.4, 0.6)))
    return ((1.7, 1.6), (5.0, 1.6), (8.2, 1.7), (11.6, 2.4), (13.2, 5.0), (11.4, 6.9), (8.2, 7.6),
            (5.0, 7.4), (1.8, 7.6), (1.9, 4.4))  # fmt: skip


PLANS: dict[str, Callable[[Drafter], Tour]] = {
    "lobby": lobby,
    "corridor": corridor,
    "office": office,
    "lounge": lounge,
    "pillar-hall": pillar_hall,
    "cafeteria": cafeteria,
}
