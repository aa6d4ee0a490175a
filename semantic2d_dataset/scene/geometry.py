"""SE(2) and SE(3) poses, polar and Cartesian points, angles of incidence."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from semantic2d_dataset.errors import InvalidInputError

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Pose2:
    """A pose in the plane: x, y in m, yaw in rad."""

    x: float
    y: float
    yaw: float

    def __post_init__(self) -> None:
        if not all(math.isfinite(value) for value in (self.x, self.y, self.yaw)):
            raise InvalidInputError(f"expected finite x, y, yaw, found {self}")

    def as_array(self) -> Float:
        """Return x, y, yaw as (3,) f8."""
        return np.array((self.x, self.y, self.yaw))


def wrap_angle(angle: ArrayLike) -> Float:
    """Wrap angles in rad to [-pi, pi)."""
    wrapped: Float = (np.asarray(angle, np.float64) + np.pi) % (2 * np.pi) - np.pi
    return wrapped


def compose(first: ArrayLike, second: ArrayLike) -> Float:
    """Chain poses a_T_b and b_T_c, each (..., 3) x y yaw, to a_T_c (..., 3)."""
    a, b = np.broadcast_arrays(np.asarray(first, np.float64), np.asarray(second, np.float64))
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = a[..., 0] + c * b[..., 0] - s * b[..., 1]
    y = a[..., 1] + s * b[..., 0] + c * b[..., 1]
    return np.stack((x, y, wrap_angle(a[..., 2] + b[..., 2])), axis=-1)


def invert(pose: ArrayLike) -> Float:
    """Invert poses (..., 3) x y yaw."""
    a = np.asarray(pose, np.float64)
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = -(c * a[..., 0] + s * a[..., 1])
    y = s * a[..., 0] - c * a[..., 1]
    return np.stack((x, y, wrap_angle(-a[..., 2])), axis=-1)


def transform(poses: ArrayLike, points: ArrayLike) -> Float:
    """Move points (..., P, 2) from the poses' frames (..., 3) into the poses' parent frame."""
    a = np.asarray(poses, np.float64)[..., None, :]
    p = np.asarray(points, np.float64)
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = a[..., 0] + c * p[..., 0] - s * p[..., 1]
    y = a[..., 1] + s * p[..., 0] + c * p[..., 1]
    return np.stack((x, y), axis=-1)


def rotation_matrix(roll: float, pitch: float, yaw: float) -> Float:
    """Rotation (3, 3) of fixed-axis roll, pitch, yaw in rad: R = Rz(yaw) Ry(pitch) Rx(roll)."""
    cr, sr = math.cos(roll), math.sin(roll)
    cp, sp = math.cos(pitch), math.sin(pitch)
    cy, sy = math.cos(yaw), math.sin(yaw)
    return np.array(
        (
            (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
            (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
            (-sp, cp * sr, cp * cr),
        )
    )


def mount_in_plane(base_T_lidar: Sequence[float]) -> tuple[Float, Float]:
    """Reduce a mount x y z roll pitch yaw to the plane.

    Returns
    -------
    rotation, translation
        (2, 2) and (2,) f8 with ``p_base = rotation @ p_lidar + translation``. A lidar that
        hangs upside down gives a reflection (determinant -1).
    """
    rotation = rotation_matrix(*base_T_lidar[3:6])[:2, :2]
    return rotation, np.asarray(base_T_lidar[:2], np.float64)


def beam_directions(bearings: ArrayLike) -> Float:
    """Return unit vectors (B, 2) of bearings (B,) in rad."""
    b = np.asarray(bearings, np.float64)
    return np.stack((np.cos(b), np.sin(b)), axis=-1)


def to_points(ranges: ArrayLike, bearings: ArrayLike) -> Float:
    """Return the beam endpoints (..., B, 2) in m of ranges (..., B) at bearings (B,), lidar frame.

    Beams whose range is not finite give NaN. (Paper, section on the point cloud.)
    """
    r = np.asarray(ranges, np.float64)
    return np.where(np.isfinite(r), r, np.nan)[..., None] * beam_directions(bearings)


def to_base(points: ArrayLike, base_T_lidar: Sequence[float]) -> Float:
    """Move points (..., 2) from the lidar frame into the base frame, in the plane."""
    rotation, translation = mount_in_plane(base_T_lidar)
    return np.asarray(points, np.float64) @ rotation.T + translation


def incidence_angles(ranges: ArrayLike, angle_increment: float) -> NDArray[np.float32]:
    """Return the angle between each beam and the normal of the surface that it meets.

    The surface is the segment between neighbouring endpoints (paper, equations for d, beta and
    alpha); the last beam uses the segment before it. A range that is not finite counts as 0, as
    in the published arrays: a beam without range has angle 0, and pi/2 comes out beside one.

    Parameters
    ----------
    ranges
        (..., B) in m.
    angle_increment
        Bearing step, rad.

    Returns
    -------
    (..., B) f4 in rad, 0 to pi/2.
    """
    r = np.ascontiguousarray(ranges, np.float32)
    if r.ndim == 0 or r.shape[-1] < 2:
        raise InvalidInputError(f"expected ranges (..., B) with B >= 2, found shape {r.shape}")
    out = np.empty_like(r)
    _incidence(r.reshape(-1, r.shape[-1]), angle_increment, out.reshape(-1, r.shape[-1]))
    return out


@numba.njit(inline="always")
def arctan_quadrant(y: np.float32, x: np.float32) -> np.float32:
    """Arctangent of y / x for y, x >= 0, free of calls (Abramowitz and Stegun 4.4.49, 2e-8)."""
    t = (y if y <= x else x) / (x if y <= x else y)
    t2 = t * t
    poly = np.float32(0.0028662257)
    poly = poly * t2 + np.float32(-0.0161657367)
    poly = poly * t2 + np.float32(0.0429096138)
    poly = poly * t2 + np.float32(-0.0752896400)
    poly = poly * t2 + np.float32(0.1065626393)
    poly = poly * t2 + np.float32(-0.1420889944)
    poly = poly * t2 + np.float32(0.1999355085)
    poly = poly * t2 + np.float32(-0.3333314528)
    poly = (poly * t2 + np.float32(1.0)) * t
    angle: np.float32 = poly if y <= x else np.float32(np.pi / 2) - poly
    return angle


@numba.njit(inline="always")
def incidence_between(
    near: np.float32, far: np.float32, cos_step: np.float32, sin_step: np.float32
) -> np.float32:
    """Angle of incidence at the endpoint of `near` on the segment to the endpoint of `far`.

    With r = near, q = far: alpha = |pi/2 - arccos((d^2 + r^2 - q^2) / (2 d r))| and
    d^2 = r^2 + q^2 - 2 r q cos = (r - q cos)^2 + (q sin)^2. The argument is (r - q cos) / d,
    so that tan(alpha) = |r - q cos| / (q sin), which keeps its digits at grazing incidence.
    """
    angle: np.float32 = arctan_quadrant(abs(near - far * cos_step), far * sin_step)
    return angle


@numba.njit(cache=True, error_model="numpy")
def _incidence(
    ranges: NDArray[np.float32], angle_increment: float, out: NDArray[np.float32]
) -> None:
    cos_step, sin_step = np.float32(np.cos(angle_increment)), np.float32(np.sin(angle_increment))
    zero = np.float32(0.0)
    beams = ranges.shape[1]
    for n in range(ranges.shape[0]):
        r = np.empty(beams + 1, np.float32)
        for k in range(beams):
            value = ranges[n, k]
            r[k] = value if value > zero and value < np.inf else zero
        r[beams] = r[beams - 2]
        for k in range(beams):
            alpha = incidence_between(r[k], r[k + 1], cos_step, sin_step)
            out[n, k] = alpha if r[k] > zero else zero


def interpolate_poses(stamps_ns: ArrayLike, poses: ArrayLike, at_ns: ArrayLike) -> Float:
    """Interpolate poses linearly in x, y and along the shorter arc in yaw.

    Parameters
    ----------
    stamps_ns
        (M,) i8, increasing.
    poses
        (M, 3) f8 x y yaw.
    at_ns
        (N,) i8 stamps to interpolate at.

    Returns
    -------
    (N, 3) f8; NaN outside the span of `stamps_ns`.
    """
    known = np.asarray(stamps_ns, np.int64)
    wanted = np.asarray(at_ns, np.int64)
    p = np.asarray(poses, np.float64)
    if known.size == 0:
        return np.full((wanted.size, 3), np.nan)
    # seconds from the first stamp: nanoseconds since the epoch do not fit a double exactly
    t, q = (known - known[0]) / 1e9, (wanted - known[0]) / 1e9
    columns = (p[:, 0], p[:, 1], np.unwrap(p[:, 2]))
    out = np.stack([np.interp(q, t, c, left=np.nan, right=np.nan) for c in columns], axis=-1)
    out[:, 2] = wrap_angle(out[:, 2])
    return out
