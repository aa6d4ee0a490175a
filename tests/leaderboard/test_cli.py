import json
import re
import subprocess
import sys

import pytest
from typer.testing import CliRunner

from leaderboard.cli import app
from leaderboard.entries import seal, to_json
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scoring.submission import result_to_json
from tests.leaderboard.test_table import TRUTH, result_of


@pytest.fixture
def paths(tmp_path):
    for name, prediction in (("walls", [9] * 8), ("perfect", TRUTH)):
        (tmp_path / f"{name}.json").write_text(result_to_json(result_of(name, prediction)))
    return [str(tmp_path / "walls.json"), str(tmp_path / "perfect.json")]


def test_table_prints_the_best_method_first(paths):
    found = CliRunner().invoke(app, ["table", *paths])
    assert found.exit_code == 0
    assert [line.split()[1] for line in found.stdout.splitlines()] == ["Method", "perfect", "walls"]


def test_table_prints_markdown_and_json_on_request(paths):
    markdown = CliRunner().invoke(app, ["table", *paths, "--markdown"]).stdout
    assert markdown.splitlines()[1].startswith("| --: | :-- | --: |")
    found = json.loads(CliRunner().invoke(app, ["table", *paths, "--json"]).stdout)
    assert [row["method"] for row in found] == ["perfect", "walls"]


def test_wrong_usage_exits_with_2(paths):
    assert CliRunner().invoke(app, ["table"]).exit_code == 2
    assert CliRunner().invoke(app, ["table", *paths, "--json", "--markdown"]).exit_code == 2


def test_bad_input_reaches_the_caller_as_an_error_of_this_package(tmp_path):
    (tmp_path / "empty.json").touch()
    found = CliRunner().invoke(app, ["table", str(tmp_path / "empty.json")])
    assert isinstance(found.exception, InvalidInputError)


def test_listing_the_command_imports_nothing_heavy():
    code = "import sys, leaderboard.cli; print({'numba', 'jsonschema', 'h5py'} & set(sys.modules))"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout == "set()\n"


def run(*words):
    return CliRunner().invoke(app, [str(word) for word in words])


def test_the_way_from_predictions_to_pages(tmp_path, dataset_folder, predictions_folder):
    entries, site = tmp_path / "entries", tmp_path / "site"
    entries.mkdir()
    fair = predictions_folder / "fair.h5"
    options = ("--entries", entries)
    added = run("add", fair, "--data", dataset_folder, *options)
    assert added.exit_code == 0, added.exception
    assert "mIoU" in added.stdout
    assert run("published", *options).stdout.startswith("wrote 17 entries")
    at_hand = ("--data", dataset_folder, "--predictions", predictions_folder)
    checked = run("check", *options, *at_hand)
    assert checked.exit_code == 0
    assert "fair.json: verified" in checked.stdout
    assert run("build", site, *options, *at_hand).exit_code == 0
    assert (site / "index.html").is_file()


def test_seeds_are_added_and_verified_together(tmp_path, dataset_folder, seeds_folder):
    entries, paths = tmp_path / "entries", sorted(seeds_folder.iterdir())
    entries.mkdir()
    options = ("--data", dataset_folder, "--entries", entries)
    urls = [word for path in paths for word in ("--url", f"https://host/{path.name}")]
    added = run("add", *paths, *urls, *options)
    assert re.search(r"mIoU \d+\.\d\d ± \d\.\d\d, mCA .+ over 3 seeds", added.stdout), added
    again = json.loads(run("add", *reversed(paths), *options, "--force", "--json").stdout)
    assert again["seeds"] == 3
    assert again["std"]["mIoU"] > 0
    at_hand = ("--predictions", seeds_folder, "--strict")
    checked = run("check", "--data", dataset_folder, "--entries", entries, *at_hand)
    assert checked.exit_code == 0
    assert checked.stdout.endswith("net.json: verified\n")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--url", "https://host/0.h5"), "3 predictions and 1 addresses: give one --url for each"),
        (("--sanity",), "a sanity row has no seeds"),
    ],
)
def test_seeds_with_wrong_options_are_wrong_usage(tmp_path, seeds_folder, words, message):
    found = run("add", *sorted(seeds_folder.iterdir()), "--entries", tmp_path, *words)
    assert found.exit_code == 2
    assert message in " ".join(re.sub("[│\n]", " ", found.output).split())
    assert not list(tmp_path.iterdir())


def test_check_fails_on_wrong_entries_and_on_unverified_ones_where_asked(board):
    assert run("check", "--entries", board).exit_code == 0
    assert run("check", "--entries", board, "--strict").exit_code == 1
    path = sorted(board.iterdir())[0]
    path.write_text(path.read_text().replace('"points": ', '"points": 1'))
    found = run("check", "--entries", board, "--json")
    assert found.exit_code == 1
    fields = [problem["field"] for problem in json.loads(found.stdout)[0]["problems"]]
    assert "result.points" in fields


def test_sanity_predictions_can_be_added(tmp_path, dataset_folder):
    (tmp_path / "entries").mkdir()
    out = tmp_path / "majority.h5"
    words = ("--data", dataset_folder, "--lidar", "small")
    assert run("sanity", "majority", "--out", out, *words).exit_code == 0
    options = ("--data", dataset_folder, "--entries", tmp_path / "entries", "--sanity")
    assert run("add", out, *options).exit_code == 0
    with pytest.raises(InvalidInputError, match="exists already"):
        raise run("sanity", "majority", "--out", out, *words).exception


def test_a_private_test_set_from_data_to_ledger(tmp_path, dataset_folder, predictions_folder):
    public, hidden, ledger = (tmp_path / name for name in ("public", "hidden", "ledger.json"))
    made = run("private", "make", dataset_folder, public, hidden)
    assert made.exit_code == 0, made.exception
    options = ("--labels", hidden, "--ledger", ledger, "--submitter", "ann")
    assert "(new)" in run("private", "score", predictions_folder / "fair.h5", *options).stdout
    again = run("private", "score", predictions_folder / "poor.h5", *options)
    assert "as before: not better by 1.00" in again.stdout
    shown = run("private", "ledger", ledger)
    assert "2 lines, none was changed" in shown.stdout


@pytest.mark.parametrize(
    "words",
    [
        ("add", "none.h5"),
        ("check", "--entries", "none"),
        ("build", "site", "--entries", "none"),
        ("published", "--entries", "none"),
        ("check", "--predictions", "none"),
        ("private", "ledger", "none.json"),
    ],
)
def test_what_is_not_there_is_an_error_and_no_traceback(words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = run(*words)
    assert isinstance(found.exception, InvalidInputError | FileNotFoundError)
    assert not list(tmp_path.iterdir())


def test_an_address_that_fails_stops_no_other(board, tmp_path):
    paths = sorted(board.iterdir())
    for path in paths[:2]:
        said = json.loads(path.read_text())
        said["predictions_url"] = f"https://other.example/{path.stem}.h5"
        path.write_text(to_json(seal(said)))
    found = run(
        *("fetch", "--entries", board, "--to", tmp_path / "files", "--host", "zenodo.org"),
    )
    assert found.exit_code == 1
    assert found.stderr.count("other.example is none of zenodo.org") == 2
    assert f"{paths[2].name}: points to no predictions" in found.stdout


def test_a_path_with_spaces_is_told_so_that_it_can_be_typed(tmp_path, dataset_folder):
    out = tmp_path / "my files" / "majority.h5"
    out.parent.mkdir()
    words = ("--data", dataset_folder, "--lidar", "small")
    assert f"add '{out}' --sanity" in run("sanity", "majority", "--out", out, *words).stdout
