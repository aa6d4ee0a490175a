"""Small sequences and data sets, made when a test needs them."""

from pathlib import Path

import numpy as np

from semantic2d_dataset.format.manifest import Manifest, publish
from semantic2d_dataset.format.sequence import SequenceHeader, SequenceWriter
from semantic2d_dataset.scene.geometry import Pose2
from semantic2d_dataset.scene.lidars import LidarSpec
from semantic2d_dataset.scene.maps import FREE, OCCUPIED, SemanticMap

SMALL_LIDAR = LidarSpec(
    name="small",
    model="Small test lidar",
    beams=37,
    angle_min=-1.8,
    angle_increment=0.1,
    range_min=0.1,
    range_max=20.0,
    base_T_lidar=(0.1, 0.0, 0.2, 0.0, 0.0, 0.0),
)


def make_arrays(scans: int, lidar: LidarSpec = SMALL_LIDAR, seed: int = 0) -> dict[str, np.ndarray]:
    """Every per-scan array that a labelled sequence usually has."""
    rng = np.random.default_rng(seed)
    shape = (scans, lidar.beams)
    ranges = rng.uniform(0.2, 15, shape).astype(np.float32)
    ranges[rng.random(shape) < 0.05] = np.inf
    ranges[rng.random(shape) < 0.02] = np.nan
    ranges[rng.random(shape) < 0.02] = -np.inf
    labels = rng.integers(0, 10, shape).astype(np.uint8)
    labels[rng.random(shape) < 0.05] = 255
    poses = np.cumsum(rng.normal(0, 0.05, (scans, 3)), axis=0)
    return {
        "scans/ranges": ranges,
        "scans/intensities": rng.uniform(0, 4000, shape).astype(np.float32),
        "scans/stamps_ns": 1_700_000_000_000_000_000 + np.arange(scans) * 50_000_000,
        "scans/labels": labels,
        "poses/initial": poses,
        "poses/refined": poses + 0.01,
        "commands/velocity": rng.normal(0, 1, (scans, 2)),
    }


def make_map() -> SemanticMap:
    occupancy = np.full((30, 40), FREE, np.uint8)
    occupancy[[0, -1]] = OCCUPIED
    occupancy[:, [0, -1]] = OCCUPIED
    labels = np.where(occupancy == OCCUPIED, 9, 255).astype(np.uint8)
    return SemanticMap(occupancy, labels, 0.05, Pose2(-1.0, -0.5, 0.0))


def make_sequence(
    path: Path,
    scans: int = 150,
    *,
    lidar: LidarSpec = SMALL_LIDAR,
    environment: str = "lobby",
    recording: str = "first",
    seed: int = 0,
    drop: tuple[str, ...] = (),
) -> dict[str, np.ndarray]:
    """Write a labelled sequence and return its arrays."""
    arrays = make_arrays(scans, lidar, seed)
    arrays = {name: values for name, values in arrays.items() if name not in drop}
    header = SequenceHeader(
        environment=environment,
        recording=recording,
        lidar=lidar,
        license="CC0-1.0",
        stamps_source="synthetic",
        provenance={"source": "generated", "seed": seed},
    )
    with SequenceWriter(path, header) as writer:
        writer.append(arrays)
        writer.set_map(make_map())
    return arrays


def make_dataset(
    folder: Path,
    *,
    environments: tuple[str, ...] = ("lobby", "corridor", "office"),
    lidars: tuple[LidarSpec, ...] = (SMALL_LIDAR,),
    scans: int = 150,
) -> Manifest:
    """Write and publish a data set of one recording in each environment."""
    (folder / "sequences").mkdir(parents=True)
    for number, environment in enumerate(environments):
        for lidar in lidars:
            name = f"{environment}--first--{lidar.name}.h5"
            make_sequence(
                folder / "sequences" / name,
                scans,
                lidar=lidar,
                environment=environment,
                seed=number,
            )
    return publish(folder, name="generated", version="1.0.0", license="CC0-1.0")
