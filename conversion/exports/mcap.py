"""A sequence as a ROS 2 MCAP: for RViz and Foxglove to show, and to come back identical."""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from conversion.exports.mcap_messages import (
    BASE_FRAME,
    LIDAR_FRAME,
    MAP_FRAME,
    MessageWriter,
    cloud_dtype,
    open_mcap,
)
from conversion.plan import BLOCK, Arrays
from semantic2d_dataset.errors import InvalidInputError, Semantic2DError, WriteError
from semantic2d_dataset.format.schema import CHUNK_ROWS, SEQUENCE
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.format.writing import partial_name, stale_partials
from semantic2d_dataset.scene.geometry import to_points
from semantic2d_dataset.scene.lidars import describe

EXPORT_VERSION = 1
SEQUENCE_TOPIC, END_TOPIC = "/semantic2d/sequence", "/semantic2d/end"
SCAN_TOPIC, LABELS_TOPIC, MAP_TOPIC = "/scan", "/scan/labels", "/map"
TF_TOPIC, TF_STATIC_TOPIC = "/tf", "/tf_static"
ON_SCAN = ("scans/stamps_ns", "scans/ranges", "scans/intensities")

_MCAP = ".mcap"
_END_OF_ROS_TIME_S = 2**31  # builtin_interfaces/Time counts seconds in an int32
_MESSAGE_BYTES = 1 << 20
_FLAT_ROWS = 1 << 16
_LATCHED = (SEQUENCE_TOPIC, TF_STATIC_TOPIC, MAP_TOPIC)


@dataclass(frozen=True)
class Export:
    """What was written: the file or folder, its scans, and its messages by topic."""

    path: Path
    scans: int
    messages: Mapping[str, int]


def export_mcap(sequence: Path, out: Path) -> Export:
    """Write a sequence as a ROS 2 recording that ROS, RViz and Foxglove open.

    It holds ``/scan``, ``/tf`` (refined poses, else initial), ``/tf_static``, ``/map``,
    ``/scan/labels`` (a point for each beam in the colour of its class), and in ``/semantic2d/``
    what else the sequence holds: converting it gives a sequence of the same content digest.

    Parameters
    ----------
    sequence
        The sequence file.
    out
        A file that ends with ``.mcap``; any other name becomes a folder with a ``metadata.yaml``.

    Raises
    ------
    FileNotFoundError
        If there is no such sequence.
    CorruptFileError
        If the sequence is damaged.
    InvalidInputError
        If `out` exists, or the stamps are none that ROS 2 can hold.
    WriteError
        If it cannot be written; nothing is left under its name then.
    """
    out = Path(out)
    _check_free(out)
    if not out.parent.is_dir():
        raise WriteError(f"{out}: the folder {out.parent} does not exist")
    with SequenceReader(Path(sequence)) as reader:
        try:
            return _write(reader, out)
        except Semantic2DError:
            raise
        except OSError as err:
            raise WriteError(f"{out}: could not be written: {err}") from err


def _write(reader: SequenceReader, out: Path) -> Export:
    for stale in stale_partials(out):
        shutil.rmtree(stale, ignore_errors=True)
    partial = partial_name(out)
    is_file = out.suffix == _MCAP
    folder = partial / (out.stem if is_file else out.name)
    try:
        with open_mcap(folder, _LATCHED) as bag:
            _Exporter(reader, bag).send_all()
        for file in folder.iterdir():
            _sync(file)
        _check_free(out)
        (folder / f"{folder.name}{_MCAP}" if is_file else folder).rename(out)
        _sync(out.parent)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return Export(out, len(reader), dict(bag.counts))


def _check_free(out: Path) -> None:
    if out.exists():
        raise InvalidInputError(f"{out}: exists; give another name, or remove it")


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


class _Exporter:
    """Send what a sequence holds: a head, each scan, then what is not per scan, and digests."""

    def __init__(self, reader: SequenceReader, bag: MessageWriter) -> None:
        self.reader, self.bag = reader, bag
        self.scene = reader.read_map()
        self.stamps = _checked_stamps(reader)
        self.names = tuple(name for name in reader.names if name != "provenance")
        self.topics = self._choose_topics()
        self.digests = {name: hashlib.sha256() for name in self.names}
        steps = np.diff(self.stamps)
        self.period_s = float(np.median(steps)) / 1e9 if steps.size else 0.0
        self.log_ns = int(self.stamps[0]) if self.stamps.size else 0

    def send_all(self) -> None:
        """Send everything, in the order of time."""
        bag, lidar = self.bag, self.reader.lidar
        head = json.dumps(self._head(), sort_keys=True)
        bag.send(SEQUENCE_TOPIC, bag.text(head), self.log_ns)
        mount = bag.transform(self.log_ns, BASE_FRAME, LIDAR_FRAME, lidar.base_T_lidar)
        bag.send(TF_STATIC_TOPIC, mount, self.log_ns)
        if self.scene is not None:
            bag.send(MAP_TOPIC, bag.grid(self.log_ns, self.scene), self.log_ns)
            self.digests["map/occupancy"].update(self.scene.occupancy.tobytes())
        with tqdm(
            total=len(self.reader), desc="export", unit=" scans", disable=None, leave=False
        ) as bar:
            for block in self._blocks():
                self._send_block(block)
                bar.update(len(block["scans/stamps_ns"]))
        for name in self.names:
            if not _is_per_scan(name) and self.topics[name] != MAP_TOPIC:
                self._send_whole(name)
        digests = {name: digest.hexdigest() for name, digest in self.digests.items()}
        end = {"head": hashlib.sha256(head.encode()).hexdigest(), "arrays": digests}
        bag.send(END_TOPIC, bag.text(json.dumps(end, sort_keys=True)), self.log_ns + 1)

    def _head(self) -> dict[str, Any]:
        header, scene = self.reader.header, self.scene
        taxonomy = asdict(header.taxonomy)
        grid = None
        if scene is not None:
            grid = {"resolution": scene.resolution, "origin": scene.origin.as_array().tolist()}
        return {
            "format": "semantic2d-mcap",
            "version": EXPORT_VERSION,
            "environment": header.environment,
            "recording": header.recording,
            "license": header.license,
            "stamps_source": header.stamps_source,
            "span_ns": self.stamps[[0, -1]].tolist() if self.stamps.size else [0, 0],
            "lidar": describe(header.lidar),
            "taxonomy": taxonomy,
            "map": grid,
            "provenance": dict(header.provenance),
            "arrays": {name: self._description(name) for name in self.names},
        }

    def _description(self, name: str) -> dict[str, Any]:
        dtype = self.reader.read(name, 0, 0).dtype.str
        return {"topic": self.topics[name], "dtype": dtype, "shape": self.reader.shape(name)}

    def _choose_topics(self) -> dict[str, str]:
        """Say on which topic each array goes; ROS's own messages first."""
        topics: dict[str, str] = {}
        for name in self.names:
            if name in ON_SCAN:
                topics[name] = SCAN_TOPIC
            elif name in ("scans/labels", "scans/confidence") and "scans/labels" in self.names:
                topics[name] = LABELS_TOPIC
            elif name == "map/occupancy" and self.scene is not None:
                topics[name] = MAP_TOPIC
            else:
                topics[name] = _topic_of(name, set(topics.values()))
        return topics

    def _blocks(self) -> Iterator[Arrays]:
        names = [name for name in self.names if _is_per_scan(name)]
        for start in range(0, len(self.reader), BLOCK):
            block = {name: self.reader.read(name, start, start + BLOCK) for name in names}
            for name, rows in block.items():
                self.digests[name].update(rows.tobytes())
            yield block

    def _send_block(self, block: Arrays) -> None:
        stamps = block["scans/stamps_ns"]
        poses = block.get("poses/refined", block.get("poses/initial"))
        clouds = self._clouds(block) if "scans/labels" in block else None
        own = [name for name in block if self.topics[name] not in (SCAN_TOPIC, LABELS_TOPIC)]
        for i, stamp_ns in enumerate(stamps.tolist()):
            # times of recording always increase, so that no reader changes the order
            self.log_ns = max(stamp_ns, self.log_ns + 1)
            for name in own:
                self.bag.send(self.topics[name], self.bag.rows(block[name][i : i + 1]), self.log_ns)
            if poses is not None and np.isfinite(poses[i]).all():
                x, y, yaw = poses[i].tolist()
                mount = (x, y, 0.0, 0.0, 0.0, yaw)
                moved = self.bag.transform(stamp_ns, MAP_FRAME, BASE_FRAME, mount)
                self.bag.send(TF_TOPIC, moved, self.log_ns)
            rows = {name: block[name][i] for name in ON_SCAN if name in block}
            scan = self.bag.scan(self.reader.lidar, self.period_s, stamp_ns, rows)
            self.bag.send(SCAN_TOPIC, scan, self.log_ns)
            if clouds is not None:
                self.bag.send(LABELS_TOPIC, self.bag.cloud(stamp_ns, clouds[i]), self.log_ns)

    def _clouds(self, block: Arrays) -> NDArray[Any]:
        """Return the points (n, B) of a block with what is known of each."""
        lidar, ranges = self.reader.lidar, block["scans/ranges"]
        measured = np.where(lidar.has_return(ranges), ranges, np.float32(np.nan))
        points = to_points(measured, lidar.bearings)  # (n, B, 2), m, lidar frame
        given = {
            "intensity": block.get("scans/intensities"),
            "label": block["scans/labels"],
            "confidence": block.get("scans/confidence"),
        }
        absent = {name for name, rows in given.items() if rows is None}
        clouds = np.zeros(ranges.shape, cloud_dtype(absent))
        clouds["x"], clouds["y"] = points[..., 0], points[..., 1]
        clouds["z"] = np.where(np.isnan(measured), np.float32(np.nan), np.float32(0))
        clouds["rgb"] = self._colours[block["scans/labels"]]
        for name, rows in given.items():
            if rows is not None:
                clouds[name] = rows
        return clouds

    @property
    def _colours(self) -> NDArray[np.float32]:
        """Colours by label as RViz packs them: 0xRRGGBB in the bits of a float, (256,) f4."""
        r, g, b = self.reader.header.taxonomy.palette.astype(np.uint32).T
        packed: NDArray[np.uint32] = r << 16 | g << 8 | b
        return packed.view(np.float32)

    def _send_whole(self, name: str) -> None:
        """Send an array that is not per scan, in blocks of bounded size, one a nanosecond."""
        shape = self.reader.shape(name)
        step = _FLAT_ROWS
        if len(shape) > 1:
            row_bytes = self.reader.read(name, 0, 0).dtype.itemsize * math.prod(shape[1:])
            step = CHUNK_ROWS * max(1, _MESSAGE_BYTES // max(1, CHUNK_ROWS * row_bytes))
        for start in range(0, shape[0], step):
            rows = self.reader.read(name, start, start + step)
            self.digests[name].update(rows.tobytes())
            self.log_ns += 1
            self.bag.send(self.topics[name], self.bag.rows(rows), self.log_ns)


def _checked_stamps(reader: SequenceReader) -> NDArray[np.int64]:
    stamps = reader.read("scans/stamps_ns")
    if stamps.size and not (stamps.min() >= 0 and stamps.max() < _END_OF_ROS_TIME_S * 10**9):
        raise InvalidInputError(
            f"{reader.path}: the stamps {stamps.min()} to {stamps.max()} ns are none that ROS 2 "
            f"can hold: expected 0 to {_END_OF_ROS_TIME_S} s"
        )
    return stamps


def _is_per_scan(name: str) -> bool:
    spec = SEQUENCE.array(name)
    return spec is not None and spec.per_scan


def _topic_of(name: str, taken: set[str]) -> str:
    """Return a topic that ROS 2 allows: letters, digits, single underscores, no digit first."""
    tokens = [re.sub("[^A-Za-z0-9]+", "_", token).strip("_") or "x" for token in name.split("/")]
    tokens = [f"n{token}" if token[0].isdigit() else token for token in tokens]
    topic = base = "/".join(("/semantic2d", *tokens))
    count = 1
    while topic in taken:
        count += 1
        topic = f"{base}_{count}"
    return topic
