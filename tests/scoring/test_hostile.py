"""Hostile submissions: each is refused within a second and 200 MB, with nothing else touched."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from semantic2d_dataset.access.registry import open_dataset
from semantic2d_dataset.errors import CorruptFileError, Semantic2DError, UnsafeFileError
from semantic2d_dataset.format.manifest import publish
from semantic2d_dataset.format.splits import NONE, TEST, VAL, SplitScheme
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D
from semantic2d_dataset.scoring.submission import PredictionsReader, validate
from tests.conftest import PROJECT
from tests.scoring import hostile
from tests.scoring.test_submission import (
    FAR,
    NEAR,
    SCANS,
    TEST_SCANS,
    guesses,
    write_sequence,
    writer_of,
)

MOST_SECONDS, MOST_BYTES = 1.0, 200 << 20
SHORT, LONG = 120, 1000
"""Fuzzed files besides those crafted: some in the ordinary suite, many in the long one."""

_JUDGE = """
import json, os, re, resource, sys, time
from pathlib import Path
from semantic2d_dataset.access.registry import open_dataset
from semantic2d_dataset.errors import Semantic2DError
from semantic2d_dataset.scoring.submission import validate

folder, data = Path(sys.argv[1]), open_dataset(sys.argv[2])
assert validate(folder / "good.h5", data) == [], validate(folder / "good.h5", data)
modules = (sys.prefix, sys.base_prefix, sys.argv[3])  # a message may import what words it
touched = None

def watch(event, given):
    if touched is None:
        return
    if event == "open":
        name = os.path.realpath(os.fsdecode(given[0])) if isinstance(given[0], str | bytes) else ""
        code = name.startswith(modules) and name.endswith((".py", ".pyc", ".json", ".so"))
        if given[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT) or not code:
            touched.append([event, name, given[2] & 3])
    elif event.partition(".")[0] in {"os", "shutil", "socket", "subprocess", "tempfile", "ctypes"}:
        touched.append([event, *map(str, given)])

def memory(name):
    return int(re.search(name + r":\\s+(\\d+) kB", Path("/proc/self/status").read_text())[1]) << 10

limit = memory("VmSize") + (4 << 30)  # of the machine's good; what counts is measured below
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
sys.addaudithook(watch)
for path in sorted(folder.glob("bad-*")):
    Path("/proc/self/clear_refs").write_text("5")  # the peak is now what is held
    held, before = memory("VmRSS"), time.process_time()
    touched = opened = []
    try:
        found = validate(path, data)
    except Semantic2DError as err:
        found = [str(err)]
    except Exception as err:
        found = repr(err)
    touched, seconds = None, time.process_time() - before
    print(json.dumps([path.name, found, seconds, memory("VmHWM") - held, opened]))
"""


@pytest.fixture(scope="module")
def toy(tmp_path_factory):
    folder = tmp_path_factory.mktemp("toy")
    (folder / "sequences").mkdir()
    sequences = (("a", NEAR), ("a", FAR))
    ids = [write_sequence(folder, r, lidar, n) for n, (r, lidar) in enumerate(sequences)]
    membership = np.full(SCANS, TEST, np.uint8)
    membership[:2] = NONE, VAL
    block = SplitScheme("block", dict.fromkeys(ids, membership), "by hand")
    publish(folder, name="toy", version="1.2.3", schemes=[block])
    return folder


@pytest.fixture(scope="module")
def good(toy, tmp_path_factory):
    """Predictions with all optional parts."""
    data = open_dataset(toy)
    path = tmp_path_factory.mktemp("good") / "good.h5"
    with writer_of(path) as writer:
        for entry in data.manifest.sequences:
            labels = guesses(data, entry.id)
            probabilities = np.eye(len(SEMANTIC2D), dtype=np.float16)[labels]
            writer.add(entry.id, TEST_SCANS, labels, probabilities, np.stack((labels, labels)))
    return path


def make_files(folder, good, seeds):
    """Spoiled copies; a pipe that nobody writes to stands for every file that links name."""
    canary = folder / "canary"
    os.mkfifo(canary)  # to open it is to wait for good
    shutil.copy(good, folder / "good.h5")
    builders = [(f"bad-{name}", build) for name, build in hostile.CRAFTED.items()]
    for seed in seeds:
        kind, rng, build = hostile.mutation(seed)
        path = folder / f"bad-{kind} {seed}"
        if kind == "cut":
            path.write_bytes(hostile.spoil_bytes(good.read_bytes(), rng))
        else:
            builders.append((path.name, build))
    for name, build in builders:
        path = folder / name.replace("/", "-")
        shutil.copy(good, path)
        with h5py.File(path, "r+") as file:
            build(file, canary)
    return len(list(folder.glob("bad-*")))


def judge(folder, toy):
    """Verdict, seconds, bytes above those held before, and what was opened, of every file."""
    command = [sys.executable, "-c", _JUDGE, str(folder), str(toy), str(PROJECT)]
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        env=os.environ | {"PYTHONPATH": str(PROJECT), "OPENBLAS_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return [json.loads(line) for line in done.stdout.splitlines()]


def state_of(*folders):
    files = sorted(path for folder in folders for path in folder.rglob("*"))
    return [(path, path.stat().st_size, path.stat().st_mtime_ns) for path in files]


def is_read_of(event, *folders):
    """Tell whether something was opened for reading, in one of the folders."""
    reading = event[0] == "open" and event[2] == os.O_RDONLY
    return reading and any(Path(event[1]).is_relative_to(folder) for folder in folders)


def check_refusals(folder, toy, good, seeds):
    count = make_files(folder, good, seeds)
    before = state_of(folder, toy)
    verdicts = judge(folder, toy)
    assert len(verdicts) == count >= 200
    for name, found, seconds, peak, opened in verdicts:
        assert isinstance(found, list), (name, found)
        assert found, f"{name} was accepted"
        assert all(0 < len(line.strip()) < 100_000 for line in found), name
        assert seconds < MOST_SECONDS, (name, seconds)
        assert peak < MOST_BYTES, (name, peak)
        assert all(is_read_of(event, folder / name, toy) for event in opened), (name, opened)
    assert state_of(folder, toy) == before


def test_two_hundred_hostile_submissions_are_refused(toy, good, tmp_path):
    check_refusals(tmp_path, toy, good, range(SHORT))


@pytest.mark.long
def test_a_thousand_hostile_submissions_are_refused(toy, good, tmp_path):
    check_refusals(tmp_path, toy, good, range(SHORT, SHORT + LONG))


@pytest.mark.parametrize(
    "content",
    [b"", b"PK\x03\x04" + bytes(100), b"\x89HDF\r\n\x1a\n", b"\x89HDF\r\n\x1a\n" + b"\xff" * 4096],
)
def test_files_that_are_no_hdf5_are_refused(toy, tmp_path, content):
    (tmp_path / "x.h5").write_bytes(content)
    with pytest.raises(Semantic2DError):
        validate(tmp_path / "x.h5", open_dataset(toy))


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1))
def test_any_mutation_of_structure_dtype_shape_ids_or_labels_is_refused(seed, toy, good, tmp_path):
    kind, _, build = hostile.mutation(seed - seed % 6 + seed % 5)  # no cuts
    path = tmp_path / "x.h5"
    shutil.copy(good, path)
    with h5py.File(path, "r+") as file:
        build(file, None)
    try:
        found = validate(path, open_dataset(toy))
    except Semantic2DError as err:
        found = [str(err)]
    assert found, kind


def test_messages_about_names_hold_nothing_for_terminals(toy, good, tmp_path):
    path = tmp_path / "x.h5"
    shutil.copy(good, path)
    with h5py.File(path, "r+") as file:
        file.move(hostile.GROUP, "predictions/\x1b[2Jx")
    problems = validate(path, open_dataset(toy))
    assert problems[0].startswith("?[2Jx: the split has no scan of this sequence")
    assert all(problem.isprintable() for problem in problems)


def test_what_readers_would_have_to_hold_is_limited(toy, good, tmp_path):
    path = tmp_path / "x.h5"
    shutil.copy(good, path)
    with h5py.File(path, "r+") as file:
        hostile.meta(file, b'{"method": "m"}' + b" " * (1 << 16))
        hostile.bomb(file, hostile.LABELS, (1000, 100_000), (1000, 1000), np.uint8)
        hostile.bomb(file, hostile.SAMPLES, (1, 1, 1), (1, 1 << 12, 1 << 13), np.uint8, (None,) * 3)
    with PredictionsReader(path) as reader:
        with pytest.raises(CorruptFileError, match="expected at most 65536 bytes"):
            _ = reader.metadata
        with pytest.raises(UnsafeFileError, match="make readers hold 100000000 bytes at once"):
            reader.blocks(hostile.FIRST, "labels")
        with pytest.raises(UnsafeFileError, match="chunks of at most 16777216 bytes"):
            reader.read(hostile.FIRST, "samples")
