from __future__ import annotations

import json
import subprocess
import sys

import pytest
import typer
from typer.testing import CliRunner

from conversion.cli import convert, parse_mount
from semantic2d_dataset.errors import InvalidInputError, RecordingError
from semantic2d_dataset.format.sequence import SequenceReader
from tests.conversion.recordings import straight_drive


def run(*arguments: object):
    app = typer.Typer()
    app.command()(convert)
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_the_summary_says_what_was_found_and_guessed(tmp_path):
    path = straight_drive("ros1").write(tmp_path)
    result = run(path, "--out", tmp_path / "out.h5")
    assert result.exit_code == 0
    assert "scans      12 of 12 of /scan" in result.stdout
    assert "11 of 12 scans (91.7%, from tf map -> odom -> base_link" in result.stdout
    assert "intensity  measured" in result.stdout
    assert "note       mount from tf" in result.stdout


def test_the_json_summary_is_for_programs_and_options_arrive(tmp_path):
    path = straight_drive("mcap").write(tmp_path)
    result = run(
        path, "--out", tmp_path / "out.h5", "--json", "--drop-without-pose", "--mount=1,2,3,0,0,.5",
        "--environment", "lab", "--recording-name", "day.1", "--license", "MIT", "--max-gap", 2,
    )  # fmt: skip
    assert result.exit_code == 0
    (outcome,) = json.loads(result.stdout)
    assert (outcome["recording"], outcome["error"]) == (str(path), None)
    (found,) = outcome["sequences"]
    assert (found["scans_in"], found["scans_out"]) == (12, 11)
    assert found["sequence_id"] == "lab--day.1--scan-8"
    assert (found["mount"], found["pose_max_gap_s"]) == ([1, 2, 3, 0, 0, 0.5], 2)
    with SequenceReader(tmp_path / "out.h5") as sequence:
        assert len(sequence) == 11
        assert sequence.header.license == "MIT"


def test_an_existing_file_is_replaced_only_by_force(tmp_path):
    path = straight_drive("db3").write(tmp_path)
    out = tmp_path / "out.h5"
    out.write_bytes(b"precious")
    result = run(path, "--out", out)
    assert isinstance(result.exception, InvalidInputError)
    assert "pass --force" in str(result.exception)
    assert out.read_bytes() == b"precious"
    assert run(path, "--out", out, "--force").exit_code == 0
    assert len(SequenceReader(out)) == 12


def test_a_failed_conversion_keeps_the_file_that_was_there(tmp_path):
    out = tmp_path / "out.h5"
    out.write_bytes(b"precious")
    (tmp_path / "bad.bag").write_bytes(b"no bag")
    result = run(tmp_path / "bad.bag", "--out", out, "--force")
    assert isinstance(result.exception, RecordingError)
    assert out.read_bytes() == b"precious"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bad.bag", "out.h5"]


def test_a_folder_of_bags_is_converted_and_what_fails_is_told_at_the_end(tmp_path):
    bags = tmp_path / "bags"
    bags.mkdir()
    for name in ("a", "b"):
        straight_drive("ros1").write(bags, name)
    (bags / "c.bag").write_bytes(b"no bag")
    result = run(bags, "--out", tmp_path / "out")
    assert result.exit_code == 1
    assert f"error: {bags / 'c.bag'}: not a ROS bag" in result.stderr
    assert "1 of 3 recordings could not be converted" in result.stderr
    assert result.stdout.count("12 of 12 of /scan") == 2
    assert len(list((tmp_path / "out").iterdir())) == 2
    again = run(bags / "a.bag", bags / "b.bag", "--out", tmp_path / "out")
    assert again.exit_code == 0
    assert again.stdout.count("complete already, 12 scans: kept") == 2


def test_files_of_one_recording_are_merged_on_request(tmp_path):
    first, second = straight_drive("ros1"), straight_drive("ros1", scans=20)
    second.messages = [m for m in second.messages if m[2] > first.messages[-1][2]]
    paths = [first.write(tmp_path, "morning"), second.write(tmp_path, "noon")]
    result = run(*paths, "--merge", "--out", tmp_path / "out.h5")
    assert "scans      20 of 20 of /scan" in result.stdout
    assert "19 of 20 scans" in result.stdout


@pytest.mark.parametrize("text", ["", "1,2,3", "1,2,3,4,5,six", "1,2,3,4,5,6,7"])
def test_a_mount_that_is_not_six_numbers_is_refused(text):
    with pytest.raises(InvalidInputError, match="expected six numbers"):
        parse_mount(text)


def test_listing_the_command_imports_nothing_heavy():
    code = (
        "import sys, conversion.cli; "
        "sys.exit(bool({'numpy', 'h5py', 'numba', 'rosbags', 'tqdm'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("kind", ["ros1", "db3"])
def test_a_file_of_the_recording_is_never_replaced(kind, tmp_path):
    path = straight_drive(kind).write(tmp_path)
    files = [path] if path.is_file() else sorted(path.iterdir())
    before = [file.read_bytes() for file in files]
    link = tmp_path / "link.h5"
    link.symlink_to(files[-1])
    for out in (*files, link):
        result = run(path, "--out", out, "--force")
        assert isinstance(result.exception, InvalidInputError)
        assert "belongs to the recording" in str(result.exception)
    assert [file.read_bytes() for file in files] == before


@pytest.mark.parametrize(
    "options", [("--max-gap", "inf"), ("--max-gap", "nan"), ("--environment", "")]
)
def test_options_that_mean_nothing_are_refused(options, tmp_path):
    result = run(straight_drive("db3").write(tmp_path), "--out", tmp_path / "out.h5", *options)
    assert isinstance(result.exception, InvalidInputError)
    assert not (tmp_path / "out.h5").exists()
