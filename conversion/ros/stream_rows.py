"""What of a type of messages is kept as rows of a stream: its numbers, and the texts of things."""

from __future__ import annotations

import keyword
import math
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from conversion.messages.scans import plain_frame
from conversion.ros.bags import Bag

_MAX_COLUMNS = 4096
_MAX_WORDS = 1 << 20  # characters of the texts of a stream; JSON may take 12 bytes for each
_WORD = 8  # characters that each text counts beside its own
_LEFT_OUT = -1  # the code of a text beyond that
_SCORE = "score"
_MAX_BEST = 4  # lists looked into: each may add as many columns as there can be
_HEADER = "std_msgs/msg/Header"
_TIMES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
_PLACES = ("", "position", "point", "location", "centroid", "center")
_PADDING = "structure_needs_at_least_one_member"  # what rosidl puts into empty types


class Entry(NamedTuple):
    """What is kept of one message: None as stamp means the time of recording."""

    stamp_ns: int | None
    said: str
    data: NDArray[Any]


class Words:
    """Give the texts of a stream numbers: each column its own, in the order they appear in."""

    def __init__(self) -> None:
        self._codes: dict[int, dict[str, int]] = {}
        self._room = _MAX_WORDS

    def code(self, column: int, text: str) -> float:
        """Return the number of a text in a column; -1 where there is no room left for it."""
        codes = self._codes.setdefault(column, {})
        if text not in codes:
            size = len(text) + _WORD
            if size > self._room:
                return _LEFT_OUT
            self._room -= size
            codes[text] = len(codes)
        return codes[text]

    def of(self, column: int) -> list[str]:
        """Return the texts of a column; the position of each is its number."""
        return list(self._codes.get(column, ()))


@dataclass(frozen=True)
class Best:
    """A list within a thing whose items have a score: the best one is kept.

    Parameters
    ----------
    items
        The attribute that is the list.
    score
        Attribute of an item.
    paths, columns
        As of `Layout`, of an item.
    """

    items: str
    score: str
    paths: tuple[str, ...]
    columns: tuple[str, ...]


@dataclass(frozen=True)
class Layout:
    """Which numbers and texts of a type are kept.

    Parameters
    ----------
    paths
        Attributes of a message, or of its items.
    columns
        Their names, one for each number or text, and then those of `best`.
    texts
        Columns that hold texts, by the codes of `Words`.
    best
        Lists within a thing of which one item is kept.
    left_out
        Fields that are not kept: times, and lists but for `items` and `best`.
    items
        The list whose items are kept one a row; None where a message is a row.
    stamped
        Whether messages have a header.
    """

    paths: tuple[str, ...]
    columns: tuple[str, ...]
    texts: tuple[int, ...]
    best: tuple[Best, ...]
    left_out: tuple[str, ...]
    items: str | None
    stamped: bool

    def take(self, message: Any, words: Words) -> Entry:
        """Return the rows of a message, (n, columns) f8; n is 1 where a message is a row."""
        things = [message] if self.items is None else getattr(message, self.items)
        get = attrgetter(*self.paths)
        rows = [_flat(get(thing), words.code) for thing in things]
        for best in self.best:
            get, score = attrgetter(*best.paths), attrgetter(best.score)
            for thing, row in zip(things, rows, strict=True):
                found = getattr(thing, best.items)
                if len(found):
                    _flat(get(max(found, key=score)), words.code, row)
                else:
                    row.extend([math.nan] * len(best.columns))
        data = np.array(rows, np.float64).reshape(len(rows), len(self.columns))
        header = message.header if self.stamped else None
        return Entry(stamp_of(header), plain_frame(header.frame_id) if header else "", data)


def layout_of(bag: Bag, type_: str) -> Layout | None:
    """Decide by its definition what is kept of a type: None where it is not kept.

    Either all its numbers, where that is all there is in it; or numbers and texts of a thing
    with a position; or those of a list of such things.
    """
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
        return _layout(top, None, _best_of(definitions, top), stamped=stamped)
    placed = [name for name, fields in items.items() if _has_place(fields)]
    if len(placed) != 1:
        return None
    others = [field.path for field in top if field.path != placed[0]]
    things = items[placed[0]]
    best = _best_of(definitions, things)
    return _layout(things, placed[0], best, stamped=stamped, others=others)


class _Field(NamedTuple):
    """A field of a type: its numbers, or what it is instead."""

    path: str
    columns: tuple[str, ...] = ()
    kind: str = "numbers"  # text, texts, frame (or header), time, numeric list, list
    item: str = ""


_OWN_HEADER = _Field("header", kind="frame")


def _best_of(definitions: Any, fields: list[_Field]) -> dict[str, list[_Field]]:
    """Return the lists of a thing whose items have one score, and the fields of an item."""
    lists = [field for field in fields if field.kind == "list" and "." not in field.path]
    found: dict[str, list[_Field]] = {}
    for field in lists[:_MAX_BEST]:
        with suppress(ValueError):  # too many fields: the list is left out as others are
            items = _all_fields(definitions, field.item)
            if len([item for item in items if _is_score(item)]) == 1:
                found[field.path] = items
    return found


def _layout(
    fields: list[_Field],
    items: str | None,
    best_of: Mapping[str, list[_Field]],
    *,
    stamped: bool,
    others: Collection[str] = (),
) -> Layout | None:
    kept = [field for field in fields if _is_kept(field)]
    columns = [column for field in kept for column in field.columns]
    if not columns:
        return None
    texts = _texts_of(kept)
    best = []
    left = [field.path for field in fields if not _is_kept(field) and field.path not in best_of]
    for path, inner in best_of.items():
        wanted = [field for field in inner if _is_kept(field)]
        score = next(field.path for field in inner if _is_score(field))
        names = tuple(f"{path}.{column}" for field in wanted for column in field.columns)
        best.append(Best(_attribute(path), _attributes(score), _paths_of(wanted), names))
        texts += [len(columns) + n for n in _texts_of(wanted)]
        columns += names
        left += [f"{path}.{field.path}" for field in inner if not _is_kept(field)]
    within = f"{items}." if items else ""
    left_out = (*others, *(f"{within}{path}" for path in left))
    attribute = None if items is None else _attribute(items)
    return Layout(
        _paths_of(kept), tuple(columns), tuple(texts), tuple(best), left_out, attribute, stamped
    )


def _is_kept(field: _Field) -> bool:
    return field.kind in ("numbers", "text")


def _is_score(field: _Field) -> bool:
    return field.columns == (field.path,) and field.path.split(".")[-1] == _SCORE


def _texts_of(fields: list[_Field]) -> list[int]:
    """Return which of the columns of some fields are texts."""
    is_text = [field.kind == "text" for field in fields for _ in field.columns]
    return [n for n, text in enumerate(is_text) if text]


def _paths_of(fields: list[_Field]) -> tuple[str, ...]:
    return tuple(_attributes(field.path) for field in fields)


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
            yield _text_field(path) if _is_text(arg) else _Field(path, (path,))
        elif kind == "NAME" and arg in _TIMES:
            yield _Field(path, kind="time")
        elif kind == "NAME" and arg == _HEADER:
            yield _Field(path, kind="frame")
        elif kind == "NAME":
            yield from _fields_of(definitions, arg, f"{path}.")
        elif kind in ("ARRAY", "SEQUENCE"):
            yield _list_field(path, kind, *arg)


def _text_field(path: str) -> _Field:
    """Return a text; frames are no texts, and said once for all of a topic."""
    if path.endswith("frame_id"):
        return _Field(path, kind="frame")
    return _Field(path, (path,), kind="text")


def _list_field(path: str, kind: str, of: Any, length: int) -> _Field:
    if of[0].name != "BASE":
        return _Field(path, kind="list", item=of[1])
    if _is_text(of[1]):
        return _Field(path, kind="texts")
    if kind == "SEQUENCE" or length > _MAX_COLUMNS:
        return _Field(path, kind="numeric list")
    return _Field(path, tuple(f"{path}[{i}]" for i in range(length)))


def _has_place(fields: list[_Field]) -> bool:
    numbers = [field for field in fields if field.kind == "numbers"]
    columns = {column for field in numbers for column in field.columns}
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


def _attributes(path: str) -> str:
    return ".".join(map(_attribute, path.split(".")))


def _flat(
    values: Any, code: Callable[[int, str], float], row: list[float] | None = None
) -> list[float]:
    """Write numbers, arrays of them and codes of texts one after another; by column, those."""
    row = [] if row is None else row
    for value in values if isinstance(values, tuple) else (values,):
        if isinstance(value, np.ndarray):
            row.extend(value.tolist())
        elif isinstance(value, str):
            row.append(code(len(row), value))
        else:
            row.append(float(value))
    return row


def stamp_of(header: Any) -> int | None:
    """Return the stamp of a header, ns; None where there is no header."""
    return None if header is None else int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)
