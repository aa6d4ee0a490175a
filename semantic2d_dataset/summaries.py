"""What a sequence, a data set or a predictions file holds, in words, for ``semantic2d info``."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset import plotting
from semantic2d_dataset.access.registry import OpenDataset
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.container import kind_of
from semantic2d_dataset.format.schema import CHUNK_ROWS, PREDICTIONS
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.scene.geometry import Pose2, to_base, to_points, transform
from semantic2d_dataset.scene.lidars import LidarSpec
from semantic2d_dataset.scene.maps import SemanticMap
from semantic2d_dataset.scene.scans import Scan
from semantic2d_dataset.scene.taxonomy import UNLABELLED
from semantic2d_dataset.scoring.predictions import PredictionsReader

_BLOCK = 64 * CHUNK_ROWS
Summary = dict[str, Any]


def describe_file(path: Path) -> Summary:
    """Summarise a predictions file, or else a sequence file.

    Raises
    ------
    FileNotFoundError, CorruptFileError, UnsafeFileError, FormatVersionError
        If it cannot be opened, or is of another kind.
    """
    describe = describe_predictions if kind_of(path) == PREDICTIONS.kind else describe_sequence
    return describe(path)


def describe_predictions(path: Path) -> Summary:
    """Summarise a predictions file: what it says it is for, and how much it holds.

    Raises
    ------
    CorruptFileError, UnsafeFileError, FormatVersionError
        If it cannot be opened.
    """
    parts = ("scan_index", "labels", "probabilities", "samples")
    with PredictionsReader(path) as reader:
        return {
            "dataset": reader.dataset,
            "dataset_version": reader.dataset_version,
            "scheme": reader.scheme,
            "split": reader.split,
            "metadata": reader.metadata,
            "arrays": {
                f"{name}/{part}": list(reader.shape(name, part))
                for name in reader.sequence_ids
                for part in parts
                if reader.has(name, part)
            },
        }


def describe_sequence(path: Path) -> Summary:
    """Summarise a sequence file: geometry, scans, returns, poses, labels, map.

    Raises
    ------
    FileNotFoundError, CorruptFileError, UnsafeFileError, FormatVersionError
        If it cannot be opened.
    """
    with SequenceReader(path) as reader:
        scene = reader.read_map()
        return {
            "sequence": reader.header.sequence_id,
            "license": reader.header.license,
            "lidar": _describe_lidar(reader.lidar),
            "scans": len(reader),
            "duration_s": _duration_s(reader),
            "stamps": reader.header.stamps_source,
            **_describe_beams(reader),
            "map": None if scene is None else _describe_map(scene),
            "arrays": {name: list(reader.shape(name)) for name in reader.names},
            "content_digest": reader.content_digest(),
        }


def _describe_lidar(lidar: LidarSpec) -> Summary:
    first, last = np.rad2deg(lidar.bearings[[0, -1]]).round(3).tolist()
    return {
        "model": lidar.model,
        "beams": lidar.beams,
        "field_deg": [first, last],
        "range_m": [lidar.range_min, lidar.range_max],
        "mount": list(lidar.base_T_lidar),
    }


def _describe_map(scene: SemanticMap) -> Summary:
    rows, columns = scene.occupancy.shape
    return {"columns": columns, "rows": rows, "resolution_m": scene.resolution}


def _duration_s(reader: SequenceReader) -> float:
    stamps = reader.read("scans/stamps_ns")
    return float(stamps[-1] - stamps[0]) / 1e9 if len(stamps) else 0.0


def _describe_beams(reader: SequenceReader) -> Summary:
    """Shares of returns, poses and classes, a block of scans at a time."""
    returns = posed = 0
    counts = np.zeros(256, np.int64)
    for start in range(0, len(reader), _BLOCK):
        batch = reader.batch(start, start + _BLOCK)
        valid = batch.valid
        returns += int(valid.sum())
        posed += int(np.isfinite(batch.poses).all(axis=1).sum())
        if batch.labels is not None:
            counts += np.bincount(batch.labels[valid], minlength=256)
    names = dict(enumerate(reader.header.taxonomy.names)) | {UNLABELLED: "unlabelled"}
    return {
        "scans_with_pose": posed,
        "has_intensities": "scans/intensities" in reader,
        "return_share": returns / max(1, len(reader) * reader.lidar.beams),
        "class_shares": {
            names.get(int(i), f"class {i}"): float(counts[i] / counts.sum())
            for i in np.argsort(-counts)
            if counts[i]
        },
    }


def describe_dataset(data: OpenDataset) -> Summary:
    """Summarise a data set: sequences, scans by lidar, and the size of every split.

    Raises
    ------
    CorruptFileError
        If a split file cannot be read.
    """
    manifest = data.manifest
    lidars: Counter[str] = Counter()
    for entry in manifest.sequences:
        lidars[entry.lidar] += entry.scans
    return {
        "name": manifest.name,
        "version": manifest.version,
        "license": manifest.license,
        "folder": str(data.root),
        "bytes": sum(entry.bytes for entry in manifest.files),
        "sequences": len(manifest.sequences),
        "environments": sorted({entry.environment for entry in manifest.sequences}),
        "scans_by_lidar": dict(sorted(lidars.items())),
        "splits": {name: data.scheme(name).sizes for name in sorted(manifest.splits)},
    }


def format_summary(said: Summary) -> str:
    """Lay a summary out for people: a line a value, shares in percent."""
    width = max(map(len, said))
    rows = []
    for key, value in said.items():
        lines = _lines_of(value, percent=key.endswith(("share", "shares")))
        rows += [(key if i == 0 else "", line) for i, line in enumerate(lines)]
    text = "\n".join(f"{key.replace('_', ' '):<{width}}  {line}".rstrip() for key, line in rows)
    return "".join(c if c.isprintable() or c == "\n" else "?" for c in text)


def _lines_of(value: object, *, percent: bool) -> list[str]:
    if isinstance(value, dict):
        return [f"{key} {_plain(each, percent=percent)}" for key, each in value.items()] or ["none"]
    if isinstance(value, list) and all(isinstance(each, str) for each in value):
        return [str(each) for each in value] or ["none"]
    return [_plain(value, percent=percent)]


def _plain(value: object, *, percent: bool) -> str:
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "none"}[value]
    if isinstance(value, float):
        return f"{value:.1%}" if percent else f"{value:g}"
    if isinstance(value, dict):
        return ", ".join(f"{key} {_plain(each, percent=percent)}" for key, each in value.items())
    if isinstance(value, list):
        return " ".join(_plain(each, percent=percent) for each in value)
    return str(value)


def draw_scan(path: Path, index: int, out: Path) -> None:
    """Draw a scan of a sequence: over its map where pose and map are known, else alone.

    Raises
    ------
    InvalidInputError
        If there is no such scan, or no picture can be written under that name.
    """
    plotting.check_picture_name(out)
    with SequenceReader(path) as reader:
        if not 0 <= index < len(reader):
            raise InvalidInputError(f"{path}: has {len(reader)} scans, so none with index {index}")
        scan, scene = reader.batch(index, index + 1)[0], reader.read_map()
        taxonomy = reader.header.taxonomy
    if scene is None or not np.isfinite(scan.pose).all():
        figure = plotting.plot_scan(scan, taxonomy=taxonomy)
    else:
        figure = plotting.plot_labelled_scan_on_map(
            scene,
            points_in_map(scan)[scan.valid],
            labels_of(scan)[scan.valid],
            pose=Pose2(*scan.pose.tolist()),
            taxonomy=taxonomy,
        )
    plotting.save(figure, out)


def points_in_map(scan: Scan) -> NDArray[np.float64]:
    """Return the beam endpoints of a scan in the map frame, (B, 2) m."""
    points = to_base(to_points(scan.ranges, scan.lidar.bearings), scan.lidar.base_T_lidar)
    return transform(scan.pose, points)


def labels_of(scan: Scan) -> NDArray[np.uint8]:
    """Return the labels of a scan, (B,) u1, all 255 where it has none."""
    if scan.labels is not None:
        return scan.labels
    return np.full(scan.lidar.beams, UNLABELLED, np.uint8)
