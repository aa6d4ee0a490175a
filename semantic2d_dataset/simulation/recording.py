"""One drive through a world, with people in it, as a lidar records it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.lidars import LidarSpec
from semantic2d_dataset.scene.maps import SemanticMap
from semantic2d_dataset.scene.scans import ScanBatch
from semantic2d_dataset.simulation.people import clothes, populate, step_aside, walk
from semantic2d_dataset.simulation.raycast import cast
from semantic2d_dataset.simulation.sensors import (
    SENSORS,
    Noise,
    SensorModel,
    Surfaces,
    measure,
)
from semantic2d_dataset.simulation.trajectories import RATE_HZ, Drive, drive, floor_of
from semantic2d_dataset.simulation.worlds import World

Float = NDArray[np.float64]
EPOCH_NS = 1_704_067_200_000_000_000  # 2024-01-01 00:00:00 UTC
BLOCK_SCANS = 256
PEOPLE_PER_M2 = 0.105
_GRID = 1e-4  # m: leg positions are rounded to it


@dataclass(frozen=True)
class Scene:
    """A drive and the people around it: what all lidars of one recording share.

    Parameters
    ----------
    world
        Where it happens.
    drive
        The robot's poses, estimates and commands, N of each.
    legs
        (N, L, 3) f8 x y radius of the people's legs, m.
    leg_surfaces
        Their class, material and shades.
    stamps_ns
        (N,) i8 since the Unix epoch.
    """

    world: World
    drive: Drive
    legs: Float
    leg_surfaces: Surfaces
    stamps_ns: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.stamps_ns)


@dataclass(frozen=True)
class SimulatedRecording:
    """What a lidar recorded, and the truth.

    Parameters
    ----------
    batch
        N scans with true labels and true poses.
    true_poses, initial_poses
        (N, 3) f8 x y yaw of the base: true, and as a particle filter would estimate them.
    velocity
        (N, 2) f8 vx m/s, wz rad/s.
    scene_map
        The annotated map of the environment.
    """

    batch: ScanBatch
    true_poses: Float
    initial_poses: Float
    velocity: Float
    scene_map: SemanticMap


def stage(
    world: World, *, seed: int, scans: int, people: int | None = None, start_ns: int = EPOCH_NS
) -> Scene:
    """Drive through a world and let people walk about in it.

    Parameters
    ----------
    people
        How many; by default as many as suit the floor.
    start_ns
        Stamp of the first scan.

    Raises
    ------
    InvalidInputError
        If `scans` is below 1, or the world has no room for the robot.
    """
    if scans < 1:
        raise InvalidInputError(f"expected at least 1 scan, found {scans}")
    rng = np.random.Generator(np.random.PCG64([seed, *world.name.encode()]))
    floor = floor_of(world)
    ride = drive(floor, world.tour, scans, rng)
    if people is None:
        people = round(PEOPLE_PER_M2 * np.count_nonzero(floor.clearance) * 0.01)
    walkers = populate(floor, ride.poses[:, :2], people, rng)
    steps = np.arange(scans)
    legs = step_aside(walk(walkers, steps / RATE_HZ), ride.poses[:, :2])
    stamps = start_ns + np.rint(steps * (1e9 / RATE_HZ)).astype(np.int64)
    return Scene(world, ride, np.rint(legs / _GRID) * _GRID, clothes(walkers), stamps)


def record_blocks(
    scene: Scene,
    lidar: LidarSpec,
    *,
    seed: int,
    model: SensorModel | None = None,
    block: int = BLOCK_SCANS,
) -> Iterator[ScanBatch]:
    """Record a scene with a lidar, some scans at a time; needs memory for these only.

    Parameters
    ----------
    model
        Errors and scales of the sensor; by default those of the lidar of that name, and the
        Hokuyo's for any other.
    block
        Scans at a time; the recording is the same whatever it is.
    """
    model = model or SENSORS.get(lidar.name, SENSORS["hokuyo-utm-30lx-ew"])
    noise = Noise.from_seed(seed, *lidar.name.encode())
    solid = scene.world.primitives
    surfaces = _joined(solid.surfaces, scene.leg_surfaces)
    for start in range(0, len(scene), block):
        rows = slice(start, start + block)
        poses = scene.drive.poses[rows]
        hits = cast(solid.segments, solid.circles, scene.legs[rows], poses, lidar)
        found = measure(hits, surfaces, lidar, model, noise)
        yield ScanBatch(
            lidar, found.ranges, found.intensities, found.labels, poses, scene.stamps_ns[rows]
        )


def record(
    scene: Scene, lidar: LidarSpec, *, seed: int, model: SensorModel | None = None
) -> SimulatedRecording:
    """Record a scene with a lidar, in memory; parameters are those of `record_blocks`."""
    batch = _whole(list(record_blocks(scene, lidar, seed=seed, model=model)))
    ride = scene.drive
    return SimulatedRecording(
        batch, ride.poses, ride.initial_poses, ride.velocity, scene.world.scene_map
    )


def simulate_recording(
    world: World, lidar: LidarSpec, *, seed: int, scans: int = 340, people: int | None = None
) -> SimulatedRecording:
    """Simulate a recording in memory: `stage`, then `record`."""
    scene = stage(world, seed=seed, scans=scans, people=people)
    return record(scene, lidar, seed=seed)


def _joined(first: Surfaces, second: Surfaces) -> Surfaces:
    return Surfaces(
        np.concatenate((first.labels, second.labels)),
        np.concatenate((first.materials, second.materials)),
        np.concatenate((first.shades, second.shades)),
    )


def _whole(blocks: list[ScanBatch]) -> ScanBatch:
    names = ("ranges", "intensities", "labels", "poses", "stamps_ns")
    arrays = (np.concatenate([getattr(block, name) for block in blocks]) for name in names)
    return ScanBatch(blocks[0].lidar, *arrays)
