"""The command line: one clear message and the right exit status for whatever it is given."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time

import pytest

from semantic2d_dataset import __version__, cli, load_dataset, load_lidars
from semantic2d_dataset.errors import DatasetNotFoundError
from semantic2d_dataset.format.manifest import read_manifest
from tests.access import hosts
from tests.conftest import PROJECT
from tests.generators import make_sequence
from tests.pipeline.published import HOKUYO, WLR, pack_archives, write_registry


@pytest.fixture
def run(monkeypatch, capsys):
    """Run the command in this process; returns exit status, output and messages."""

    def run_it(*words):
        monkeypatch.setattr(sys, "argv", ["semantic2d", *map(str, words)])
        try:
            cli.main()
            status = 0
        except SystemExit as end:
            status = end.code or 0
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return run_it


def test_version(run):
    assert run("--version") == (0, f"semantic2d-dataset {__version__}\n", "")


def test_help_lists_every_command(run):
    status, out, _ = run("--help")
    assert status == 0
    for command in (
        "info",
        "verify",
        "download",
        "release",
        "card",
        "diff",
        "contribute",
        "list",
        "show",
        "remove",
        "simulate",
        "score",
        "score-part",
        "score-merge",
        "report",
        "compare",
        "corrupt",
        "robustness",
        "submission",
        "plot",
        "view",
        "run",
        "convert",
        "salsa",
        "baseline",
        "leaderboard",
    ):
        assert f"\n  {command} " in out


@pytest.mark.parametrize(
    "words", [["convert"], ["salsa", "label"], ["baseline", "train"], ["leaderboard", "table"]]
)
def test_commands_of_siblings_have_help(words, run):
    status, out, _ = run(*words, "--help")
    assert status == 0
    assert f"Usage: semantic2d {' '.join(words)}" in out


@pytest.mark.parametrize(
    "words",
    [
        ["nothing"],
        ["info"],
        ["verify", "--nothing"],
        ["simulate", "x", "--scans", "many"],
        ["simulate", "x", "--scans", "0"],
        ["simulate", "x", "--seed", "-1"],
        ["run"],
        ["run", "x", "--jobs", "0"],
        ["convert"],
        ["salsa", "nothing"],
        ["salsa", "label"],
        ["baseline", "train"],
        ["leaderboard", "table"],
        ["score"],
        ["score-part", "x", "two/4", "y"],
        ["score-merge"],
        ["compare", "x"],
        ["submission", "nothing"],
        ["corrupt", "x", "y", "--severity", "6"],
    ],
)
def test_wrong_usage_exits_with_2(words, run):
    status, _, err = run(*words)
    assert status == 2
    assert "Usage: semantic2d" in err


@pytest.fixture
def bad_files(tmp_path, dataset_folder):
    """One file of each wrong kind."""
    make_sequence(tmp_path / "good.h5", 10)
    whole = (tmp_path / "good.h5").read_bytes()
    (tmp_path / "truncated").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "empty").write_bytes(b"")
    (tmp_path / "wrong-kind").write_text("hello")
    (tmp_path / "folder").mkdir()
    return tmp_path


COMMANDS = {
    "info": ["info", "{bad}"],
    "verify": ["verify", "{bad}"],
    "score": ["score", "{bad}"],
    "score-part": ["score-part", "{bad}", "1/2", "{out}"],
    "score-merge": ["score-merge", "{bad}", "--out", "{out}"],
    "compare": ["compare", "{bad}", "{bad}"],
    "submission new": ["submission", "new", "{bad}", "{out}"],
    "submission pack": ["submission", "pack", "{bad}", "{bad}", "--out", "{out}"],
    "submission validate": ["submission", "validate", "{bad}"],
    "submission show": ["submission", "show", "{bad}"],
    "robustness": ["robustness", "{bad}", "{bad}"],
    "report": ["report", "{bad}", "--out", "{out}"],
    "plot": ["plot", "{bad}", "--out", "{out}.png"],
    "view": ["view", "{bad}", "--save", "{out}"],
    "salsa review": ["salsa", "review", "{bad}", "--out", "{out}"],
    "convert": ["convert", "{bad}", "--out", "{out}"],
    "salsa sequence": [
        "salsa",
        "label",
        "{bad}",
        "--map",
        "{bad}",
        "--annotation",
        "{bad}",
        "--out",
        "{out}",
    ],
    "salsa map": [
        "salsa",
        "label",
        "{good}",
        "--map",
        "{bad}",
        "--annotation",
        "{bad}",
        "--out",
        "{out}",
    ],
    "train": ["baseline", "train", "s3net", "--data", "{bad}", "--out", "{out}"],
    "predict": ["baseline", "predict", "{bad}", "--out", "{out}"],
    "leaderboard": ["leaderboard", "table", "{bad}"],
    "run": ["run", "{bad}"],
}


@pytest.mark.parametrize("kind", ["missing", "empty", "truncated", "wrong-kind", "folder"])
@pytest.mark.parametrize("command", COMMANDS)
def test_bad_input_gives_one_message_and_exit_1(command, kind, run, bad_files):
    places = {
        "bad": bad_files / kind,
        "good": bad_files / "good.h5",
        "out": bad_files / "out",
    }
    before = sorted(bad_files.iterdir())
    status, _, err = run(*(word.format(**places) for word in COMMANDS[command]))
    assert status == 1
    assert err.startswith("error: ")
    assert kind in err.splitlines()[0]
    assert "Traceback" not in err
    assert sorted(bad_files.iterdir()) == before


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["info", "semantic3d"], "nor a known data set; did you mean 'semantic2d@2'?"),
        (["simulate", "{tmp}/new", "--lidar", "velodyne"], "unknown lidar 'velodyne'; known"),
        (["simulate", "{tmp}/new", "--environment", "moon"], "unknown"),
        (["simulate", "{tmp}"], "exists already; choose a new folder"),
        (["simulate", "{tmp}/new", "--name", "My Data"], "such as 'my-data'"),
        (["score", "{tmp}/good.h5", "--out", "{tmp}/good.h5"], "is an input itself"),
        (["score", "{tmp}/good.h5", "--out", "{tmp}/no/x.json"], "does not exist"),
        (["report", "{tmp}/good.h5", "--out", "{tmp}"], "is a folder"),
        (["plot", "{tmp}/good.h5", "--scan", "10"], "has 10 scans, so none with index 10"),
        (["plot", "{tmp}/good.h5", "--out", "{tmp}/x.doc"], "x.doc"),
        (["baseline", "train", "s4net", "--out", "{tmp}/x"], "s4net"),
        (["baseline", "train", "s3net", "--features", "XY", "--out", "{tmp}/x"], "unknown feat"),
        (
            ["baseline", "train", "s3net", "--data", "{data}", "--out", "{tmp}/x"],
            "no sequence of the lidar 'hokuyo'; it has small",
        ),
        (
            [
                *("baseline", "train", "s3net", "--data", "{data}", "--lidar", "small"),
                *("--scheme", "random", "--out", "{tmp}/x"),
            ],
            "unknown scheme 'random'; known are block, environment, frame",
        ),
    ],
)
def test_unknown_names_say_what_there_is(words, says, run, tmp_path, dataset_folder):
    make_sequence(tmp_path / "good.h5", 10)
    places = {"tmp": tmp_path, "data": dataset_folder}
    status, _, err = run(*(word.format(**places) for word in words))
    assert status == 1
    assert says in err
    assert [p.name for p in tmp_path.iterdir()] == ["good.h5"]


def test_debug_shows_the_traceback(run):
    with pytest.raises(FileNotFoundError):
        run("info", "nothing", "--debug")


def test_info_describes_a_sequence(run, tmp_path):
    make_sequence(tmp_path / "a.h5", 10)
    status, out, _ = run("info", tmp_path / "a.h5")
    assert status == 0
    assert "lobby--first--small" in out
    assert "beams 37" in out
    status, out, _ = run("info", tmp_path / "a.h5", "--json")
    said = json.loads(out)
    assert said["scans"] == 10
    assert said["lidar"]["beams"] == 37
    assert sum(said["class_shares"].values()) == pytest.approx(1)
    assert len(said["content_digest"]) == 64


def test_info_describes_a_data_set(run, dataset_folder):
    status, out, _ = run("info", dataset_folder)
    assert status == 0
    assert "generated" in out
    assert "frame train 315, val 45, test 90, none 0" in out
    said = json.loads(run("info", dataset_folder, "--json")[1])
    assert said["scans_by_lidar"] == {"small": 450}
    assert said["splits"]["frame"] == {"train": 315, "val": 45, "test": 90, "none": 0}


def test_verify_says_what_is_wrong_and_exits_1(run, dataset_folder, tmp_path):
    copy = shutil.copytree(dataset_folder, tmp_path / "copy")
    assert run("verify", copy, "--full")[0] == 0
    victim = read_manifest(copy).sequences[0].file
    (copy / victim).unlink()
    status, out, _ = run("verify", copy)
    assert status == 1
    assert f"{victim}: missing" in out
    status, out, _ = run("verify", copy, "--json")
    assert status == 1
    assert len(json.loads(out)["problems"]) == 1


def test_plot_draws_a_scan_over_its_map(run, tmp_path):
    make_sequence(tmp_path / "a.h5", 10)
    assert run("plot", tmp_path / "a.h5", "--scan", "3", "--out", tmp_path / "a.png")[0] == 0
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")


def test_view_writes_a_recording_where_asked_to(run, tmp_path):
    pytest.importorskip("rerun", reason="needs the extra 'view'")
    make_sequence(tmp_path / "a.h5", 10)
    status, out, _ = run("view", tmp_path / "a.h5", "--every", "3", "--save", tmp_path / "a.rrd")
    assert (status, out) == (0, f"wrote {tmp_path / 'a.rrd'}: 4 scans\n")
    assert (tmp_path / "a.rrd").read_bytes().startswith(b"RRF")
    status, _, err = run("view", tmp_path / "a.h5", "--save", tmp_path / "a.rrd")
    assert (status, "exists already" in err) == (1, True)


def test_view_without_its_extra_says_how_to_get_it(run, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    make_sequence(tmp_path / "a.h5", 10)
    status, _, err = run("view", tmp_path / "a.h5", "--save", tmp_path / "a.rrd")
    assert (status, err.count("\n")) == (1, 1)
    assert "pip install 'semantic2d-dataset[view]'" in err
    status, _, err = run("view", tmp_path / "a.h5", "--save", tmp_path / "a.h5")
    assert (status, "is an input itself" in err) == (1, True)


def test_shadowing_does_not_stop_other_commands(tmp_path):
    (tmp_path / "conversion.py").write_text("raise RuntimeError")
    done = subprocess.run(
        [sys.executable, "-m", "semantic2d_dataset.cli", "convert", "x"],
        env=os.environ | {"PYTHONPATH": f"{tmp_path}{os.pathsep}{PROJECT}"},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr.startswith("error: the package 'conversion' of semantic2d-dataset is")


PREDICT = ["semantic2d", "baseline", "predict", "run", "--out", "p.h5"]
WITHOUT_TORCH = "import sys; sys.modules['torch'] = None\n"


@pytest.mark.parametrize(
    "code",
    [
        "from semantic2d_dataset import load_dataset",
        f"from semantic2d_dataset import cli\nsys.argv = {PREDICT}\ncli.main()",
    ],
)
def test_missing_torch_is_told_with_the_way_to_get_it(code):
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_TORCH + code],
        cwd=PROJECT,
        check=False,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 1
    assert "pip install 'semantic2d-dataset[torch]'" in done.stderr.splitlines()[-1]


INTERRUPTED = {
    "own command": ["simulate", "{tmp}/out", "--scans", "3000"],
    "forwarded command": [
        *("baseline", "train", "s3net", "--data", "{data}", "--lidar", "small"),
        *("--preset", "quick", "--epochs", "100000", "--minutes", "60", "--out", "{tmp}/out"),
    ],
}


@pytest.mark.parametrize("command", INTERRUPTED)
def test_interrupted_command_says_so_and_exits_with_130(command, tmp_path, dataset_folder):
    words = [w.format(tmp=tmp_path, data=dataset_folder) for w in INTERRUPTED[command]]
    process = subprocess.Popen(
        [sys.executable, "-m", "semantic2d_dataset.cli", *words],
        cwd=PROJECT,
        stderr=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + 60
    while not list(tmp_path.iterdir()) and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(1)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    # Python itself ends by the signal where it hit code run from C; to a shell that is 130 too
    assert process.returncode in (130, -signal.SIGINT)
    assert err.splitlines()[-1].startswith("interrupted")
    assert "Traceback" not in err
    if command == "own command":
        assert list(tmp_path.iterdir()) == []


@pytest.fixture
def own_registry(tmp_path, monkeypatch):
    """A registry file with one data set, on a host of this machine."""
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.delenv("SEMANTIC2D_OFFLINE", raising=False)
    host = hosts.Host({"raw.bag": b"raw" * 500, "processed.zip": b"done"})
    source = {"kind": "zenodo", "record": "7", "host": host.url}
    entry = {
        "id": "own",
        "version": "1",
        "title": "Own",
        "license": "CC0",
        "sources": [source],
        "doi": "10.1/x",
    }
    path = tmp_path / "registry.json"
    said = {"format": "semantic2d-registry", "format_version": "1.0", "datasets": [entry]}
    path.write_text(json.dumps(said))
    yield path
    host.close()


def test_download_lists_and_then_gets_what_is_chosen(own_registry, run, tmp_path):
    status, out, _ = run("download", "own", "--registry", own_registry, "--list")
    assert status == 0
    assert out.splitlines() == [
        "own@1: Own",
        "license: CC0",
        "https://doi.org/10.1/x",
        "   4.00B  processed.zip",
        "  1.50kB  raw.bag",
        "2 file(s), 1.50kB",
    ]
    words = ["download", "own@1", "--registry", own_registry, "--to", tmp_path / "out"]
    words += ["--archives-only"]
    status, out, _ = run(*words, "--only", "*.zip")
    assert status == 0
    assert out.endswith(f"1 file(s), 4.00B in {tmp_path / 'out'}, checked; 0 had been there\n")
    assert (tmp_path / "out" / "processed.zip").read_bytes() == b"done"
    status, out, _ = run(*words, "--only", "*.zip", "--offline", "--json")
    assert status == 0
    said = json.loads(out)
    assert said["files"][0]["name"] == "processed.zip"
    assert said["files"][0]["fetched"] is False


def test_download_goes_to_the_home_of_data_sets(own_registry, run, tmp_path, monkeypatch):
    monkeypatch.setenv("SEMANTIC2D_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("SEMANTIC2D_REGISTRY", str(own_registry))
    assert run("download", "own", "--part", "all")[0] == 0
    assert (tmp_path / "home" / "downloads" / "own-1" / "raw.bag").is_file()


@pytest.fixture
def archives(tmp_path, monkeypatch):
    """A registry whose one data set is archives on a host of this machine."""
    monkeypatch.setenv("SEMANTIC2D_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.delenv("SEMANTIC2D_OFFLINE", raising=False)
    host = hosts.Host(pack_archives(tmp_path / "packed"))
    registry = write_registry(tmp_path / "registry.json", host)
    monkeypatch.setenv("SEMANTIC2D_REGISTRY", str(registry))
    yield host
    host.close()


def test_downloaded_data_set_is_listed_loaded_repaired_and_removed(archives, run, tmp_path):
    folder = tmp_path / "home" / "datasets" / "d-1"
    status, _, err = run("info", "d")
    assert (status, "get it with: semantic2d download d@1" in err) == (1, True)
    status, out, _ = run("download", "d", "--version", "1", "--lidar", "hokuyo")
    assert status == 0
    assert out.splitlines()[-1].startswith(f"{folder}: 1 sequence, 6 scans of {HOKUYO}, 0.")
    with pytest.raises(DatasetNotFoundError, match="semantic2d download d@1 --lidar wlr716"):
        load_dataset("d", lidar="wlr716", split=None)
    scans = load_dataset("d", lidar="wlr716", split=None, download=True)
    assert (len(scans), scans.lidar.name) == (6, WLR)
    both = load_lidars("d", ["hokuyo", "wlr716"], split=None, download=True)
    assert len(both) == 12
    said = json.loads(run("list", "--json")[1])
    assert [each["folder"] for each in said if "folder" in each] == [str(folder)]
    assert f"in {folder}" in run("show", "d")[1]
    victim = next((folder / "sequences").iterdir())
    victim.write_bytes(victim.read_bytes()[:-100])
    assert run("verify", "d")[0] == 1
    status, out, _ = run("verify", "d", "--repair")
    assert status == 0
    assert out.splitlines() == [f"{victim}: repaired", f"{folder}: 5 files, no problem(s)"]
    assert json.loads(run("download", "d@1", "--json")[1])["changed"] is False
    status, out, _ = run("remove", "d", "--archives-too")
    assert status == 0
    assert [line.partition(": removed, ")[0] for line in out.splitlines()] == [
        str(folder),
        str(tmp_path / "home" / "downloads" / "d-1"),
    ]


def test_raw_recordings_are_got_as_they_are(archives, run, tmp_path):
    status, out, _ = run("download", "d", "--part", "raw", "--to", tmp_path / "raw")
    assert status == 0
    assert (tmp_path / "raw" / "rosbags.zip").read_bytes() == b"a bag"
    assert "1 file(s), 5.00B" in out
    assert not (tmp_path / "home" / "datasets").exists()
    status, _, err = run("download", "d", "--lidar", "rplidar")
    assert status == 1
    assert f"d@1: has no lidar 'rplidar'; it has {HOKUYO}, {WLR}" in err


def test_interrupted_download_says_that_what_has_arrived_is_kept(archives, tmp_path):
    archives.moods = [hosts.drip_slowly] * 2
    command = [sys.executable, "-m", "semantic2d_dataset.cli", "download", "d"]
    process = subprocess.Popen(
        command, cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(PROJECT)}, stderr=subprocess.PIPE
    )
    wait_for(lambda: list((tmp_path / "home").rglob("*.partial")))
    process.send_signal(signal.SIGINT)
    err = process.communicate(timeout=60)[1].decode()
    assert process.returncode in (130, -signal.SIGINT)
    assert err.splitlines()[-1] == (
        "interrupted; what has arrived and what is converted is kept: run this again to go on"
    )
    assert "nothing half done" not in err


def wait_for(condition):
    deadline = time.monotonic() + 60
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert condition()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["semantic2d@9"], "not a known data set; did you mean 'semantic2d@2'?"),
        (["semantic2d-mini", "--archives-only"], "made on this machine"),
        (["semantic2d", "--offline"], "offline, and its list of files is not here"),
        (["own", "--only", "*.tar"], "no file fits '*.tar'"),
        (["own", "--registry", "nowhere.json"], "nowhere.json: no such file"),
    ],
)
def test_download_says_in_one_line_what_is_wrong(
    words, message, own_registry, run, tmp_path, monkeypatch
):
    monkeypatch.setenv("SEMANTIC2D_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("SEMANTIC2D_REGISTRY", str(own_registry))
    status, out, err = run("download", *words)
    assert (status, out) == (1, "")
    assert message in err
    assert err.count("\n") == 1
