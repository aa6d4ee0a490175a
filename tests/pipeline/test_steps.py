from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from filelock import FileLock

from semantic2d_dataset import cli, open_dataset
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.executors import Executor, Serial, open_executor
from semantic2d_dataset.format.manifest import find_problems, read_manifest
from semantic2d_dataset.pipeline.config import read_config
from semantic2d_dataset.pipeline.report import Report
from semantic2d_dataset.pipeline.steps import plan_pipeline, run_pipeline
from tests.clusters import cluster
from tests.pipeline.drives import config, files_of, room_drive, two_drives, write_config

COMMAND = "import sys; from semantic2d_dataset.cli import main; sys.argv[0] = 'semantic2d'; main()"


def make(folder: Path, executor: Executor | None = None, **changes: object) -> Report:
    said = config() | changes
    return run_pipeline(read_config(write_config(folder, said)), executor or Serial())


def states(report: Report) -> list[str]:
    return [row.state for row in report.rows]


def digests(folder: Path) -> dict[str, str]:
    """What the data set holds, whoever made it and when."""
    return {entry.id: entry.content_digest for entry in read_manifest(folder).sequences}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Recordings and a data set made of them; do not change it."""
    folder = tmp_path_factory.mktemp("pipeline") / "rooms"
    two_drives(folder)
    return folder, make(folder)


@pytest.fixture
def rooms(made, tmp_path):
    """A copy of it to change, with the same paths relative to the configuration."""
    return shutil.copytree(made[0], tmp_path / "rooms", symlinks=True)


def test_a_run_makes_a_data_set_of_labelled_sequences(made):
    folder, report = made
    assert (report.published, report.changed, report.failed) == (True, True, 0)
    assert states(report) == ["made", "made"]
    assert not find_problems(folder / "data", full=True)
    data = open_dataset(str(folder / "data"))
    assert data.manifest.name == "rooms"
    assert data.manifest.license == "CC0-1.0"
    assert [e.id for e in data.sequences()] == ["room--monday--scan-541", "room--second--scan-541"]
    assert sorted(data.manifest.splits) == ["block", "frame"]
    for entry in data.sequences():
        reader = data.reader(entry.id)
        assert reader.header.license == "CC0-1.0"
        assert reader.read("alignment/accepted").all()
        assert {5, 6, 7, 9} <= set(np.unique(reader.read("scans/labels")))
    row = report.as_dict()["recordings"][0]
    assert (row["scans"], row["accepted"], row["labelled_share"]) == (24, 24, 1.0)


def test_a_second_run_keeps_every_byte(rooms):
    before = files_of(rooms / "data")
    report = make(rooms)
    assert states(report) == ["kept", "kept"]
    assert (report.published, report.changed) == (True, False)
    assert files_of(rooms / "data") == before


def test_where_a_setting_of_labelling_changed_only_that_is_done_again(rooms):
    converted = files_of(rooms / "data" / "work" / "converted")
    before = digests(rooms / "data")
    said = config()
    said["recordings"][0]["salsa"] = {"transfer": {"object_m": 0.3}}
    report = make(rooms, **said)
    assert states(report) == ["labelled", "kept"]
    assert report.changed
    assert files_of(rooms / "data" / "work" / "converted") == converted
    after = digests(rooms / "data")
    assert [name for name in before if before[name] != after[name]] == ["room--monday--scan-541"]
    assert states(make(rooms, **said)) == ["kept", "kept"]


def test_where_the_annotation_changed_all_is_labelled_again(rooms):
    annotation = json.loads((rooms / "room.json").read_text())
    annotation["shapes"][1]["label"] = "chair"
    (rooms / "room.json").write_text(json.dumps(annotation))
    assert states(make(rooms)) == ["labelled", "labelled"]


def test_where_an_option_or_the_recording_changed_it_is_converted_again(rooms):
    said = config()
    said["recordings"][1]["convert"] = {"max_gap_s": 5.0}
    assert states(make(rooms, **said)) == ["kept", "made"]
    (rooms / "monday.bag").unlink()
    room_drive(rooms, "monday", kind="ros1", scans=20)
    report = make(rooms, **said)
    assert states(report) == ["made", "kept"]
    assert read_manifest(rooms / "data").sequences[0].scans == 20


def test_what_no_longer_belongs_is_set_aside(rooms):
    said = config()
    said["recordings"][1]["recording"] = "third"
    make(rooms, **said)
    assert list(digests(rooms / "data")) == ["room--monday--scan-541", "room--third--scan-541"]
    removed = rooms / "data" / "work" / "removed"
    assert [file.name for file in removed.iterdir()] == ["room--second--scan-541.h5"]


def test_splits_are_those_asked_for_and_leave_dropped_scans_out(rooms):
    (rooms / "drop.txt").write_text("2\n5-7\n")
    said = config()
    said["recordings"][0]["drop"] = "drop.txt"
    report = make(rooms, splits={"frame": {"seed": 7}}, **said)
    assert states(report) == ["kept", "kept"]
    assert report.changed
    data = open_dataset(str(rooms / "data"))
    assert list(data.manifest.splits) == ["frame"]
    assert [file.name for file in (rooms / "data" / "splits").iterdir()] == ["frame.h5"]
    membership = data.scheme("frame").membership
    dropped = np.flatnonzero(membership["room--monday--scan-541"] == 255)
    np.testing.assert_array_equal(dropped, [2, 5, 6, 7])
    assert (membership["room--second--scan-541"] != 255).all()
    assert not make(rooms, splits={"frame": {"seed": 7}}, **said).changed
    (rooms / "drop.txt").write_text("24\n")
    report = make(rooms, **said)
    assert "has 24 scans, from 0 to 23; found '24'" in report.rows[0].error


def test_another_version_is_published_of_what_is_there(rooms):
    report = make(rooms, version="1.1.0")
    assert (states(report), report.changed) == (["kept", "kept"], True)
    assert read_manifest(rooms / "data").version == "1.1.0"


def test_a_recording_that_fails_stops_no_other_and_the_old_data_set_stays(rooms):
    before = files_of(rooms / "data")
    (rooms / "bad.bag").write_bytes(b"no bag")
    rng = np.random.default_rng(0)
    said = config()
    said["salsa"] = {"acceptance": {"max_residual_m": 0.05}}
    said["recordings"][:0] = [{"path": "bad.bag", "map": "room"}]
    said["recordings"] += [{"path": "elsewhere", "map": "room"}]
    room_drive(rooms, "elsewhere", warp=lambda ranges: rng.uniform(0.3, 3.0, ranges.shape))
    report = make(rooms, **said)
    assert states(report) == ["failed", "labelled", "labelled", "failed"]
    assert "not a ROS bag" in report.rows[0].error
    assert "the scans do not fit the map" in report.rows[3].error
    assert (report.published, report.changed) == (False, False)
    assert files_of(rooms / "data") == before
    text = str(report)
    assert f"failed: {rooms}/bad.bag: " in text
    assert text.endswith(
        "2 of 4 recordings failed, so nothing was published; run again to go on from what is done"
    )
    said["recordings"] = said["recordings"][1:3]
    report = make(rooms, **said)
    assert states(report) == ["kept", "kept"]
    assert report.changed


def test_two_recordings_that_become_one_sequence_are_told(rooms):
    said = config()
    said["recordings"][0]["recording"] = "x"
    loaded = read_config(write_config(rooms, said))
    twin = replace(loaded.recordings[0], paths=loaded.recordings[1].paths, name="other")
    report = run_pipeline(replace(loaded, recordings=(loaded.recordings[0], twin)), Serial())
    assert states(report) == ["made", "failed"]
    assert "and so does room--x; give it another name" in report.rows[1].error


def test_only_some_recordings_are_made_and_nothing_is_published(made, tmp_path):
    folder = tmp_path / "rooms"
    shutil.copytree(made[0], folder, ignore=shutil.ignore_patterns("data"))
    said = read_config(folder / "data.yaml")
    report = run_pipeline(said, Serial(), only=["second"])
    assert states(report) == ["made"]
    assert not report.published
    assert str(report).endswith("nothing was published: 1 recordings were chosen, not all")
    assert [path.name for path in (folder / "data").iterdir()] == ["work"]
    assert states(run_pipeline(said, Serial())) == ["made", "kept"]


def test_a_dry_run_tells_the_steps_and_changes_nothing(rooms):
    before = sorted(rooms.rglob("*"))
    said = config()
    said["recordings"][0]["salsa"] = {"transfer": {"object_m": 0.3}}
    said["recordings"][1]["convert"] = {"max_gap_s": 5.0}
    plan = plan_pipeline(read_config(write_config(rooms, said)))
    assert [each["steps"] for each in plan] == [["label"], ["convert", "label"]]
    assert [each["recording"] for each in plan] == ["room--monday", "room--second"]
    plan = plan_pipeline(read_config(write_config(rooms, config())), only=["monday"])
    assert [each["steps"] for each in plan] == [[]]
    assert sorted(rooms.rglob("*")) == before


def test_a_folder_of_another_data_set_is_left_alone(rooms):
    before = files_of(rooms / "data")
    with pytest.raises(InvalidInputError, match="holds the data set 'rooms', not 'others'"):
        make(rooms, name="others")
    assert files_of(rooms / "data") == before


def test_two_runs_at_once_are_refused(rooms):
    with (
        FileLock(rooms / "data" / "work" / ".lock"),
        pytest.raises(InvalidInputError, match="another run is at work there"),
    ):
        make(rooms)


def test_a_file_in_the_way_of_the_folder_is_told(rooms):
    with pytest.raises(InvalidInputError, match="a file is in the way; choose another 'out'"):
        make(rooms, out="room.json")


def test_a_folder_of_somebody_s_is_not_taken_over(rooms):
    with pytest.raises(InvalidInputError, match=r"holds .*, which is read; choose a folder of its"):
        make(rooms, out=".")
    (rooms / "mine" / "sequences").mkdir(parents=True)
    (rooms / "mine" / "sequences" / "own.h5").write_bytes(b"mine")
    with pytest.raises(InvalidInputError, match="mine: holds files, but no data set"):
        make(rooms, out="mine")
    assert (rooms / "mine" / "sequences" / "own.h5").read_bytes() == b"mine"
    assert [path.name for path in (rooms / "mine").iterdir()] == ["sequences"]


def test_several_processes_make_the_same_as_one(made, tmp_path):
    folder = tmp_path / "rooms"
    shutil.copytree(made[0], folder, ignore=shutil.ignore_patterns("data"))
    with open_executor(jobs=2) as executor:
        report = make(folder, executor)
    assert states(report) == ["made", "made"]
    assert digests(folder / "data") == digests(made[0] / "data")


# --- the command ------------------------------------------------------------------------------


def run(*words, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["semantic2d", "run", *map(str, words)])
    with pytest.raises(SystemExit) as end:
        cli.main()
    said = capsys.readouterr()
    return end.value.code or 0, said.out, said.err


def test_the_command_prints_a_table_or_json_and_its_status_tells(rooms, capsys, monkeypatch):
    status, out, _ = run(rooms / "data.yaml", capsys=capsys, monkeypatch=monkeypatch)
    assert status == 0
    assert out.splitlines()[1].split() == [
        *("room--monday", "1", "24", "24", "100.0%"),
        *(out.splitlines()[1].split()[5], "kept"),
    ]
    assert out.endswith("data: rooms 1.0.0 is complete already\n")
    words = (rooms / "data.yaml", "--dry-run", "--only", "second")
    assert run(*words, capsys=capsys, monkeypatch=monkeypatch)[:2] == (0, "room--second: kept\n")
    (rooms / "monday.bag").write_bytes(b"no bag")
    words = (rooms / "data.yaml", "--json")
    status, out, _ = run(*words, capsys=capsys, monkeypatch=monkeypatch)
    assert status == 1
    words = (rooms / "data.yaml", "--dry-run")
    status, said, err = run(*words, capsys=capsys, monkeypatch=monkeypatch)
    assert (status, said) == (1, "room--second: kept\n")
    assert "room--monday: " in err
    assert "not a ROS bag" in err
    said = json.loads(out)
    assert [each["state"] for each in said["recordings"]] == ["failed", "kept"]
    status, _, err = run(rooms / "none.yaml", capsys=capsys, monkeypatch=monkeypatch)
    assert (status, err) == (1, f"error: {rooms}/none.yaml: no such file or directory\n")


def kill_when(folder: Path, pattern: str, sign: int, *words: object) -> tuple[int, str]:
    """Start a run, and end it as soon as a file of that pattern is there."""
    with subprocess.Popen(
        [sys.executable, "-c", COMMAND, "run", folder / "data.yaml", *map(str, words)],
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
    ) as process:
        until = time.monotonic() + 60
        while process.poll() is None and time.monotonic() < until:
            if list((folder / "data").glob(pattern)):
                break
            time.sleep(0.001)
        process.send_signal(sign)
        return process.wait(timeout=60), str(process.stderr.read())


KILLED_AT = {
    "converting": "work/converted/room--second/.*.partial",
    "labelling": "work/labelled/.*.partial",
    "publishing": "work/staged/sequences/*",
}


@pytest.mark.parametrize(
    ("step", "words"),
    [
        ("labelling", ()),
        *(pytest.param(s, ("--jobs", 2), marks=pytest.mark.long) for s in KILLED_AT),
    ],
)
def test_a_run_that_is_killed_goes_on_where_it_was(step, words, made, tmp_path):
    folder = tmp_path / "rooms"
    shutil.copytree(made[0], folder, ignore=shutil.ignore_patterns("data"))
    status, _ = kill_when(folder, KILLED_AT[step], signal.SIGKILL, *words)
    assert status == -signal.SIGKILL
    assert not (folder / "data" / "dataset.json").exists()
    report = make(folder)
    assert report.published
    assert digests(folder / "data") == digests(made[0] / "data")
    assert not list((folder / "data").rglob(".*.partial"))
    if step != "converting":
        assert states(report)[0] != "made"


def test_an_interrupted_run_says_so_and_leaves_nothing_half_done(made, tmp_path):
    folder = tmp_path / "rooms"
    shutil.copytree(made[0], folder, ignore=shutil.ignore_patterns("data"))
    status, said = kill_when(folder, KILLED_AT["labelling"], signal.SIGINT)
    assert status in (130, -signal.SIGINT)
    assert said.splitlines()[-1].startswith("interrupted")
    assert "Traceback" not in said
    assert not list((folder / "data").rglob(".*.partial"))


def test_killed_while_files_are_moved_no_half_data_set_is_there(rooms, monkeypatch):
    replace, moved = Path.replace, []

    def stop_at_the_second(self, target):
        if Path(target).parent.name == "sequences":
            moved.append(target)
            if len(moved) == 2:
                raise KeyboardInterrupt
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", stop_at_the_second)
    said = config() | {"salsa": {"transfer": {"object_m": 0.3}}}
    with pytest.raises(KeyboardInterrupt):
        make(rooms, **said)
    assert not (rooms / "data" / "dataset.json").exists()
    monkeypatch.undo()
    report = make(rooms, **said)
    assert states(report) == ["kept", "kept"]
    assert not find_problems(rooms / "data", full=True)


@pytest.mark.long
def test_a_cluster_makes_the_same_as_one_process_though_a_worker_is_killed_midway(tmp_path):
    pytest.importorskip("distributed")
    alone, apart = tmp_path / "alone", tmp_path / "apart"
    two_drives(alone, scans=3000)
    shutil.copytree(alone, apart)
    assert make(alone).published
    with cluster(tmp_path) as (address, workers):
        log = (apart / "log").open("wb")
        words = ("run", apart / "data.yaml", "--scheduler", address)
        process = subprocess.Popen(
            [sys.executable, "-c", COMMAND, *map(str, words)], stdout=log, stderr=log
        )
        until = time.monotonic() + 120
        while not list((apart / "data").glob("work/labelled/.*.partial")):
            assert process.poll() is None, (apart / "log").read_text()
            assert time.monotonic() < until
            time.sleep(0.01)
        workers[0].kill()
        assert process.poll() is None
        assert process.wait(timeout=300) == 0, (apart / "log").read_text()
        log.close()
    assert digests(apart / "data") == digests(alone / "data")
    assert not find_problems(apart / "data", full=True)
