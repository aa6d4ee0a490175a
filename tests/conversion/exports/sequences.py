"""Sequences with everything in them, and recordings made of others with one thing changed."""

from pathlib import Path

import numpy as np
from rosbags.rosbag2 import Reader, StoragePlugin, Writer

from conversion.exports.exported import ExportedSource
from conversion.options import Options
from conversion.ros.bags import Bag
from conversion.ros.recording import RosRecording
from semantic2d_dataset.format.sequence import SequenceHeader, SequenceWriter
from semantic2d_dataset.scene.geometry import Pose2
from semantic2d_dataset.scene.lidars import LidarSpec
from semantic2d_dataset.scene.maps import SemanticMap
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, Taxonomy

LIDAR = LidarSpec(
    name="odd.lidar_2",
    model='Odd "lidar" \N{GREEK SMALL LETTER LAMDA}',
    beams=23,
    angle_min=-1.9000000000000004,
    angle_increment=0.1 + 1e-17,
    range_min=0.1,
    range_max=12.000000000000002,
    base_T_lidar=(0.1, -0.2, 0.3, 3.1415926, 1e-17, 0.7),
)
COLOURED = Taxonomy(("nothing", "left", "right"), ((9, 8, 7), (255, 128, 1), (0, 0, 255)), 1)
DTYPES = ("<f4", "<f8", "|u1", "<u2", "<u4", "<u8", "|i1", "<i2", "<i4", "<i8")


def any_bits(rng, shape, dtype):
    """Random bytes: NaNs with payloads, denormals and infinities among the floats."""
    dtype = np.dtype(dtype)
    raw = rng.integers(0, 256, int(np.prod(shape)) * dtype.itemsize, np.uint8)
    return np.frombuffer(raw.tobytes(), dtype).reshape(shape)


def random_arrays(rng, scans, taxonomy=SEMANTIC2D):
    """The arrays that a sequence must have, and about half of those that it may have."""
    return {
        name: array
        for name, array in full_arrays(rng, scans, taxonomy).items()
        if name in ("scans/ranges", "scans/stamps_ns") or rng.random() < 0.6
    }


def full_arrays(rng, scans=6, taxonomy=SEMANTIC2D):
    """Every array that a sequence may have."""
    beams = (scans, LIDAR.beams)
    ranges = rng.uniform(0, 14, beams).astype(np.float32)
    ranges[rng.random(beams) < 0.2] = np.inf
    ranges[rng.random(beams) < 0.1] = -np.inf
    odd = rng.random(beams) < 0.1
    ranges[odd] = any_bits(rng, beams, "<f4")[odd]
    labels = rng.integers(0, len(taxonomy.names), beams).astype(np.uint8)
    labels[rng.random(beams) < 0.1] = 255
    poses = rng.normal(0, 3, (scans, 3))
    poses[rng.random(scans) < 0.3] = np.nan
    segments = rng.integers(0, 4, scans)
    images = any_bits(rng, 100, "|u1")
    steps = rng.integers(0, 3, scans) * 50_000_000  # some stamps are equal
    stamps = 1_700_000_000_123_456_789 + np.cumsum(steps)
    return {
        "scans/ranges": ranges,
        "scans/stamps_ns": stamps.astype(np.int64),
        "scans/intensities": any_bits(rng, beams, "<f4"),
        "scans/labels": labels,
        "scans/confidence": any_bits(rng, beams, "|u1"),
        "poses/initial": poses,
        "poses/refined": any_bits(rng, (scans, 3), "<f8"),
        "alignment/residual_m": any_bits(rng, scans, "<f4"),
        "alignment/inlier_ratio": any_bits(rng, scans, "<f4"),
        "alignment/accepted": rng.integers(0, 2, scans).astype(np.uint8),
        "alignment/covariance": any_bits(rng, (scans, 3, 3), "<f8"),
        "commands/velocity": any_bits(rng, (scans, 2), "<f8"),
        "lines/offsets": np.concatenate(([0], np.cumsum(segments))).astype(np.int64),
        "lines/segments": any_bits(rng, (int(segments.sum()), 4), "<f4"),
        "streams/2nd-odom/data": any_bits(rng, (70, 13), "<f8"),
        "streams/2nd-odom/stamps_ns": any_bits(rng, 70, "<i8"),
        "streams/camera/data": images,
        "streams/camera/offsets": np.array([0, 60, 100]),
        "streams/camera/about": np.frombuffer(b'{"topic": "/camera"}', np.uint8),
        "streams/none/data": np.empty((0, 7)),
        **{
            f"original/x{d[1:]}": any_bits(rng, (5, 2, 3)[: i % 3 + 1], d)
            for i, d in enumerate(DTYPES)
        },
    }


def random_map(rng):
    occupancy = rng.choice(np.array([0, 100, 255], np.uint8), (9, 14))
    labels = any_bits(rng, (9, 14), "|u1")
    return SemanticMap(occupancy, labels, 0.05 + 1e-17, Pose2(-1.1, 2.2, 0.30000000000000004))


def write_sequence(path, arrays, *, scene=None, taxonomy=SEMANTIC2D, lidar=LIDAR):
    """Write a sequence of these arrays."""
    header = SequenceHeader(
        environment="lab",
        recording="one",
        lidar=lidar,
        license="CC-BY-4.0",
        stamps_source="record",
        provenance={"sources": [{"name": "a.bag", "bytes": 3}], "pi": 3.141592653589793},
        taxonomy=taxonomy,
    )
    with SequenceWriter(path, header) as writer:
        writer.append(arrays)
        if scene is not None:
            writer.set_map(scene)
    return path


def random_sequence(path, seed, scans=12):
    """Write a sequence that depends on a seed."""
    rng = np.random.default_rng(seed)
    taxonomy = COLOURED if seed % 2 else SEMANTIC2D
    arrays = random_arrays(rng, scans, taxonomy)
    scene = random_map(rng) if seed % 3 else None
    return write_sequence(path, arrays, scene=scene, taxonomy=taxonomy)


def open_export(path):
    """Return an export as the source that reads it."""
    return ExportedSource(RosRecording(Bag(path)))


def import_export(path: Path, out: Path, options: Options | None = None) -> Path:
    """Write the sequence of an export, as a conversion does."""
    with open_export(path) as source:
        (plan,) = source.plans(options or Options())
        with SequenceWriter(out, plan.header) as writer:
            for arrays in plan.blocks():
                writer.append(arrays)
            if plan.scene is not None:
                writer.set_map(plan.scene)
    return out


def rewrite(path, folder, change):
    """Copy a recording; `change` gets topic, number within it and bytes, and gives a list."""
    counts: dict[str, int] = {}
    with (
        Reader(path) as reader,
        Writer(folder, version=8, storage_plugin=StoragePlugin.MCAP) as writer,
    ):
        connections = {
            c.id: writer.add_connection(
                c.topic, c.msgtype, msgdef=c.msgdef.data, rihs01=c.digest or "unknown"
            )
            for c in reader.connections
        }
        for connection, stamp, raw in reader.messages():
            number = counts[connection.topic] = counts.get(connection.topic, -1) + 1
            for each in change(connection.topic, number, bytes(raw)):
                writer.write(connections[connection.id], stamp, each)
    return folder
