"""Poses that agree with their neighbours in time: alignment where it is sure, odometry elsewhere.

A scan between two bare walls says nothing of where along them it was taken. Over the whole
recording, the aligned poses with their covariances, the motion from scan to scan and the rough
poses are weighed against each other: least squares over a chain, whose normal equations are block
tridiagonal (Thrun, Burgard and Fox, "Probabilistic Robotics", chapter 11).
"""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from salsa.alignment import Alignment
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.scene.geometry import compose, interpolate_poses, invert, wrap_angle

Float = NDArray[np.float64]

_JUMPS = (100.0, 30.0, 10.0, 3.0, 3.0, 3.0)
"""Standard deviations: a motion farther off begins to lose its say; less and less is let pass."""


@dataclass(frozen=True)
class Smoothing:
    """What is trusted how much: standard deviations.

    Parameters
    ----------
    motion_m, motion_rad
        Of the motion from scan to scan as the rough poses tell it, for one second; they grow with
        the root of time.
    motion_share
        Of that motion, relative to the way.
    align_m, align_rad
        Least of an aligned pose, whatever its covariance: the map is not exact.
    rough_m, rough_rad
        Of the rough poses themselves; many, since those of neighbours are wrong alike.
    odometry
        Stream of the sequence that tells the motion, such as ``odom``; the rough poses where "".
    """

    motion_m: float = 0.02
    motion_rad: float = 0.01
    motion_share: float = 0.05
    align_m: float = 0.01
    align_rad: float = 0.003
    rough_m: float = 10.0
    rough_rad: float = 3.0
    odometry: str = ""

    def __post_init__(self) -> None:
        if not all(0 < value < np.inf for value in astuple(self)[:-1]):
            raise InvalidInputError(f"smoothing: expected numbers above 0, found {self}")


def smooth(
    found: Alignment,
    rough: Float,
    stamps_ns: NDArray[np.int64],
    smoothing: Smoothing,
    *,
    odometry: Float | None = None,
) -> Float:
    """Return the most likely poses of a recording.

    Parameters
    ----------
    found
        N aligned scans in the order of time; those not accepted count for nothing.
    rough
        (N, 3) f8 poses before alignment.
    stamps_ns
        (N,) i8.
    smoothing
        Standard deviations.
    odometry
        (N, 3) f8 poses in any frame whose differences tell the motion, NaN where unknown; the
        rough poses unless given.

    Returns
    -------
    (N, 3) f8 x y yaw; NaN where the rough pose is.
    """
    known = np.flatnonzero(np.isfinite(rough).all(axis=-1) & np.isfinite(found.poses).all(axis=-1))
    odometry = rough if odometry is None else odometry
    poses = found.poses.copy()
    if len(known) > 1:
        start = np.where(found.accepted[known, None], found.poses[known], rough[known])
        motion = compose(invert(odometry[known[:-1]]), odometry[known[1:]])
        weights = _motion_weights(motion, np.diff(stamps_ns[known]) / 1e9, smoothing)
        weights[~np.isfinite(motion).all(axis=-1)] = 0.0
        motion = np.nan_to_num(motion)
        trusted = _information(found, known, smoothing)
        prior = np.repeat((smoothing.rough_m, smoothing.rough_rad), (2, 1)) ** -2.0
        poses[known] = _solve_chain(
            start, found.poses[known], trusted, rough[known], prior, motion, weights
        )
        poses[known, 2] = wrap_angle(poses[known, 2])
    return poses


def read_odometry(reader: SequenceReader, stream: str) -> Float:
    """Read poses (N, 3) at the stamps of the scans from a stream of odometry, NaN outside it.

    Raises
    ------
    InvalidInputError
        If there is no such stream, or it does not hold poses.
    """
    if not stream or f"streams/{stream}/data" not in reader:
        there = sorted({name.split("/")[1] for name in reader.names if name.startswith("streams/")})
        raise InvalidInputError(
            f"{reader.path}: has no stream {stream!r}; it has {', '.join(there) or 'none'}; "
            f"convert the recording with --stream /{stream}"
        )
    columns = reader.describe_stream(stream).get("columns", [])
    if not set(_POSE_COLUMNS) <= set(columns):
        raise InvalidInputError(
            f"{reader.path}: streams/{stream}: expected the columns {', '.join(_POSE_COLUMNS)} of "
            f"nav_msgs/Odometry, found {', '.join(columns) or 'none'}"
        )
    data, stamps = reader.read(f"streams/{stream}/data"), reader.read(f"streams/{stream}/stamps_ns")
    x, y, qx, qy, qz, qw = (data[:, columns.index(name)] for name in _POSE_COLUMNS)
    yaw = np.arctan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz))
    order = np.unique(stamps, return_index=True)[1]
    poses = np.stack((x, y, yaw), axis=-1)[order]
    return interpolate_poses(stamps[order], poses, reader.read("scans/stamps_ns"))


_POSE_COLUMNS = tuple(
    f"pose.pose.{name}"
    for name in (
        "position.x",
        "position.y",
        "orientation.x",
        "orientation.y",
        "orientation.z",
        "orientation.w",
    )
)


def _motion_weights(motion: Float, seconds: Float, smoothing: Smoothing) -> Float:
    """Return inverse variances (N - 1, 3) of x, y and yaw of each step."""
    drift = np.maximum(seconds, 1e-3)
    with np.errstate(over="ignore"):  # a leap to nowhere has no weight
        way = np.hypot(motion[:, 0], motion[:, 1])
        metres = smoothing.motion_m**2 * drift + (smoothing.motion_share * way) ** 2
        turn = smoothing.motion_rad**2 * drift + (smoothing.motion_share * motion[:, 2]) ** 2
    return 1.0 / np.stack((metres, metres, turn), axis=-1)


def _information(found: Alignment, known: NDArray[np.int64], smoothing: Smoothing) -> Float:
    """Return inverse covariances (K, 3, 3) of the aligned poses, 0 where not accepted."""
    floor = np.repeat((smoothing.align_m, smoothing.align_rad), (2, 1)) ** 2.0
    trusted = np.zeros((len(known), 3, 3))
    sure = found.accepted[known]
    trusted[sure] = np.linalg.inv(found.covariance[known[sure]] + np.diag(floor))
    return trusted


@numba.njit(cache=True)
def _solve_chain(
    start: Float,
    aligned: Float,
    trusted: Float,
    rough: Float,
    prior: Float,
    motion: Float,
    weights: Float,
) -> Float:
    """Gauss-Newton over the chain; steps that contradict the alignments (jumps) lose their say."""
    poses = start.copy()
    count = len(poses)
    diagonal, above, right = np.empty((count, 3, 3)), np.empty((count, 3, 3)), np.empty((count, 3))
    for jump in _JUMPS:
        for n in range(count):
            diagonal[n] = trusted[n]
            right[n] = trusted[n] @ _difference(aligned[n], poses[n])
            to_rough = _difference(rough[n], poses[n])
            for k in range(3):
                diagonal[n, k, k] += prior[k]
                right[n, k] += prior[k] * to_rough[k]
        for n in range(count - 1):
            _add_step(poses, motion, weights, jump, n, diagonal, above, right)
        poses += _solve_tridiagonal(diagonal, above, right)
    return poses


@numba.njit(cache=True)
def _difference(first: Float, second: Float) -> Float:
    out = first - second
    out[2] = (out[2] + np.pi) % (2 * np.pi) - np.pi
    return out


@numba.njit(cache=True)
def _add_step(
    poses: Float,
    motion: Float,
    weights: Float,
    jump: float,
    n: int,
    diagonal: Float,
    above: Float,
    right: Float,
) -> None:
    """Add the step from pose n to the next to the normal equations, Geman-McClure weighted."""
    c, s = np.cos(poses[n, 2]), np.sin(poses[n, 2])
    dx, dy = poses[n + 1, 0] - poses[n, 0], poses[n + 1, 1] - poses[n, 1]
    error = np.empty(3)
    error[0] = motion[n, 0] - (c * dx + s * dy)
    error[1] = motion[n, 1] - (c * dy - s * dx)
    turn = motion[n, 2] - (poses[n + 1, 2] - poses[n, 2])
    error[2] = (turn + np.pi) % (2 * np.pi) - np.pi
    here = np.zeros((3, 3))  # change of the step by pose n
    here[0], here[1] = (-c, -s, c * dy - s * dx), (s, -c, -c * dx - s * dy)
    here[2, 2] = -1.0
    there = np.zeros((3, 3))
    there[0, 0], there[0, 1], there[1, 0], there[1, 1], there[2, 2] = c, s, -s, c, 1.0
    w = weights[n] / (1.0 + (error * error * weights[n]).sum() / jump**2) ** 2
    for a in range(3):
        for b in range(3):
            for k in range(3):
                diagonal[n, a, b] += here[k, a] * w[k] * here[k, b]
                diagonal[n + 1, a, b] += there[k, a] * w[k] * there[k, b]
        for k in range(3):
            right[n, a] += here[k, a] * w[k] * error[k]
            right[n + 1, a] += there[k, a] * w[k] * error[k]
    above[n] = (here.T * w) @ there


@numba.njit(cache=True)
def _solve_tridiagonal(diagonal: Float, above: Float, right: Float) -> Float:
    """Solve a symmetric block tridiagonal system: forward elimination, back substitution."""
    count = len(diagonal)
    for n in range(1, count):
        factor = np.linalg.solve(diagonal[n - 1], above[n - 1]).T
        diagonal[n] -= factor @ above[n - 1]
        right[n] -= factor @ right[n - 1]
    out = np.empty_like(right)
    out[count - 1] = np.linalg.solve(diagonal[count - 1], right[count - 1])
    for n in range(count - 2, -1, -1):
        out[n] = np.linalg.solve(diagonal[n], right[n] - above[n] @ out[n + 1])
    return out
