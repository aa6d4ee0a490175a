"""``semantic2d splits``: what it prints, writes and refuses."""

import json

import pytest

from semantic2d_dataset.cli import main


@pytest.fixture
def run(monkeypatch, capsys):
    def run_command(*words):
        monkeypatch.setattr("sys.argv", ["semantic2d", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            main()
        said = capsys.readouterr()
        return ended.value.code or 0, said.out, said.err

    return run_command


def test_list_says_how_schemes_were_made_and_how_large_they_are(run, dataset_folder):
    status, out, _ = run("splits", "list", dataset_folder)
    assert status == 0
    assert "frame: train 315, val 45, test 90, none 0\n  single scans at random, seed 0" in out
    said = json.loads(run("splits", "list", dataset_folder, "--json")[1])
    assert [each["scheme"] for each in said] == ["block", "environment", "frame"]
    assert said[2]["scans"] == {"train": 315, "val": 45, "test": 90, "none": 0}


def test_audit_prints_a_verdict_for_each_scheme(run, dataset_folder):
    status, out, _ = run("splits", "audit", dataset_folder)
    assert status == 0
    assert [line.split(":")[0] for line in out.splitlines() if line[:1].isalpha()] == [
        "block",
        "environment",
        "frame",
    ]
    assert "frame: leaks: 89 % of test scans lie next to a train scan" in out


def test_audit_writes_a_picture_and_prints_json(run, dataset_folder, tmp_path):
    picture = tmp_path / "audit.png"
    status, out, _ = run(
        *("splits", "audit", dataset_folder, "--scheme", "frame", "--scheme", "block"),
        *("--lidar", "small", "--out", picture, "--json"),
    )
    assert status == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    frame, block = json.loads(out)
    assert (frame["scheme"], block["scheme"]) == ("frame", "block")
    assert frame["test"]["scans"] == frame["test"]["per_lidar"]["small"]["scans"] == 90
    assert block["test"]["next_to_train"] == 0


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--scheme", "random"), "unknown scheme 'random'; known are block, environment, frame"),
        (("--lidar", "hokuyo"), "has no sequence of the lidar 'hokuyo'; it has small"),
        (("--out", "audit.doc"), "expected a name that ends in one of"),
    ],
)
def test_what_cannot_be_audited_is_told_before_any_work(run, dataset_folder, words, says):
    status, out, err = run("splits", "audit", dataset_folder, *words)
    assert (status, out) == (1, "")
    assert says in err
