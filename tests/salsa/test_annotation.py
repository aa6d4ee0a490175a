import json

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image

from salsa.annotation import annotate_map, label_cells, read_annotation, write_label_image
from semantic2d_dataset.errors import AlignmentError, InvalidInputError
from semantic2d_dataset.scene.geometry import Pose2
from semantic2d_dataset.scene.maps import FREE, OCCUPIED, write_map
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, UNLABELLED
from tests.salsa import rooms

SIZE = (20, 30)
OTHER, CHAIR, WALL, PERSON = (
    SEMANTIC2D.id_of(name) for name in ("Other", "Chair", "Wall", "Person")
)


def test_annotating_the_room_gives_each_surface_its_class(tmp_path):
    found, wanted = annotate_map(*rooms.write_room(tmp_path)), rooms.room_map()
    np.testing.assert_array_equal(found.occupancy, wanted.occupancy)
    np.testing.assert_array_equal(found.labels != UNLABELLED, wanted.occupancy == OCCUPIED)
    assert (found.labels == wanted.labels).mean() > 0.999


def test_row_0_of_the_labels_is_the_bottom_of_the_picture(tmp_path):
    item = rooms.shape("Chair", [[0, 15], [9, 19]], "rectangle")
    path = rooms.write_labelme(tmp_path / "a.json", [item], SIZE)
    labels = read_annotation(path, SIZE).regions
    assert (labels[:5, :10] == CHAIR).all()
    assert (labels[5:] == UNLABELLED).all()


def test_only_occupied_cells_take_a_class_and_those_just_beside_a_shape_too():
    scene = rooms.room_map()
    regions = np.full_like(scene.labels, UNLABELLED)
    regions[:, :100] = WALL
    labels = label_cells(scene, regions).labels
    assert (labels[scene.occupancy != OCCUPIED] == UNLABELLED).all()
    bottom = labels[10]  # the wall that runs through row 10
    assert (bottom[10:102] == WALL).all()
    assert (bottom[102:] == UNLABELLED).all()


def test_a_mapped_person_is_free_space():
    scene = rooms.room_map()
    regions = np.where(scene.labels == SEMANTIC2D.id_of("Pillar"), PERSON, scene.labels)
    found = label_cells(scene, regions.astype(np.uint8))
    pillar = scene.labels == SEMANTIC2D.id_of("Pillar")
    assert (found.occupancy[pillar] == FREE).all()
    assert (found.labels[pillar] == UNLABELLED).all()
    assert (found.occupancy[~pillar] == scene.occupancy[~pillar]).all()


@pytest.mark.parametrize("mode", ["P", "L", "RGB"])
def test_a_label_image_of_ids_or_colours_is_the_same_annotation(tmp_path, mode):
    scene = rooms.room_map()
    ids = np.where(scene.labels == UNLABELLED, 0, scene.labels).astype(np.uint8)[::-1]
    pixels = SEMANTIC2D.palette[ids] if mode == "RGB" else ids
    image = Image.fromarray(np.ascontiguousarray(pixels))
    if mode == "P":
        image.putpalette(SEMANTIC2D.palette.tobytes())
        assert image.mode == "P"
    image.save(tmp_path / "label.png")
    np.testing.assert_array_equal(
        read_annotation(tmp_path / "label.png", rooms.SHAPE).regions, scene.labels
    )


def test_a_person_before_a_wall_takes_only_the_cells_in_its_own_shape():
    scene = rooms.room_map()
    regions = np.full_like(scene.labels, UNLABELLED)
    regions[10, 50:60] = PERSON  # on the wall that runs through row 10
    found = label_cells(scene, regions)
    assert (found.occupancy[10, 50:60] == FREE).all()
    assert (found.occupancy[10, 45:50] == OCCUPIED).all()
    assert (found.occupancy[10, 60:65] == OCCUPIED).all()
    assert (found.labels == UNLABELLED).all()


def test_a_label_image_that_does_not_fit_is_an_error(tmp_path):
    def saved(pixels):
        Image.fromarray(pixels).save(tmp_path / "label.png")
        return tmp_path / "label.png"

    with pytest.raises(InvalidInputError, match="40 x 20 pixels, but the map has 30 x 20"):
        read_annotation(saved(np.zeros((20, 40), np.uint8)), SIZE)
    with pytest.raises(InvalidInputError, match=r"class ids 0 to 9.*found 17"):
        read_annotation(saved(np.full(SIZE, 17, np.uint8)), SIZE)
    with pytest.raises(InvalidInputError, match=r"colour \(1, 2, 3\) at column 0, row 0"):
        read_annotation(saved(np.full((*SIZE, 3), (1, 2, 3), np.uint8)), SIZE)
    (tmp_path / "label.png").write_bytes(b"no image")
    with pytest.raises(InvalidInputError, match="neither labelme JSON .* nor an image"):
        read_annotation(tmp_path / "label.png", SIZE)
    with pytest.raises(FileNotFoundError, match="none.png"):
        read_annotation(tmp_path / "none.png", SIZE)


def test_an_annotation_that_meets_no_occupied_cell_is_an_error(tmp_path):
    map_yaml, annotation = rooms.write_room(tmp_path)
    rooms.write_labelme(annotation, [rooms.shape("Wall", [[0, 0], [3, 3]], "rectangle")])
    with pytest.raises(AlignmentError, match="no occupied cell"):
        annotate_map(map_yaml, annotation)
    rooms.write_labelme(annotation, rooms.room_shapes())
    with pytest.raises(FileNotFoundError):
        annotate_map(tmp_path / "none.yaml", annotation)
    assert json.loads(annotation.read_text())["shapes"]


def test_every_cell_of_a_person_region_is_free_whatever_the_map_has_there():
    scene = rooms.room_map()
    regions = np.full_like(scene.labels, UNLABELLED)
    regions[:30, :30] = PERSON  # unknown space, walls and free space
    found = label_cells(scene, regions)
    assert {0, 100, 255} == set(np.unique(scene.occupancy[:30, :30]))
    assert (found.occupancy[:30, :30] == FREE).all()
    np.testing.assert_array_equal(found.occupancy[30:], scene.occupancy[30:])


def test_a_map_with_nothing_but_other_has_nothing_to_transfer(tmp_path):
    map_yaml, annotation = rooms.write_room(tmp_path)
    rooms.write_labelme(annotation, [rooms.shape("Other", [[0, 0], [179, 139]], "rectangle")])
    with pytest.raises(AlignmentError, match="no occupied cell of .*room.yaml lies in a labelled"):
        annotate_map(map_yaml, annotation)


def test_a_map_without_an_occupied_cell_is_told_to_check_its_settings(tmp_path):
    map_yaml, annotation = rooms.write_room(tmp_path)
    Image.fromarray(np.full(rooms.SHAPE, 254, np.uint8)).save(tmp_path / "room.pgm")
    with pytest.raises(AlignmentError, match=r"room.yaml: no cell is occupied.*negate"):
        annotate_map(map_yaml, annotation)


@given(
    regions=arrays(
        np.uint8,
        st.tuples(st.integers(1, 12), st.integers(1, 12)),
        elements=st.sampled_from([*range(len(SEMANTIC2D)), UNLABELLED]),
    )
)
def test_a_written_label_image_reads_back_the_same(tmp_path_factory, regions):
    path = tmp_path_factory.getbasetemp() / "labels.png"
    write_label_image(path, regions)
    found = read_annotation(path, regions.shape)
    np.testing.assert_array_equal(found.regions, regions)
    assert found.shapes == ()


def test_a_written_label_image_shows_the_classes_in_their_colours(tmp_path):
    write_label_image(tmp_path / "a.png", np.array([[WALL, UNLABELLED], [OTHER, CHAIR]], np.uint8))
    with Image.open(tmp_path / "a.png") as image:
        assert image.mode == "P"
        rgba = np.asarray(image.convert("RGBA"))
    wanted = [[[*SEMANTIC2D.colours[i], 255] for i in (OTHER, CHAIR)]]  # the largest y is on top
    assert rgba[:1].tolist() == wanted
    assert rgba[1].tolist() == [[*SEMANTIC2D.colours[WALL], 255], [255, 255, 255, 0]]


def test_ids_of_more_than_a_byte_are_not_cut_off(tmp_path):
    Image.fromarray(np.full(SIZE, 256 + CHAIR, np.uint16)).save(tmp_path / "a.png")
    with pytest.raises(InvalidInputError, match="found 257"):
        read_annotation(tmp_path / "a.png", SIZE)
    Image.fromarray(np.full(SIZE, CHAIR, np.uint16)).save(tmp_path / "a.png")
    assert (read_annotation(tmp_path / "a.png", SIZE).regions == CHAIR).all()


def test_a_truncated_label_image_is_refused(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 10, SIZE).astype(np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    whole = (tmp_path / "a.png").read_bytes()
    for length in (0, 20, 60, len(whole) // 2):
        (tmp_path / "a.png").write_bytes(whole[:length])
        with pytest.raises(InvalidInputError, match="image"):
            read_annotation(tmp_path / "a.png", SIZE)


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.0])
def test_the_origin_of_the_map_turns_with_its_labels(yaw, tmp_path):
    origin = Pose2(2.0, -1.0, yaw)
    write_map(tmp_path / "room.yaml", rooms.room_map(origin))
    annotation = rooms.write_labelme(tmp_path / "room.json", rooms.room_shapes())
    scene = annotate_map(tmp_path / "room.yaml", annotation)
    x, y = 3.025, 2.3  # on the left side of the pillar, from the corner of the grid
    c, s = np.cos(yaw), np.sin(yaw)
    row, column = scene.cells_of((2.0 + c * x - s * y, -1.0 + s * x + c * y))
    assert scene.labels[row, column] == SEMANTIC2D.id_of("Pillar")


@pytest.mark.parametrize(
    ("settings", "levels"),
    [({"negate": 1}, (255, 0)), ({"mode": "raw"}, (100, 0)), ({"mode": "scale"}, (0, 255))],
)
def test_maps_of_every_mode_can_be_annotated(settings, levels, tmp_path):
    map_yaml, annotation = rooms.write_room(tmp_path)
    occupied = rooms.room_map().occupancy == OCCUPIED
    image = np.where(occupied, *levels).astype(np.uint8)[::-1]
    Image.fromarray(np.ascontiguousarray(image)).save(tmp_path / "room.pgm")
    said = yaml.safe_load(map_yaml.read_text()) | settings
    map_yaml.write_text(yaml.safe_dump(said))
    scene = annotate_map(map_yaml, annotation)
    np.testing.assert_array_equal(scene.labels != UNLABELLED, occupied)


def test_the_published_map_and_its_label_image_are_read(shared_data):
    folder = shared_data / "temple_lobby"
    if not folder.is_dir():
        pytest.skip(f"{folder} is not present")
    scene = annotate_map(folder / "map.yaml", folder / "label.png")
    occupied = scene.occupancy == OCCUPIED
    assert occupied.sum() == 19854
    assert (scene.labels[occupied] != UNLABELLED).mean() > 0.999
    said = read_annotation(folder / "label.png", scene.occupancy.shape)
    people = said.regions == PERSON
    assert people.sum() == 4536
    assert (scene.occupancy[people] == FREE).all()
