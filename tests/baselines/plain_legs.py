"""Leg detection again, scan by scan in plain Python: to check the fast one, and to time it by."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import grey_opening

from baselines.leg_detector import LegParameters


class Edge(NamedTuple):
    before: int
    after: int
    falls: bool


class Person(NamedTuple):
    pattern: int
    legs: tuple[tuple[int, int], tuple[int, int]]


def people_of(
    ranges: np.ndarray,
    bearings: np.ndarray,
    parameters: LegParameters,
    range_min: float,
    range_max: float,
) -> list[Person]:
    """The people of one scan, pattern by pattern."""
    r = ranges.astype(float)
    usable = (r > 0) & (r >= range_min) & (r < range_max)
    filled = np.where(usable, r, range_max)
    smooth = grey_opening(filled, parameters.window_beams, mode="nearest")
    return Search(smooth, bearings, parameters).run()


class Search:
    """One scan, smoothed; piece i lies between edges i and i + 1."""

    def __init__(self, r: np.ndarray, bearings: np.ndarray, parameters: LegParameters) -> None:
        self.r, self.bearings, self.p = r, bearings, parameters
        self.points = r[:, None] * np.stack((np.cos(bearings), np.sin(bearings)), axis=-1)
        self.edges = self.find_edges()
        self.kinds = "".join("F" if edge.falls else "R" for edge in self.edges)
        self.used: set[int] = set()
        self.people: list[Person] = []

    def run(self) -> list[Person]:
        self.find_apart()
        self.find_straddling()
        for m in self.fronts(0):
            if self.p.min_together_m <= self.width(m) <= self.p.max_together_m:
                self.take(2, m, m)
        return self.people

    def find_apart(self) -> None:
        for m in self.fronts(0):
            if m not in self.used and self.is_leg(m):
                end = self.edges[m + 1].before
                near = (
                    n
                    for n in self.fronts(m + 2)
                    if self.apart(end, self.edges[n].after) <= self.p.max_gap_m
                )
                n = next(filter(self.is_leg, near), None)
                if n is not None:
                    self.take(0, m, n)

    def find_straddling(self) -> None:
        for m in range(len(self.kinds) - 2):
            known = (
                self.kinds[m : m + 3] in ("FFR", "FRR") and self.is_leg(m) and self.is_leg(m + 1)
            )
            free = self.used.isdisjoint((m, m + 1, m + 2))
            step = self.apart(self.edges[m + 1].before, self.edges[m + 1].after)
            if known and free and step <= self.p.max_gap_m:
                self.take(1, m, m + 1)

    def find_edges(self) -> list[Edge]:
        edges: list[Edge] = []
        jumps = np.diff(self.r)
        for k in np.flatnonzero(np.abs(jumps) > self.p.edge_m).tolist():
            falls = bool(jumps[k] < 0)
            again = bool(edges) and edges[-1].falls == falls
            if again and self.apart(edges[-1].after, k) < self.p.same_edge_m:
                edges[-1] = edges[-1]._replace(after=k + 1)
            else:
                edges.append(Edge(k, k + 1, falls))
        return edges

    def fronts(self, start: int) -> list[int]:
        found = (i for i in range(start, len(self.kinds) - 1) if self.kinds[i : i + 2] == "FR")
        return [i for i in found if i not in self.used]

    def is_leg(self, i: int) -> bool:
        return self.p.min_leg_m <= self.width(i) <= self.p.max_leg_m

    def width(self, i: int) -> float:
        first, last = self.span(i)
        if self.r[first] > self.p.max_distance_m:
            return 0.0
        mean = (self.r[first] + self.r[last]) / 2
        return self.apart(first, last) + mean * (self.bearings[1] - self.bearings[0])

    def span(self, i: int) -> tuple[int, int]:
        return self.edges[i].after, self.edges[i + 1].before

    def apart(self, i: int, j: int) -> float:
        return float(np.hypot(*(self.points[i] - self.points[j])))

    def take(self, pattern: int, m: int, n: int) -> None:
        self.used.update((m, m + 1, n, n + 1))
        self.people.append(Person(pattern, (self.span(m), self.span(n))))
