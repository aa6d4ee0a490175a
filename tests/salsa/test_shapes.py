import base64
import contextlib
import io
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageDraw

from salsa.shapes import paint, read_shapes
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, UNLABELLED
from tests.salsa import rooms

SIZE = (20, 30)
CHAIR, WALL, PERSON, TRASH = (
    SEMANTIC2D.id_of(name) for name in ("Chair", "Wall", "Person", "Trash bin")
)
KINDS = (
    "polygon",
    "rectangle",
    "oriented_rectangle",
    "circle",
    "line",
    "linestrip",
    "point",
    "points",
    "mask",
)


def drawn(folder, *items):
    """Class ids (H, W) of shapes; row 0 is the top."""
    return paint(read_shapes(rooms.write_labelme(folder / "a.json", list(items), SIZE), SIZE), SIZE)


@pytest.mark.parametrize("names", [("Wall", "Chair"), ("Chair", "Wall")])
def test_later_shapes_lie_on_top(tmp_path, names):
    box = [[2, 2], [12, 2], [12, 12], [2, 12]]
    earlier, later = names
    labels = drawn(tmp_path, rooms.shape(earlier, box), rooms.shape(later, box[:3]))
    assert set(np.unique(labels)) == {CHAIR, WALL, UNLABELLED}
    assert labels[4, 10] == SEMANTIC2D.id_of(later)
    assert labels[10, 4] == SEMANTIC2D.id_of(earlier)


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
        ("oriented_rectangle", [[5, 2], [11, 5], [8, 11], [2, 8]], 57, {}),
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


def test_labels_are_matched_whatever_their_case_and_published_spelling(tmp_path):
    for label, wanted in (
        ("People", PERSON),
        ("CHAIR", CHAIR),
        ("trash_bin", TRASH),
        ("wall ", WALL),
    ):
        labels = drawn(tmp_path, rooms.shape(label, [[0, 0], [5, 5]], "rectangle"))
        assert set(np.unique(labels)) == {wanted, UNLABELLED}


def test_all_labels_that_are_no_class_are_told_at_once(tmp_path):
    box = [[0, 0], [5, 5]]
    items = [rooms.shape(name, box, "rectangle") for name in ("Lamp", "Wall", "Shelf", "Lamp")]
    with pytest.raises(InvalidInputError) as told:
        drawn(tmp_path, *items)
    assert "'Lamp' in shapes 1, 4; 'Shelf' in shape 3" in str(told.value)
    assert "known are Other, Chair, Door" in str(told.value)


def test_what_else_labelme_writes_makes_no_difference(tmp_path):
    box = rooms.shape("Wall", [[2, 2], [8, 8]], "rectangle")
    plain = drawn(tmp_path, box)
    more = box | {"group_id": 7, "flags": {"old": True}, "description": "x", "mask": None}
    content = {
        "version": "6.3.1",
        "flags": {"checked": True},
        "shapes": [more],
        "imagePath": "../another.pgm",
        "imageData": "not an image",
        "imageHeight": SIZE[0],
        "imageWidth": SIZE[1],
    }
    (tmp_path / "b.json").write_text(json.dumps(content), encoding="utf-8")
    np.testing.assert_array_equal(paint(read_shapes(tmp_path / "b.json", SIZE), SIZE), plain)


@pytest.mark.parametrize(
    "corners",
    [
        [[-3.5, -2.2], [12.6, 1.4], [40.1, 25.7], [4.4, 17.5]],
        [[11.5, 7.2], [22.6, 9.4], [14.4, 15.5]],
        [[25, 15], [29.9, 15], [29.9, 19.9]],
    ],
)
def test_a_polygon_is_drawn_as_on_the_whole_image(tmp_path, corners):
    image = Image.new("L", SIZE[::-1], UNLABELLED)
    ImageDraw.Draw(image).polygon([tuple(p) for p in corners], fill=WALL, outline=WALL)
    np.testing.assert_array_equal(drawn(tmp_path, rooms.shape("Wall", corners)), np.asarray(image))


@pytest.mark.parametrize("place", [(12, 7), (-2, -1), (27, 18)])
def test_a_bitmap_lies_where_its_corner_does(tmp_path, place):
    x, y = place
    item = rooms.shape("Wall", [[x, y], [x + 5, y + 3]], "mask", mask=bitmap())
    wanted = np.full(SIZE, UNLABELLED, np.uint8)
    wanted[max(y, 0) : y + 4, max(x, 0) : x + 6] = WALL
    np.testing.assert_array_equal(drawn(tmp_path, item), wanted)


def test_strokes_are_three_pixels_wide_on_both_sides_of_a_line(tmp_path):
    upright = drawn(tmp_path, rooms.shape("Wall", [[12, 4], [12, 14]], "line"))
    wanted = np.full(SIZE, UNLABELLED, np.uint8)
    wanted[4:15, 11:14] = WALL
    np.testing.assert_array_equal(upright, wanted)
    flat = drawn(tmp_path, rooms.shape("Wall", [[4, 12], [14, 12]], "line"))
    wanted = np.full(SIZE, UNLABELLED, np.uint8)
    wanted[11:14, 4:15] = WALL
    np.testing.assert_array_equal(flat, wanted)


def test_a_shape_beside_the_image_covers_nothing(tmp_path):
    path = rooms.write_labelme(
        tmp_path / "a.json", [rooms.shape("Wall", [[-30, -30], [-10, -10]], "rectangle")], SIZE
    )
    (shape,) = read_shapes(path, SIZE)
    assert not shape.mask.any()
    assert shape.bounds == (-30, -30, -10, -10)


numbers = st.one_of(st.floats(), st.integers(-300, 300), st.none(), st.text(max_size=3))
points_of_any_kind = st.one_of(st.none(), st.lists(st.lists(numbers, max_size=3), max_size=5))


@given(
    label=st.one_of(st.sampled_from(SEMANTIC2D.names), st.text(max_size=5), st.none()),
    kind=st.one_of(st.sampled_from(KINDS), st.none(), st.integers()),
    points=points_of_any_kind,
    mask=st.one_of(st.none(), st.text(max_size=8), st.just(bitmap())),
)
def test_any_shape_is_drawn_or_refused_in_words(tmp_path_factory, label, kind, points, mask):
    folder = tmp_path_factory.getbasetemp()
    item = {"label": label, "shape_type": kind, "points": points, "mask": mask}
    with contextlib.suppress(InvalidInputError):
        labels = drawn(folder, item)
        assert labels.shape == SIZE


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
        read_shapes(path, SIZE)


@pytest.mark.parametrize(
    ("points", "shape_type", "message"),
    [
        ([[0, 0], [1, 1]], "polygon", "expected 3 or more finite points.*polygon"),
        ([[0, 0], [1, float("nan")], [2, 2]], "polygon", "finite points"),
        ([[0, 0], [9, 0], [9, 9]], "oriented_rectangle", "expected 4 or more.*oriented_rectangle"),
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


@pytest.mark.parametrize(
    ("kind", "size", "says"),
    [("PNG", (2000, 4), "2000 x 4 pixels, more than"), ("GIF", (4, 4), "cannot identify")],
)
def test_a_mask_larger_than_the_image_or_of_another_format_is_an_error(tmp_path, kind, size, says):
    data = io.BytesIO()
    Image.new("L", size).save(data, kind)
    mask = base64.b64encode(data.getvalue()).decode()
    with pytest.raises(InvalidInputError, match=f"shape 1: its mask cannot be read .*{says}"):
        drawn(tmp_path, rooms.shape("Wall", [[0, 0], [4, 4]], "mask", mask=mask))
