"""The tf tree of a recording: chains between frames, poses along them, and rigid mounts."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from conversion.messages.recordings import TransformSample
from conversion.messages.spill import Spill
from conversion.messages.tracks import TrackLog, default_gap_s, planar
from semantic2d_dataset.scene.geometry import compose, invert

Mount = tuple[float, float, float, float, float, float]
_BASES = ("base_link", "base_footprint")
_RIGID = 1e-3  # m, and parts of a quaternion: how far a mount may move
_POSTDATED_NS = 100_000_000  # below that, publishers' latencies explain a lead
_LEVEL = 0.9  # cosine of the tilt up to which a transform is one of the plane


class Edge(NamedTuple):
    """A transform on a chain: from parent to child, taken backward or as it is."""

    log: TrackLog
    static: bool
    inverse: bool

    @property
    def constant(self) -> NDArray[np.float64]:
        """The first value as a (4, 4) matrix."""
        matrix = _matrix(self.log.first)
        if self.inverse:
            matrix[:3, :3] = matrix[:3, :3].T
            matrix[:3, 3] = -matrix[:3, :3] @ matrix[:3, 3]
        return matrix

    @property
    def is_rigid(self) -> bool:
        """Whether the transform never moves."""
        return self.static or bool((self.log.extent <= _RIGID).all())

    @property
    def is_level(self) -> bool:
        """Whether the transform keeps z upward, in every sample."""
        return self.log.upright >= _LEVEL


class Transforms:
    """Collect transforms, then answer for chains of them.

    All samples are kept, 40 bytes each, in one temporary file once they are many.
    """

    def __init__(self) -> None:
        self._spill = Spill()
        self._logs: dict[tuple[str, str], TrackLog] = {}
        self._static: set[tuple[str, str]] = set()
        self._neighbours: dict[str, list[str]] = {}

    @property
    def frames(self) -> tuple[str, ...]:
        """Every frame that occurs."""
        return tuple(sorted(self._neighbours))

    def moving(self) -> Iterator[TrackLog]:
        """Yield the samples of every transform that is not static."""
        return (log for key, log in self._logs.items() if key not in self._static)

    def add(self, sample: TransformSample, record_ns: int) -> None:
        """Add a transform that was recorded at a time."""
        stamp_ns, parent, child, values, static = sample
        log = self._logs.get((parent, child))
        if log is None:
            log = self._logs[parent, child] = TrackLog(self._spill)
            self._neighbours.setdefault(parent, []).append(child)
            self._neighbours.setdefault(child, []).append(parent)
        if static:
            self._static.add((parent, child))
        log.add(stamp_ns, record_ns, values)

    def chain(self, parent: str, child: str) -> tuple[str, ...] | None:
        """Return the frames from one to another, or None where nothing connects them."""
        came_from = {parent: parent}
        queue = deque((parent,))
        while queue and child not in came_from:
            frame = queue.popleft()
            for neighbour in self._neighbours.get(frame, ()):
                if neighbour not in came_from:
                    came_from[neighbour] = frame
                    queue.append(neighbour)
        if child not in came_from or child not in self._neighbours:
            return None
        frames = [child]
        while frames[-1] != parent:
            frames.append(came_from[frames[-1]])
        return tuple(reversed(frames))

    def base_of(self, lidar_frame: str) -> str | None:
        """Guess the robot's frame: base_link, else base_footprint; one that carries the lidar."""
        named = [f for name in _BASES for f in self.frames if f.rsplit("/", 1)[-1] == name]
        carrying = [frame for frame in named if self.chain(frame, lidar_frame)]
        return next(iter(carrying or named), None)

    def mount(self, base: str, lidar_frame: str) -> Mount | None:
        """Return x y z roll pitch yaw of the lidar on its base, or None without a rigid chain."""
        chain = self.chain(base, lidar_frame)
        if chain is None or not all(edge.is_rigid for edge in self._edges(chain)):
            return None
        matrix = np.eye(4)
        for edge in self._edges(chain):
            matrix = matrix @ edge.constant
        return _mount_of(matrix) if np.isfinite(matrix).all() else None

    def poses(
        self, chain: tuple[str, ...], at_ns: NDArray[np.int64], stamps: str, max_gap_s: float | None
    ) -> tuple[NDArray[np.float64], float, float]:
        """Return the poses of the last frame of a chain in its first, in the plane.

        The moving transform nearest the robot is odometry: it is interpolated, never
        extrapolated. Those before it are corrections, such as map to odom, which change
        slowly: they also hold for a while before their first and after their last sample. A
        localiser post-dates them (transform_tolerance of amcl, 1 s in Nav2); against the lead
        of the odometry's stamps over their record times that is seen, and undone.

        Returns
        -------
        poses, max_gap_s, postdated_s
            (N, 3) f8, NaN where unknown; the gap that was allowed; the largest lead undone.
        """
        edges = list(self._edges(chain))
        moving = [edge for edge in edges if not edge.is_rigid]
        moving = moving or [edge for edge in edges if not edge.static]  # a robot at rest
        last = moving[-1].log if moving else None
        tracks = {id(edge.log): edge.log.track(stamps) for edge in moving}
        gap = default_gap_s(*tracks.values()) if max_gap_s is None else max_gap_s
        found, postdated = np.zeros((at_ns.size, 3)), 0
        for edge in edges:
            if edge not in moving or last is None:
                step = planar(edge.log.last[None])
            else:
                held, lead = edge.log is not last, edge.log.lead_ns - last.lead_ns
                lead = lead if stamps == "header" and lead > _POSTDATED_NS else 0
                step = tracks[id(edge.log)].shifted(-lead).sample(at_ns, gap, held=held)
                postdated = max(postdated, lead)
            found = compose(found, invert(step) if edge.inverse else step)
        return found, gap, postdated / 1e9

    def is_level(self, chain: tuple[str, ...]) -> bool:
        """Tell whether a chain stays in the plane (its last transform may flip the lidar)."""
        return all(edge.is_level for edge in list(self._edges(chain))[:-1])

    def _edges(self, chain: tuple[str, ...]) -> Iterator[Edge]:
        for pair in pairwise(chain):
            inverse = pair not in self._logs
            key = (pair[1], pair[0]) if inverse else pair
            yield Edge(self._logs[key], key in self._static, inverse)


def _matrix(value: NDArray[np.float64]) -> NDArray[np.float64]:
    x, y, z, w = value[3:] / (np.linalg.norm(value[3:]) or 1.0)
    matrix = np.eye(4)
    matrix[:3, :3] = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    matrix[:3, 3] = value[:3]
    return matrix


def _mount_of(matrix: NDArray[np.float64]) -> Mount:
    """Fixed-axis angles of R = Rz(yaw) Ry(pitch) Rx(roll), as `scene.geometry.rotation_matrix`."""
    roll = np.arctan2(matrix[2, 1], matrix[2, 2])
    pitch = np.arcsin(np.clip(-matrix[2, 0], -1.0, 1.0))
    yaw = np.arctan2(matrix[1, 0], matrix[0, 0])
    x, y, z, *angles = (float(value) + 0.0 for value in (*matrix[:3, 3], roll, pitch, yaw))
    return (x, y, z, angles[0], angles[1], angles[2])  # + 0.0 turns -0.0 into 0.0
