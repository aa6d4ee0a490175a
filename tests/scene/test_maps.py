import tracemalloc

import numpy as np
import pytest
import yaml
from PIL import Image

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.geometry import Pose2
from semantic2d_dataset.scene.maps import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    SemanticMap,
    map_image,
    read_map,
    write_map,
)
from tests.generators import make_map

SETTINGS = {
    "image": "map.png",
    "resolution": 0.05,
    "origin": [-1.0, -2.0, 0.0],
    "negate": 0,
    "occupied_thresh": 0.65,
    "free_thresh": 0.196,
}


def write_files(folder, pixels, **settings):
    Image.fromarray(np.asarray(pixels, np.uint8)).save(folder / "map.png")
    path = folder / "map.yaml"
    path.write_text(yaml.safe_dump(SETTINGS | settings))
    return path


def test_row_zero_is_the_smallest_y(tmp_path):
    found = read_map(write_files(tmp_path, [[0, 254], [254, 205]]))
    assert found.occupancy.tolist() == [[FREE, UNKNOWN], [OCCUPIED, FREE]]
    assert (found.labels == 255).all()


def test_negate_turns_black_into_free(tmp_path):
    found = read_map(write_files(tmp_path, [[0, 255]], negate=1))
    assert found.occupancy.tolist() == [[FREE, OCCUPIED]]


def test_raw_mode_takes_values_as_they_are(tmp_path):
    found = read_map(write_files(tmp_path, [[0, 100, 255, 37]], mode="raw"))
    assert found.occupancy.tolist() == [[FREE, OCCUPIED, UNKNOWN, UNKNOWN]]


def test_transparent_pixels_are_unknown_in_scale_mode(tmp_path):
    pixels = np.array([[[255, 255, 255, 255], [255, 255, 255, 0]]], np.uint8)
    Image.fromarray(pixels, "RGBA").save(tmp_path / "map.png")
    (tmp_path / "map.yaml").write_text(yaml.safe_dump(SETTINGS | {"mode": "scale"}))
    assert read_map(tmp_path / "map.yaml").occupancy.tolist() == [[FREE, UNKNOWN]]


def test_a_written_map_reads_back_the_same(tmp_path):
    scene = make_map()
    write_map(tmp_path / "room.yaml", scene)
    found = read_map(tmp_path / "room.yaml")
    np.testing.assert_array_equal(found.occupancy, scene.occupancy)
    assert (found.resolution, found.origin) == (scene.resolution, scene.origin)


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.0])
def test_cells_and_their_centres_agree_under_a_turned_origin(yaw):
    cells = np.zeros((20, 30), np.uint8)
    scene = SemanticMap(cells, cells.copy(), 0.1, Pose2(3.0, -4.0, yaw))
    wanted = np.stack(np.meshgrid(np.arange(20), np.arange(30), indexing="ij"), axis=-1)
    np.testing.assert_array_equal(scene.cells_of(scene.centres_of(wanted)), wanted)


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"resolution": None}, "a map needs image, resolution and origin"),
        ({"origin": [0, 0]}, "a map needs image"),
        ({"resolution": -1}, "resolution above 0"),
        ({"mode": "colour"}, "trinary, scale or raw"),
        ({"origin": [0, 0, float("nan")]}, "finite"),
        ({"resolution": 10**400}, "map.yaml: a map needs"),
        ({"negate": float("inf")}, "map.yaml: a map needs"),
        ({"resolution": float("inf")}, "map.yaml: expected a resolution"),
        ({"image": ["map.png"]}, "map.yaml: a map needs.*image is no text"),
        ({"image": "a\0b"}, "map.yaml: a map needs.*image is no text"),
    ],
)
def test_bad_settings_are_named(settings, says, tmp_path):
    with pytest.raises(InvalidInputError, match=says):
        read_map(write_files(tmp_path, [[0, 254]], **settings))


def test_missing_image_is_named(tmp_path):
    (tmp_path / "map.yaml").write_text(yaml.safe_dump(SETTINGS))
    with pytest.raises(FileNotFoundError, match="map.png"):
        read_map(tmp_path / "map.yaml")


@pytest.mark.parametrize("content", [b"", b"\x89PNG\r\n\x1a\n", b"P5 4 4"])
def test_file_that_is_no_image_is_refused(content, tmp_path):
    path = write_files(tmp_path, [[0, 254]])
    (tmp_path / "map.png").write_bytes(content)
    with pytest.raises(InvalidInputError, match="not an image"):
        read_map(path)


def test_an_image_that_another_program_would_draw_is_not_opened(tmp_path):
    path = write_files(tmp_path, [[0, 254]])
    (tmp_path / "map.png").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 5 5\n")
    with pytest.raises(InvalidInputError, match="cannot identify image file"):
        read_map(path)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"- 1",
        b"{",
        b"\xff\xfe",
        b"image: 2024-99-99",
        b"image: !!timestamp x",
        b"image: !!int ''",
        b"[" * 5000,
    ],
)
def test_file_that_is_no_map_yaml_is_refused(content, tmp_path):
    path = tmp_path / "map.yaml"
    path.write_bytes(content)
    with pytest.raises(InvalidInputError, match="map.yaml"):
        read_map(path)


def test_colours_count_as_the_average_of_their_channels(tmp_path):
    colours = [[(255, 0, 0), (0, 90, 178), (0, 90, 177), (206, 205, 205), (205, 205, 205)]]
    found = read_map(write_files(tmp_path, colours))
    assert found.occupancy.tolist() == [[OCCUPIED, UNKNOWN, OCCUPIED, FREE, UNKNOWN]]


def test_reading_a_grey_map_takes_few_bytes_a_pixel(tmp_path):
    side = 2000
    path = write_files(tmp_path, np.full((side, side), 254))
    read_map(path)
    tracemalloc.start()
    read_map(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 12 * side**2


def test_the_image_of_a_map_lies_beside_its_yaml_file(tmp_path):
    assert map_image(write_files(tmp_path, [[0]])) == tmp_path / "map.png"
    (tmp_path / "none.yaml").write_text("resolution: 1")
    with pytest.raises(InvalidInputError, match="none.yaml: a map needs an image"):
        map_image(tmp_path / "none.yaml")


def test_published_map_reads(shared_data):
    found = read_map(shared_data / "temple_lobby" / "map.yaml")
    assert {FREE, OCCUPIED} <= set(np.unique(found.occupancy).tolist())
