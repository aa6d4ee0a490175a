"""Calibrated cameras: projection, and the files that describe them."""

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from salsa.cameras import Camera, mount_matrix, project, read_camera
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.lidars import WLR_716

# x of the camera is -y of its parent, y is -z, z is x: it looks forward
FORWARD = (0.2, 0.05, 0.6, -np.pi / 2, 0.0, -np.pi / 2)
CAMERA = Camera(640, 480, 500.0, 510.0, 322.0, 238.0, mount_matrix(FORWARD))
BENT = replace(CAMERA, distortion=(-0.28, 0.07, 1e-3, -2e-3, 0.01))
OWN = {"width": 640, "height": 480, "fx": 500.0, "fy": 510.0, "cx": 322.0, "cy": 238.0}


def ray_of(pixel, camera):
    """The point at z = 1 of a pixel, by fixed-point iteration as image libraries do it."""
    k1, k2, p1, p2, k3 = camera.distortion
    bent = np.array(((pixel[0] - camera.cx) / camera.fx, (pixel[1] - camera.cy) / camera.fy))
    x, y = bent
    for _ in range(200):
        r2 = x * x + y * y
        aside = (2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y)
        x, y = (bent - aside) / (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3)
    return np.array((x, y, 1.0))


def test_a_camera_that_looks_forward_sees_left_on_the_left_and_low_things_low():
    camera_T_base = np.linalg.inv(CAMERA.in_base(WLR_716))
    ahead = np.array(((5.2, 0.05, 0.6, 1), (5.2, 1.05, 0.6, 1), (5.2, 0.05, 0.1, 1)))
    found = project((ahead @ camera_T_base.T)[:, :3], CAMERA)
    np.testing.assert_allclose(found, [(322, 238), (322 - 100, 238), (322, 238 + 51)])


@given(
    u=st.floats(0, 640),
    v=st.floats(0, 480),
    depth=st.floats(0.05, 60),
    camera=st.sampled_from((CAMERA, BENT)),
)
def test_a_pixel_projects_to_itself_from_any_depth(u, v, depth, camera):
    points = depth * ray_of((u, v), camera)
    np.testing.assert_allclose(project(points, camera), [(u, v)], atol=1e-6)


def test_points_behind_or_beside_the_camera_have_no_pixel():
    points = [(0, 0, -1), (0, 0, 0), (1, 0, -0.5), (np.nan, 0, 1)]
    assert np.isnan(project(points, CAMERA)).all()
    barrel = replace(CAMERA, distortion=(-0.3, 0.0, 0.0, 0.0, 0.0))
    turned_back = [(1.9, 0.0, 1.0)]  # r (1 - 0.3 r^2) is small again, and would lie in the image
    assert np.isnan(project(turned_back, barrel)).all()
    assert np.isfinite(project([(1.0, 0.0, 1.0)], barrel)).all()


def test_a_camera_on_the_lidar_turns_with_its_mount():
    on_lidar = replace(CAMERA, parent="lidar")
    base = mount_matrix(WLR_716.base_T_lidar) @ mount_matrix(FORWARD)
    np.testing.assert_allclose(on_lidar.in_base(WLR_716), base)
    np.testing.assert_array_equal(CAMERA.in_base(WLR_716), mount_matrix(FORWARD))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 0}, "expected an image of 1 to"),
        ({"fx": -1.0}, "focal lengths above 0"),
        ({"cx": np.nan}, "must be finite"),
        ({"distortion": (0.1, 0.2)}, "expected k1 k2 p1 p2 k3, found 2"),
        ({"distortion": (1e9, 0, 0, 0, 0)}, "expected numbers up to"),
        ({"parent": "map"}, "expected one of"),
        ({"parent_T_camera": np.eye(3)}, "parent_T_camera: expected float64"),
        ({"parent_T_camera": np.diag((1.0, 1.0, -1.0, 1.0))}, "a rotation and a translation"),
        ({"parent_T_camera": 2 * np.eye(4)}, "a rotation and a translation"),
    ],
)
def test_what_is_no_camera_is_refused(change, message):
    with pytest.raises(InvalidInputError, match=message):
        replace(CAMERA, **change)


def write(path, content):
    text = json.dumps(content) if path.suffix == ".json" else yaml.safe_dump(content)
    path.write_text(text, encoding="utf-8")
    return path


def same(one, other):
    np.testing.assert_allclose(one.lens, other.lens)
    np.testing.assert_allclose(one.parent_T_camera, other.parent_T_camera, atol=1e-9)
    assert (one.width, one.height, one.parent) == (other.width, other.height, other.parent)


@pytest.mark.parametrize("name", ["camera.yaml", "camera.json"])
@pytest.mark.parametrize(
    "pose",
    [
        list(FORWARD),
        [0.2, 0.05, 0.6, -0.5, 0.5, -0.5, 0.5],
        mount_matrix(FORWARD).tolist(),
    ],
)
def test_a_file_of_our_own_says_the_pose_in_three_ways(name, pose, tmp_path):
    path = write(tmp_path / name, OWN | {"base_T_camera": pose})
    same(read_camera(path), CAMERA)
    bent = OWN | {"lidar_T_camera": pose, "distortion": list(BENT.distortion)}
    same(read_camera(write(path, bent)), replace(BENT, parent="lidar"))


def calibration(camera=BENT):
    """What ROS's camera_calibration writes."""
    k = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    turn = mount_matrix((0, 0, 0, 0.01, -0.02, 0.03))[:3, :3]
    p = [450.0, 0.0, 330.0, 0.0, 0.0, 460.0, 240.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    return {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": "front",
        "camera_matrix": {"rows": 3, "cols": 3, "data": k},
        "distortion_model": "plumb_bob",
        "distortion_coefficients": {"rows": 1, "cols": 5, "data": list(camera.distortion)},
        "rectification_matrix": {"rows": 3, "cols": 3, "data": turn.reshape(-1).tolist()},
        "projection_matrix": {"rows": 3, "cols": 4, "data": p},
    }


def test_intrinsics_come_from_the_file_of_a_calibration(tmp_path):
    write(tmp_path / "ost.yaml", calibration())
    said = {"camera_info": "ost.yaml", "base_T_camera": list(FORWARD)}
    same(read_camera(write(tmp_path / "camera.yaml", said)), BENT)


def test_of_a_rectified_image_there_is_no_distortion_and_the_frame_is_turned(tmp_path):
    write(tmp_path / "ost.yaml", calibration())
    said = {"camera_info": "ost.yaml", "base_T_camera": list(FORWARD), "rectified": True}
    found = read_camera(write(tmp_path / "camera.yaml", said))
    np.testing.assert_allclose(found.lens[:9], (450, 460, 330, 240, 0, 0, 0, 0, 0))
    point = np.array((0.3, -0.2, 2.0))
    turned = np.reshape(calibration()["rectification_matrix"]["data"], (3, 3)) @ point
    in_base = CAMERA.parent_T_camera @ (*point, 1)
    np.testing.assert_allclose(np.linalg.inv(found.parent_T_camera) @ in_base, (*turned, 1))


@pytest.mark.parametrize("upper", [False, True])
def test_intrinsics_come_from_an_echoed_message(upper, tmp_path):
    said = calibration()
    message = {
        "header": {"frame_id": "camera"},
        "height": 480,
        "width": 640,
        "distortion_model": "plumb_bob",
        "d": said["distortion_coefficients"]["data"],
        "k": said["camera_matrix"]["data"],
    }
    if upper:
        message = {key.upper() if len(key) == 1 else key: v for key, v in message.items()}
    (tmp_path / "info.yaml").write_text(yaml.safe_dump(message) + "---\n", encoding="utf-8")
    own = {"camera_info": "info.yaml", "base_T_camera": list(FORWARD)}
    same(read_camera(write(tmp_path / "camera.yaml", own)), BENT)


POSE = {"base_T_camera": list(FORWARD)}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (OWN, "camera.yaml: expected base_T_camera or lidar_T_camera, one of them, found neither"),
        (OWN | POSE | {"lidar_T_camera": list(FORWARD)}, "found base_T_camera, lidar_T_camera"),
        (POSE | {"width": 640}, "expected height, fx, fy, cx, cy, or camera_info"),
        (OWN | POSE | {"skew": 0}, "unknown keys skew; known beside base_T_camera are cx, cy"),
        (OWN | POSE | {"width": 640.5}, "width: expected a whole number of pixels, found 640.5"),
        (OWN | POSE | {"fx": True}, "fx: expected a number, found True"),
        (OWN | POSE | {"fx": "wide"}, "fx: expected a number, found 'wide'"),
        (OWN | POSE | {"distortion": [0.1]}, "k1 k2 p1 p2 k3 .* found 1 numbers"),
        (OWN | {"base_T_camera": [1, 2, 3]}, "expected x y z roll pitch yaw, .* found"),
        (OWN | {"base_T_camera": [0, 0, 0, 0, 0, 0, 2]}, "length 1, found length 2"),
        (OWN | {"base_T_camera": [[1, 0, 0, 0]] * 4}, "a rotation and a translation"),
        (POSE | {"camera_info": 3}, "camera_info: expected the name of a file"),
        (POSE | {"camera_info": "a\0b"}, "camera_info: expected the name of a file"),
        (POSE | {"camera_info": "info.yaml", "rectified": 1}, "expected true or false, found 1"),
        ([1], "camera.yaml: expected a mapping, found list"),
    ],
)
def test_a_file_that_is_no_camera_is_refused_with_its_reason(content, message, tmp_path):
    path = write(tmp_path / "camera.yaml", content)
    with pytest.raises(InvalidInputError, match=message):
        read_camera(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"distortion_model": "equidistant"}, "info.yaml: .*'equidistant' is not known"),
        ({"camera_matrix": {"data": [1, 2]}}, "camera_matrix: expected 9 numbers"),
        ({"image_width": None}, "width: expected a whole number"),
    ],
)
def test_a_calibration_that_cannot_be_used_is_refused(change, message, tmp_path):
    write(tmp_path / "info.yaml", calibration() | change)
    path = write(tmp_path / "camera.yaml", POSE | {"camera_info": "info.yaml"})
    with pytest.raises(InvalidInputError, match=message):
        read_camera(path)


def test_a_file_that_is_missing_or_no_yaml_is_told(tmp_path):
    with pytest.raises(FileNotFoundError):
        read_camera(tmp_path / "none.yaml")
    (tmp_path / "bad.yaml").write_text("a: [1", encoding="utf-8")
    with pytest.raises(InvalidInputError, match="bad.yaml: not a YAML or JSON file"):
        read_camera(tmp_path / "bad.yaml")
