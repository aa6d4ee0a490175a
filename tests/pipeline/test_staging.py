"""Folders that are filled aside, taken over, and swapped in."""

import multiprocessing
import os
import signal
import time
from pathlib import Path

import pytest

from semantic2d_dataset.errors import WriteError
from semantic2d_dataset.format.writing import partial_name
from semantic2d_dataset.pipeline.staging import Staging, discard, link, size_of, tidy


def put(staging, text):
    (staging.data / "it").write_text(text)


def test_folder_appears_when_it_is_published(tmp_path):
    with Staging(tmp_path / "x") as staging:
        put(staging, "new")
        (staging.data / ".it.host-1-ab.partial").write_text("half")
        assert not (tmp_path / "x").exists()
        staging.publish(lambda: False)
    assert [p.name for p in tmp_path.rglob("*")] == ["x", "it"]


def test_folder_takes_the_place_of_another(tmp_path):
    for text in ("old", "new"):
        with Staging(tmp_path / "x") as staging:
            put(staging, text)
            staging.publish(lambda: False)
    assert (tmp_path / "x" / "it").read_text() == "new"
    assert [p.name for p in tmp_path.iterdir()] == ["x"]


def test_folder_of_a_faster_process_stays(tmp_path):
    with Staging(tmp_path / "x") as staging:
        put(staging, "slow")
        (tmp_path / "x").mkdir()
        (tmp_path / "x" / "it").write_text("fast")
        staging.publish(lambda: True)
    assert (tmp_path / "x" / "it").read_text() == "fast"
    assert [p.name for p in tmp_path.iterdir()] == ["x"]


def test_what_an_error_leaves_is_taken_over(tmp_path):
    with pytest.raises(ValueError, match="bad"), Staging(tmp_path / "x") as staging:
        put(staging, "half")
        raise ValueError("bad")
    with Staging(tmp_path / "x") as staging:
        assert (staging.data / "it").read_text() == "half"
        staging.publish(lambda: False)
    assert [p.name for p in tmp_path.iterdir()] == ["x"]


def test_nothing_is_left_of_a_run_that_did_nothing(tmp_path):
    with pytest.raises(ValueError, match="bad"), Staging(tmp_path / "x"):
        raise ValueError("bad")
    assert list(tmp_path.iterdir()) == []


def fill_and_wait(target):
    with Staging(target) as staging:
        put(staging, "half")
        (target.parent / "ready").write_text("")
        time.sleep(60)


def test_what_a_killed_process_leaves_is_taken_over(tmp_path):
    worker = multiprocessing.get_context("fork").Process(
        target=fill_and_wait, args=(tmp_path / "x",), daemon=True
    )
    worker.start()
    while not (tmp_path / "ready").exists():
        time.sleep(0.01)
    with Staging(tmp_path / "x") as staging:
        assert not (staging.data / "it").exists()  # that process lives
    os.kill(worker.pid, signal.SIGKILL)
    worker.join()
    with Staging(tmp_path / "x") as staging:
        assert (staging.data / "it").read_text() == "half"
        staging.publish(lambda: False)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["ready", "x"]


def test_what_another_machine_left_is_taken_over_after_a_rest(tmp_path):
    left = tmp_path / ".x.elsewhere-1-abcd.partial"
    (left / "data").mkdir(parents=True)
    (left / "data" / "it").write_text("half")
    with Staging(tmp_path / "x") as staging:
        assert not (staging.data / "it").exists()
    for path in (left / "data" / "it", left / "data", left):
        os.utime(path, (1e9, 1e9))
    with Staging(tmp_path / "x") as staging:
        assert (staging.data / "it").read_text() == "half"


def test_what_was_being_removed_is_removed(tmp_path, monkeypatch):
    gone = next(pid for pid in range(99999, 0, -1) if not Path(f"/proc/{pid}").exists())
    with monkeypatch.context() as patch:
        patch.setattr(os, "getpid", lambda: gone)
        left = partial_name(tmp_path / "x.removed")
    left.mkdir()
    (tmp_path / ".x.resume" / "work").mkdir(parents=True)  # published already
    tidy(tmp_path / "x")
    assert list(tmp_path.iterdir()) == []


def test_file_in_the_way_is_told(tmp_path):
    with pytest.raises(WriteError, match="x: "), Staging(tmp_path / "x") as staging:
        put(staging, "new")
        (tmp_path / "x").write_text("a file")
        staging.publish(lambda: False)
    assert (tmp_path / "x").read_text() == "a file"


def test_bytes_are_counted_and_discarded(tmp_path):
    (tmp_path / "x" / "y").mkdir(parents=True)
    (tmp_path / "x" / "y" / "z").write_bytes(bytes(1000))
    assert size_of(tmp_path / "x") == discard(tmp_path / "x", tmp_path / "x") == 1000
    assert list(tmp_path.iterdir()) == []


def test_link_copies_where_it_cannot_link(tmp_path, monkeypatch):
    (tmp_path / "a").write_text("a")
    link(tmp_path / "a", tmp_path / "b")
    assert (tmp_path / "b").samefile(tmp_path / "a")

    def refuse(*_):
        raise OSError("no links here")

    monkeypatch.setattr(os, "link", refuse)
    link(tmp_path / "a", tmp_path / "b")
    assert not (tmp_path / "b").samefile(tmp_path / "a")
    assert (tmp_path / "b").read_text() == "a"
