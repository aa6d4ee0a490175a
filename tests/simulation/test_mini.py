"""semantic2d-mini: its content, and that every machine makes the same one."""

import hashlib
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from semantic2d_dataset.errors import ChecksumError, InvalidInputError
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.format.split_schemes import make_block_scheme
from semantic2d_dataset.simulation import mini

PAPER_SHARES = {9: 37.9, 6: 13.3, 4: 11.4, 2: 10.5}  # %, section on the class distribution
_IN_MEMORY = """
import hashlib, sys
from semantic2d_dataset.scene.lidars import LIDARS
from semantic2d_dataset.simulation.mini import MINI_SEED
from semantic2d_dataset.simulation.plans import PLANS
from semantic2d_dataset.simulation.recording import record, stage
from semantic2d_dataset.simulation.worlds import draw_world
digest = hashlib.sha256()
for name in PLANS:
    scene = stage(draw_world(name, MINI_SEED), seed=MINI_SEED, scans=60)
    for lidar in LIDARS.values():
        found = record(scene, lidar, seed=MINI_SEED)
        for array in (found.batch.ranges, found.batch.intensities, found.batch.labels,
                      found.initial_poses, found.true_poses, found.velocity,
                      found.scene_map.occupancy, found.scene_map.labels):
            digest.update(array.tobytes())
print(digest.hexdigest())
"""
_PLAIN_MACHINE = {
    "NUMBA_CPU_NAME": "generic",
    "NUMBA_DISABLE_INTEL_SVML": "1",
    "OPENBLAS_CORETYPE": "Nehalem",
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4,-AVX512F",
}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mini")
    manifest = mini.make_mini(folder)  # raises where the digest is not the pinned one
    batches = {}
    for entry in manifest.sequences:
        with SequenceReader(folder / entry.file) as reader:
            batches[entry.id] = reader.batch()
    return folder, manifest, batches


def shares(batches):
    counts = sum(np.bincount(b.labels[b.valid], minlength=10) for b in batches)
    return 100 * counts / counts.sum()


def run_in_memory(environment):
    command = [sys.executable, "-c", _IN_MEMORY]
    done = subprocess.run(
        command, env=os.environ | environment, capture_output=True, text=True, check=True
    )
    return done.stdout


def test_mini_is_six_environments_by_three_lidars(made):
    _, manifest, batches = made
    assert len({entry.environment for entry in manifest.sequences}) == 6
    assert len({entry.lidar for entry in manifest.sequences}) == 3
    assert sum(len(batch) for batch in batches.values()) == 6120
    assert set(manifest.splits) == {"block", "frame", "environment", "lidar"}
    assert mini.combined_digest(manifest) == mini.MINI_DIGEST


@pytest.mark.parametrize("lidar", ["", "hokuyo-utm-30lx-ew", "wlr-716", "rplidar-s2"])
def test_class_shares_are_within_three_points_of_the_paper(made, lidar):
    found = shares(batch for i, batch in made[2].items() if i.endswith(lidar))
    for label, wanted in PAPER_SHARES.items():
        assert abs(found[label] - wanted) < 3
    assert found[0] < 3
    assert found[1:].min() > 1.5


def test_every_class_occurs_in_every_part_of_the_block_split_of_every_lidar(made):
    batches = made[2]
    scheme = make_block_scheme({i: b.stamps_ns for i, b in batches.items()})
    for lidar in ("hokuyo-utm-30lx-ew", "wlr-716", "rplidar-s2"):
        for split in ("train", "val", "test"):
            labels = [
                np.unique(batch.labels[scheme.scans_of(i, split)])
                for i, batch in batches.items()
                if i.endswith(lidar)
            ]
            assert set(np.concatenate(labels)) == set(range(10))


def test_every_class_occurs_in_every_sequence(made):
    for batch in made[2].values():
        assert set(np.unique(batch.labels[batch.valid])) == set(range(10))


def test_beams_without_a_return_are_other(made):
    for batch in made[2].values():
        assert not batch.labels[~batch.valid].any()
        assert not batch.intensities[~batch.valid].any()


def test_intensities_of_the_hokuyo_are_spread_as_in_the_paper(made):
    hokuyo = [b.intensities for i, b in made[2].items() if i.endswith("hokuyo-utm-30lx-ew")]
    assert np.mean(hokuyo) == pytest.approx(3082, rel=0.1)
    assert np.std(hokuyo) == pytest.approx(1529, rel=0.2)


def test_sequences_hold_map_poses_and_commands(made):
    folder, manifest, _ = made
    with SequenceReader(folder / manifest.sequences[0].file) as reader:
        assert reader.read_map() is not None
        for name in ("poses/initial", "poses/refined", "commands/velocity"):
            assert np.isfinite(reader.read(name)).all()


def test_plain_processor_makes_the_same_scans(tmp_path):
    plain = _PLAIN_MACHINE | {"NUMBA_CACHE_DIR": str(tmp_path)}
    here = run_in_memory({})
    assert len(here.strip()) == hashlib.sha256().digest_size * 2
    assert run_in_memory(plain) == here


def test_another_content_than_the_pinned_one_is_refused(tmp_path, monkeypatch):
    manifest = mini.simulate_dataset(
        tmp_path, seed=9, environments=["lounge"], scans=4, lidars=["wlr716"]
    )
    monkeypatch.setattr(mini, "simulate_dataset", lambda *_, **__: manifest)
    with pytest.raises(ChecksumError, match=r"semantic2d-mini .* found"):
        mini.make_mini(tmp_path)


def test_recordings_of_one_environment_share_the_building_and_differ_in_the_drive(tmp_path):
    manifest = mini.simulate_dataset(
        tmp_path, seed=9, environments=["office"], recordings=2, scans=6, lidars=["wlr716"]
    )
    first, second = (SequenceReader(tmp_path / entry.file) for entry in manifest.sequences)
    np.testing.assert_array_equal(first.read_map().occupancy, second.read_map().occupancy)
    assert (first.read("poses/refined") != second.read("poses/refined")).any()
    assert [r.header.recording for r in (first, second)] == ["drive-1", "drive-2"]


def test_what_is_named_twice_is_written_once(tmp_path):
    manifest = mini.simulate_dataset(
        tmp_path,
        seed=9,
        environments=["lounge", "lounge"],
        scans=4,
        lidars=["wlr716", "wlr-716"],
    )
    assert [entry.id for entry in manifest.sequences] == ["lounge--drive-1--wlr-716"]


def test_interrupted_simulation_stops_within_seconds_and_leaves_no_sequence(tmp_path):
    code = (
        "import signal, sys; from pathlib import Path\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in a background job\n"
        "from semantic2d_dataset.simulation.mini import simulate_dataset\n"
        "simulate_dataset(Path(sys.argv[1]), seed=1, environments=['lounge'], scans=20000)"
    )
    command = [sys.executable, "-c", code, str(tmp_path)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as run:
        while sum(f.stat().st_size > 1 << 17 for f in tmp_path.glob("sequences/.*")) < 2:
            assert run.poll() is None
            time.sleep(0.05)
        run.send_signal(signal.SIGINT)
        start = time.monotonic()
        assert "KeyboardInterrupt" in run.communicate(timeout=60)[1]
        assert time.monotonic() - start < 5
    assert not list(tmp_path.glob("sequences/*"))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"scans": 0}, "at least 1"),
        ({"lidars": ["sick"]}, "unknown lidar 'sick'"),
        ({"environments": ["lobby", "attic"]}, "unknown floor plan 'attic'"),
        ({"environments": []}, "at least 1 environment.*found 0, 1, 4 and 3"),
        ({"lidars": []}, "at least 1 environment.*found 6, 1, 4 and 0"),
        ({"recordings": 0}, "at least 1"),
        ({"seed": -1}, "seed: expected a whole number from 0 on, found -1"),
        ({"name": "My data"}, "data set name 'My data'"),
        ({"version": "first"}, "data set version 'first'"),
    ],
)
def test_wrong_wishes_are_refused_before_any_work(tmp_path, wrong, message):
    with pytest.raises(InvalidInputError, match=message):
        mini.simulate_dataset(tmp_path, **({"seed": 1, "scans": 4} | wrong))
    assert not list(tmp_path.iterdir())
