"""Recordings that `conversion.exports.mcap` wrote: the sequence comes back as it was."""

from __future__ import annotations

import hashlib
import math
from collections import deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from conversion.exports.mcap import (
    END_TOPIC,
    EXPORT_VERSION,
    LABELS_TOPIC,
    MAP_TOPIC,
    ON_SCAN,
    SCAN_TOPIC,
    SEQUENCE_TOPIC,
    TF_TOPIC,
)
from conversion.exports.mcap_messages import (
    LASER_SCAN,
    LIDAR_FRAME,
    MULTI_ARRAYS,
    OCCUPANCY_GRID,
    POINT_CLOUD,
    STRING,
)
from conversion.messages.recordings import Message, Recording, Topic
from conversion.options import Options
from conversion.plan import BLOCK, Arrays, SequencePlan
from conversion.ros.recording import RosRecording
from semantic2d_dataset.errors import InvalidInputError, RecordingError
from semantic2d_dataset.format.container import load_json
from semantic2d_dataset.format.schema import SEQUENCE
from semantic2d_dataset.format.sequence import SequenceHeader
from semantic2d_dataset.scene.geometry import Pose2
from semantic2d_dataset.scene.lidars import LidarSpec
from semantic2d_dataset.scene.maps import SemanticMap
from semantic2d_dataset.scene.taxonomy import Taxonomy

_HONOURED = ("environment", "recording", "license", "distro")
_CLOUD_FIELDS = {"scans/labels": "label", "scans/confidence": "confidence"}
_TYPES = {SCAN_TOPIC: LASER_SCAN, LABELS_TOPIC: POINT_CLOUD, MAP_TOPIC: OCCUPANCY_GRID}
_CARRIED: Mapping[str, Collection[str]] = {
    SCAN_TOPIC: ON_SCAN,
    LABELS_TOPIC: _CLOUD_FIELDS,
    MAP_TOPIC: ("map/occupancy",),
}


def is_exported(recording: Recording) -> bool:
    """Tell whether a recording is an export of a sequence."""
    return any(topic[:2] == (SEQUENCE_TOPIC, STRING) for topic in recording.topics)


@dataclass(frozen=True)
class ArrayPlace:
    """Where an array of a sequence is in an export, and what it must be."""

    topic: str
    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    per_scan: bool


class ExportedSource:
    """An export as a `conversion.plan.Source`: its sequence with the same content digest.

    Parameters
    ----------
    recording
        An open bag for which `is_exported` holds; leaving this context closes it.
    """

    def __init__(self, recording: RosRecording) -> None:
        self.recording = recording
        self.path: Path = recording.path
        self.kind = "exported sequence"
        self.versions: Mapping[str, str] = recording.versions

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.recording.__exit__(*error)

    def files(self) -> Sequence[Path]:
        """Return the files of the export."""
        return self.recording.files()

    def plans(self, options: Options) -> tuple[SequencePlan, ...]:
        """Decide upon the one sequence of the export.

        Raises
        ------
        RecordingError
            If messages that describe it are missing or damaged.
        InvalidInputError
            If an option is set that would change what was exported.
        """
        _check_options(options)
        head, end = self._read_head_and_end()
        if head.get("version") != EXPORT_VERSION:
            raise RecordingError(
                self.path,
                f"expected an export of version {EXPORT_VERSION}, found "
                f"{head.get('version')!r}; install the version of semantic2d-dataset that wrote it",
            )
        try:
            plan = self._plan(head, end)
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as err:
            raise RecordingError(
                self.path, f"{SEQUENCE_TOPIC}: describes no sequence: {err!r}; export it again"
            ) from err
        return (replace(plan, header=_renamed(plan.header, options)),)

    def _plan(self, head: Any, end: Any) -> SequencePlan:
        places = {name: _place_of(name, said) for name, said in head["arrays"].items()}
        digests = {name: str(end["arrays"][name]) for name in places}
        missing = [name for name in SEQUENCE.required if name not in places]
        if missing:
            raise ValueError(f"lacks {', '.join(missing)}")
        scans = places["scans/stamps_ns"].shape[0]
        first, last = head["span_ns"]
        header = _header_of(head)
        for name, place in places.items():
            if name.startswith("scans/") and place.shape[1:] not in ((), (header.lidar.beams,)):
                raise ValueError(f"{name}: {place.shape} for {header.lidar.beams} beams")
        return SequencePlan(
            header=header,
            scans_in=scans,
            scans_out=scans,
            scans_with_pose=sum(t.messages for t in self.recording.topics if t.name == TF_TOPIC),
            duration_s=(int(last) - int(first)) / 1e9,
            blocks=partial(self._blocks, places, digests),
            topic=SCAN_TOPIC,
            frame=LIDAR_FRAME,
            pose_source="the exported sequence",
            scene=self._scene(head["map"], places),
        )

    def _scene(self, said: Any, places: Mapping[str, ArrayPlace]) -> SemanticMap | None:
        """Read the map, None where the export has none."""
        if said is None:
            return None
        wanted = {name: places[name] for name in ("map/occupancy", "map/labels")}
        grids = {name: np.empty((0, *place.shape[1:]), np.uint8) for name, place in wanted.items()}
        for name, rows in self._rows(wanted):
            grids[name] = np.concatenate((grids[name], rows))
        for name, place in wanted.items():
            if grids[name].shape != place.shape:
                raise ValueError(f"{name}: expected {place.shape}, found {grids[name].shape}")
        occupancy, labels = grids.values()
        x, y, yaw = map(float, said["origin"])
        return SemanticMap(occupancy, labels, float(said["resolution"]), Pose2(x, y, yaw))

    def _blocks(
        self, places: Mapping[str, ArrayPlace], digests: Mapping[str, str]
    ) -> Iterator[Arrays]:
        """Yield the arrays, scans in lockstep; whether they are whole is known at the end."""
        counts = dict.fromkeys(places, 0)
        hashes = {name: hashlib.sha256() for name in places}
        scans = _Lockstep(self.path, {n: place for n, place in places.items() if place.per_scan})
        for name, rows in self._rows(places, progress=True):
            counts[name] += len(rows)
            hashes[name].update(rows.tobytes())
            if places[name].per_scan:
                yield from scans.add(name, rows)
            elif not name.startswith("map/"):
                yield {name: rows}
        for name, place in places.items():
            if counts[name] != place.shape[0]:
                raise RecordingError(
                    self.path,
                    f"{place.topic}: expected {place.shape[0]} rows of {name}, found "
                    f"{counts[name]}: messages are missing; export the sequence again",
                )
            if hashes[name].hexdigest() != digests[name]:
                raise RecordingError(
                    self.path,
                    f"{place.topic}: {name} is not what was exported: a message is damaged or "
                    "was changed; export the sequence again",
                )
        yield scans.rest()
        yield from (
            {name: np.empty(place.shape, place.dtype)}
            for name, place in places.items()
            if not place.per_scan and not place.shape[0] and not name.startswith("map/")
        )

    def _rows(
        self, places: Mapping[str, ArrayPlace], *, progress: bool = False
    ) -> Iterator[tuple[str, NDArray[Any]]]:
        """Yield the rows of arrays, message by message, each checked against its place."""
        carried: dict[str, list[str]] = {}
        for name, place in places.items():
            carried.setdefault(place.topic, []).append(name)
        topics = self._topics_of(places)
        total = sum(topic.messages for topic in topics)
        messages = self.recording.messages(topics)
        hidden = None if progress else True
        for message in tqdm(
            messages, total=total, desc="convert", unit=" msg", disable=hidden, leave=False
        ):
            for name, rows in self._decode(message, carried[message.topic]):
                place = places[name]
                if rows.dtype != place.dtype or rows.shape[1:] != place.shape[1:]:
                    raise RecordingError(
                        self.path,
                        f"{message.topic}: expected {place.dtype} rows of {place.shape[1:]} of "
                        f"{name}, found {rows.dtype} of {rows.shape[1:]}; export it again",
                    )
                yield name, rows

    def _topics_of(self, places: Mapping[str, ArrayPlace]) -> tuple[Topic, ...]:
        wanted = {
            (place.topic, _TYPES.get(place.topic, MULTI_ARRAYS[place.dtype.str]))
            for place in places.values()
        }
        return tuple(topic for topic in self.recording.topics if topic[:2] in wanted)

    def _decode(
        self, message: Message, names: Collection[str]
    ) -> Iterator[tuple[str, NDArray[Any]]]:
        """Yield the rows of those arrays that a message carries."""
        if message.type == LASER_SCAN:
            scan = self.recording.scan(message)
            found: Arrays = {
                "scans/stamps_ns": np.array([scan.stamp_ns], np.int64),
                "scans/ranges": scan.ranges[None],
                "scans/intensities": scan.intensities[None],
            }
        elif message.type == POINT_CLOUD:
            take = partial(_fields_of, {name: _CLOUD_FIELDS[name] for name in names})
            found = self.recording.bag.read(message, take)
        else:
            rows_of = _grid_of if message.type == OCCUPANCY_GRID else _array_of
            found = dict.fromkeys(names, self.recording.bag.read(message, rows_of))
        yield from ((name, found[name]) for name in names)

    def _read_head_and_end(self) -> tuple[Any, Any]:
        """Read the two messages of JSON that say what the export holds."""
        wanted = (SEQUENCE_TOPIC, END_TOPIC)
        topics = [t for t in self.recording.topics if t.name in wanted and t.type == STRING]
        texts: dict[str, list[str]] = {name: [] for name in wanted}
        for message in self.recording.messages(topics):
            text = self.recording.bag.read(message, lambda m: str(m.data))
            texts[message.topic].append(text)
        head, end = self._parse(SEQUENCE_TOPIC, texts), self._parse(END_TOPIC, texts)
        if hashlib.sha256(texts[SEQUENCE_TOPIC][0].encode()).hexdigest() != end.get("head"):
            raise RecordingError(
                self.path, f"{SEQUENCE_TOPIC}: is not what was exported; export the sequence again"
            )
        return head, end

    def _parse(self, topic: str, texts: Mapping[str, Sequence[str]]) -> Any:
        if len(texts[topic]) != 1:
            raise RecordingError(
                self.path,
                f"{topic}: expected one message, found {len(texts[topic])}: this export of a "
                "sequence is not whole; export it again",
            )
        try:
            said = load_json(texts[topic][0])
        except InvalidInputError as err:
            raise RecordingError(self.path, f"{topic}: {err}; export the sequence again") from err
        if not isinstance(said, dict):
            raise RecordingError(self.path, f"{topic}: expected a JSON object; export it again")
        return said


class _Lockstep:
    """Collect rows of several arrays, and give them away by blocks of as many of each."""

    def __init__(self, path: Path, places: Mapping[str, ArrayPlace]) -> None:
        self.path, self.places = path, places
        self.rows: dict[str, deque[NDArray[Any]]] = {name: deque() for name in places}

    def add(self, name: str, rows: NDArray[Any]) -> Iterator[Arrays]:
        """Add a row of an array; yield a block when there is one."""
        self.rows[name].extend(np.split(rows, len(rows)) if len(rows) != 1 else (rows,))
        lengths = [len(waiting) for waiting in self.rows.values()]
        if min(lengths) >= BLOCK:
            yield self._take(BLOCK)
        elif len(self.rows[name]) > 2 * BLOCK:
            late = min(self.rows, key=lambda other: len(self.rows[other]))
            raise RecordingError(
                self.path,
                f"{self.places[late].topic}: messages with {late} are missing; export the "
                "sequence again",
            )

    def rest(self) -> Arrays:
        """Return what is left, equally long."""
        return self._take(min(len(waiting) for waiting in self.rows.values()))

    def _take(self, count: int) -> Arrays:
        return {
            name: np.concatenate(
                (
                    np.empty((0, *self.places[name].shape[1:]), self.places[name].dtype),
                    *(waiting.popleft() for _ in range(count)),
                )
            )
            for name, waiting in self.rows.items()
        }


def _check_options(options: Options) -> None:
    usual = Options()
    changed = [
        field.name
        for field in fields(Options)
        if field.name not in _HONOURED
        and getattr(options, field.name) != getattr(usual, field.name)
    ]
    if changed:
        raise InvalidInputError(
            f"an exported sequence comes back as it was: {', '.join(changed)} cannot be chosen; "
            f"only {', '.join(_HONOURED[:-1])} can"
        )


def _place_of(name: str, said: Any) -> ArrayPlace:
    spec = SEQUENCE.array(name)
    dtype, shape = np.dtype(said["dtype"]), tuple(int(n) for n in said["shape"])
    if spec is None or dtype.str not in spec.dtypes or len(shape) not in spec.ndims:
        raise ValueError(f"{name} of {said} has no place in a sequence")
    if min(shape) < 0 or math.prod(shape) * dtype.itemsize > spec.max_bytes:
        raise ValueError(f"{name}: no array can have the shape {shape}")
    topic = str(said["topic"])
    if name not in _CARRIED.get(topic, (name,)):
        raise ValueError(f"{topic} carries no {name}")
    return ArrayPlace(topic, dtype, shape, spec.per_scan)


def _header_of(head: Any) -> SequenceHeader:
    lidar, taxonomy = head["lidar"], head["taxonomy"]
    return SequenceHeader(
        environment=head["environment"],
        recording=head["recording"],
        lidar=LidarSpec(**lidar | {"base_T_lidar": tuple(lidar["base_T_lidar"])}),
        license=head["license"],
        stamps_source=head["stamps_source"],
        provenance={"exported": head["provenance"]},
        taxonomy=Taxonomy(
            tuple(map(str, taxonomy["names"])),
            tuple((int(r), int(g), int(b)) for r, g, b in taxonomy["colours"]),
            int(taxonomy["background_id"]),
        ),
    )


def _renamed(header: SequenceHeader, options: Options) -> SequenceHeader:
    """Take the names that the user chose."""
    return replace(
        header,
        environment=header.environment if options.environment is None else options.environment,
        recording=header.recording if options.recording is None else options.recording,
        license=header.license if options.license == Options.license else options.license,
    )


def _array_of(message: Any) -> NDArray[Any]:
    sizes = [int(dim.size) for dim in message.layout.dim]
    return np.asarray(message.data).reshape(sizes)


def _grid_of(message: Any) -> NDArray[Any]:
    shape = (int(message.info.height), int(message.info.width))
    return np.asarray(message.data, np.int8).view(np.uint8).reshape(shape)


def _fields_of(names: Mapping[str, str], message: Any) -> Arrays:
    """Return bytes of the points of a cloud, (1, B) u1, by the arrays that they belong to."""
    offsets = {field.name: int(field.offset) for field in message.fields}
    points = np.asarray(message.data, np.uint8).reshape(-1, int(message.point_step))
    # copies, or the bytes of whole clouds would stay in memory
    return {array: points[None, :, offsets[field]].copy() for array, field in names.items()}
