"""Locks: one process at a time, and none is kept out where there are no locks."""

import threading
import time

import pytest
from filelock import FileLock

from semantic2d_dataset.format import locks
from semantic2d_dataset.format.locks import alone


def test_the_second_waits_for_the_first_and_says_so(tmp_path, capsys):
    order, held = [], threading.Event()

    def work():
        with FileLock(tmp_path / ".x.lock"):
            held.set()
            time.sleep(0.2)
            order.append("first")

    thread = threading.Thread(target=work)
    thread.start()
    held.wait()
    with alone(tmp_path / "x"):
        order.append("second")
    thread.join()
    assert order == ["first", "second"]
    assert "another process is at work; waiting" in capsys.readouterr().err


def test_its_folder_is_made(tmp_path):
    with alone(tmp_path / "new" / "x"):
        assert (tmp_path / "new").is_dir()


@pytest.mark.parametrize("error", [OSError, NotImplementedError])
def test_without_locks_work_goes_on(error, tmp_path, monkeypatch):
    class NoLock:
        def __init__(self, path):
            pass

        def acquire(self, **_):
            raise error

    monkeypatch.setattr(locks, "FileLock", NoLock)
    done = []
    with alone(tmp_path / "x"):
        done.append(True)
    assert done
