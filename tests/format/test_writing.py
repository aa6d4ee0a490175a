"""Writers that are killed, interrupted, starved of disk, or run side by side."""

import multiprocessing
import os
import re
import resource
import signal
import subprocess
import sys
import textwrap
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from semantic2d_dataset.errors import InvalidInputError, WriteError
from semantic2d_dataset.format import writing
from semantic2d_dataset.format.sequence import SequenceHeader, SequenceReader, SequenceWriter
from semantic2d_dataset.format.writing import stale_partials, write_text_atomically
from tests.conftest import PROJECT
from tests.generators import SMALL_LIDAR, make_arrays, make_sequence

HEADER = SequenceHeader(environment="lobby", recording="first", lidar=SMALL_LIDAR)

WRITE_SLOWLY = textwrap.dedent(
    """
    import sys, time
    from pathlib import Path
    from semantic2d_dataset.format.sequence import SequenceWriter
    from tests.format.test_writing import HEADER
    from tests.generators import make_arrays

    arrays = make_arrays(2000)
    with SequenceWriter(Path(sys.argv[1]), HEADER) as writer:
        for start in range(0, 2000, 100):
            writer.append({name: a[start : start + 100] for name, a in arrays.items()})
            print(start, flush=True)
            time.sleep(0.005)
    print("done", flush=True)
    """
)


def start_writer(path):
    return subprocess.Popen(
        [sys.executable, "-c", WRITE_SLOWLY, str(path)],
        cwd=PROJECT,
        stdout=subprocess.PIPE,
        text=True,
    )


def wait_until_alone(path):
    """Wait until the child process has removed its partial file."""
    deadline = time.monotonic() + 20
    while [p for p in path.parent.iterdir() if p != path]:
        assert time.monotonic() < deadline, sorted(path.parent.iterdir())
        time.sleep(0.02)


def check_absent_or_right(path):
    wait_until_alone(path)
    if path.exists():
        with SequenceReader(path) as reader:
            reader.check_values()
            assert len(reader) == 2000


def kill_at(path, signal_number, lines):
    process = start_writer(path)
    for _ in range(lines):
        process.stdout.readline()
    process.send_signal(signal_number)
    process.wait()
    process.stdout.close()
    check_absent_or_right(path)
    path.unlink(missing_ok=True)


@pytest.mark.parametrize("lines", [0, 1, 10, 20])
def test_killed_writer_leaves_nothing_or_all(lines, tmp_path):
    kill_at(tmp_path / "a.h5", signal.SIGKILL, lines)


@pytest.mark.long
@pytest.mark.parametrize("run", range(100))
def test_writer_killed_at_any_moment_leaves_nothing_or_all(run, tmp_path):
    path = tmp_path / "a.h5"
    process = start_writer(path)
    process.stdout.readline()
    time.sleep(run * 0.003)
    process.kill()
    process.wait()
    process.stdout.close()
    check_absent_or_right(path)


def test_exception_while_writing_leaves_nothing(tmp_path):
    path = tmp_path / "a.h5"
    with pytest.raises(RuntimeError, match="ours"), SequenceWriter(path, HEADER) as writer:
        writer.append(make_arrays(100))
        raise RuntimeError("ours")
    assert list(tmp_path.iterdir()) == []


def test_existing_file_stays_until_the_new_one_is_whole(tmp_path):
    path = tmp_path / "a.h5"
    make_sequence(path, 10)
    with pytest.raises(RuntimeError), SequenceWriter(path, HEADER) as writer:
        writer.append(make_arrays(100))
        raise RuntimeError
    assert len(SequenceReader(path)) == 10
    make_sequence(path, 20)
    assert len(SequenceReader(path)) == 20
    assert [p.name for p in tmp_path.iterdir()] == ["a.h5"]


def test_killed_child_is_a_write_error(tmp_path):
    path = tmp_path / "a.h5"
    with pytest.raises(WriteError, match="killed by signal 9"), SequenceWriter(path, HEADER) as w:
        os.kill(w._container._child.pid, signal.SIGKILL)
        for _ in range(100):
            w.append(make_arrays(500))
    assert list(tmp_path.iterdir()) == []


FAIL_IN_A_THREAD = textwrap.dedent(
    """
    import threading, zlib
    compress = zlib.compress
    def fail(*args):
        if threading.current_thread() is not threading.main_thread():
            raise zlib.error("Error -4 while compressing data: insufficient memory")
        return compress(*args)
    zlib.compress = fail
    """
)


def test_failure_in_a_compressing_thread_is_a_write_error(tmp_path, monkeypatch):
    startup, folder = tmp_path / "startup", tmp_path / "folder"
    startup.mkdir()
    folder.mkdir()
    (startup / "sitecustomize.py").write_text(FAIL_IN_A_THREAD)
    monkeypatch.setenv("PYTHONPATH", str(startup))
    with pytest.raises(WriteError, match="Error -4 while compressing data"):
        make_sequence(folder / "a.h5", 1000)
    assert list(folder.iterdir()) == []


def peak_mb(pid):
    status = Path(f"/proc/{pid}/status")
    if not status.exists():
        pytest.skip("this system does not tell a process's peak memory in /proc")
    return int(re.search(r"VmHWM:\s+(\d+) kB", status.read_text())[1]) / 1024


def test_large_blocks_do_not_grow_the_writing_process(tmp_path):
    rows = np.zeros((100_000, 500), np.float32)  # 200 MB
    with pytest.raises(RuntimeError), SequenceWriter(tmp_path / "a.h5", HEADER) as writer:
        writer.append(make_arrays(100))
        writer._container.append({"original/x": rows[:20_000]})
        before = peak_mb(writer._container._child.pid)
        writer._container.append({"original/x": rows})
        after = peak_mb(writer._container._child.pid)
        raise RuntimeError
    assert after < before + 40


def test_full_disk_is_told_before_it_is_full(tmp_path, monkeypatch):
    nearly_full = os.statvfs(tmp_path)
    usage = type(
        "usage", (), {"total": nearly_full.f_blocks, "used": 0, "free": writing._FREE_BYTES_KEPT}
    )
    monkeypatch.setattr(writing.shutil, "disk_usage", lambda _: usage)
    with (
        pytest.raises(WriteError, match="the disk is full"),
        SequenceWriter(tmp_path / "a.h5", HEADER) as writer,
    ):
        writer.append(make_arrays(100))
    assert list(tmp_path.iterdir()) == []


def test_file_size_limit_becomes_a_write_error(tmp_path):
    code = textwrap.dedent(
        """
        import resource, sys
        from pathlib import Path
        from semantic2d_dataset.errors import WriteError
        from tests.generators import make_sequence
        resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
        try:
            make_sequence(Path(sys.argv[1]), 3000)
        except WriteError as err:
            print("refused:", err)
        """
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "a.h5")],
        cwd=PROJECT,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.startswith("refused:"), done
    assert list(tmp_path.iterdir()) == []
    assert resource.getrlimit(resource.RLIMIT_FSIZE)[0] != 200_000


def write_same(path, seed):
    make_sequence(path, 200, seed=seed)


@pytest.mark.parametrize("count", [2, pytest.param(8, marks=pytest.mark.long)])
def test_processes_writing_one_name_leave_one_good_file(count, tmp_path):
    path = tmp_path / "a.h5"
    context = multiprocessing.get_context("spawn")
    workers = [context.Process(target=write_same, args=(path, seed)) for seed in range(count)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert [worker.exitcode for worker in workers] == [0] * count
    assert [p.name for p in tmp_path.iterdir()] == ["a.h5"]
    found = SequenceReader(path).read("scans/ranges")
    assert any(
        np.array_equal(found, make_arrays(200, seed=seed)["scans/ranges"], equal_nan=True)
        for seed in range(count)
    )


def test_partial_file_of_a_dead_process_is_removed_by_the_next_writer(tmp_path):
    path = tmp_path / "a.h5"
    process = subprocess.Popen([sys.executable, "-c", "pass"])
    process.wait()
    host = writing.socket.gethostname()
    dead = tmp_path / f".a.h5.{host}-{process.pid}-00000000.partial"
    alive = tmp_path / f".a.h5.{host}-{os.getpid()}-00000000.partial"
    foreign = tmp_path / f".a.h5.{host}-999999-{process.pid}-00000000.partial"  # host-999999
    for partial in (dead, alive, foreign):
        partial.write_bytes(b"half")
    assert stale_partials(path) == [dead]
    make_sequence(path, 10)
    assert not dead.exists()
    assert alive.exists()
    assert foreign.exists()


def test_modules_in_the_current_folder_are_not_run(tmp_path, monkeypatch):
    (tmp_path / "json.py").write_text("raise SystemExit('mine')")
    monkeypatch.chdir(tmp_path)
    make_sequence(tmp_path / "a.h5", 5)
    assert len(SequenceReader(tmp_path / "a.h5")) == 5


def test_provenance_that_json_cannot_hold_is_refused(tmp_path):
    header = replace(HEADER, provenance={"path": tmp_path})
    with pytest.raises(InvalidInputError, match="provenance: JSON cannot hold it"):
        SequenceWriter(tmp_path / "a.h5", header)
    assert list(tmp_path.iterdir()) == []


def test_missing_folder_is_named(tmp_path):
    with pytest.raises(WriteError, match="none does not exist"):
        SequenceWriter(tmp_path / "none" / "a.h5", HEADER)
    with pytest.raises(WriteError, match="none does not exist"):
        write_text_atomically(tmp_path / "none" / "a.json", "{}")


def test_a_full_disk_is_one_clear_error_and_leaves_what_was_there(tmp_path):
    path = tmp_path / "a.json"
    write_text_atomically(path, "one")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10, before[1]))  # bytes of any file
    try:
        with pytest.raises(WriteError, match=r"a\.json: could not be written"):
            write_text_atomically(path, "x" * 1000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert path.read_text() == "one"
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


def test_text_replaces_text_whole(tmp_path):
    path = tmp_path / "a.json"
    write_text_atomically(path, "one")
    write_text_atomically(path, "zwei äöü")
    assert path.read_text(encoding="utf-8") == "zwei äöü"
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


@pytest.mark.parametrize(
    ("arrays", "says"),
    [
        ({"scans/extra": np.zeros(3)}, "has no place"),
        ({"scans/labels": np.zeros((3, 37))}, "expected |u1"),
        ({"scans/labels": np.zeros((3, 36), np.uint8)}, "scans/labels: expected"),
        ({"poses/initial": np.zeros((3, 2))}, "poses/initial: expected"),
        ({"scans/stamps_ns": np.array([2, 1])}, "stamps go backward"),
    ],
)
def test_array_that_is_not_of_the_format_is_named(arrays, says, tmp_path):
    with (
        pytest.raises(InvalidInputError, match=says.replace("|", r"\|")),
        SequenceWriter(tmp_path / "a.h5", HEADER) as writer,
    ):
        writer.append(arrays)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "later", [np.zeros((3, 5), np.float32), np.zeros((3, 1), np.float32), np.zeros((3, 4))]
)
def test_rows_unlike_earlier_ones_are_refused(later, tmp_path):
    with (
        pytest.raises(InvalidInputError, match=r"original/x: expected <f4 \('n', 4\) as before"),
        SequenceWriter(tmp_path / "a.h5", HEADER) as writer,
    ):
        writer._container.append({"original/x": np.zeros((3, 4), np.float32)})
        writer._container.append({"original/x": later})
    assert list(tmp_path.iterdir()) == []


def test_stamps_may_not_go_backward_between_blocks(tmp_path):
    path = tmp_path / "a.h5"
    with pytest.raises(InvalidInputError, match="backward"), SequenceWriter(path, HEADER) as writer:
        writer.append({"scans/stamps_ns": np.array([5])})
        writer.append({"scans/stamps_ns": np.array([4])})


@pytest.mark.parametrize(
    ("arrays", "says"),
    [
        ({"scans/stamps_ns": np.arange(3)}, "a sequence needs scans/ranges"),
        (
            {
                "scans/ranges": np.ones((3, 37), np.float32),
                "scans/stamps_ns": np.arange(3),
                "scans/labels": np.zeros((2, 37), np.uint8),
            },
            "scans/labels: expected 3 rows, found 2",
        ),
    ],
)
def test_incomplete_sequence_is_not_written(arrays, says, tmp_path):
    with (
        pytest.raises(InvalidInputError, match=says),
        SequenceWriter(tmp_path / "a.h5", HEADER) as writer,
    ):
        writer.append(arrays)
    assert list(tmp_path.iterdir()) == []
