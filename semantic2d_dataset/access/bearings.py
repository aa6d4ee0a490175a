"""Where the beams of one lidar fall among those of another on the same base."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.geometry import mount_in_plane
from semantic2d_dataset.scene.lidars import LidarSpec

NO_BEAM = -1
"""The number of a beam that is not there."""

_SAME = 1e-3  # beams; closer bearings are one
_WIDEST_GAP = 1.5  # beams between the last and the first of a lidar that sees all around
_LEVEL = 0.5  # least determinant of a mount, a tilt of 60 degrees


def level_mount(lidar: LidarSpec) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the mount in the plane as `mount_in_plane` does.

    Raises
    ------
    InvalidInputError
        If the lidar is not mounted level enough to have a yaw.
    """
    rotation, translation = mount_in_plane(lidar.base_T_lidar)
    if abs(np.linalg.det(rotation)) < _LEVEL:
        raise InvalidInputError(
            f"lidar {lidar.name!r}: expected a level mount, found roll and pitch "
            f"{lidar.base_T_lidar[3:5]} rad: its scans cannot be reprojected in the plane"
        )
    return rotation, translation


def find_positions(beams_of: LidarSpec, on: LidarSpec) -> NDArray[np.float64]:
    """Return where the beams of one lidar fall on the row of beams of another.

    Both are turned by their mounts, and mirrored where one of them hangs upside down.

    Returns
    -------
    (B,) f8, in beams of `on`, 0 its first; the fewest beams from the middle of the row.

    Raises
    ------
    InvalidInputError
        If one of them is not mounted level enough to have a yaw.
    """
    to_base, from_base = (level_mount(lidar)[0] for lidar in (beams_of, on))
    turned = np.linalg.solve(from_base, to_base)
    sense = np.sign(np.linalg.det(turned))  # -1 where one of the two hangs upside down
    bearings = sense * beams_of.bearings + np.arctan2(turned[1, 0], turned[0, 0])
    positions = (bearings - on.angle_min) / on.angle_increment
    circle = 2 * np.pi / on.angle_increment
    # a little less than one, so that the two ends of a full circle stay where they are
    turns = np.rint((1 - 1e-6) * (positions - (on.beams - 1) / 2) / circle)
    found: NDArray[np.float64] = positions - turns * circle
    whole = np.rint(found)
    return np.where(np.abs(found - whole) < _SAME, whole, found)


def find_neighbours(
    positions: NDArray[np.float64], lidar: LidarSpec
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Return the beams on both sides of positions, (B,) i8 each, and how near the second is.

    -1 stands for both where a position is more than half a beam out of the field of view.
    """
    last = lidar.beams - 1
    gap = 2 * np.pi / lidar.angle_increment - last
    left = np.clip(np.floor(positions), 0, last).astype(np.int64)
    right = np.minimum(left + 1, last)
    weight = np.clip(positions - left, 0.0, 1.0)
    beside = (positions < 0) | (positions > last)
    if gap <= _WIDEST_GAP:
        beyond = np.where(positions < 0, positions + gap, positions - last)
        left, right = np.where(beside, last, left), np.where(beside, 0, right)
        weight = np.where(beside, beyond / gap, weight)
    else:
        outside = (positions < -0.5) | (positions > last + 0.5)
        left, right = np.where(outside, NO_BEAM, left), np.where(outside, NO_BEAM, right)
    return left, right, weight


def nearest_of(beams_of: LidarSpec, on: LidarSpec) -> NDArray[np.int64]:
    """Return for each beam of a lidar the one of another that is nearest in bearing.

    Returns
    -------
    (B,) i8; -1 where a beam is out of the other's field of view.

    Raises
    ------
    InvalidInputError
        If one of them is not mounted level enough to have a yaw.
    """
    left, right, weight = find_neighbours(find_positions(beams_of, on), on)
    return np.where(weight < 0.5, left, right)
