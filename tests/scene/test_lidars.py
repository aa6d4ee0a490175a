from dataclasses import replace

import numpy as np
import pytest
import yaml

from semantic2d_dataset.access.features import features_of
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.lidars import (
    HOKUYO_UTM_30LX_EW,
    LIDARS,
    RPLIDAR_S2,
    describe,
    find_lidar,
    read_lidar,
)
from tests.generators import SMALL_LIDAR


@pytest.mark.parametrize(
    ("name", "beams", "last_bearing"),
    [
        ("hokuyo", 1081, 2.356194496154785),
        ("wlr716", 811, 2.356194496154785),
        ("RPLIDAR_S2", 1972, 3.1415927410125732),
    ],
)
def test_lidars_of_the_release_have_their_recorded_geometry(name, beams, last_bearing):
    spec = find_lidar(name)
    assert spec.bearings.shape == (beams,)
    np.testing.assert_allclose(spec.bearings[[0, -1]], [-last_bearing, last_bearing])


def test_unknown_lidar_lists_the_known_ones():
    with pytest.raises(InvalidInputError, match="unknown lidar 'velodyne'; known are hokuyo"):
        find_lidar("velodyne")


def test_a_return_is_finite_and_within_the_limits():
    ranges = np.array([0.0999, 0.1, 59.99, 60.0, np.inf, -np.inf, np.nan, 0.0])
    expected = [False, True, True, False, False, False, False, False]
    assert HOKUYO_UTM_30LX_EW.has_return(ranges).tolist() == expected


@pytest.mark.parametrize("spec", [*LIDARS.values(), SMALL_LIDAR])
def test_lidar_file_reads_back_the_same(spec, tmp_path):
    path = tmp_path / "lidar.yaml"
    path.write_text(yaml.safe_dump(describe(spec) | {"base_T_lidar": list(spec.base_T_lidar)}))
    assert read_lidar(path) == spec


@pytest.mark.parametrize(
    ("field", "value", "says"),
    [
        ("beams", 1, "expected 2 to 100000 beams"),
        ("angle_increment", -0.1, "counter-clockwise"),
        ("angle_increment", 1.0, "at most 2 pi"),
        ("range_max", 0.05, "range_min < range_max"),
        ("range_max", float("nan"), "finite"),
        ("base_T_lidar", [0, 0, 0], "x y z roll pitch yaw"),
        ("colour", "red", "expected a mapping with the keys"),
    ],
)
def test_lidar_file_with_a_bad_field_says_which(field, value, says, tmp_path):
    path = tmp_path / "lidar.yaml"
    fields = describe(RPLIDAR_S2) | {"base_T_lidar": [0.0] * 6, "angle_increment": 0.003}
    path.write_text(yaml.safe_dump(fields | {field: value}))
    with pytest.raises(InvalidInputError, match=says):
        read_lidar(path)


@pytest.mark.parametrize("text", ["", "- a", "{", "\x00"])
def test_file_that_is_no_lidar_is_refused(text, tmp_path):
    path = tmp_path / "lidar.yaml"
    path.write_text(text)
    with pytest.raises(InvalidInputError, match="lidar.yaml"):
        read_lidar(path)


def test_a_mount_given_as_a_list_makes_the_same_lidar():
    spec = replace(SMALL_LIDAR, base_T_lidar=list(SMALL_LIDAR.base_T_lidar))
    assert spec == SMALL_LIDAR
    assert hash(spec) == hash(SMALL_LIDAR)
    assert features_of(np.ones((2, spec.beams), np.float32), None, spec, "RA").shape == (2, 2, 37)
