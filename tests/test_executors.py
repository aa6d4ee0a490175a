from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest

from semantic2d_dataset import executors
from semantic2d_dataset.errors import AlignmentError, InvalidInputError, WorkerLostError
from semantic2d_dataset.executors import Processes, Serial, open_executor
from tests.clusters import cluster
from tests.conftest import PROJECT

KINDS = [1, 2]


def square(item: int) -> int:
    return item * item


def slow_first(item: int) -> int:
    time.sleep(0.4 if item == 0 else 0.0)
    return item


def fail_at(bad: int, item: int) -> int:
    if item == bad:
        raise AlignmentError(f"{item} fits nowhere")
    return item


def die(item: int) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return item


def die_at(bad: int, item: int) -> int:
    return die(item) if item == bad else item


def die_at_any(bad: set[int], item: int) -> int:
    time.sleep(0.0 if item in bad else 0.3)
    return die(item) if item in bad else item


def die_once(folder: Path, item: int) -> int:
    """Die with item 3, the first time that it is met."""
    if item == 3 and not (folder / "died").exists():
        (folder / "died").touch()
        die(item)
    return item


def say(item: str) -> str | None:
    return os.environ.get(item)


def threads_of_numba(item: int) -> int:
    import numba

    return int(numba.get_num_threads())


@pytest.mark.parametrize("jobs", KINDS)
def test_results_come_in_the_order_of_the_items(jobs):
    with open_executor(jobs=jobs) as executor:
        assert executor.workers == jobs
        assert list(executor.map(slow_first, range(9))) == list(range(9))
        assert list(executor.map(square, [])) == []
        assert list(executor.map(partial(pow, 2), [3, 4])) == [8, 16]


def test_results_come_as_they_are_done_where_order_does_not_matter():
    with Processes(2) as executor:
        list(executor.map(square, range(4)))  # both have started
        found = list(executor.map(slow_first, range(6), in_order=False))
    assert sorted(found) == list(range(6))
    assert found[0] != 0


@pytest.mark.parametrize(("jobs", "most"), [(1, 1), (2, 4)])
def test_items_are_taken_only_as_there_is_room(jobs, most):
    taken = []

    def items():
        for item in range(30):
            taken.append(item)
            yield item

    with open_executor(jobs=jobs) as executor:
        for done, _ in enumerate(executor.map(square, items())):
            assert len(taken) - done <= most
    assert len(taken) == 30


@pytest.mark.parametrize("jobs", KINDS)
def test_an_error_of_the_function_is_raised_and_no_more_is_begun(jobs):
    taken = iter(range(100))
    with open_executor(jobs=jobs) as executor:
        found = executor.map(partial(fail_at, 3), taken)
        assert [next(found) for _ in range(3)] == [0, 1, 2]
        with pytest.raises(AlignmentError, match="3 fits nowhere"):
            next(found)
        assert next(taken) <= 3 + 2 * jobs
        assert list(executor.map(square, [5])) == [25]


def test_an_item_whose_process_was_killed_is_tried_once_more(tmp_path):
    with Processes(2) as executor:
        assert list(executor.map(partial(die_once, tmp_path), range(12))) == list(range(12))


def test_an_item_that_kills_its_process_twice_is_told():
    with Processes(2) as executor:
        found = executor.map(partial(die_at, 3), range(9))
        assert [next(found) for _ in range(3)] == [0, 1, 2]
        with pytest.raises(WorkerLostError, match="a process was killed .is memory short"):
            next(found)
        assert list(executor.map(square, [5])) == [25]


@pytest.mark.parametrize("in_order", [False, pytest.param(True, marks=pytest.mark.long)])
def test_items_that_kill_their_process_take_no_other_with_them(in_order):
    """Items are slow, so that one is tried once more while another is about to kill."""
    with Processes(2) as executor:
        found = executor.map(
            partial(die_at_any, {3, 7, 9}), range(12), in_order=in_order, lost=lambda item, _: -item
        )
        assert sorted(found) == [-9, -7, -3, 0, 1, 2, 4, 5, 6, 8, 10, 11]


def test_leaving_by_an_error_does_not_wait_for_what_runs():
    began = time.monotonic()

    def leave():
        with Processes(2) as executor:
            next(executor.map(time.sleep, [0.0, 60.0, 60.0, 60.0]))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        leave()
    assert time.monotonic() - began < 50


def test_numba_has_one_thread_in_each_process(monkeypatch):
    monkeypatch.delenv("NUMBA_NUM_THREADS", raising=False)
    with Processes(2) as executor:
        assert list(executor.map(threads_of_numba, [0, 0])) == [1, 1]
    monkeypatch.setenv("NUMBA_NUM_THREADS", "2")
    with Processes(1) as executor:
        assert list(executor.map(say, ["NUMBA_NUM_THREADS"])) == ["2"]


SCRIPT = """
import os, sys, time
from semantic2d_dataset.executors import Processes
from tests.test_executors import write_pid

if __name__ == "__main__":
    try:
        with Processes(2) as executor:
            list(executor.map(write_pid, [sys.argv[1]] * 2))
    except KeyboardInterrupt:
        sys.exit(130)
"""


def write_pid(folder: str) -> None:
    (Path(folder) / str(os.getpid())).touch()
    time.sleep(60)


@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGKILL])
def test_processes_end_with_the_one_that_started_them(sign, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    pids = tmp_path / "pids"
    pids.mkdir()
    began = time.monotonic()
    started = subprocess.Popen(
        [sys.executable, script, pids],
        env=os.environ | {"PYTHONPATH": str(PROJECT)},
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    while len(list(pids.iterdir())) < 2 and started.poll() is None:
        time.sleep(0.05)
    # as a terminal does: Ctrl-C reaches all of them
    os.killpg(started.pid, sign) if sign == signal.SIGINT else started.kill()
    said = started.communicate(timeout=50)[1]
    assert started.returncode == (130 if sign == signal.SIGINT else -signal.SIGKILL)
    assert "Traceback" not in said
    workers = [int(path.name) for path in pids.iterdir()]
    while any(map(is_alive, workers)):
        assert time.monotonic() - began < 50
        time.sleep(0.05)


def is_alive(pid: int) -> bool:
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().split()[2]
    except OSError:
        return False


def test_jobs_are_one_or_more():
    with pytest.raises(InvalidInputError, match="jobs: expected 1 or more, found 0"):
        open_executor(jobs=0)
    assert isinstance(open_executor(), Serial)


def test_a_scheduler_that_does_not_answer_is_told(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(executors, "_CONNECT_S", 1)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    with pytest.raises(InvalidInputError, match="no Dask scheduler answers there"):
        open_executor(scheduler=address)


def test_a_cluster_without_dask_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InvalidInputError, match=r"pip install 'semantic2d-dataset\[dask\]'"):
        open_executor(scheduler="tcp://127.0.0.1:1")


def slow_square(item: int) -> int:
    time.sleep(0.05)
    return item * item


@pytest.mark.long
def test_a_cluster_gives_the_same_in_order_though_one_of_its_workers_is_killed(tmp_path):
    pytest.importorskip("distributed")
    with cluster(tmp_path) as (address, workers), open_executor(scheduler=address) as executor:
        found = executor.map(slow_square, range(60))
        first = [next(found) for _ in range(10)]
        workers[0].kill()
        assert [*first, *found] == [item * item for item in range(60)]
        with pytest.raises(AlignmentError, match="3 fits nowhere"):
            list(executor.map(partial(fail_at, 3), range(9)))
        found = executor.map(slow_square, range(9), in_order=False)
        assert sorted(found) == [item * item for item in range(9)]


@pytest.mark.long
def test_an_item_that_kills_every_worker_is_given_up_by_the_cluster(tmp_path):
    pytest.importorskip("distributed")
    with (
        cluster(tmp_path, nanny=True) as (address, _),
        open_executor(scheduler=address) as executor,
        pytest.raises(WorkerLostError, match="given up by the cluster"),
    ):
        list(executor.map(partial(die_at, 3), range(9)))
