"""How fast and how right SALSA labels, beside a plain rendering of its steps.

    python benchmarks/salsa_labelling.py speed [--lobby FOLDER]
    python benchmarks/salsa_labelling.py accuracy [--lobby FOLDER] [--points lines]
    python benchmarks/salsa_labelling.py sequence FILE.h5 [--map MAP.yaml --annotation LABELS.json]

Scans are simulated (Hokuyo, people walking about) in the generator's six floor plans, in a corridor
of two bare walls (accuracy only) and, where `--lobby` names a folder with its map.yaml and
label.png, in the published map of the lobby.
World = map: nothing stands there that the map does not know. World != map: 30 % of chairs and
tables moved by 0.3 to 1 m, one unmapped object for each 10 m2, walls displaced by 3 to 5 cm.
Starts: as a particle filter would estimate (8 cm, 2 degrees, drifting), or each scan by itself
anywhere within a circle and an angle around the truth. The default seeds are held out: settings
were tuned with seeds below 100 only.

`speed` times alignment and label transfer, which is what the plain rendering does, and then all
that ``semantic2d salsa label`` does with a scan in memory (things that stay, line features), on
one thread and on two; the plain rendering (plain_salsa.py) has one. Each runs in a process of its
own, in turn, after a warm-up, over the same scans; the plain one gets every so-manieth of them.
Ratios of one thread are of processor time, of two of the clock's.

`accuracy` takes errors over all scans and shares of labels over the accepted ones (the plain
rendering accepts all). "Off" are accepted scans more than 20 cm away; "off, seen" leaves out the
direction in which the scan cannot tell where it is, such as along a corridor.

`sequence` says how the scans of a file lie on a map before and after, by thirds, and takes its
refined poses for the truth with `--exact`.
"""

from __future__ import annotations

import argparse
import json
import os
import pickle
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from plain_salsa import Prepared, label_scan, prepare
from scipy import ndimage

from salsa.alignment import TRUSTED, Alignment, align, corrections, fit, measure
from salsa.annotation import annotate_map, read_annotation
from salsa.evidence import Ledger, coarse, gather
from salsa.fields import MapField, map_field
from salsa.labelling import DEFAULT_TRANSFER, transfer_labels
from salsa.things import DEFAULT_PERSISTENCE, NO_THINGS, Persistence, find_things
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.scene.geometry import compose, wrap_angle
from semantic2d_dataset.scene.lidars import find_lidar
from semantic2d_dataset.scene.lines import FAST, extract_lines
from semantic2d_dataset.scene.maps import FREE, SemanticMap, read_map
from semantic2d_dataset.scene.scans import ScanBatch
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D
from semantic2d_dataset.simulation.furniture import Primitives
from semantic2d_dataset.simulation.plans import PLANS
from semantic2d_dataset.simulation.recording import SimulatedRecording, simulate_recording
from semantic2d_dataset.simulation.sensors import DRYWALL, Surfaces
from semantic2d_dataset.simulation.worlds import (
    World,
    draw_world,
    perturb,
    rasterise,
    world_from_map,
)

PERSON, CHAIR, TABLE, WALL = map(SEMANTIC2D.id_of, ("Person", "Chair", "Table", "Wall"))
HELD_OUT = (101, 102, 103)
# name: largest error of x, y (m) and of yaw (degrees); none for the recording's own estimates
STARTS = {"amcl": None, "0.3 m, 5 deg": (0.3, 5.0), "0.5 m, 10 deg": (0.5, 10.0)}
WORLDS = ("= map", "!= map")
BARE = "bare-corridor"
OFF_M = 0.2
UNSEEN = 10.0  # standard deviations along the two axes of a pose differ by more
BUDGET_S = 3.0  # repetitions in one process; the best counts
PLAIN_SCANS = 20  # of each recording


class Labelled(NamedTuple):
    """What became of a recording."""

    alignment: Alignment
    labels: np.ndarray  # (N, B) u1


def label(
    batch: ScanBatch,
    field: MapField,
    *,
    points: Literal["all", "lines"] = "all",
    persistence: Persistence | None = DEFAULT_PERSISTENCE,
) -> Labelled:
    """Label a whole recording in memory: what ``semantic2d salsa label`` does, line by line."""
    fit(batch, batch.poses, field, TRUSTED.inlier_m)  # the command says how they lay before
    found = align(batch, field, points=points)
    corrections(batch.poses, found.poses)
    things = NO_THINGS
    if persistence is not None:
        ledger = Ledger(coarse(field)[1])
        ledger.add(gather(batch, found.poses, found.accepted, field))
        things = find_things(ledger, field, DEFAULT_TRANSFER.object_m, persistence, SEMANTIC2D)
    labels, _confidence = transfer_labels(
        batch,
        found.poses,
        field,
        found.accepted,
        quality=found.inlier_ratio,
        things=things.layer(field.free.shape),
    )
    return Labelled(found, labels)


def find_lines(batch: ScanBatch) -> None:
    lidar = batch.lidar
    extract_lines(
        batch.ranges, lidar.bearings, FAST, range_min=lidar.range_min, range_max=lidar.range_max
    )


# Where scans come from


class Place(NamedTuple):
    """A world whose map is right, and the annotation of that map where it is an image."""

    name: str
    world: World
    label_image: np.ndarray | None


class Case(NamedTuple):
    """A recording with rough poses, and its map."""

    batch: ScanBatch
    scene: SemanticMap
    label_image: np.ndarray | None


def find_places(options: argparse.Namespace, seed: int) -> Iterator[Place]:
    for plan in options.plans:
        bare = plan == BARE
        world = bare_corridor() if bare else draw_world(plan, seed, clutter=False)
        yield Place(plan, world, None)
    if options.lobby is not None:
        yield published_lobby(options.lobby, seed)


def bare_corridor(length: float = 160.0, width: float = 2.4) -> World:
    """Build a corridor whose ends lie farther off than the lidar reaches from the tour."""
    corners = np.array(((0.0, 0.0), (length, 0.0), (length, width), (0.0, width)))
    walls = np.concatenate((corners, np.roll(corners, -1, axis=0)), axis=1)
    labels = np.full(4, WALL, np.uint8)
    surfaces = Surfaces(labels, np.full(4, DRYWALL, np.uint8), np.ones(4))
    solid = Primitives(walls, np.zeros((0, 3)), surfaces, np.arange(4, dtype=np.int32))
    tour = np.array(((length / 2 - 15, width / 2), (length / 2 + 15, width / 2)))
    return World(BARE, solid, rasterise(solid, tour[0]), tour)


def published_lobby(folder: Path, seed: int) -> Place:
    """Stand a world on the published map; the robot visits places 0.6 m clear of everything."""
    scene = annotate_map(folder / "map.yaml", folder / "label.png")
    image = read_annotation(folder / "label.png", scene.occupancy.shape).regions
    clearance = ndimage.distance_transform_edt(scene.occupancy == FREE) * scene.resolution
    regions, _count = ndimage.label(clearance > 0.6)
    largest = 1 + np.argmax(np.bincount(regions.ravel())[1:])
    spots = scene.centres_of(np.argwhere(regions == largest))
    tour = spots[np.random.default_rng(seed).integers(len(spots), size=12)]
    world = world_from_map("published-lobby", scene, tour)
    return Place("published lobby", group_furniture(world, image), image)


def group_furniture(world: World, image: np.ndarray) -> World:
    """Make one object of the edges in each annotated chair or table, so that they move as one."""
    solid, scene = world.primitives, world.scene_map
    ends = solid.segments.reshape(-1, 2, 2)
    rows, columns = scene.cells_of(ends.mean(axis=1)).T
    objects = solid.objects.copy()
    for kind in (CHAIR, TABLE):
        # cells up to 10 cm beside a shape took its class
        shapes, _count = ndimage.label(ndimage.binary_dilation(image == kind, iterations=5))
        mine = (solid.labels == kind) & (shapes[rows, columns] > 0)
        objects[mine] = objects.max() + shapes[rows, columns][mine]
    return replace(world, primitives=replace(solid, objects=objects))


def record(place: Place, kind: str, seed: int, scans: int) -> SimulatedRecording:
    world = place.world if kind == WORLDS[0] else perturb(place.world, seed)
    return simulate_recording(world, find_lidar("hokuyo"), seed=seed, scans=scans)


def start_from(recording: SimulatedRecording, start: str, seed: int) -> ScanBatch:
    limits = STARTS[start]
    if limits is None:
        return replace(recording.batch, poses=recording.initial_poses)
    rng = np.random.default_rng((seed, 7))
    count = len(recording.batch)
    way, away = rng.uniform(-np.pi, np.pi, count), limits[0] * np.sqrt(rng.random(count))
    turn = np.deg2rad(limits[1]) * rng.uniform(-1, 1, count)
    error = np.stack((away * np.cos(way), away * np.sin(way), turn), axis=-1)
    return replace(recording.batch, poses=compose(recording.true_poses, error))


def every(recording_scans: int, wanted: int) -> np.ndarray:
    """Return the rows that the plain rendering gets."""
    return np.unique(np.linspace(0, recording_scans - 1, wanted).astype(int))


def select(batch: ScanBatch, rows: np.ndarray) -> ScanBatch:
    names = ("ranges", "intensities", "labels", "poses", "stamps_ns")
    return replace(batch, **{name: getattr(batch, name)[rows] for name in names})


def label_plainly(batch: ScanBatch, known: Prepared) -> tuple[np.ndarray, np.ndarray]:
    found = [
        label_scan(ranges, batch.lidar, rough, known)
        for ranges, rough in zip(batch.ranges, batch.poses, strict=True)
    ]
    poses, labels = zip(*found, strict=True)
    return np.stack(poses), np.stack(labels)


# Speed

Rates = dict[str, float]
WAYS = {"plain": 1, "ours, one thread": 1, "ours, two threads": 2}


def compare_speed(options: argparse.Namespace) -> None:
    print("| world | start | way | scans/s | ratio | all of it, scans/s | ratio |")
    print("|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "cases"
        for kind in WORLDS:
            for start in options.starts:
                file.write_bytes(pickle.dumps(list(find_cases(options, kind, start))))
                runs: dict[str, list[Rates]] = {way: [] for way in WAYS}
                for _ in range(options.rounds):
                    for way in WAYS:
                        runs[way].append(run(way, file, options.plain_scans))
                report_speed(f"| {kind} | {start}", runs)


def find_cases(options: argparse.Namespace, kind: str, start: str) -> Iterator[Case]:
    for seed in options.seeds:
        for place in find_places(options, seed):
            recording = record(place, kind, seed, options.scans)
            batch = start_from(recording, start, seed)
            yield Case(batch, recording.scene_map, place.label_image)


def run(way: str, file: Path, plain_scans: int) -> Rates:
    """Time one way in a process of its own."""
    one = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    command = [sys.executable, __file__, "measure", way, str(file), str(plain_scans)]
    done = subprocess.run(
        command,
        check=True,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | one | {"NUMBA_NUM_THREADS": str(WAYS[way])},
    )
    return json.loads(done.stdout)


def measure_way(options: argparse.Namespace) -> None:
    """Print the best rates in scans/s, by the clock and by processor time."""
    cases: list[Case] = pickle.loads(options.file.read_bytes())
    if options.way == "plain":
        cases = [
            case._replace(batch=select(case.batch, every(len(case.batch), options.plain_scans)))
            for case in cases
        ]
    found: Rates = {"scans": sum(len(case.batch) for case in cases)}
    for name, job in (plain_jobs if options.way == "plain" else our_jobs)(cases).items():
        job()  # compiles, or reads what was compiled
        for clock, seconds in zip(("wall", "processor"), fastest(job), strict=True):
            found[name + clock] = found["scans"] / seconds
    print(json.dumps(found))


def plain_jobs(cases: list[Case]) -> dict[str, Callable[[], object]]:
    known = [prepare(case.scene, case.label_image) for case in cases]
    batches = [case.batch for case in cases]
    return {"": lambda: [label_plainly(*both) for both in zip(batches, known, strict=True)]}


def our_jobs(cases: list[Case]) -> dict[str, Callable[[], object]]:
    fields = [map_field(case.scene) for case in cases]
    batches = [case.batch for case in cases]
    pairs = list(zip(batches, fields, strict=True))
    return {
        "": lambda: [label(*pair, persistence=None) for pair in pairs],
        "all, ": lambda: [(label(*pair), find_lines(pair[0])) for pair in pairs],
    }


def fastest(job: Callable[[], object]) -> tuple[float, float]:
    """Return the least seconds by the clock and of processor time, each on its own."""
    found: list[tuple[float, float]] = []
    while sum(wall for wall, _ in found) < BUDGET_S:
        wall, processor = time.perf_counter(), time.process_time()
        job()
        found.append((time.perf_counter() - wall, time.process_time() - processor))
    return min(wall for wall, _ in found), min(processor for _, processor in found)


def report_speed(start: str, runs: dict[str, list[Rates]]) -> None:
    for way, found in runs.items():
        clock = "processor" if WAYS[way] == 1 else "wall"
        plain = statistics.median(one[clock] for one in runs["plain"])
        rates = [one[clock] for one in found]
        cells = [start, f"{way} ({found[0]['scans']:,} scans)", *compare(rates, plain)]
        if way == "plain":
            cells += ["", ""]  # it needs them anyway
        else:
            cells += compare([one["all, " + clock] for one in found], plain)
        print(" | ".join(cells), "|", flush=True)


def compare(rates: list[float], plain: float) -> tuple[str, str]:
    middle = statistics.median(rates)
    return f"{middle:,.0f} ({min(rates):,.0f} to {max(rates):,.0f})", f"{middle / plain:,.0f}"


# Accuracy

Outcome = dict[str, np.ndarray]
HEADER = (
    "place", "world", "start", "way", "scans", "median cm", "median deg", "p95 cm", "accepted",
    "off", "off, seen", "right %", "Person IoU %",
)  # fmt: skip


def compare_accuracy(options: argparse.Namespace) -> None:
    print("| " + " | ".join(HEADER) + " |")
    print("|" + "---|" * len(HEADER))
    found: dict[tuple[str, ...], list[Outcome]] = {}
    for seed in options.seeds:
        for place in find_places(options, seed):
            for kind in WORLDS:
                recording = record(place, kind, seed, options.scans)
                field = map_field(recording.scene_map)
                for start in options.starts:
                    batch = start_from(recording, start, seed)
                    key = (place.name, kind, start)
                    ours = judge_ours(recording, batch, field, options.points)
                    found.setdefault((*key, "ours"), []).append(ours)
                    if STARTS[start] is None and options.plain_scans:
                        rows = every(len(batch), options.plain_scans)
                        plain = judge_plain(recording, batch, rows, place.label_image)
                        found.setdefault((*key, "plain"), []).append(plain)
    for key, parts in (found | pool_plans(found)).items():
        print_row(key, parts)


def pool_plans(found: dict[tuple[str, ...], list[Outcome]]) -> dict[tuple[str, ...], list[Outcome]]:
    """Put the floor plans together, where there are several."""
    drawn = {key[0] for key in found if key[0] in PLANS}
    pooled: dict[tuple[str, ...], list[Outcome]] = {}
    for (place, *rest), parts in found.items():
        if len(drawn) > 1 and place in drawn:
            pooled.setdefault((f"all {len(drawn)} plans", *rest), []).extend(parts)
    return pooled


def judge_ours(
    recording: SimulatedRecording,
    batch: ScanBatch,
    field: MapField,
    points: Literal["all", "lines"],
) -> Outcome:
    found, labels = label(batch, field, points=points)
    return judge(recording, found.poses, labels, found.accepted, seen_axis(found.covariance))


def judge_plain(
    recording: SimulatedRecording, batch: ScanBatch, rows: np.ndarray, image: np.ndarray | None
) -> Outcome:
    names = ("true_poses", "initial_poses", "velocity")
    some = replace(
        recording,
        batch=select(recording.batch, rows),
        **{name: getattr(recording, name)[rows] for name in names},
    )
    poses, labels = label_plainly(select(batch, rows), prepare(recording.scene_map, image))
    everything = np.ones(len(rows), bool)
    return judge(some, poses, labels, everything, np.full((len(rows), 2), np.nan))


def seen_axis(covariance: np.ndarray) -> np.ndarray:
    """Return the direction (N, 2) that alone can be seen; NaN where both can, or none is known."""
    known = np.isfinite(covariance).all(axis=(1, 2))
    values, vectors = np.linalg.eigh(np.where(known[:, None, None], covariance, 0)[:, :2, :2])
    single = known & (values[:, 1] > UNSEEN**2 * values[:, 0])
    return np.where(single[:, None], vectors[:, :, 0], np.nan)


def judge(
    recording: SimulatedRecording,
    poses: np.ndarray,
    labels: np.ndarray,
    accepted: np.ndarray,
    seen: np.ndarray,
) -> Outcome:
    """Return figures per scan."""
    error = poses - recording.true_poses
    metres = np.hypot(error[:, 0], error[:, 1])
    across = np.abs((error[:, :2] * seen).sum(axis=-1))
    truth, use = recording.batch.labels, recording.batch.valid & accepted[:, None]
    ours, theirs = (labels == PERSON) & use, (truth == PERSON) & use
    return {
        "metres": metres,
        "across": np.where(np.isnan(across), metres, across),
        "degrees": np.rad2deg(np.abs(wrap_angle(error[:, 2]))),
        "accepted": accepted,
        "points": use.sum(axis=-1),
        "right": ((labels == truth) & use).sum(axis=-1),
        "both": (ours & theirs).sum(axis=-1),
        "either": (ours | theirs).sum(axis=-1),
    }


def print_row(key: tuple[str, ...], parts: list[Outcome]) -> None:
    all_ = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    accepted, scans = all_["accepted"], len(all_["metres"])
    off = [np.count_nonzero(all_[name][accepted] > OFF_M) for name in ("metres", "across")]
    share = 100 * all_["right"].sum() / max(all_["points"].sum(), 1)
    person = 100 * all_["both"].sum() / max(all_["either"].sum(), 1)
    numbers = (
        f"{scans:,}",
        f"{100 * np.median(all_['metres']):.2f}",
        f"{np.median(all_['degrees']):.3f}",
        f"{100 * np.quantile(all_['metres'], 0.95):.1f}",
        f"{100 * accepted.mean():.1f} %" if key[-1] == "ours" else "",
        f"{off[0]}",
        f"{off[1]}" if key[-1] == "ours" else "",
        f"{share:.2f}",
        f"{person:.1f}",
    )
    print("| " + " | ".join((*key, *numbers)) + " |", flush=True)


# A sequence of a file


def describe_sequence(options: argparse.Namespace) -> None:
    with SequenceReader(options.sequence) as reader:
        batch = replace(reader.batch(), poses=reader.read("poses/initial"))
        truth = reader.read("poses/refined") if options.exact else None
        scene = reader.read_map() if options.map is None else read_map(options.map)
    if options.annotation:
        scene = annotate_map(options.map, options.annotation)
    field = map_field(scene)
    known = np.isfinite(batch.poses).all(axis=-1)
    print(f"{options.sequence.name}: {len(batch)} scans, {known.sum()} with a pose")
    report_near("before", measure(batch, batch.poses, field).inlier_ratio[known])
    for points in ("all", "lines"):
        found = align(batch, field, points=points)
        report_near(f"after, {points}", found.inlier_ratio[known])
        print(f"  accepted {found.accepted[known].mean():.1%}")
        if truth is not None:
            error = (found.poses - truth)[known]
            metres = np.median(np.hypot(error[:, 0], error[:, 1]))
            degrees = np.rad2deg(np.median(np.abs(wrap_angle(error[:, 2]))))
            print(f"  error {100 * metres:.2f} cm, {degrees:.3f} degrees")
        wall, _processor = fastest(lambda points=points: align(batch, field, points=points))
        print(f"  {len(batch) / wall:,.0f} scans/s")


def report_near(what: str, near: np.ndarray) -> None:
    thirds = " ".join(f"{np.median(part):6.1%}" for part in np.array_split(near, 3))
    print(f"{what:<14} near the map: {np.median(near):6.1%}; by thirds {thirds}")


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    for name, scans, seeds in (("speed", 250, HELD_OUT[:1]), ("accuracy", 1200, HELD_OUT)):
        command = commands.add_parser(name)
        command.add_argument("--lobby", type=Path, help="folder of the published lobby's map")
        command.add_argument("--plans", type=split, default=list(PLANS))
        command.add_argument("--seeds", type=lambda text: list(map(int, split(text))))
        command.add_argument("--scans", type=int, default=scans, help="of each recording")
        command.add_argument("--plain-scans", type=int, default=PLAIN_SCANS)
        command.set_defaults(seeds=list(seeds), starts=list(STARTS))
    commands.choices["speed"].add_argument("--rounds", type=int, default=3)
    commands.choices["speed"].set_defaults(starts=["amcl", "0.5 m, 10 deg"])
    commands.choices["accuracy"].set_defaults(plans=[*PLANS, BARE])
    commands.choices["accuracy"].add_argument("--points", choices=("all", "lines"), default="all")
    command = commands.add_parser("sequence")
    command.add_argument("sequence", type=Path)
    command.add_argument("--map", type=Path)
    command.add_argument("--annotation", type=Path)
    command.add_argument("--exact", action="store_true")
    command = commands.add_parser("measure")  # one process of `speed`
    command.add_argument("way", choices=WAYS)
    command.add_argument("file", type=Path)
    command.add_argument("plain_scans", type=int)
    return parser.parse_args()


def split(text: str) -> list[str]:
    return text.split(",") if text else []


def main() -> None:
    options = parse()
    if options.command == "measure":
        measure_way(options)
        return
    busy = f"load {os.getloadavg()[0]:.1f} at the start"  # two threads need two idle cores
    cores = f"{platform.machine()}, {os.cpu_count()} cores"
    print(f"{cores}, {busy}, Python {platform.python_version()}")
    if options.command == "sequence":
        describe_sequence(options)
        return
    print(f"seeds {', '.join(map(str, options.seeds))}; {options.scans} scans a recording")
    if options.lobby is None:
        print("the published lobby is left out: no --lobby FOLDER with map.yaml and label.png")
    print()
    (compare_speed if options.command == "speed" else compare_accuracy)(options)


if __name__ == "__main__":
    main()
