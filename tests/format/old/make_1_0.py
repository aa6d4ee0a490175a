"""Write the files of format 1.0 that ``tests/format/test_old_versions.py`` opens for good.

Run once, with the version of the package that wrote format 1.0, from the project's folder::

    python -m tests.format.old.make_1_0 tests/format/old/1.0

The files are kept as they are: a later version must open them, not write them again.
"""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from semantic2d_dataset.format.manifest import publish
from semantic2d_dataset.format.sequence import SequenceHeader, SequenceWriter
from semantic2d_dataset.format.splits import SplitScheme
from semantic2d_dataset.scene.geometry import Pose2
from semantic2d_dataset.scene.lidars import LidarSpec
from semantic2d_dataset.scene.maps import SemanticMap
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D
from semantic2d_dataset.scoring.predictions import PredictionsWriter

SCANS, BEAMS = 70, 12  # two chunks of scans
LIDAR = LidarSpec("tiny", "Tiny lidar", BEAMS, -1.1, 0.2, 0.1, 20.0, (0.1, 0.0, 0.2, 0.0, 0.0, 3.1))
HEADER = SequenceHeader(
    environment="hall",
    recording="monday",
    lidar=LIDAR,
    license="CC0-1.0",
    stamps_source="record",
    provenance={"source": "generated", "sha256": "0" * 64},
)


def rows(*shape: int) -> np.ndarray:
    """Numbers that differ, between 0 and 1, whatever draws random ones."""
    return (np.arange(np.prod(shape)) * 0.61803398875 % 1).reshape(shape)


def sequence_arrays() -> dict[str, np.ndarray]:
    """Every array of the format."""
    ranges = (0.2 + 15 * rows(SCANS, BEAMS)).astype(np.float32)
    ranges[3, :3] = (np.inf, -np.inf, np.nan)
    stamps = 1_700_000_000_000_000_000 + np.arange(SCANS) * 50_000_000
    labels = (10 * rows(SCANS, BEAMS)).astype(np.uint8)
    labels[5, 2] = 255
    return {
        "scans/ranges": ranges,
        "scans/intensities": (4000 * rows(SCANS, BEAMS)).astype(np.float32),
        "scans/stamps_ns": stamps,
        "scans/labels": labels,
        "scans/confidence": (255 * rows(SCANS, BEAMS)).astype(np.uint8),
        "poses/initial": rows(SCANS, 3),
        "poses/refined": rows(SCANS, 3) + 0.01,
        "alignment/residual_m": rows(SCANS).astype(np.float32),
        "alignment/inlier_ratio": rows(SCANS).astype(np.float32),
        "alignment/accepted": (rows(SCANS) > 0.1).astype(np.uint8),
        "alignment/covariance": rows(SCANS, 3, 3),
        "commands/velocity": rows(SCANS, 2),
        "lines/segments": rows(2 * SCANS, 4).astype(np.float32),
        "lines/offsets": np.arange(SCANS + 1) * 2,
        "streams/odom/stamps_ns": stamps[:9],
        "streams/odom/data": rows(9, 3),
        "streams/odom/about": as_bytes({"topic": "/odom", "columns": ["x", "y", "yaw"]}),
        "streams/camera/stamps_ns": stamps[:2],
        "streams/camera/data": np.arange(20, dtype=np.uint8),
        "streams/camera/offsets": np.array([0, 12, 20]),
        "streams/camera/about": as_bytes({"topic": "/camera", "type": "CompressedImage"}),
        "original/zeros": (rows(SCANS, BEAMS) > 0.5).astype(np.uint8),
    }


def as_bytes(said: object) -> np.ndarray:
    """JSON as the format keeps it."""
    return np.frombuffer(json.dumps(said, sort_keys=True).encode(), np.uint8)


def main(folder: Path) -> None:
    """Write all files into a new folder."""
    data = folder / "dataset"
    (data / "sequences").mkdir(parents=True)
    scene = SemanticMap(
        np.tile(np.uint8([0, 100, 255]), (4, 2)),
        np.tile(np.uint8([255, 9, 255]), (4, 2)),
        0.05,
        Pose2(-1.0, -0.5, 0.1),
    )
    arrays = sequence_arrays()
    with SequenceWriter(data / "sequences" / f"{HEADER.sequence_id}.h5", HEADER) as writer:
        writer.append(arrays)
        writer.set_map(scene)
    bare = replace(HEADER, recording="tuesday")
    needed = ("scans/ranges", "scans/stamps_ns")
    with SequenceWriter(data / "sequences" / f"{bare.sequence_id}.h5", bare) as writer:
        writer.append({name: arrays[name][:5] for name in needed})
    ids = np.repeat(np.uint8([0, 255, 1, 255, 2]), SCANS // 5)
    members = {HEADER.sequence_id: ids, bare.sequence_id: np.zeros(5, np.uint8)}
    publish(
        data,
        name="old-data",
        version="1.0.0",
        license="CC0-1.0",
        schemes=[SplitScheme("block", members, "by hand")],
    )
    tested = np.flatnonzero(ids == 2)
    write_predictions(folder / "predictions.h5", tested, arrays["scans/labels"][tested])
    write_registry(folder / "registry.json")


def write_predictions(path: Path, index: np.ndarray, truth: np.ndarray) -> None:
    """Predict the test scans of the first sequence, some wrongly, with all that may be said."""
    labels = truth.copy()
    labels[::4] = (labels[::4] + 1) % 10
    shares = rows(len(index), BEAMS, 10)
    with PredictionsWriter(
        path,
        dataset="old-data",
        dataset_version="1.0.0",
        scheme="block",
        split="test",
        taxonomy=SEMANTIC2D,
        metadata={"method": "As it was"},
    ) as writer:
        writer.add(
            HEADER.sequence_id,
            index,
            labels,
            probabilities=(shares / shares.sum(axis=-1, keepdims=True)).astype(np.float16),
            samples=np.stack([labels, labels]),
        )


def write_registry(path: Path) -> None:
    """Name a data set in every way that a registry can."""
    files = [{"name": "a.zip", "url": "https://a.example/a.zip", "size": 3}]
    sources = [
        {"kind": "zenodo", "record": "1"},
        {"kind": "huggingface", "repository": "team/data", "folder": "d", "revision": "main"},
        {"kind": "files", "files": [files[0] | {"checksum": "sha256:" + "0" * 64}]},
    ]
    dataset = {
        "id": "old-data",
        "version": "1",
        "title": "Old data",
        "license": "CC0-1.0",
        "doi": "10.5281/zenodo.1",
        "citation": "Nobody",
        "checksums": {"a.zip": "md5:" + "0" * 32},
        "sources": sources,
    }
    said = {"format": "semantic2d-registry", "format_version": "1.0", "datasets": [dataset]}
    path.write_text(json.dumps(said, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
