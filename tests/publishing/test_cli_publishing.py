import json

import pytest

from semantic2d_dataset import cli
from tests.publishing.rooms import make_rooms


@pytest.fixture
def run(monkeypatch, capsys):
    def run_it(*words):
        monkeypatch.setattr("sys.argv", ["semantic2d", *map(str, words)])
        try:
            cli.main()
            status = 0
        except SystemExit as end:
            status = end.code or 0
        said = capsys.readouterr()
        return status, said.out, said.err

    return run_it


def test_a_folder_is_released_looked_at_and_released_again(run, tmp_path):
    rooms = make_rooms(tmp_path / "rooms")
    words = ("release", rooms, "--version", "1.0.0", "--name", "rooms", "--license", "MIT")
    status, out, _ = run(*words)
    assert status == 0
    assert "released rooms 1.0.0" in out
    assert "look at this: the data set says MIT, and 3 sequence(s) say otherwise" in out
    status, out, _ = run(*words, "--json")
    assert json.loads(out)["changed"] is False
    assert run("verify", rooms, "--full")[0] == 0
    status, out, _ = run("card", rooms)
    assert out == (rooms / "DATASET_CARD.md").read_text()
    status, out, _ = run("card", rooms, "--out", tmp_path / "card.md")
    assert (tmp_path / "card.md").read_text() == (rooms / "DATASET_CARD.md").read_text()


def test_a_version_that_the_change_does_not_allow_exits_1_and_says_which_does(run, tmp_path):
    rooms = make_rooms(tmp_path / "rooms")
    run("release", rooms, "--version", "1.0.0", "--name", "rooms")
    status, _, err = run("release", rooms, "--version", "1.0.0", "--license", "MIT")
    assert status == 1
    assert "release it with --version 1.0.1" in err


def test_a_contribution_with_an_error_exits_1(run, tmp_path):
    rooms = make_rooms(tmp_path / "rooms")
    status, out, _ = run("contribute", "check", rooms, "--json")
    assert status == 1  # labels at random
    assert json.loads(out)["errors"] > 0
    status, _, err = run("contribute", "check", tmp_path / "nothing")
    assert status == 1
    assert "does not exist" in err


@pytest.mark.parametrize("file", ["dataset.json", "SHA256SUMS", "DATASET_CARD.md", "release.yaml"])
def test_a_card_never_takes_the_place_of_what_it_is_about(file, run, tmp_path):
    rooms = make_rooms(tmp_path / "rooms")
    (rooms / "release.yaml").write_text("title: Rooms\n")
    run("release", rooms, "--version", "1.0.0", "--name", "rooms")
    before = (rooms / file).read_bytes()
    status, _, err = run("card", rooms, "--out", rooms / file)
    assert status == 1
    assert "choose another name" in err
    assert (rooms / file).read_bytes() == before
