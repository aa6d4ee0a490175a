"""Hostile submissions: each is refused within a second and 200 MB, with nothing else touched."""

import json
import os
import shutil
import subprocess
import sys

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from semantic2d_dataset.access.registry import open_dataset
from semantic2d_dataset.errors import Semantic2DError
from semantic2d_dataset.format.manifest import publish
from semantic2d_dataset.format.splits import NONE, TEST, VAL, SplitScheme
from semantic2d_dataset.scoring.submission import validate
from tests.conftest import PROJECT
from tests.scoring import hostile
from tests.scoring.test_submission import (
    FAR,
    NEAR,
    SCANS,
    Folder,
    write_predictions,
    write_sequence,
)

HUNDRED_MB = 100 << 20
SHORT, LONG = 120, 1000
"""Fuzzed files besides those crafted: some in the ordinary suite, many in the long one."""

_JUDGE = """
import json, resource, sys, time
from pathlib import Path
from semantic2d_dataset.access.registry import open_dataset
from semantic2d_dataset.errors import Semantic2DError
from semantic2d_dataset.scoring.submission import validate

folder, data = Path(sys.argv[1]), open_dataset(sys.argv[2])
assert validate(folder / "good.h5", data) == [], validate(folder / "good.h5", data)
pages = int(Path("/proc/self/statm").read_text().split()[0])
limit = pages * resource.getpagesize() + int(sys.argv[3])
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
for path in sorted(folder.glob("bad-*")):
    before = time.process_time()
    try:
        found = validate(path, data)
    except Semantic2DError as err:
        found = [str(err)]
    except Exception as err:
        found = repr(err)
    print(json.dumps([path.name, found, time.process_time() - before]))
"""


@pytest.fixture(scope="module")
def toy(tmp_path_factory):
    folder = tmp_path_factory.mktemp("toy")
    (folder / "sequences").mkdir()
    sequences = (("a", NEAR), ("b", NEAR), ("a", FAR))
    ids = [write_sequence(folder, r, lidar, n) for n, (r, lidar) in enumerate(sequences)]
    membership = np.full(SCANS, TEST, np.uint8)
    membership[:2] = NONE, VAL
    block = SplitScheme("block", dict.fromkeys(ids, membership), "by hand")
    publish(folder, name="toy", version="1.2.3", schemes=[block])
    return folder


@pytest.fixture(scope="module")
def good(toy, tmp_path_factory):
    data = open_dataset(toy)
    schemes = {"block": data.scheme("block")}
    path = tmp_path_factory.mktemp("good") / "good.h5"
    return write_predictions(path, Folder(toy, data.manifest, schemes))


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


def judge(folder, toy, memory):
    command = [sys.executable, "-c", _JUDGE, str(folder), str(toy), str(memory)]
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


def check_refusals(folder, toy, good, seeds):
    count = make_files(folder, good, seeds)
    before = sorted((p.name, p.stat().st_size) for p in folder.iterdir())
    verdicts = judge(folder, toy, 2 * HUNDRED_MB)
    assert len(verdicts) == count >= 200
    for name, found, seconds in verdicts:
        assert isinstance(found, list), (name, found)
        assert found, f"{name} was accepted"
        assert all(0 < len(line.strip()) < 100_000 for line in found), name
        assert seconds < 1, (name, seconds)
    assert sorted((p.name, p.stat().st_size) for p in folder.iterdir()) == before
    return verdicts


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
