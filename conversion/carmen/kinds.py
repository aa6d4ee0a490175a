"""What a CARMEN log tells of each of its lasers: what stands for no return, and the mount."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from conversion.carmen.lines import LAYOUTS, Angles, LaserLine, angles_of, range_max_of
from conversion.inspection.scan_statistics import CELL_M, ScanStatistics

SAME_RANGE_M = 0.005
"""Half of the centimetres that logs are rounded to."""

# Codes (no echo, dazzled, ...) of the SICK lasers whose ranges are 13 bits of centimetres.
_SICK_CODES = range(8183, 8192)
# The same codes in 13, 14 and 15 bits of millimetres, and what CARMEN's programs cut ranges to.
_CUT_OFFS_M = (8.18, 8.19, 16.38, 32.76, 32.77, 50.0, 80.0)
_FEW = 3  # more of the largest range than chance would make
_VARIED = 100  # different centimetres, so that a value that recurs among them was chosen
_RIGID = 2e-3  # m and rad: how far the laser may move on the robot, by rounding

Pose = tuple[float, float, float]
"""x, y in m, yaw in rad."""


class NoReturn(NamedTuple):
    """A range that stands for no return, m, and the share of all beams that it is."""

    value_m: float
    share: float


class LaserKind:
    """Collect the lines of one kind.

    Parameters
    ----------
    line
        The first of them.
    parameters
        The numbers among the log's PARAM lines, by name.
    """

    def __init__(self, line: LaserLine, parameters: Mapping[str, float]) -> None:
        self.name = line.kind
        self.lines = 0
        self.poses = 0
        self._assumed: dict[int, Angles] = {}
        self._limit_m = range_max_of(line, parameters)
        self._statistics = ScanStatistics(0.0, self._limit_m)
        self._beams = 0
        self._largest_m = 0.0
        self._codes = np.zeros(len(_SICK_CODES), np.int64)
        self._offset: Pose | None = None
        self._low: NDArray[np.float64] = np.full(3, np.inf)
        self._high: NDArray[np.float64] = np.full(3, -np.inf)

    def add(self, line: LaserLine, parameters: Mapping[str, float]) -> None:
        """Add a line.

        Raises
        ------
        ValueError
            If it holds something that is no number.
        """
        self.lines += 1
        self._add_ranges(line.values(line.ranges))
        angles = angles_of(line, parameters)
        if angles.assumed:
            self._assumed[line.beams] = angles
        if LAYOUTS[line.kind.encode()].posed:
            self._add_poses(*line.poses())

    @property
    def no_return(self) -> tuple[NoReturn, ...]:
        """Ranges that stand for no return, by value.

        These are the SICK codes, a largest range that is a usual cut-off or the stated limit, and
        what recurs beyond almost all others where these vary.
        """
        found = {r.value_m: r.share for r in self._recurring()}
        largest = round(self._largest_m, 2)
        count = self._count_of(self._largest_m)
        if count >= _FEW and largest in (*_CUT_OFFS_M, round(self._limit_m, 2)):
            found[largest] = count / self._beams
        if self._largest_m < _SICK_CODES[-1] / 100 + SAME_RANGE_M:
            for code, number in zip(_SICK_CODES, self._codes.tolist(), strict=True):
                found |= {code / 100: number / self._beams} if number else {}
        return tuple(NoReturn(value, share) for value, share in sorted(found.items()))

    @property
    def is_rigid(self) -> bool:
        """Whether the laser stays where it is on the robot, so that both poses mean one."""
        return self._offset is not None and bool((self._high - self._low <= _RIGID).all())

    @property
    def mount(self) -> Pose:
        """The laser on the robot; identity where the two poses tell nothing of that."""
        return self._offset if self.is_rigid and self._offset is not None else (0.0, 0.0, 0.0)

    def notices(self, *, corrected: bool) -> Iterator[str]:
        """Say what was guessed; `corrected` is whether the log's poses were, by a SLAM."""
        if self.no_return:
            values = ", ".join(f"{r.value_m:g} m ({r.share:.2%})" for r in self.no_return)
            yield f"{self.name}: read as no return (+inf): {values} of the beams"
        for beams, angles in self._assumed.items():
            yield (
                f"{self.name}: {beams} beams and no angles: taken to cover 180 degrees in steps of "
                f"{math.degrees(angles.step):.4f}; --lidar LIDAR.yaml says what they are"
            )
        if self.is_rigid and not corrected:
            yield (
                f"{self.name}: nothing says that its poses were corrected by a SLAM; where they "
                "are plain odometry, pass --poses none"
            )

    def _recurring(self) -> Iterator[NoReturn]:
        if np.count_nonzero(self._statistics.histogram) >= _VARIED:
            for found in self._statistics.recurring:
                if found.no_return and found.value_m > 0:
                    yield NoReturn(round(found.value_m, 2), found.share)

    def _count_of(self, range_m: float) -> int:
        cell = int(range_m / CELL_M)
        return int(self._statistics.histogram[max(cell - 1, 0) : cell + 2].sum())

    def _add_ranges(self, ranges: NDArray[np.float32]) -> None:
        if not ranges.size:
            return
        self._statistics.add(ranges[None])
        self._beams += ranges.size
        finite = ranges[np.isfinite(ranges)]
        self._largest_m = max(self._largest_m, float(finite.max(initial=0.0)))
        centimetres = np.rint(finite[finite > _SICK_CODES[0] / 100 - SAME_RANGE_M] * 100.0)
        codes = centimetres[centimetres <= _SICK_CODES[-1]].astype(np.int64) - _SICK_CODES[0]
        self._codes += np.bincount(codes, minlength=len(_SICK_CODES))

    def _add_poses(self, laser: Pose, robot: Pose) -> None:
        if not all(map(math.isfinite, (*laser, *robot))):
            return
        c, s = math.cos(robot[2]), math.sin(robot[2])
        dx, dy = laser[0] - robot[0], laser[1] - robot[1]
        yaw = math.remainder(laser[2] - robot[2], 2 * math.pi)
        if self._offset is not None:  # so that a laser that looks backward does not jump at pi
            yaw = self._offset[2] + math.remainder(yaw - self._offset[2], 2 * math.pi)
        offset = (c * dx + s * dy, c * dy - s * dx, yaw)
        self._offset = self._offset or offset
        self.poses += 1
        np.minimum(self._low, offset, out=self._low)
        np.maximum(self._high, offset, out=self._high)
