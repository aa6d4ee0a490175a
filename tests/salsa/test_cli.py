import json

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from salsa.cli import app
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


def test_the_summary_is_printed_even_where_the_picture_fails(words, tmp_path, monkeypatch):
    def fail(*_paths):
        raise OSError("disk full")

    monkeypatch.setattr("salsa.pictures.plot_labelled_sequence", fail)
    result = CliRunner().invoke(app, [*words, f"--plot={tmp_path / 'a.png'}"])
    assert str(result.exception) == "disk full"
    assert "6 accepted" in result.output
