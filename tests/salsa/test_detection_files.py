"""JSON files of detections: what is read, and what is refused with the entry that is wrong."""

import json
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from salsa.detection_files import read_json
from semantic2d_dataset.errors import InvalidInputError, Semantic2DError

START_NS = 1_700_000_000_000_000_000
DOG_BOX = {"box": [10, 20.5, 30, 40], "class": "dog", "score": 0.75}
OWN = {
    "frames": [
        {"stamp_ns": START_NS + 100, "detections": [DOG_BOX]},
        {"stamp_ns": START_NS, "detections": []},
        {
            "stamp_ns": START_NS + 50,
            "detections": [
                {"box": [1, 2, 3, 4], "class": "person"},
                {"box": [5, 6, 7, 8], "class": "dog", "score": 0.25},
            ],
        },
    ]
}
COCO = {
    "images": [{"id": 7, "stamp_ns": START_NS}, {"id": 8, "stamp_ns": START_NS + 100}],
    "annotations": [
        {"image_id": 8, "category_id": 18, "bbox": [10, 20.5, 20, 19.5], "score": 0.75},
    ],
    "categories": [{"id": 18, "name": "dog"}],
}


def read(content, folder):
    path = folder / "detections.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return read_json(path)


def test_a_file_of_our_own_gives_all_images_and_all_boxes(tmp_path):
    stamps, entries = read(OWN, tmp_path)
    assert stamps == [START_NS + 100, START_NS, START_NS + 50]
    assert [(entry.name, entry.score) for entry in entries] == [
        ("dog", 0.75),
        ("person", 1.0),
        ("dog", 0.25),
    ]
    assert entries[0].box == (10, 20.5, 30, 40)


def test_a_file_in_the_manner_of_coco_is_read(tmp_path):
    stamps, entries = read(COCO, tmp_path)
    assert stamps == [START_NS, START_NS + 100]
    assert entries == [(START_NS + 100, (10, 20.5, 30, 40), "dog", 0.75)]


def changed(content, *path, to):
    """A deep copy with one value changed, or left out."""
    *path, key = path
    copy = json.loads(json.dumps(content))
    holder = copy
    for part in path:
        holder = holder[part]
    if to is KeyError:
        del holder[key]
    else:
        holder[key] = to
    return copy


BOX = ("frames", 0, "detections", 0)
NOTE = ("annotations", 0)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "not a JSON file"),
        ("[" * 100_000, "not a JSON file"),
        ([], "expected an object with `frames`, or with `images`"),
        ({"frames": 3}, "frames: expected a list, found 3"),
        ({"frames": [3]}, r"frames\[0\]: expected an object with `stamp_ns`, found 3"),
        (changed(OWN, "frames", 1, "detections", to=KeyError), r"frames\[1\]: .*`detections`"),
        (changed(OWN, "frames", 1, "stamp_ns", to=1.5), r"frames\[1\].stamp_ns: expected a whole"),
        (changed(OWN, "frames", 1, "stamp_ns", to=True), r"frames\[1\].stamp_ns: expected a whole"),
        (changed(OWN, "frames", 1, "stamp_ns", to=2**63), r"frames\[1\].stamp_ns: expected nano"),
        (
            changed(OWN, *BOX, "box", to=[1, 2, 3]),
            r"frames\[0\].detections\[0\].box: expected 4 num",
        ),
        (changed(OWN, *BOX, "box", to=[1, 2, "3", 4]), r"detections\[0\].box: expected 4 numbers"),
        (changed(OWN, *BOX, "box", to=[1, 2, float("nan"), 4]), r"\.box: expected 4 numbers"),
        (
            changed(OWN, *BOX, "box", to=[3, 2, 1, 4]),
            r"detections\[0\]: expected a box with left < r",
        ),
        (changed(OWN, *BOX, "class", to=KeyError), r"detections\[0\]: .*`class`"),
        (changed(OWN, *BOX, "class", to=None), r"detections\[0\].class: expected a name or number"),
        (
            changed(OWN, *BOX, "score", to=75),
            r"detections\[0\].score: expected a number from 0 to 1",
        ),
        (changed(OWN, *BOX, "score", to=True), r"detections\[0\].score: expected a number"),
        (
            changed(COCO, *NOTE, "image_id", to=9),
            r"annotations\[0\].image_id: no image has the id 9",
        ),
        (
            changed(COCO, *NOTE, "category_id", to=1),
            r"annotations\[0\].category_id: no category has",
        ),
        (
            changed(COCO, *NOTE, "bbox", to=[1, 2, 0, 4]),
            r"annotations\[0\]: expected a box with left",
        ),
        (changed(COCO, "images", 0, "stamp_ns", to=KeyError), r"images\[0\]: .*`stamp_ns`"),
        (changed(COCO, "categories", to=KeyError), "expected an object with `categories`"),
    ],
)
def test_the_entry_that_is_wrong_is_named(content, message, tmp_path):
    with pytest.raises(InvalidInputError, match=rf"detections.json: .*{message}"):
        read(content, tmp_path)


def test_a_missing_file_is_told(tmp_path):
    with pytest.raises(FileNotFoundError):
        read_json(tmp_path / "none.json")


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(
            st.sampled_from(("stamp_ns", "detections", "box", "class", "score")), inner, max_size=4
        )
    ),
    max_leaves=12,
)


@given(frames=st.lists(JSON, max_size=3))
def test_any_json_is_read_or_refused_with_our_own_error(frames, tmp_path_factory):
    folder = tmp_path_factory.mktemp("any")
    with suppress(Semantic2DError):
        read({"frames": frames}, folder)
