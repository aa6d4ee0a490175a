"""What the messages of a bag look like: its own definitions of types, else those of a release."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from typing import Any, NamedTuple

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from semantic2d_dataset.errors import InvalidInputError

TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")

_DEFAULT = {True: "noetic", False: "humble"}
_IDL_RULE = "=" * 80 + "\nIDL: "
_DIRECTIVE = re.compile(r"^[ \t]*#.*$", re.MULTILINE)
_MAX_TEXT = 1 << 20  # characters; those of ROS have a few thousand
_MAX_UNROLLED = 4096  # rosbags writes a line of code for each element of such an array
_MAX_DEPTH = 32


class Connection(NamedTuple):
    """A topic of one type in one file, as its recorder described it.

    Parameters
    ----------
    id
        Its number in the file.
    topic, type, messages
        As `conversion.messages.recordings.Topic`.
    definition
        Text that defines the type; empty where the file has none.
    idl
        Whether the text is IDL instead of ROS's own language.
    """

    id: int
    topic: str
    type: str
    messages: int
    definition: str
    idl: bool = False


class Definitions:
    """The types of a bag; only those that are read are ever compiled.

    Parameters
    ----------
    connections
        All of the bag.
    ros1
        Whether it is a bag of ROS 1.
    distro
        The release of ROS that defines what the bag does not; None takes Noetic or Humble.

    Raises
    ------
    InvalidInputError
        If the release is not known.
    """

    def __init__(
        self, connections: Collection[Connection], *, ros1: bool, distro: str | None = None
    ) -> None:
        self.distro = (distro or _DEFAULT[ros1]).lower()
        if self.distro not in known_distros(ros1=ros1):
            raise InvalidInputError(
                f"distro: expected one of {', '.join(known_distros(ros1=ros1))} for a bag of "
                f"ROS {1 if ros1 else 2}, found {distro!r}"
            )
        self.standard = get_typestore(Stores(f"ros{1 if ros1 else 2}_{self.distro}"))
        for name in TF_TYPES:  # Noetic's store has no tf
            if name not in self.standard.fielddefs:
                text = "geometry_msgs/TransformStamped[] transforms"
                self.standard.register(get_types_from_msg(text, name))
        self._texts: dict[str, set[tuple[str, bool]]] = {}
        for connection in connections:
            if connection.definition.strip():
                key = (connection.definition, connection.idl)
                self._texts.setdefault(connection.type, set()).add(key)
        self._stores: dict[str, Typestore] = {}

    def store_of(self, type_: str) -> Typestore:
        """Return a store that knows a type as the bag means it.

        Raises
        ------
        Exception
            If the definition cannot be read (rosbags raises many kinds), or there is none.
        """
        if type_ not in self._stores:
            found = [self._compile(type_, *text) for text in sorted(self._texts.get(type_, ()))]
            if any(leaves(store, type_) != leaves(found[0], type_) for store in found[1:]):
                raise ValueError(f"the bag defines {type_} in {len(found)} ways")
            if not found and type_ not in self.standard.fielddefs:
                raise ValueError(
                    f"neither the bag nor ROS {self.distro} defines {type_}; --distro names another"
                )
            self._stores[type_] = found[0] if found else self.standard
        return self._stores[type_]

    def is_standard(self, type_: str) -> bool:
        """Tell whether the bag means by a type, and by all in it, what ROS means by it."""
        try:
            return leaves(self.store_of(type_), type_) == leaves(self.standard, type_)
        except Exception:  # rosbags fails in many ways on a definition that it cannot read
            return False

    def _compile(self, type_: str, text: str, idl: bool) -> Typestore:  # noqa: FBT001
        if len(text) > _MAX_TEXT:
            raise ValueError(f"the definition of {type_} has {len(text)} characters")
        types = _types_of_idl(text) if idl else dict(get_types_from_msg(text, type_))
        waiting = [type_, *types]
        while waiting:  # what the text leaves out is taken from the release
            name = waiting.pop()
            if name not in types:
                if name not in self.standard.fielddefs:
                    raise ValueError(f"the definition of {type_} lacks that of {name}")
                types[name] = self.standard.fielddefs[name]
            waiting += [part for part in _parts_of(types[name]) if part not in types]
        store = get_typestore(Stores.EMPTY)
        store.register(types)
        return store


def known_distros(*, ros1: bool) -> tuple[str, ...]:
    """Return the releases of ROS whose types are known."""
    prefix = "ros1_" if ros1 else "ros2_"
    return tuple(s.value.removeprefix(prefix) for s in Stores if s.value.startswith(prefix))


def leaves(store: Typestore, type_: str) -> list[tuple[str, Any]]:
    """Return the plain fields of a type with their paths, in the order of its bytes."""
    return list(_leaves(store.fielddefs, type_, "", 0))


def _leaves(known: Any, type_: str, path: str, depth: int) -> Iterator[tuple[str, Any]]:
    if depth > _MAX_DEPTH:
        raise ValueError(f"the definition of {type_} never ends")
    for name, field in known[type_][1]:
        (kind, detail), size = _inner(field)
        where = f"{path}/{name}{size}"
        if kind == Nodetype.NAME:
            yield from _leaves(known, detail, where, depth + 1)
        else:
            yield where, detail


def _inner(field: Any) -> tuple[Any, str]:
    """Return what an array or list consists of, and its size in brackets; a field as it is."""
    kind, detail = field
    if kind not in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        return field, ""
    inner, size = detail
    return inner, f"[{size}]" if kind == Nodetype.ARRAY else "[]"


def _parts_of(definition: Any) -> Iterator[str]:
    """Types that the fields of a definition name."""
    for name, (kind, detail) in definition[1]:
        (inner, about), _ = _inner((kind, detail))
        plain = inner == Nodetype.BASE and about[0] != "string"
        if kind == Nodetype.ARRAY and not plain and detail[1] > _MAX_UNROLLED:
            raise ValueError(f"the field {name} has {detail[1]} elements: more than can be read")
        if inner == Nodetype.NAME:
            yield about


def _types_of_idl(text: str) -> dict[str, Any]:
    text = _DIRECTIVE.sub("", text)  # rosbags reads no #include
    if not text.startswith(_IDL_RULE):
        return dict(get_types_from_idl(text))
    types: dict[str, Any] = {}
    for part in text.split(_IDL_RULE)[1:]:
        types |= get_types_from_idl(part.partition("\n")[2])
    return types
