import base64
import io
import json

import numpy as np
import pytest
from PIL import Image

from salsa.annotation import annotate_map, label_cells, read_annotation
from semantic2d_dataset.errors import AlignmentError, InvalidInputError
from semantic2d_dataset.scene.maps import FREE, OCCUPIED
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, UNLABELLED
from tests.salsa import rooms

SIZE = (20, 30)
CHAIR, WALL, PERSON = (SEMANTIC2D.id_of(name) for name in ("Chair", "Wall", "Person"))


def drawn(tmp_path, *shapes):
    return read_annotation(rooms.write_labelme(tmp_path / "a.json", list(shapes), SIZE), SIZE).regions


def test_annotating_the_room_gives_each_surface_its_class(tmp_path):
    found, wanted = annotate_map(*rooms.write_room(tmp_path)), rooms.room_map()
    np.testing.assert_array_equal(found.occupancy, wanted.occupancy)
    np.testing.assert_array_equal(found.labels != UNLABELLED, wanted.occupancy == OCCUPIED)
    assert (found.labels == wanted.labels).mean() > 0.999


def test_row_0_of_the_labels_is_the_bottom_of_the_picture(tmp_path):
    labels = drawn(tmp_path, rooms.shape("Chair", [[0, 15], [9, 19]], "rectangle"))
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


def test_later_shapes_lie_on_top(tmp_path):
    box = [[2, 2], [12, 2], [12, 12], [2, 12]]
    labels = drawn(tmp_path, rooms.shape("Wall", box), rooms.shape("Chair", box[:3]))
    assert set(np.unique(labels)) == {CHAIR, WALL, UNLABELLED}
    assert labels[SIZE[0] - 1 - 4, 10] == CHAIR


def bitmap():
    data = io.BytesIO()
    Image.fromarray(np.full((4, 6), 255, np.uint8)).save(data, "PNG")
    return base64.b64encode(data.getvalue()).decode()


@pytest.mark.parametrize(
    ("shape_type", "points", "cells", "more"),
    [
        ("polygon", [[2, 2], [8, 2], [8, 8], [2, 8]], 49, {}),
        ("rectangle", [[8, 8], [2, 2]], 49, {}),
        ("rectangle", [[2, 2], [8, 2], [8, 8], [2, 8]], 49, {}),
        ("circle", [[10, 10], [15, 10]], 81, {}),
        ("line", [[2, 5], [20, 5]], 57, {}),
        ("linestrip", [[2, 5], [20, 5], [20, 15]], 88, {}),
        ("point", [[5, 5]], 9, {}),
        ("points", [[5, 5], [15, 5]], 18, {}),
        ("mask", [[3, 3], [8, 6]], 24, {"mask": bitmap()}),
    ],
)
def test_every_shape_type_of_labelme_is_drawn(tmp_path, shape_type, points, cells, more):
    labels = drawn(tmp_path, rooms.shape("chair", points, shape_type, **more))
    assert (labels == CHAIR).sum() == pytest.approx(cells, rel=0.35)
    assert set(np.unique(labels)) == {CHAIR, UNLABELLED}


def test_names_are_matched_whatever_their_spelling_and_the_unknown_listed(tmp_path):
    labels = drawn(tmp_path, rooms.shape("People", [[0, 0], [5, 5]], "rectangle"))
    assert (labels == PERSON).any()
    with pytest.raises(InvalidInputError, match=r"shape 1: unknown class 'Lamp'.*Chair, Door"):
        drawn(tmp_path, rooms.shape("Lamp", [[0, 0], [5, 5]], "rectangle"))


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
        read_annotation(tmp_path / "label.png", rooms.SHAPE), scene.labels
    )


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "not a labelme JSON"),
        ("[]", "list of `shapes`"),
        (
            '{"shapes": [], "imageHeight": "20", "imageWidth": 30}',
            "whole numbers, found '20' and 30",
        ),
        ('{"shapes": 3}', "list of `shapes`"),
        ('{"shapes": [], "imageHeight": 20, "imageWidth": 31}', "31 x 20 pixels, but the map"),
        ('{"shapes": []}', "whole numbers, found None and None"),
        ('{"shapes": [3], "imageHeight": 20, "imageWidth": 30}', "shape 1: expected a label"),
        ('{"shapes": [{"label": "Wall"}], "imageHeight": 20, "imageWidth": 30}', "points"),
    ],
)
def test_a_malformed_annotation_says_what_is_wrong(tmp_path, content, message):
    path = tmp_path / "a.json"
    path.write_text(content, encoding="utf-8")
    with pytest.raises(InvalidInputError, match=message):
        read_annotation(path, SIZE)


@pytest.mark.parametrize(
    ("points", "shape_type", "message"),
    [
        ([[0, 0], [1, 1]], "polygon", "a polygon needs 3"),
        ([[0, 0], [1, float("nan")], [2, 2]], "polygon", "finite points"),
        ([[0, 0], [1, 1]], "spline", "unknown shape type 'spline'"),
        ([[0, 0, 0]], "point", "points"),
        ([[0, 0], [4, 4]], "mask", "mask cannot be read"),
        ([[0, 0], [1, 1]], ["polygon"], "unknown shape type"),
        ([[0, 10**400], [1, 1]], "line", "shape 1: expected a label and points"),
        ([[0, 0], [1e30, 1]], "line", "up to 361 pixels, 10 diagonals of the image, found 1e.30"),
        ([[-360, 0], [360, 0]], "circle", "radii up to 361 pixels.*found 720"),
    ],
)
def test_a_malformed_shape_says_what_is_wrong(tmp_path, points, shape_type, message):
    with pytest.raises(InvalidInputError, match=message):
        drawn(tmp_path, rooms.shape("Wall", points, shape_type))


def test_a_mask_of_other_letters_than_ascii_is_an_error(tmp_path):
    item = rooms.shape("Wall", [[0, 0], [4, 4]], "mask", mask="\u00e9")
    with pytest.raises(InvalidInputError, match="shape 1: its mask cannot be read"):
        drawn(tmp_path, item)


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
    with pytest.raises(InvalidInputError, match=r"class ids 0 to 9.*found \[17\]"):
        read_annotation(saved(np.full(SIZE, 17, np.uint8)), SIZE)
    with pytest.raises(InvalidInputError, match=r"colour \(1, 2, 3\) at column 0, row 0"):
        read_annotation(saved(np.full((*SIZE, 3), (1, 2, 3), np.uint8)), SIZE)
    (tmp_path / "label.png").write_bytes(b"no image")
    with pytest.raises(InvalidInputError, match="neither labelme JSON nor an image"):
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
