"""Detections from JSON files, and from streams of a sequence."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from conversion.ros.bags import Bag
from conversion.ros.streams import read_streams
from salsa.detections import Detections, read_detections, read_names
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.sequence import SequenceHeader, SequenceReader, SequenceWriter
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, Taxonomy
from tests.conversion.detections import FOXY, HUMBLE, NOETIC, detection_drive
from tests.generators import SMALL_LIDAR, make_arrays
from tests.salsa.test_detection_files import DOG_BOX, OWN, START_NS

TAXONOMY = Taxonomy((*SEMANTIC2D.names, "Dog"), (*SEMANTIC2D.colours, (120, 80, 20)))
PERSON, DOG = TAXONOMY.id_of("Person"), TAXONOMY.id_of("Dog")


@pytest.fixture(scope="module")
def reader(tmp_path_factory):
    """A sequence with a stream of each kind of detections."""
    path = tmp_path_factory.mktemp("detections") / "a.h5"
    header = SequenceHeader(environment="lab", recording="one", lidar=SMALL_LIDAR)
    with SequenceWriter(path, header) as writer:
        writer.append(make_arrays(3))
        for name, arrays in streams().items():
            writer.append({f"streams/{name}/{key}": rows for key, rows in arrays.items()})
    with SequenceReader(path) as opened:
        yield opened


def streams():
    new = ("bbox.center.position.x", "bbox.center.position.y", "bbox.size_x", "bbox.size_y")
    old = ("bbox.center.x", "bbox.center.y", "bbox.size_x", "bbox.size_y")
    what, score = "results.hypothesis.class_id", "results.hypothesis.score"
    rows = [
        (20, 30, 20, 10, 1, 0.75),
        (40, 50, 4, 6, 0, 1.0),
        (40, 50, 4, 6, np.nan, np.nan),  # nothing was said of what it is
        (40, 50, 0, 6, 0, 1.0),
        (40, 50, 4, 6, -1, 1.0),
    ]
    words = {what: ["person", "dog"], "id": ["t1"]}
    return {
        "new": stream((*new, what, score), rows, {"words": words}, offsets=(0, 1, 1, 5)),
        "old": stream(
            (*old, "results.id", "results.score"), [(20, 30, 20, 10, 18, 0.75)], {}, offsets=(0, 1)
        ),
        "one-each": stream(
            (*new, "class_name", "score"),
            [(20, 30, 20, 10, 0, 0.75)],
            {"words": {"class_name": ["dog"]}},
        ),
        "odom": stream(("pose.x", "pose.y"), [(1.0, 2.0)], {}),
        "torn": stream((*new, what, score), rows, {"words": words}, offsets=(0, 1, 1, 9)),
    }


def stream(columns, rows, more, offsets=None):
    """Messages 50 ns apart, the last first."""
    said = {"topic": "/detections", "columns": columns} | more
    messages = len(rows) if offsets is None else len(offsets) - 1
    arrays = {
        "stamps_ns": START_NS + 50 * np.arange(messages)[::-1],
        "data": np.array(rows, float),
        "about": np.frombuffer(json.dumps(said).encode(), np.uint8),
    }
    return arrays if offsets is None else arrays | {"offsets": np.array(offsets)}


def read(content, reader, folder, **options):
    path = folder / "detections.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return read_detections(path, reader, TAXONOMY, **options)


def test_frames_are_sorted_and_doubtful_boxes_left_out(reader, tmp_path):
    found = read(OWN, reader, tmp_path)
    assert found.stamps_ns.tolist() == [START_NS, START_NS + 50, START_NS + 100]
    assert found.offsets.tolist() == [0, 0, 1, 2]
    assert found.boxes.tolist() == [[1, 2, 3, 4], [10, 20.5, 30, 40]]
    assert found.class_ids.tolist() == [PERSON, DOG]
    assert found.scores.tolist() == [1.0, 0.75]
    assert len(read(OWN, reader, tmp_path, min_score=0.2)) == 3


def test_frames_of_one_stamp_become_one(reader, tmp_path):
    frames = [{"stamp_ns": 5, "detections": [DOG_BOX]}] * 2
    found = read({"frames": frames}, reader, tmp_path)
    assert (found.stamps_ns.tolist(), found.offsets.tolist()) == ([5], [0, 2])


def test_a_stream_gives_the_boxes_that_have_a_class_and_an_area(reader):
    found = read_detections("stream:new", reader, TAXONOMY)
    assert found.stamps_ns.tolist() == [START_NS, START_NS + 50, START_NS + 100]
    assert found.offsets.tolist() == [0, 1, 1, 2]
    assert found.boxes.tolist() == [[38, 47, 42, 53], [10, 25, 30, 35]]
    assert found.class_ids.tolist() == [PERSON, DOG]
    assert found.scores.tolist() == [1.0, 0.75]


def test_a_stream_with_numbers_for_classes_takes_their_names(reader):
    found = read_detections("stream:old", reader, TAXONOMY, names={"18": "dog"})
    assert (found.class_ids.tolist(), found.boxes.tolist()) == ([DOG], [[10, 25, 30, 35]])
    with pytest.raises(InvalidInputError, match="stream:old: detected classes '18' are not known"):
        read_detections("stream:old", reader, TAXONOMY)


def test_a_stream_of_single_detections_is_read(reader):
    found = read_detections("stream:one-each", reader, TAXONOMY)
    assert (found.class_ids.tolist(), found.offsets.tolist()) == ([DOG], [0, 1])


@pytest.mark.parametrize(
    ("kind", "definition", "names"),
    [
        ("ros1", NOETIC, (18, 1)),
        ("db3", FOXY, ("dog", "person")),
        ("mcap", HUMBLE, ("dog", "person")),
    ],
)
def test_detections_come_back_from_a_bag_of_any_release(kind, definition, names, tmp_path):
    dog, person = names
    frames = [[(20.0, 30.0, 20.0, 10.0, {person: 0.2, dog: 0.75})], [], [(4.0, 5.0, 2.0, 2.0, {})]]
    bag_path = detection_drive(kind, definition, frames).write(tmp_path)
    header = SequenceHeader(environment="lab", recording="one", lidar=SMALL_LIDAR)
    with SequenceWriter(tmp_path / "a.h5", header) as writer, Bag(bag_path) as bag:
        writer.append(make_arrays(3))
        for arrays in read_streams(bag, ["/detections"], 0, 2**63 - 1):
            writer.append(arrays)
    with SequenceReader(tmp_path / "a.h5") as reader:
        found = read_detections("stream:detections", reader, TAXONOMY, names={"18": "Dog"})
    assert len(found.stamps_ns) == 3
    assert found.boxes.tolist() == [[10, 25, 30, 35]]
    assert (found.class_ids.tolist(), found.scores.tolist()) == ([DOG], [0.75])


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("none", r"stream:none: there is no such stream; there are new, odom, old, .*--stream"),
        ("odom", r"expected a column bbox.center.position.x or bbox.center.x"),
        ("torn", r"its offsets do not divide the 5 detections"),
    ],
)
def test_a_stream_that_holds_no_detections_is_told(name, message, reader):
    with pytest.raises(InvalidInputError, match=message):
        read_detections(f"stream:{name}", reader, TAXONOMY)


def classes(*names):
    boxes = [{"box": [1, 2, 3, 4], "class": name} for name in names]
    return {"frames": [{"stamp_ns": START_NS, "detections": boxes}]}


def test_all_classes_that_are_not_known_are_listed_at_once(reader, tmp_path):
    with pytest.raises(InvalidInputError) as told:
        read(classes("cat", "dog", "kite", 3), reader, tmp_path)
    assert "detections.json: detected classes '3', 'cat', 'kite' are not known" in str(told.value)
    assert "known are Other, Chair, Door" in str(told.value)


def test_classes_can_be_another_or_nothing(reader, tmp_path):
    content = classes("puppy", "handbag", "couch", "pedestrian")
    names = {"puppy": "Dog", "handbag": None, "couch": "Sofa"}
    found = read(content, reader, tmp_path, names=names)
    assert found.class_ids.tolist() == [DOG, TAXONOMY.id_of("Sofa"), PERSON]
    with pytest.raises(
        InvalidInputError, match="the class named for 'puppy': unknown class 'Wolf'"
    ):
        read(content, reader, tmp_path, names={"puppy": "Wolf"})


def test_names_come_from_a_file(tmp_path):
    (tmp_path / "names.yaml").write_text("18: Dog\nhandbag:\n", encoding="utf-8")
    assert read_names(tmp_path / "names.yaml") == {"18": "Dog", "handbag": None}
    for text, message in (
        ("[1]", "names.yaml: expected a mapping"),
        ("a: [", "names.yaml: not a YAML or JSON file"),
        ("dog: 3", "names.yaml: 'dog': expected a class"),
    ):
        (tmp_path / "names.yaml").write_text(text, encoding="utf-8")
        with pytest.raises(InvalidInputError, match=message):
            read_names(tmp_path / "names.yaml")


def test_a_file_without_an_image_is_told(reader, tmp_path):
    with pytest.raises(InvalidInputError, match="detections.json: holds no image"):
        read({"frames": []}, reader, tmp_path)


def test_a_missing_file_and_a_score_out_of_range_are_told(reader, tmp_path):
    with pytest.raises(FileNotFoundError):
        read_detections(tmp_path / "none.json", reader, TAXONOMY)
    with pytest.raises(InvalidInputError, match="min_score: expected 0 to 1"):
        read(OWN, reader, tmp_path, min_score=2)


@given(
    frames=st.dictionaries(
        st.integers(0, 2**63 - 1),
        st.lists(
            st.tuples(
                st.floats(-100, 100), st.floats(1, 50), st.floats(0.5, 1), st.sampled_from("DP")
            ),
            max_size=3,
        ),
        min_size=1,
        max_size=5,
    )
)
def test_every_box_comes_back_with_its_image(frames, reader, tmp_path_factory):
    content = [
        {
            "stamp_ns": stamp,
            "detections": [
                {"box": [x, x, x + size, x + size], "class": letter, "score": score}
                for x, size, score, letter in boxes
            ],
        }
        for stamp, boxes in frames.items()
    ]
    names = {"D": "Dog", "P": "Person"}
    found = read({"frames": content}, reader, tmp_path_factory.mktemp("boxes"), names=names)
    assert found.stamps_ns.tolist() == sorted(frames)
    for i, stamp in enumerate(sorted(frames)):
        rows = slice(found.offsets[i], found.offsets[i + 1])
        assert found.boxes[rows, 0].tolist() == [x for x, _, _, _ in frames[stamp]]
        assert found.scores[rows].tolist() == [score for _, _, score, _ in frames[stamp]]
        ids = [TAXONOMY.id_of(names[letter]) for _, _, _, letter in frames[stamp]]
        assert found.class_ids[rows].tolist() == ids


GOOD = Detections(
    np.array((1, 2)),
    np.array((0, 1, 1)),
    np.array(((1.0, 2.0, 3.0, 4.0),)),
    np.array((DOG,), np.uint8),
    np.array((0.5,)),
)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"stamps_ns": np.array((2, 1))}, "must increase"),
        ({"stamps_ns": np.array((1, 1))}, "must increase"),
        ({"stamps_ns": np.array((1.0, 2.0))}, "stamps_ns: expected int64"),
        ({"offsets": np.array((0, 1))}, "offsets: expected int64"),
        ({"offsets": np.array((0, 2, 1))}, "offsets do not divide the 1 boxes"),
        ({"offsets": np.array((0, 0, 0))}, "offsets do not divide the 1 boxes"),
        ({"boxes": np.array(((1.0, 2.0, 1.0, 4.0),))}, "left < right"),
        ({"boxes": np.array(((1.0, 2.0, np.inf, 4.0),))}, "left < right"),
        ({"scores": np.array((np.nan,))}, "scores: expected 0 to 1"),
        ({"class_ids": np.array((1,))}, "class_ids: expected uint8"),
    ],
)
def test_arrays_that_are_no_detections_are_refused(change, message):
    assert len(GOOD) == 1
    with pytest.raises(InvalidInputError, match=message):
        replace(GOOD, **change)
