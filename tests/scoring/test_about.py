import re

import h5py
import pytest
import yaml

from semantic2d_dataset import cli
from semantic2d_dataset.access.registry import open_dataset
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D
from semantic2d_dataset.scoring.about import pack, read_about, remarks_on, write_template
from semantic2d_dataset.scoring.predictions import (
    PredictionsReader,
    PredictionsWriter,
    metadata_problems,
)
from semantic2d_dataset.scoring.submission import score_predictions

SAID = {
    "method": "guess",
    "features": "RIA",
    "training_data": "generated 1.0.0 block",
    "parameters": 7,
    "seeds": [3],
    "note": "of my own",
}


@pytest.fixture
def predictions(dataset_folder, tmp_path):
    data = open_dataset(dataset_folder)
    with PredictionsWriter(
        tmp_path / "p.h5",
        dataset="generated",
        dataset_version="1.0.0",
        scheme="block",
        split="test",
        taxonomy=SEMANTIC2D,
        metadata=SAID,
    ) as writer:
        for entry in data.manifest.sequences:
            indices = data.scheme("block").scans_of(entry.id, "test")
            labels = data.reader(entry.id).read("scans/labels")[indices]
            writer.add(entry.id, indices, labels % 5)
    return tmp_path / "p.h5"


def test_a_template_holds_what_the_predictions_say(predictions):
    said = yaml.safe_load(write_template(predictions))
    assert said == {
        "method": "guess",
        "track": {"features": "RIA", "training_data": "generated 1.0.0 block"},
        "parameters": 7,
        "seeds": [3],
        "note": "of my own",
    }


def test_a_template_whose_fields_all_lost_their_first_character_is_valid(predictions, tmp_path):
    lines = write_template(predictions).splitlines()
    filled = [re.sub(r"^#(?=\w|  )", "", line) for line in lines]  # not "# What ..."
    said = yaml.safe_load("\n".join(filled))
    assert metadata_problems(said) == []
    assert remarks_on(said) == []
    (tmp_path / "about.yaml").write_text("\n".join(filled))
    with pytest.raises(InvalidInputError) as caught:
        read_about(tmp_path / "about.yaml")
    for name in ("authors", "paper", "code", "hardware"):
        number = next(n for n, line in enumerate(filled, 1) if line.startswith(f"{name}:"))
        assert f"line {number}: {name}: still the example" in str(caught.value)
    assert set(said) >= {"authors", "paper", "code", "track", "hardware", "scans_per_second"}
    assert set(said["track"]) == {"features", "training_data", "other_data"}


def test_packing_changes_the_description_alone(predictions, dataset_folder, tmp_path):
    about = tmp_path / "about.yaml"
    about.write_text("method: better\npaper: https://example.org/1\nauthors: [A, B]\n")
    pack(predictions, read_about(about), tmp_path / "s.h5")
    data = open_dataset(dataset_folder)
    before, after = (score_predictions(tmp_path / name, data) for name in ("p.h5", "s.h5"))
    assert after["submission"]["metadata"]["method"] == "better"
    for result in (before, after):
        del result["submission"]
    assert before == after
    with PredictionsReader(tmp_path / "s.h5") as reader:
        assert reader.metadata["authors"] == ["A", "B"]


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ("paper: https://example.org", "'method' is a required property"),
        ("method: x\npaper: ftp://example.org", "line 2: paper: expected an address"),
        ("- method", "expected fields and values that say what a method is, found ['method']"),
        ("# method: x", "expected fields and values that say what a method is, found nothing"),
        ("method: [", "not a YAML file"),
        ("method: x\nparameters: many", "line 2: parameters: expected a whole number"),
        ("method: x\nautors: [a]", "line 2: autors: expected text, a number, true or false"),
        ("method: x\nautors: [a]", "did you mean 'authors'?"),
        ("method: x\ntrack:\n  feature: R", "line 2: track: unknown field 'feature'; did you mean"),
        ("method: x\nauthors: [a, '']", "line 2: authors[1]: expected a name of 1 to 200"),
        ("method: x\npaper: example.org", "expected an address such as https://example.org/paper"),
        ("method: x\nseeds: [1]\nmethod: y", "method: given in lines 1, 3; keep one"),
        ("method: x\n12: y", "expected text as the name of a field, found 12"),
        ("method: x\ntrack: {12: y}", "expected text as the name of a field, found 12"),
        ("method: x\nscans_per_second: .nan", "line 2: scans_per_second: expected a finite number"),
        ("method: x\nhardware: .inf", "line 2: hardware: expected a finite number, found inf"),
    ],
)
def test_a_description_that_does_not_fit_is_refused(tmp_path, said, message):
    (tmp_path / "about.yaml").write_text(said)
    with pytest.raises(InvalidInputError, match=r"about\.yaml") as caught:
        read_about(tmp_path / "about.yaml")
    assert message in str(caught.value)


def test_all_that_is_wrong_in_a_description_is_said_at_once(tmp_path):
    (tmp_path / "about.yaml").write_text("method: x\nauthors: a\nseeds: 1\ncode: [b]\n")
    with pytest.raises(InvalidInputError) as caught:
        read_about(tmp_path / "about.yaml")
    for line, name in enumerate(("authors", "seeds", "code"), 2):
        assert f"\n  - line {line}: {name}: expected " in str(caught.value)


def test_what_a_description_leaves_out_and_what_may_be_a_slip_is_remarked():
    silent, slip = remarks_on({"method": "x", "features": "R", "hardwre": "y", "mood": "good"})
    assert silent.startswith("does not say: authors, paper, code, parameters, hardware")
    assert "features" not in silent
    assert slip == "hardwre: a field of your own; did you mean 'hardware'?"


@pytest.mark.parametrize("url", ["https://a.org", "http://a.org:80/x?y=1#z", "https://a.org/~x/"])
def test_web_addresses_are_accepted(url):
    assert metadata_problems({"method": "m", "paper": url, "code": url}) == []


@pytest.mark.parametrize(
    "change",
    [
        {"paper": "javascript:alert(1)"},
        {"paper": "https://a.org/'onclick='x"},
        {"code": 'https://a.org/"><script>'},
        {"code": "https://a.org/ x"},
        {"code": "https://user@a.org/"},
        {"paper": "https://a.org/\n"},
        {"paper": "https://a.org/" + "x" * 500},
        {"method": "\u202eevil"},
        {"method": "zero\u200bwidth"},
        {"method": "two\nlines"},
        {"method": "x" * 201},
        {"authors": ["ok", "\x1b]0;x\x07"]},
        {"authors": ["x"] * 101},
        {"hardware": "\x00"},
        {"track": {"features": 3}},
        {"track": {"unknown": "x"}},
        {"parameters": 10**16},
        {"parameters": 1.5},
        {"scans_per_second": 0},
        {"seeds": [2**64]},
        {"deep": {"er": {}}},
        {"x" * 41: 1},
        {"\x1b": 1},
        {"name\n": 1},
        {f"k{n}": n for n in range(60)},
    ],
)
def test_what_no_page_should_get_is_refused(change):
    problems = metadata_problems({"method": "m"} | change)
    assert problems
    assert all(len(problem) < 700 for problem in problems)


def test_the_commands_note_what_is_left_out_and_where_a_data_set_is_looked_for(
    predictions, tmp_path, monkeypatch, capsys
):
    def run(*words):
        monkeypatch.setattr("sys.argv", ["semantic2d", *map(str, words)])
        with pytest.raises(SystemExit) as end:
            cli.main()
        return end.value.code or 0, capsys.readouterr().err

    about = tmp_path / "about.yaml"
    assert run("submission", "new", predictions, about) == (0, "")
    status, err = run("submission", "pack", predictions, about, "--out", tmp_path / "s.h5")
    left_out = "authors, paper, code, hardware, scans_per_second, scans_per_second_measured"
    assert (status, err) == (0, f"note: {about}: does not say: {left_out}, other_data\n")
    status, err = run("submission", "validate", tmp_path / "s.h5")
    assert status == 1
    assert f"\n{tmp_path / 's.h5'} names it; if you have it in a folder, add --data FOLDER" in err


def test_what_a_file_does_not_say_can_be_said_to_the_validator(
    predictions, dataset_folder, monkeypatch, capsys
):
    with h5py.File(predictions, "r+") as file:
        del file.attrs["scheme"], file.attrs["split"]
    for more, status in (((), 1), (("--scheme", "block", "--split", "test"), 0)):
        words = ["submission", "validate", predictions, "--data", dataset_folder, *more]
        monkeypatch.setattr("sys.argv", ["semantic2d", *map(str, words)])
        with pytest.raises(SystemExit) as end:
            cli.main()
        assert (end.value.code or 0) == status
        assert ("no problem(s)" in capsys.readouterr().out) == (status == 0)
