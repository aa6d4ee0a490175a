import json
import subprocess
import sys

import pytest
from typer.testing import CliRunner

from leaderboard.cli import app
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
