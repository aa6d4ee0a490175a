import json

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from salsa.annotation import annotate_map
from salsa.cli import app
from salsa.labelmerc import labelmerc
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.sequence import SequenceReader
from tests.salsa import rooms
from tests.salsa.test_sequences import write_source


@pytest.fixture
def words(tmp_path):
    truth = rooms.true_poses(6)
    write_source(tmp_path / "in.h5", rooms.batch_at(truth, rooms.rough_poses(truth)))
    map_yaml, annotation = rooms.write_room(tmp_path)
    return [
        "label",
        str(tmp_path / "in.h5"),
        f"--map={map_yaml}",
        f"--annotation={annotation}",
        f"--out={tmp_path / 'out.h5'}",
    ]


def test_label_prints_what_came_of_it_and_draws_it(words, tmp_path):
    result = CliRunner().invoke(app, [*words, "--plot", str(tmp_path / "picture.png")])
    assert result.exit_code == 0, result.output
    assert "6 scans, 6 with a pose, 6 accepted" in result.output
    assert "Wall" in result.output
    with Image.open(tmp_path / "picture.png") as picture:
        colours = np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0)
    assert [227, 0, 0] in colours.tolist()


def test_json_can_be_read_by_a_program(words):
    result = CliRunner().invoke(app, [*words, "--json"])
    assert json.loads(result.stdout)["scans_accepted"] == 6


def test_a_second_run_needs_force(words):
    runner = CliRunner()
    assert runner.invoke(app, words).exit_code == 0
    assert isinstance(runner.invoke(app, words).exception, InvalidInputError)
    assert runner.invoke(app, [*words, "--force"]).exit_code == 0


def test_limits_of_static_things_reach_the_provenance(words, tmp_path):
    result = CliRunner().invoke(app, [*words, "--static-after", "30"])
    assert result.exit_code == 0, result.output
    with SequenceReader(tmp_path / "out.h5") as reader:
        said = reader.header.provenance["salsa"]["parameters"]["persistence"]
    assert said["min_seconds"] == 30
    result = CliRunner().invoke(app, [*words, "--static-after", "0", "--force"])
    assert result.exit_code == 0, result.output
    with SequenceReader(tmp_path / "out.h5") as reader:
        assert reader.header.provenance["salsa"]["parameters"]["persistence"] is None


@pytest.mark.parametrize("name", ["in.h5", "room.yaml", "room.pgm", "none/a.png", "a.bmpx"])
def test_a_picture_that_cannot_be_written_is_refused_before_any_work(words, name, tmp_path):
    result = CliRunner().invoke(app, [*words, "--force", f"--plot={tmp_path / name}"])
    assert isinstance(result.exception, InvalidInputError)
    assert not (tmp_path / "out.h5").exists()


def test_an_input_is_no_picture_and_a_picture_is_replaced_only_by_force(words, tmp_path):
    picture = tmp_path / "room.png"
    with Image.open(tmp_path / "room.pgm") as image:
        image.save(picture)
    before = picture.read_bytes()
    refused = CliRunner().invoke(app, [*words, f"--plot={picture}"])
    assert "exists already" in str(refused.exception)
    settings = (tmp_path / "room.yaml").read_text()
    (tmp_path / "room.yaml").write_text(settings.replace("room.pgm", "room.png"))
    refused = CliRunner().invoke(app, [*words, "--force", f"--plot={picture}"])
    assert "is an input itself" in str(refused.exception)
    assert picture.read_bytes() == before
    assert not (tmp_path / "out.h5").exists()


def review(*words):
    return CliRunner().invoke(app, ["review", *map(str, words)])


def test_review_writes_a_page_and_replaces_one_only_by_force(labelled_room, tmp_path):
    page = tmp_path / "page.html"
    result = review(labelled_room, "--out", page)
    assert result.exit_code == 0, result.output
    assert f"wrote {page}" in result.output
    page.write_text("mine")
    assert "exists already" in str(review(labelled_room, "--out", page).exception)
    assert page.read_text() == "mine"
    assert review(labelled_room, "--out", page, "--force").exit_code == 0
    assert "Review of labelled.h5" in page.read_text()


def test_review_drops_scans_into_a_cleaned_copy_and_shows_that(labelled_room, tmp_path):
    (tmp_path / "scans.txt").write_text("# blurred\n3\n10-12\n")
    words = ("--out", tmp_path / "page.html", "--drop", tmp_path / "scans.txt")
    result = review(labelled_room, *words, "--cleaned", tmp_path / "cleaned.h5")
    assert result.exit_code == 0, result.output
    assert f"wrote {tmp_path / 'cleaned.h5'}: 4 scans dropped" in result.output
    assert "Review of cleaned.h5" in (tmp_path / "page.html").read_text()
    with SequenceReader(tmp_path / "cleaned.h5") as reader:
        assert not reader.read("alignment/accepted")[[3, 10, 11, 12]].any()


def test_review_refuses_before_anything_is_written(labelled_room, tmp_path):
    listed = tmp_path / "scans.txt"
    listed.write_text("3\n9999\n")
    drop, page = ("--drop", listed), ("--out", tmp_path / "page.html")
    cleaned = ("--cleaned", tmp_path / "cleaned.h5")
    for words in (drop, cleaned):
        result = review(labelled_room, *page, *words)
        assert result.exit_code == 2
        assert "belong together" in result.output
    found = review(labelled_room, *page, *drop, *cleaned).exception
    assert "line 2: the sequence has 60 scans" in str(found)
    for target in ((labelled_room, *cleaned), (listed, *cleaned), (cleaned[1], *cleaned)):
        result = review(labelled_room, "--out", target[0], *drop, *target[1:], "--force")
        assert "is an input itself" in str(result.exception)
    result = review(labelled_room, *page, *drop, "--cleaned", labelled_room, "--force")
    assert "is an input itself" in str(result.exception)
    assert [path.name for path in tmp_path.iterdir()] == ["scans.txt"]


def test_the_summary_is_printed_even_where_the_picture_fails(words, tmp_path, monkeypatch):
    def fail(*_paths):
        raise OSError("disk full")

    monkeypatch.setattr("salsa.pictures.plot_labelled_sequence", fail)
    result = CliRunner().invoke(app, [*words, f"--plot={tmp_path / 'a.png'}"])
    assert str(result.exception) == "disk full"
    assert "6 accepted" in result.output


@pytest.fixture
def room(tmp_path):
    """The words that check a map, and the folder that it lies in."""
    map_yaml, annotation = rooms.write_room(tmp_path)
    return ["map", str(map_yaml), str(annotation)]


def test_map_says_what_the_annotation_holds_and_what_to_look_at(room, tmp_path):
    shapes = [shape for shape in rooms.room_shapes() if shape["label"] != "Wall"]
    rooms.write_labelme(tmp_path / "room.json", shapes)
    result = CliRunner().invoke(app, room)
    assert result.exit_code == 0, result.output
    for said in (
        "180 x 140 pixels of 5 cm, 9.0 x 7.0 m",
        "3 shapes",
        "Pillar",
        "no class",
        "become Other",
        "m long, at pixel (",
    ):
        assert said in result.output


def test_map_says_when_there_is_nothing_to_look_at(room):
    assert "nothing to look at" in CliRunner().invoke(app, room).output


def test_map_prints_json_for_a_program(room):
    found = json.loads(CliRunner().invoke(app, [*room, "--json"]).stdout)
    assert found["unlabelled"] == 0
    assert found["warnings"] == []
    assert [shape["name"] for shape in found["shapes"]] == ["Wall", "Pillar", "Table", "Sofa"]


def test_the_label_image_that_map_writes_is_the_same_annotation(room, tmp_path):
    image = tmp_path / "labels.png"
    result = CliRunner().invoke(app, [*room, f"--out={image}", f"--plot={tmp_path / 'map.png'}"])
    assert result.exit_code == 0, result.output
    from_json, from_image = (annotate_map(tmp_path / "room.yaml", p) for p in (room[2], image))
    np.testing.assert_array_equal(from_image.labels, from_json.labels)
    assert CliRunner().invoke(app, ["map", room[1], str(image)]).exit_code == 0
    with Image.open(tmp_path / "map.png") as picture:
        assert min(picture.size) > 300


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("--out=labels.jpg", "end its name in .png"),
        ("--out=none/labels.png", "does not exist"),
        ("--plot=map.txt", "ends in one of"),
        ("--plot=none/map.png", "does not exist"),
        ("--out=old.png", "exists already"),
        ("--plot=old.png", "exists already"),
    ],
)
def test_map_refuses_names_that_cannot_be_written(room, option, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "old.png").write_bytes(b"kept")
    before = sorted(tmp_path.iterdir())
    result = CliRunner().invoke(app, [*room, option])
    assert result.exit_code == 1
    assert message in str(result.exception)
    assert sorted(tmp_path.iterdir()) == before
    assert (tmp_path / "old.png").read_bytes() == b"kept"


def test_map_writes_neither_over_an_input_nor_two_things_into_one_file(room, tmp_path):
    image = tmp_path / "labels.png"
    assert CliRunner().invoke(app, [*room, f"--out={image}"]).exit_code == 0
    for words in (["map", room[1], str(image), "--force"], [*room, f"--plot={image}", "--force"]):
        result = CliRunner().invoke(app, [*words, f"--out={image}"])
        assert isinstance(result.exception, InvalidInputError)
    assert CliRunner().invoke(app, [*room, f"--out={image}", "--force"]).exit_code == 0


def test_map_of_another_size_is_an_error_and_nothing_is_written(room, tmp_path):
    rooms.write_labelme(tmp_path / "room.json", rooms.room_shapes(), (140, 181))
    result = CliRunner().invoke(app, [*room, f"--out={tmp_path / 'labels.png'}"])
    assert "181 x 140 pixels, but the map has 180 x 140" in str(result.exception)
    assert not (tmp_path / "labels.png").exists()


def test_labelmerc_is_written_once(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, ["labelmerc"])
    assert result.exit_code == 0, result.output
    assert "labelme --config .labelmerc" in result.output
    assert (tmp_path / ".labelmerc").read_text() == labelmerc()
    (tmp_path / ".labelmerc").write_text("mine")
    assert isinstance(CliRunner().invoke(app, ["labelmerc"]).exception, InvalidInputError)
    assert (tmp_path / ".labelmerc").read_text() == "mine"
    assert CliRunner().invoke(app, ["labelmerc", "--force"]).exit_code == 0
    assert (tmp_path / ".labelmerc").read_text() == labelmerc()


def test_a_camera_and_its_detections_need_each_other(words):
    for option in (["--camera", "camera.yaml"], ["--detections", "seen.json"]):
        result = CliRunner().invoke(app, [*words, *option])
        assert isinstance(result.exception, InvalidInputError)
        assert "--camera and --detections need each other" in str(result.exception)


def test_other_classes_reach_the_check_and_labelme(tmp_path):
    rooms.write_room(tmp_path)
    shapes = [*rooms.room_shapes(), rooms.shape("dog", rooms.pixel_box(rooms.BOXES["Pillar"]))]
    rooms.write_labelme(tmp_path / "room.json", shapes)
    (tmp_path / "classes.yaml").write_text("extends: semantic2d\nclasses: {Dog: [9, 9, 9]}")
    words = ["map", str(tmp_path / "room.yaml"), str(tmp_path / "room.json")]
    assert "no class: 'dog' in shape 5" in str(CliRunner().invoke(app, words).exception)
    other = ["--taxonomy", str(tmp_path / "classes.yaml")]
    result = CliRunner().invoke(app, [*words, *other, "--plot", str(tmp_path / "map.png")])
    assert result.exit_code == 0, result.exception
    assert "Dog" in result.output
    out = tmp_path / "labelmerc"
    result = CliRunner().invoke(app, ["labelmerc", "--out", str(out), *other])
    assert result.exit_code == 0, result.exception
    assert "Dog" in out.read_text(encoding="utf-8")
