"""Other topics of a bag as arrays: commands, odometry, IMU, goals, plans, people, images."""

from __future__ import annotations

import io
import json
import keyword
from array import array
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from tqdm import tqdm

from conversion.messages.recordings import Topic
from conversion.messages.scans import plain_frame
from conversion.plan import Arrays
from conversion.ros.bags import Bag
from semantic2d_dataset.errors import RecordingError
from semantic2d_dataset.format.sequence import slug

ALL = "all"
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"

_BLOCK_BYTES = 1 << 20
_MAX_COLUMNS = 4096
_MAX_SAID = 16  # frames or formats listed of one topic
_HEADER = "std_msgs/msg/Header"
_TIMES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
_PLACES = ("", "position", "point", "location", "centroid", "center")
_PADDING = "structure_needs_at_least_one_member"  # what rosidl puts into empty types

# Encodings of sensor_msgs/Image that PNG holds: bytes of a value, and its channels in PNG's order.
_RGB, _BGR = (0, 1, 2), (2, 1, 0)
_PNG: Mapping[str, tuple[int, tuple[int, ...]]] = {
    "mono8": (1, (0,)),
    "8UC1": (1, (0,)),
    "8UC3": (1, _RGB),
    "rgb8": (1, _RGB),
    "bgr8": (1, _BGR),
    "8UC4": (1, (*_RGB, 3)),
    "rgba8": (1, (*_RGB, 3)),
    "bgra8": (1, (*_BGR, 3)),
    "mono16": (2, (0,)),
    "16UC1": (2, (0,)),
    **{f"bayer_{order}8": (1, (0,)) for order in ("rggb", "bggr", "gbrg", "grbg")},
    **{f"bayer_{order}16": (2, (0,)) for order in ("rggb", "bggr", "gbrg", "grbg")},
}
_TIFF = "32FC1"


class Entry(NamedTuple):
    """What is kept of one message: None as stamp means the time of recording."""

    stamp_ns: int | None
    said: str
    data: NDArray[Any]


@dataclass(frozen=True)
class Layout:
    """Which numbers of a type are kept.

    Parameters
    ----------
    paths
        Attributes of a message, or of its items.
    columns
        Their names, one for each number.
    left_out
        Fields that are not kept: texts, times, and lists but for `items`.
    items
        The list whose items are kept one a row; None where a message is a row.
    stamped
        Whether messages have a header.
    """

    paths: tuple[str, ...]
    columns: tuple[str, ...]
    left_out: tuple[str, ...]
    items: str | None
    stamped: bool

    def take(self, message: Any) -> Entry:
        """Return the rows of a message, (n, columns) f8; n is 1 where a message is a row."""
        things = [message] if self.items is None else getattr(message, self.items)
        get = attrgetter(*self.paths)
        rows = [_flat(get(thing)) for thing in things]
        data = np.array(rows, np.float64).reshape(len(rows), len(self.columns))
        header = message.header if self.stamped else None
        return Entry(_stamp_ns(header), plain_frame(header.frame_id) if header else "", data)


@dataclass(frozen=True)
class Stream:
    """A topic that can be kept under a name; an image where it has no layout."""

    name: str
    topic: Topic
    layout: Layout | None

    @property
    def is_ragged(self) -> bool:
        """Whether a message may have any number of rows or bytes."""
        return self.layout is None or self.layout.items is not None

    def take(self, message: Any) -> Entry:
        """Return what is kept of a message."""
        if self.layout is not None:
            return self.layout.take(message)
        if self.topic.type == COMPRESSED_IMAGE:
            data, how = np.array(message.data, np.uint8), str(message.format)
        else:
            data, how = _encode(message)
        return Entry(_stamp_ns(message.header), how, data)


def choose_streams(bag: Bag, names: Collection[str]) -> tuple[Stream, ...]:
    """Return the streams of some topics.

    Parameters
    ----------
    bag
        The recording.
    names
        Topics, with or without leading slash; ``all`` means every topic that can be kept and
        holds messages, but images only where they are named.

    Raises
    ------
    RecordingError
        If a name is no topic that can be kept, with those that can.
    """
    able = _streams_of(bag) if names else ()
    chosen: set[str] = set()
    for name in names:
        if name == ALL:
            chosen |= {s.name for s in able if s.layout is not None and s.topic.messages}
            continue
        named = {s.name for s in able if s.topic.name.strip("/") == name.strip("/")}
        if not named:
            raise RecordingError(bag.path, _why_not(bag, name, able))
        chosen |= named
    return tuple(stream for stream in able if stream.name in chosen)


def read_streams(bag: Bag, names: Collection[str], start_ns: int, stop_ns: int) -> Iterator[Arrays]:
    """Yield arrays ``streams/<name>/{stamps_ns,data,offsets,about}`` of some topics.

    Messages of a fixed number of numbers are rows of `data`, (M, C) f8. Of lists of things with
    a position (plans, people) each thing is a row, and message i has rows offsets[i] to
    offsets[i + 1]; of images these are bytes. Stamps are those of headers, else of recording.
    `about` is JSON: topic, type, columns, frames, and what is left out.

    Parameters
    ----------
    bag, names
        As for `choose_streams`.
    start_ns, stop_ns
        Record times, both included.

    Raises
    ------
    RecordingError
        If a name is no topic that can be kept, or the recording is damaged.
    """
    return _read(bag, choose_streams(bag, names), max(start_ns, 0), stop_ns)


class _Log:
    """Collect what is kept of one stream, and give it away by blocks."""

    def __init__(self, stream: Stream) -> None:
        self.stream = stream
        self.stamps = array("q")
        self.ends = array("q", [0] if stream.is_ragged else [])
        self.data: list[NDArray[Any]] = []
        self.size = self.end = 0
        self.from_header: bool | None = None
        self.said: list[str] = []

    def add(self, entry: Entry, record_ns: int) -> None:
        """Add a message that was recorded at a time."""
        self.from_header = entry.stamp_ns is not None
        self.stamps.append(record_ns if entry.stamp_ns is None else entry.stamp_ns)
        self.data.append(entry.data)
        self.size += entry.data.nbytes + 8
        if self.stream.is_ragged:
            self.end += len(entry.data)
            self.ends.append(self.end)
        if entry.said not in self.said and len(self.said) < _MAX_SAID:
            self.said.append(entry.said)

    def flush(self) -> Arrays:
        """Return the rows since the last time."""
        layout = self.stream.layout
        empty = np.empty(0, np.uint8) if layout is None else np.empty((0, len(layout.columns)))
        found: Arrays = {
            "stamps_ns": np.array(self.stamps, np.int64),
            "data": np.concatenate((empty, *self.data)),
        }
        if self.stream.is_ragged:
            found["offsets"] = np.array(self.ends, np.int64)
        self.stamps, self.ends, self.data, self.size = array("q"), array("q"), [], 0
        return {f"streams/{self.stream.name}/{name}": rows for name, rows in found.items()}

    def about(self) -> Arrays:
        """Return what is known of the stream, as bytes of JSON."""
        layout, topic = self.stream.layout, self.stream.topic
        said: dict[str, Any] = {"topic": topic.name, "type": topic.type}
        if self.from_header is not None:
            said["stamps"] = "header" if self.from_header else "record"
        if layout is None:
            said |= {"formats": self.said}
        else:
            frames = [frame for frame in self.said if frame]
            said |= {"columns": layout.columns, "frames": frames, "left_out": layout.left_out}
        text = json.dumps(said, sort_keys=True).encode()
        return {f"streams/{self.stream.name}/about": np.frombuffer(text, np.uint8)}


def _read(bag: Bag, streams: tuple[Stream, ...], start_ns: int, stop_ns: int) -> Iterator[Arrays]:
    topics = [stream.topic for stream in streams]
    logs = {(stream.topic.name, stream.topic.type): _Log(stream) for stream in streams}
    total = sum(topic.messages for topic in topics)
    messages = bag.messages(topics, start_ns)
    for message in tqdm(
        messages, total=total, desc="streams", unit=" msg", disable=None, leave=False
    ):
        if message.record_ns > stop_ns:
            break
        log = logs[message.topic, message.type]
        log.add(bag.read(message, log.stream.take), message.record_ns)
        if log.size >= _BLOCK_BYTES:
            yield log.flush()
    for log in logs.values():
        yield log.flush() | log.about()


def _streams_of(bag: Bag) -> tuple[Stream, ...]:
    """Every topic that can be kept, with a name of its own."""
    streams: dict[str, Stream] = {}
    for topic in bag.topics:
        layout = _layout_of(bag, topic.type)
        if layout is not None or topic.type in (IMAGE, COMPRESSED_IMAGE):
            name, count = slug(topic.name), 1
            while name in streams:
                count += 1
                name = f"{slug(topic.name)}-{count}"
            streams[name] = Stream(name, topic, layout)
    return tuple(streams.values())


def _why_not(bag: Bag, name: str, able: tuple[Stream, ...]) -> str:
    types = [topic.type for topic in bag.topics if topic.name.strip("/") == name.strip("/")]
    why = f"{name} is of type {types[0]}, which cannot be kept" if types else f"no topic {name!r}"
    kept = ", ".join(f"{s.topic.name} ({s.topic.type})" for s in able) or "none"
    return f"{why}; topics that can be kept as streams: {kept}; all means these, without images"


class _Field(NamedTuple):
    """A field of a type: its numbers, or what it is instead."""

    path: str
    columns: tuple[str, ...] = ()
    kind: str = "numbers"  # text, frame (or header), time, numeric list, list
    item: str = ""


_OWN_HEADER = _Field("header", kind="frame")


def _layout_of(bag: Bag, type_: str) -> Layout | None:
    """Decide by its definition what is kept of a type: None where it is not kept.

    Either all its numbers, where that is all there is in it; or those of a thing with a
    position; or those of a list of such things.
    """
    if type_ in (IMAGE, COMPRESSED_IMAGE):
        return None
    try:
        definitions = bag.fields_of(type_)
        found = _all_fields(definitions, type_)
        top = [field for field in found if field != _OWN_HEADER]
        lists = [field for field in top if field.kind == "list" and "." not in field.path]
        items = {field.path: _all_fields(definitions, field.item) for field in lists}
    except Exception:  # rosbags fails in many ways on a definition that it cannot read
        return None
    if any(field.kind == "numeric list" and "." not in field.path for field in top):
        return None
    stamped = _OWN_HEADER in found
    if _has_place(top) or all(field.kind in ("numbers", "frame") for field in top):
        return _layout(top, None, stamped=stamped)
    placed = [name for name, fields in items.items() if _has_place(fields)]
    if len(placed) != 1:
        return None
    others = [field.path for field in top if field.path != placed[0]]
    return _layout(items[placed[0]], placed[0], stamped=stamped, others=others)


def _layout(
    fields: list[_Field], items: str | None, *, stamped: bool, others: Collection[str] = ()
) -> Layout | None:
    kept = [field for field in fields if field.kind == "numbers"]
    columns = tuple(column for field in kept for column in field.columns)
    if not columns:
        return None
    within = f"{items}." if items else ""
    left = [f"{within}{field.path}" for field in fields if field.kind != "numbers"]
    paths = tuple(".".join(map(_attribute, field.path.split("."))) for field in kept)
    attribute = None if items is None else _attribute(items)
    return Layout(paths, columns, (*others, *left), attribute, stamped)


def _all_fields(definitions: Any, type_: str) -> list[_Field]:
    """List the fields of a type; types within types may make more than can be listed."""
    fields: list[_Field] = []
    size = 0
    for field in _fields_of(definitions, type_, ""):
        fields.append(field)
        size += max(1, len(field.columns))
        if size > _MAX_COLUMNS:
            raise ValueError(f"{type_} has more than {_MAX_COLUMNS} fields")
    return fields


def _fields_of(definitions: Any, type_: str, prefix: str) -> Iterator[_Field]:
    """Yield the fields of a type, those of nested types by dotted paths."""
    for name, (node, arg) in definitions[type_][1]:
        path, kind = f"{prefix}{name}", node.name
        if kind == "BASE" and name != _PADDING:
            text = "frame" if name.endswith("frame_id") else "text"
            yield _Field(path, kind=text) if _is_text(arg) else _Field(path, (path,))
        elif kind == "NAME" and arg in _TIMES:
            yield _Field(path, kind="time")
        elif kind == "NAME" and arg == _HEADER:
            yield _Field(path, kind="frame")
        elif kind == "NAME":
            yield from _fields_of(definitions, arg, f"{path}.")
        elif kind in ("ARRAY", "SEQUENCE"):
            yield _list_field(path, kind, *arg)


def _list_field(path: str, kind: str, of: Any, length: int) -> _Field:
    if of[0].name != "BASE":
        return _Field(path, kind="list", item=of[1])
    if _is_text(of[1]):
        return _Field(path, kind="text")
    if kind == "SEQUENCE" or length > _MAX_COLUMNS:
        return _Field(path, kind="numeric list")
    return _Field(path, tuple(f"{path}[{i}]" for i in range(length)))


def _has_place(fields: list[_Field]) -> bool:
    columns = {column for field in fields for column in field.columns}
    parents = [column.rpartition(".")[0] for column in columns if column.split(".")[-1] == "x"]
    return any(
        parent.split(".")[-1] in _PLACES and f"{parent}.y".lstrip(".") in columns
        for parent in parents
    )


def _is_text(base: Any) -> bool:
    return base[0] in ("string", "wstring")


def _attribute(name: str) -> str:
    """Return the attribute by which rosbags holds a field; some names are words of Python."""
    return f"{name}_" if keyword.iskeyword(name) else name


def _flat(values: Any) -> list[float]:
    """Write numbers and arrays of them one after another."""
    row: list[float] = []
    for value in values if isinstance(values, tuple) else (values,):
        if isinstance(value, np.ndarray):
            row.extend(value.tolist())
        else:
            row.append(float(value))
    return row


def _stamp_ns(header: Any) -> int | None:
    return None if header is None else int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def _encode(message: Any) -> tuple[NDArray[np.uint8], str]:
    """Encode an Image without loss: as PNG, or TIFF where its values are floats."""
    encoding, height, width = str(message.encoding), int(message.height), int(message.width)
    if encoding != _TIFF and encoding not in _PNG:
        known = ", ".join((*_PNG, _TIFF))
        raise ValueError(f"the encoding {encoding!r} cannot be kept; those that can be: {known}")
    size, channels = _PNG.get(encoding, (4, (0,)))
    raw = np.asarray(message.data, np.uint8).reshape(height, int(message.step))
    if width * size * len(channels) > raw.shape[1]:
        raise ValueError(f"{raw.shape[1]} bytes a row for {width} pixels of {encoding}")
    order, kind = ">" if message.is_bigendian else "<", "f" if encoding == _TIFF else "u"
    values = np.ascontiguousarray(raw[:, : width * size * len(channels)]).view(
        f"{order}{kind}{size}"
    )
    pixels = values.reshape(height, width, len(channels))[..., channels]
    native = pixels.astype(pixels.dtype.newbyteorder("="))
    image = Image.fromarray(native[..., 0] if len(channels) == 1 else native)
    stream = io.BytesIO()
    if encoding == _TIFF:
        image.save(stream, "TIFF", compression="tiff_adobe_deflate")
    else:
        image.save(stream, "PNG", compress_level=1)
    name = "tiff" if encoding == _TIFF else "png"
    return np.frombuffer(stream.getvalue(), np.uint8), f"{name} of {encoding}"
