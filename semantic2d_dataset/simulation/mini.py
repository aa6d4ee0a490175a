"""The embedded data set `semantic2d-mini`, and bigger simulated ones.

Furniture and the number of people were fitted so that the class shares of `semantic2d-mini`, at
its seed, come close to the paper's. Other seeds give shares that lie a few points farther off.
"""

from __future__ import annotations

import hashlib
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor, as_completed
from functools import partial
from pathlib import Path
from typing import NoReturn, Self

import numpy as np
from tqdm import tqdm

import semantic2d_dataset
from semantic2d_dataset.errors import ChecksumError, InvalidInputError
from semantic2d_dataset.format.manifest import Manifest, check_names, publish
from semantic2d_dataset.format.sequence import SequenceHeader, SequenceWriter
from semantic2d_dataset.scene.lidars import LIDARS, LidarSpec, find_lidar
from semantic2d_dataset.scene.scans import ScanBatch
from semantic2d_dataset.simulation.plans import PLANS
from semantic2d_dataset.simulation.recording import EPOCH_NS, Scene, record_blocks, stage
from semantic2d_dataset.simulation.worlds import check_plan, draw_world

MINI_NAME = "semantic2d-mini"
MINI_VERSION = "1.1.0"
MINI_SEED = 2024
MINI_DIGEST = "c7c05ab3de70a6754f29ec4e641b22094b3d0bbfb2c10ac46d3e21aad7a4cc98"
_LICENSE = "MIT"
_HOUR_NS = 3_600_000_000_000
_Advance = Callable[[int], None]


def make_mini(folder: Path) -> Manifest:
    """Make `semantic2d-mini` in a folder and check it against its pinned digest.

    Six floor plans, one drive of 17 s through each, three lidars: 6,120 scans.

    Raises
    ------
    ChecksumError
        If this machine drew another data set than the one that was published.
    """
    manifest = simulate_dataset(folder, seed=MINI_SEED, name=MINI_NAME, version=MINI_VERSION)
    found = combined_digest(manifest)
    if found != MINI_DIGEST:
        raise ChecksumError(
            f"{folder}: expected {MINI_NAME} {MINI_VERSION} with the content digest "
            f"{MINI_DIGEST}, found {found}; this version of numpy or scipy may draw other "
            "numbers than those that constraints.txt names"
        )
    return manifest


def simulate_dataset(
    folder: Path,
    *,
    seed: int,
    environments: Sequence[str] | None = None,
    recordings: int = 1,
    scans: int = 340,
    lidars: Sequence[str] = tuple(LIDARS),
    name: str = "semantic2d-simulated",
    version: str = "1.0.0",
) -> Manifest:
    """Simulate recordings, and publish them with the standard split schemes.

    Parameters
    ----------
    folder
        An existing folder; gets ``sequences/``, ``splits/`` and ``dataset.json``.
    seed
        Of everything; whole number from 0 on.
    environments
        Floor plans, by default all; one named twice is drawn once. Recordings of one
        environment share the building.
    recordings
        Drives through each environment; they are named drive-1, drive-2 and so on.
    scans
        Scans of each drive, at 20 Hz.
    lidars
        Names or short names of lidars of the release; one named twice records once.
    name, version
        What the manifest says of the data set.

    Raises
    ------
    InvalidInputError
        If a name is unknown or malformed, or a number too small; nothing is written then.
    WriteError
        If a file cannot be written.
    """
    check_names(name, version)
    plans = _plans(PLANS if environments is None else environments)
    specs = list(dict.fromkeys(find_lidar(lidar) for lidar in lidars))
    if min(recordings, scans, len(specs), len(plans)) < 1:
        raise InvalidInputError(
            "expected at least 1 environment, recording, scan and lidar, found "
            f"{len(plans)}, {recordings}, {scans} and {len(specs)}"
        )
    if seed < 0:
        raise InvalidInputError(f"seed: expected a whole number from 0 on, found {seed}")
    sequences = Path(folder) / "sequences"
    sequences.mkdir(exist_ok=True)
    work = [(plan, number) for plan in plans for number in range(recordings)]
    total = len(work) * len(specs) * scans
    with (
        tqdm(total=total, desc=f"simulating {name}", unit="scan", disable=None) as bar,
        _Crew(bar) as crew,
    ):
        for plan, number in work:
            scene = _stage(plan, number, seed, scans)
            crew.run([partial(_write, sequences, scene, spec, seed, number) for spec in specs])
    return publish(Path(folder), name=name, version=version, license=_LICENSE)


def combined_digest(manifest: Manifest) -> str:
    """SHA-256 over the content digests of all sequences, hex."""
    lines = sorted(f"{entry.id} {entry.content_digest}\n" for entry in manifest.sequences)
    return hashlib.sha256("".join(lines).encode()).hexdigest()


class _Crew:
    """Threads that share a progress bar, and stop soon after any of them, or Ctrl-C, says so."""

    def __init__(self, bar: tqdm[NoReturn]) -> None:
        self._bar = bar
        self._lock = threading.Lock()
        self._stopped = False
        self._pool = ThreadPoolExecutor(os.cpu_count())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._stopped = kind is not None
        self._pool.shutdown(cancel_futures=True)

    def run(self, jobs: Iterable[Callable[[_Advance], None]]) -> None:
        """Do all jobs; each gets a function to call with the number of scans just done."""
        for job in as_completed([self._pool.submit(job, self._advance) for job in jobs]):
            job.result()

    def _advance(self, scans: int) -> None:
        if self._stopped:
            raise CancelledError
        with self._lock:
            self._bar.update(scans)


def _plans(names: Iterable[str]) -> tuple[str, ...]:
    plans = tuple(dict.fromkeys(names))
    for plan in plans:
        check_plan(plan)
    return plans


def _stage(plan: str, number: int, seed: int, scans: int) -> Scene:
    world = draw_world(plan, seed)
    return stage(world, seed=_seed_of(seed, number), scans=scans, start_ns=_start_ns(number))


def _seed_of(seed: int, number: int) -> int:
    """Seed of one recording: the first has the data set's own."""
    return seed if number == 0 else int(np.random.SeedSequence([seed, number]).generate_state(1)[0])


def _start_ns(number: int) -> int:
    return EPOCH_NS + number * _HOUR_NS


def _write(
    folder: Path,
    scene: Scene,
    lidar: LidarSpec,
    seed: int,
    number: int,
    advance: _Advance,
) -> None:
    header = SequenceHeader(
        environment=scene.world.name,
        recording=f"drive-{number + 1}",
        lidar=lidar,
        license=_LICENSE,
        stamps_source="header",
        provenance={
            "generator": f"semantic2d_dataset {semantic2d_dataset.__version__} simulation",
            "parameters": {"seed": seed, "recording": number, "scans": len(scene)},
        },
    )
    with SequenceWriter(folder / f"{header.sequence_id}.h5", header) as writer:
        writer.set_map(scene.world.scene_map)
        writer.append(
            {
                "scans/stamps_ns": scene.stamps_ns,
                "poses/initial": scene.drive.initial_poses,
                "poses/refined": scene.drive.poses,
                "commands/velocity": scene.drive.velocity,
            }
        )
        for batch in record_blocks(scene, lidar, seed=_seed_of(seed, number)):
            writer.append(dict(_arrays(batch)))
            advance(len(batch))


def _arrays(batch: ScanBatch) -> Iterator[tuple[str, np.ndarray]]:
    yield "scans/ranges", batch.ranges
    if batch.intensities is not None and batch.labels is not None:
        yield "scans/intensities", batch.intensities
        yield "scans/labels", batch.labels
