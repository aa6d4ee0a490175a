"""Other topics of a bag as arrays: commands, odometry, goals, plans, people, detections, images."""

from __future__ import annotations

import io
import json
from array import array
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from tqdm import tqdm

from conversion.messages.recordings import Topic
from conversion.plan import Arrays
from conversion.ros.bags import Bag
from conversion.ros.stream_rows import Entry, Layout, Words, layout_of, stamp_of
from semantic2d_dataset.errors import RecordingError
from semantic2d_dataset.format.sequence import slug

ALL = "all"
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"

_BLOCK_BYTES = 1 << 20
_MAX_SAID = 16  # frames or formats listed of one topic

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

    def take(self, message: Any, words: Words) -> Entry:
        """Return what is kept of a message; its texts join `words`."""
        if self.layout is not None:
            return self.layout.take(message, words)
        if self.topic.type == COMPRESSED_IMAGE:
            data, how = np.array(message.data, np.uint8), str(message.format)
        else:
            data, how = _encode(message)
        return Entry(stamp_of(message.header), how, data)


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
    A text is a number, and its word in `about`; of a list within a thing whose items have a
    score (hypotheses of a detection), the best item is kept, NaN where there is none. `about` is
    JSON: topic, type, columns, frames, words, lists of which only the best is kept, and what is
    left out.

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
        self._words = Words()
        self.take: Callable[[Any], Entry] = partial(stream.take, words=self._words)

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
            if layout.texts:
                said["words"] = {layout.columns[n]: self._words.of(n) for n in layout.texts}
            if layout.best:
                said["best_of"] = [best.items for best in layout.best]
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
        log.add(bag.read(message, log.take), message.record_ns)
        if log.size >= _BLOCK_BYTES:
            yield log.flush()
    for log in logs.values():
        yield log.flush() | log.about()


def _streams_of(bag: Bag) -> tuple[Stream, ...]:
    """Every topic that can be kept, with a name of its own."""
    streams: dict[str, Stream] = {}
    for topic in bag.topics:
        is_image = topic.type in (IMAGE, COMPRESSED_IMAGE)
        layout = None if is_image else layout_of(bag, topic.type)
        if layout is not None or is_image:
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
