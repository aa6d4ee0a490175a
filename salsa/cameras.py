"""A calibrated camera: where a point in front of it lies in its image (plumb_bob), and its file.

The camera's frame is that of ROS images (REP 103, the *optical* frame): x to the right, y down, z
forward. Pixels are x to the right and y down from the upper left corner of the image.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.documents import read_yaml
from semantic2d_dataset.scene.geometry import rotation_matrix
from semantic2d_dataset.scene.lidars import LidarSpec
from semantic2d_dataset.scene.scans import check_array

Float = NDArray[np.float64]

PARENTS = ("base", "lidar")

_SIZE, _LENS = ("width", "height"), ("fx", "fy", "cx", "cy")
_MAX_PIXELS = 100_000
_RIGID = 1e-3  # how far R R' may be from the identity: files are written with a few digits
_NEGLIGIBLE, _MAX_DISTORTION = 1e-9, 1e6
_MODELS = ("plumb_bob", "")


@dataclass(frozen=True)
class Camera:
    """Intrinsics, distortion and mount of one camera.

    Parameters
    ----------
    width, height
        Of the image, pixels.
    fx, fy, cx, cy
        Focal lengths and principal point, pixels.
    parent_T_camera
        (4, 4) f8 pose of the optical frame: ``p_parent = R p_camera + t``, m.
    parent
        The frame of that pose: ``base`` or ``lidar``.
    distortion
        k1, k2, p1, p2, k3 of the model plumb_bob; zeros for a rectified image.

    Raises
    ------
    InvalidInputError
        If a value is out of its domain, or the pose is no rotation and translation.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    parent_T_camera: Float
    parent: str = "base"
    distortion: tuple[float, float, float, float, float] = (0.0,) * 5

    def __post_init__(self) -> None:
        check_array("parent_T_camera", self.parent_T_camera, np.float64, (4, 4))
        if self.parent not in PARENTS:
            raise InvalidInputError(f"parent: expected one of {PARENTS}, found {self.parent!r}")
        if not all(0 < size <= _MAX_PIXELS for size in (self.width, self.height)):
            raise InvalidInputError(
                f"expected an image of 1 to {_MAX_PIXELS} pixels a side, "
                f"found {self.width} x {self.height}"
            )
        if len(self.distortion) != 5:
            raise InvalidInputError(
                f"distortion: expected k1 k2 p1 p2 k3, found {len(self.distortion)} numbers"
            )
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if not (np.isfinite(numbers).all() and np.isfinite(self.parent_T_camera).all()):
            raise InvalidInputError("every number of a camera must be finite")
        if np.abs(self.distortion).max() > _MAX_DISTORTION:
            raise InvalidInputError(
                f"distortion: expected numbers up to {_MAX_DISTORTION:g}, found {self.distortion}"
            )
        if not (self.fx > 0 and self.fy > 0):
            raise InvalidInputError(
                f"expected focal lengths above 0 pixels, found fx {self.fx} and fy {self.fy}"
            )
        _check_rigid(self.parent_T_camera)

    def in_base(self, lidar: LidarSpec) -> Float:
        """Return the pose (4, 4) of the camera in the base frame of a robot with a lidar."""
        if self.parent == "base":
            return self.parent_T_camera
        return mount_matrix(lidar.base_T_lidar) @ self.parent_T_camera

    @property
    def lens(self) -> Float:
        """What `pixel_of` takes: fx fy cx cy k1 k2 p1 p2 k3, and the limit of the model.

        Beyond that squared distance from the axis (at z = 1) the polynomial turns back, and would
        show in the image what lies beside it.
        """
        k1, k2, _, _, k3 = self.distortion
        slope = np.array((7 * k3, 5 * k2, 3 * k1, 1.0))  # of r + k1 r^3 + k2 r^5 + k3 r^7, by r^2
        roots = np.roots(np.where(np.abs(slope) < _NEGLIGIBLE, 0.0, slope))
        real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
        limit = real.min() if len(real) else np.inf
        return np.array((self.fx, self.fy, self.cx, self.cy, *self.distortion, limit))


def project(points: ArrayLike, camera: Camera) -> Float:
    """Return the pixels (P, 2) f8 of points (P, 3) in m in the camera's frame.

    They may lie beyond the image; NaN for points behind the camera, or so far aside that its
    model of distortion does not hold.
    """
    p = np.ascontiguousarray(points, np.float64).reshape(-1, 3)
    pixels = np.empty((len(p), 2))
    _project(p, camera.lens, pixels)
    return pixels


def mount_matrix(mount: Sequence[float]) -> Float:
    """Return the pose x y z (m) roll pitch yaw (rad) as a matrix (4, 4)."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_matrix(*mount[3:6]), mount[:3]
    return pose


def read_camera(path: Path) -> Camera:
    """Read a camera from a YAML or JSON file.

    Its keys are `width`, `height`, `fx`, `fy`, `cx`, `cy` and perhaps `distortion` (k1 k2 p1 p2
    k3), or instead of these `camera_info`: the name of ROS's file, beside this one; with
    `rectified: true` of the rectified image. And either `base_T_camera` or `lidar_T_camera`: the
    pose of the optical frame, as x y z roll pitch yaw, as x y z qx qy qz qw, or as 4 rows of 4.

    Raises
    ------
    FileNotFoundError
        If a file is missing.
    InvalidInputError
        If a file is not such a mapping, or a value is out of its domain.
    """
    path = Path(path)
    found = _read_mapping(path)
    poses = [key for key in found if key in {f"{parent}_T_camera" for parent in PARENTS}]
    if len(poses) != 1:
        raise InvalidInputError(
            f"{path}: expected base_T_camera or lidar_T_camera, one of them, found "
            f"{', '.join(poses) or 'neither'}"
        )
    from_ros = "camera_info" in found
    lens = {"camera_info", "rectified"} if from_ros else {*_SIZE, *_LENS, "distortion"}
    unknown = sorted(str(key) for key in set(found) - lens - set(poses))
    if unknown:
        raise InvalidInputError(
            f"{path}: unknown keys {', '.join(unknown)}; known beside {poses[0]} are "
            f"{', '.join(sorted(lens))}" + ("" if from_ros else ", or camera_info instead of these")
        )
    try:
        pose = _pose_of(found[poses[0]])
        parent = poses[0].partition("_")[0]
        if not from_ros:
            return _own_camera(found, pose, parent)
    except (InvalidInputError, TypeError, ValueError, OverflowError) as err:
        raise InvalidInputError(f"{path}: {err}") from err
    return _ros_camera(path, found, pose, parent)


def camera_files(path: Path) -> dict[str, Path]:
    """Return the files that a camera is read from, by their role.

    Raises
    ------
    FileNotFoundError, InvalidInputError
        If the first of them is missing, or not a mapping, or names no file.
    """
    path = Path(path)
    found = _read_mapping(path)
    named = {"camera_info": _info_file(path, found)} if "camera_info" in found else {}
    return {"camera": path} | named


def _info_file(path: Path, found: Mapping[str, Any]) -> Path:
    name = found["camera_info"]
    if not isinstance(name, str) or "\0" in name:
        raise InvalidInputError(f"{path}: camera_info: expected the name of a file, found {name!r}")
    return path.parent / name


def _own_camera(found: Mapping[str, Any], pose: Float, parent: str) -> Camera:
    missing = [key for key in (*_SIZE, *_LENS) if key not in found]
    if missing:
        raise InvalidInputError(f"expected {', '.join(missing)}, or camera_info")
    width, height = (_whole(key, found[key]) for key in _SIZE)
    fx, fy, cx, cy = (_number(key, found[key]) for key in _LENS)
    distortion = _distortion_of(found.get("distortion", ()))
    return Camera(width, height, fx, fy, cx, cy, pose, parent, distortion)


def _ros_camera(path: Path, found: Mapping[str, Any], pose: Float, parent: str) -> Camera:
    rectified = found.get("rectified", False)
    if not isinstance(rectified, bool):
        raise InvalidInputError(f"{path}: rectified: expected true or false, found {rectified!r}")
    source = _info_file(path, found)
    said = _read_mapping(source)
    try:
        camera = _camera_of_info(said, pose, parent)
        return _rectified(camera, said) if rectified else camera
    except (InvalidInputError, KeyError, TypeError, ValueError, OverflowError) as err:
        reason = f"no {err}" if isinstance(err, KeyError) else str(err)
        raise InvalidInputError(f"{source}: not a camera_info: {reason}") from err


def _camera_of_info(said: Mapping[str, Any], pose: Float, parent: str) -> Camera:
    """Take what camera_calibration writes, or what `rostopic echo` does of a CameraInfo."""
    width = _whole("width", _first(said, "image_width", "width"))
    height = _whole("height", _first(said, "image_height", "height"))
    model = said.get("distortion_model", "plumb_bob")
    if model not in _MODELS:
        raise InvalidInputError(
            f"distortion_model {model!r} is not known, only plumb_bob; detect in rectified images, "
            f"and say `rectified: true`"
        )
    k = _numbers("camera_matrix", _first(said, "camera_matrix", "k", "K"), 9)
    distortion = _distortion_of(_data(_first(said, "distortion_coefficients", "d", "D")))
    return Camera(width, height, k[0], k[4], k[2], k[5], pose, parent, distortion)


def _rectified(camera: Camera, said: Mapping[str, Any]) -> Camera:
    """Turn to the rectified image: no distortion, and a frame turned by the rectification."""
    p = _numbers("projection_matrix", _first(said, "projection_matrix", "p", "P"), 12)
    r = _numbers("rectification_matrix", _first(said, "rectification_matrix", "r", "R"), 9)
    turn = np.eye(4)
    turn[:3, :3] = np.reshape(r, (3, 3)).T
    return replace(
        camera,
        fx=p[0],
        fy=p[5],
        cx=p[2],
        cy=p[6],
        distortion=(0.0,) * 5,
        parent_T_camera=camera.parent_T_camera @ turn,
    )


def _pose_of(value: Any) -> Float:
    if isinstance(value, list) and len(value) == 4 and all(isinstance(v, list) for v in value):
        return np.array([_numbers("a row of the pose", row, 4) for row in value])
    if not isinstance(value, list) or len(value) not in (6, 7):
        raise InvalidInputError(
            f"the camera's pose: expected x y z roll pitch yaw, x y z qx qy qz qw or 4 rows of 4 "
            f"numbers, found {value!r}"
        )
    numbers = _numbers("the camera's pose", value, len(value))
    if len(numbers) == 6:
        return mount_matrix(numbers)
    length = math.hypot(*numbers[3:])
    if not abs(length - 1) < 0.01:
        raise InvalidInputError(f"expected a quaternion of length 1, found length {length:g}")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat(numbers[3:]).as_matrix(), numbers[:3]
    return pose


def _check_rigid(pose: Float) -> None:
    rotation = pose[:3, :3]
    rigid = np.allclose(rotation @ rotation.T, np.eye(3), atol=_RIGID)
    if not (rigid and np.linalg.det(rotation) > 0 and np.allclose(pose[3], (0, 0, 0, 1))):
        raise InvalidInputError(
            f"the camera's pose: expected a rotation and a translation, found {pose.tolist()}"
        )


def _distortion_of(value: Any) -> tuple[float, float, float, float, float]:
    """Take none, 4 (k1 k2 p1 p2) or 5 numbers."""
    count = len(value) if isinstance(value, (list, tuple)) else 5
    if count not in (0, 4, 5):
        raise InvalidInputError(
            f"distortion: expected k1 k2 p1 p2 k3 of the model plumb_bob, found {count} numbers"
        )
    k1, k2, p1, p2, k3 = (*_numbers("distortion", value, count), *[0.0] * (5 - count))
    return k1, k2, p1, p2, k3


def _read_mapping(path: Path) -> Mapping[str, Any]:
    """Read the first document of a YAML file; ``rostopic echo`` ends each with a line."""
    found = read_yaml(path, kind="a YAML or JSON file", several=True)
    if not isinstance(found, dict):
        raise InvalidInputError(f"{path}: expected a mapping, found {type(found).__name__}")
    return found


def _first(said: Mapping[str, Any], *names: str) -> Any:
    """Return the value of the first name that there is."""
    return next((said[name] for name in names if name in said), said.get(names[0]))


def _data(value: Any) -> Any:
    return value.get("data") if isinstance(value, dict) else value


def _numbers(what: str, value: Any, count: int) -> list[float]:
    found = _data(value)
    if not isinstance(found, (list, tuple)) or len(found) != count:
        raise InvalidInputError(f"{what}: expected {count} numbers, found {found!r}")
    return [_number(what, each) for each in found]


def _number(what: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise InvalidInputError(f"{what}: expected a number, found {value!r}")
    try:
        return float(value)  # YAML takes 1e-3, without a point, as text
    except (ValueError, OverflowError) as err:
        raise InvalidInputError(f"{what}: expected a number, found {value!r}") from err


def _whole(what: str, value: Any) -> int:
    if type(value) is not int:
        raise InvalidInputError(f"{what}: expected a whole number of pixels, found {value!r}")
    return value


@numba.njit(inline="always")
def pixel_of(x: float, y: float, z: float, lens: Float) -> tuple[float, float]:
    """Return the pixel of a point in the camera's frame; NaN where it has none."""
    if not z > 0.0:
        return np.nan, np.nan
    a, b = x / z, y / z
    r2 = a * a + b * b
    if not r2 < lens[9]:
        return np.nan, np.nan
    k1, k2, p1, p2, k3 = lens[4], lens[5], lens[6], lens[7], lens[8]
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    u = a * radial + 2.0 * p1 * a * b + p2 * (r2 + 2.0 * a * a)
    v = b * radial + p1 * (r2 + 2.0 * b * b) + 2.0 * p2 * a * b
    return lens[0] * u + lens[2], lens[1] * v + lens[3]


@numba.njit(cache=True)
def _project(points: Float, lens: Float, pixels: Float) -> None:
    for k in range(len(points)):
        pixels[k] = pixel_of(points[k, 0], points[k, 1], points[k, 2], lens)
