from __future__ import annotations

import os
import signal
import socket
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

from conversion import jobs
from conversion.convert import Kept
from conversion.jobs import convert_recordings
from conversion.summary import Summary
from semantic2d_dataset import executors
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.sequence import SequenceReader
from tests.clusters import cluster
from tests.conversion.recordings import START_NS, Recording, straight_drive


def drives(folder: Path, count: int) -> list[tuple[Path]]:
    return [(straight_drive("ros1", scans=5 + n).write(folder, f"drive{n}"),) for n in range(count)]


def check_all(out: Path, count: int) -> None:
    files = sorted(out.iterdir())
    assert [file.suffix for file in files] == [".h5"] * count
    for n, file in enumerate(files):
        with SequenceReader(file) as sequence:
            assert (len(sequence), sequence.header.recording) == (5 + n, f"drive{n}")


@pytest.mark.parametrize("workers", [1, 2])
def test_recordings_are_converted_side_by_side_as_one_by_one(workers, tmp_path):
    recordings = drives(tmp_path, 3)
    outcomes = list(convert_recordings(recordings, tmp_path / "out", jobs=workers))
    assert sorted(outcome.recording for outcome in outcomes) == [str(p) for (p,) in recordings]
    assert all(isinstance(outcome.results[0], Summary) for outcome in outcomes)
    check_all(tmp_path / "out", 3)
    again = list(convert_recordings(recordings, tmp_path / "out", jobs=workers))
    assert all(isinstance(outcome.results[0], Kept) for outcome in again)


@pytest.mark.parametrize("workers", [1, 2])
def test_one_that_fails_stops_no_other(workers, tmp_path):
    recordings = drives(tmp_path, 2)
    (tmp_path / "bad.bag").write_bytes(b"no bag")
    recordings[1:1] = [(tmp_path / "bad.bag",), (tmp_path / "none.bag",)]
    outcomes = list(convert_recordings(recordings, tmp_path / "out", jobs=workers))
    errors = {outcome.recording: outcome.error for outcome in outcomes if outcome.error}
    assert "not a ROS bag" in errors[str(tmp_path / "bad.bag")]
    assert "no such file" in errors[str(tmp_path / "none.bag")]
    check_all(tmp_path / "out", 2)


def test_several_recordings_need_a_folder(tmp_path):
    with pytest.raises(InvalidInputError, match="2 recordings need a folder as --out"):
        list(convert_recordings(drives(tmp_path, 2), tmp_path / "out.h5"))


def test_a_process_that_is_killed_is_told_and_the_rest_can_be_run_again(tmp_path, monkeypatch):
    recordings = drives(tmp_path, 3)
    monkeypatch.setattr(jobs, "run", die)
    outcomes = list(convert_recordings(recordings, tmp_path / "out", jobs=2))
    assert all("a process was killed" in outcome.error for outcome in outcomes)
    monkeypatch.undo()
    assert not [o for o in convert_recordings(recordings, tmp_path / "out", jobs=2) if o.error]
    check_all(tmp_path / "out", 3)


def die(job):
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_scheduler_that_does_not_answer_is_told(tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(executors, "_CONNECT_S", 1)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    with pytest.raises(InvalidInputError, match="no Dask scheduler answers there"):
        list(convert_recordings(drives(tmp_path, 1), tmp_path / "out", scheduler=address))


# --- a cluster of two workers on loopback -----------------------------------------------------


def long_drive(folder: Path, name: str) -> Path:
    drive, random = Recording("mcap"), np.random.default_rng(0)
    for n in range(3000):
        ranges = random.uniform(0.2, 20, 400).astype(np.float32)
        drive.add_scan(START_NS + n * 10_000_000, ranges, intensities=ranges, increment=0.01)
    return drive.write(folder, name)


@pytest.mark.long
def test_a_cluster_converts_all_though_one_of_its_workers_is_killed_midway(tmp_path):
    pytest.importorskip("distributed")
    recordings = [(long_drive(tmp_path, f"drive{n}"),) for n in range(6)]
    out = tmp_path / "out"
    with cluster(tmp_path) as (address, workers):
        outcomes = convert_recordings(recordings, out, scheduler=address)
        first = next(outcomes)
        busy_one(workers).kill()
        rest = list(outcomes)
    assert [outcome.error for outcome in (first, *rest)] == [None] * 6
    files = sorted(out.iterdir())
    assert [file.suffix for file in files] == [".h5"] * 6
    for file in files:
        with SequenceReader(file) as sequence:
            sequence.check_values()
            assert len(sequence) == 3000


def busy_one(workers: list[subprocess.Popen[bytes]]) -> subprocess.Popen[bytes]:
    """Return a worker that is writing: its sequences are written by a process of their own."""
    psutil = pytest.importorskip("psutil")
    until = time.monotonic() + 60
    while time.monotonic() < until:
        for worker in workers:
            if psutil.Process(worker.pid).children():
                return worker
        time.sleep(0.01)
    raise TimeoutError("no worker ever wrote")
