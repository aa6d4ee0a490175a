"""Where detections come from: JSON files, of our own kind and COCO's, and streams of a sequence."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.sequence import SequenceReader

_BLOCK_ROWS = 1 << 16
_MAX_STAMP = 2**63 - 1
_MAX_EXACT = 2**53  # of the numbers that f8 holds
# Columns of streams: vision_msgs of ROS 2 since Humble, before, and of yolo_msgs.
_X = ("bbox.center.position.x", "bbox.center.x")
_Y = ("bbox.center.position.y", "bbox.center.y")
_WIDTH = ("bbox.size_x", "bbox.size.x")
_HEIGHT = ("bbox.size_y", "bbox.size.y")
_CLASS = ("results.hypothesis.class_id", "results.hypothesis.id", "results.id", "class_name")
_SCORE = ("results.hypothesis.score", "results.score", "score")


class Entry(NamedTuple):
    """One box of the image of a stamp, its class as the detector calls it."""

    stamp_ns: int
    box: tuple[float, ...]
    name: str
    score: float


def read_json(path: Path) -> tuple[list[int], list[Entry]]:
    """Return the stamps of all images, and their boxes, of a file as docs/camera.md has it.

    Raises
    ------
    FileNotFoundError
        If the file is missing.
    InvalidInputError
        If it is of neither kind, naming the entry that is wrong.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as err:
        raise InvalidInputError(f"{path}: not a JSON file: {err}") from err
    try:
        if isinstance(content, dict) and "frames" in content:
            return _own_entries(content)
        if isinstance(content, dict) and "images" in content:
            return _coco_entries(content)
    except InvalidInputError as err:
        raise InvalidInputError(f"{path}: {err}") from err
    raise InvalidInputError(
        f"{path}: expected an object with `frames`, or with `images`, `annotations` and "
        f"`categories` as in COCO"
    )


def _own_entries(content: Mapping[str, Any]) -> tuple[list[int], list[Entry]]:
    stamps, entries = [], []
    for i, frame in enumerate(_list(content, "frames", "")):
        where = f"frames[{i}]"
        stamps.append(_stamp(frame, where))
        for k, found in enumerate(_list(frame, "detections", where)):
            at = f"{where}.detections[{k}]"
            box = _four(found, "box", at)
            name = _get(found, "class", at)
            if not isinstance(name, str) and type(name) is not int:
                raise InvalidInputError(f"{at}.class: expected a name or number, found {name!r}")
            entries.append(_entry(stamps[-1], box, str(name), found, at))
    return stamps, entries


def _coco_entries(content: Mapping[str, Any]) -> tuple[list[int], list[Entry]]:
    images = {}
    for i, image in enumerate(_list(content, "images", "")):
        images[_whole(image, "id", f"images[{i}]")] = _stamp(image, f"images[{i}]")
    names = {}
    for i, category in enumerate(_list(content, "categories", "")):
        names[_whole(category, "id", f"categories[{i}]")] = str(
            _get(category, "name", f"categories[{i}]")
        )
    entries = []
    for i, found in enumerate(_list(content, "annotations", "")):
        at = f"annotations[{i}]"
        image, category = _whole(found, "image_id", at), _whole(found, "category_id", at)
        if image not in images:
            raise InvalidInputError(f"{at}.image_id: no image has the id {image}")
        if category not in names:
            raise InvalidInputError(f"{at}.category_id: no category has the id {category}")
        x, y, width, height = _four(found, "bbox", at)
        box = (x, y, x + width, y + height)
        entries.append(_entry(images[image], box, names[category], found, at))
    return list(images.values()), entries


def _entry(stamp_ns: int, box: tuple[float, ...], name: str, found: Any, at: str) -> Entry:
    if not (box[0] < box[2] and box[1] < box[3]):
        raise InvalidInputError(
            f"{at}: expected a box with left < right and top < bottom, found {list(box)}"
        )
    score = found.get("score", 1.0)
    if isinstance(score, bool) or not isinstance(score, (int, float)) or not 0 <= score <= 1:
        raise InvalidInputError(f"{at}.score: expected a number from 0 to 1, found {score!r}")
    return Entry(stamp_ns, box, name, float(score))


def _get(holder: Any, key: str, where: str) -> Any:
    if not isinstance(holder, dict) or key not in holder:
        at = f"{where}: " if where else ""
        raise InvalidInputError(f"{at}expected an object with `{key}`, found {holder!r:.80}")
    return holder[key]


def _list(holder: Any, key: str, where: str) -> list[Any]:
    found = _get(holder, key, where)
    if not isinstance(found, list):
        at = f"{where}.{key}" if where else key
        raise InvalidInputError(f"{at}: expected a list, found {found!r:.80}")
    return found


def _whole(holder: Any, key: str, where: str) -> int:
    found = _get(holder, key, where)
    if type(found) is not int:
        raise InvalidInputError(f"{where}.{key}: expected a whole number, found {found!r:.80}")
    return found


def _stamp(holder: Any, where: str) -> int:
    found = _whole(holder, "stamp_ns", where)
    if not 0 <= found <= _MAX_STAMP:
        raise InvalidInputError(
            f"{where}.stamp_ns: expected nanoseconds since the epoch, found {found}"
        )
    return found


def _four(holder: Any, key: str, where: str) -> tuple[float, ...]:
    found = _get(holder, key, where)
    good = isinstance(found, list) and len(found) == 4
    if not good or not all(
        isinstance(n, (int, float)) and not isinstance(n, bool) and abs(n) < 1e9 for n in found
    ):
        raise InvalidInputError(f"{where}.{key}: expected 4 numbers in pixels, found {found!r:.80}")
    return tuple(float(n) for n in found)


def read_stream(reader: SequenceReader, name: str, where: str) -> tuple[list[int], list[Entry]]:
    """Return the stamps of all messages, and their boxes that have an area, a class and a score.

    Raises
    ------
    InvalidInputError
        If the sequence has no such stream, or it holds no detections.
    """
    if f"streams/{name}/data" not in reader:
        known = sorted(path.split("/")[1] for path in reader.names if path.endswith("/about"))
        raise InvalidInputError(
            f"{where}: there is no such stream; there are {', '.join(known) or 'none'} (convert "
            f"the recording with --stream and the topic of the detections)"
        )
    said = reader.describe_stream(name)
    columns = said.get("columns", [])
    at = [_column(where, columns, names) for names in (_X, _Y, _WIDTH, _HEIGHT, _CLASS, _SCORE)]
    words = said.get("words", {}).get(columns[at[4]])
    stamps = reader.read(f"streams/{name}/stamps_ns")
    rows = reader.shape(f"streams/{name}/data")[0]
    offsets = np.arange(rows + 1)
    if f"streams/{name}/offsets" in reader:
        offsets = reader.read(f"streams/{name}/offsets")
    if (
        len(offsets) != len(stamps) + 1
        or offsets[-1] != rows
        or offsets[0] != 0
        or (np.diff(offsets) < 0).any()
    ):
        raise InvalidInputError(f"{where}: its offsets do not divide the {rows} detections")
    taken = np.repeat(stamps, np.diff(offsets))
    entries: list[Entry] = []
    for start in range(0, rows, _BLOCK_ROWS):
        block = reader.read(f"streams/{name}/data", start, min(start + _BLOCK_ROWS, rows))[:, at]
        good = np.isfinite(block).all(axis=-1) & (block[:, 2:4] > 0).all(axis=-1)
        named = _MAX_EXACT if words is None else len(words)
        good &= (block[:, 4] >= 0) & (block[:, 4] < named)  # -1: its name was not kept
        x, y, width, height, codes, scores = block[good].T
        boxes = np.stack((x - width / 2, y - height / 2, x + width / 2, y + height / 2), axis=-1)
        entries += [
            Entry(stamp, tuple(box), str(code) if words is None else words[code], score)
            for stamp, box, code, score in zip(
                taken[start : start + len(block)][good].tolist(),
                boxes.tolist(),
                codes.astype(np.int64).tolist(),
                np.clip(scores, 0.0, 1.0).tolist(),
                strict=True,
            )
        ]
    return stamps.tolist(), entries


def _column(where: str, columns: list[str], names: tuple[str, ...]) -> int:
    found = next((columns.index(name) for name in names if name in columns), None)
    if found is None:
        raise InvalidInputError(
            f"{where}: no detections: expected a column {' or '.join(names)}; convert the "
            f"recording again if its topic is a vision_msgs/Detection2DArray"
        )
    return found
