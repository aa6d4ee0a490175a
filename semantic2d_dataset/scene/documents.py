"""YAML and JSON documents that people write: configurations, maps, calibrations."""

from __future__ import annotations

import difflib
from collections.abc import Collection
from pathlib import Path
from typing import Any

import yaml

from semantic2d_dataset.errors import InvalidInputError

# What PyYAML raises on text that is no YAML, or whose dates, numbers or nesting cannot be.
_FAILURES = (
    yaml.YAMLError,
    ValueError,
    TypeError,
    AttributeError,
    LookupError,
    ArithmeticError,
    RecursionError,
)


_MAX_VALUES = 1_000_000


def read_yaml(path: Path, *, kind: str = "a YAML file", several: bool = False) -> Any:
    """Read a YAML document, which JSON is too, as plain values; None where the file is empty.

    Parameters
    ----------
    path
        The file, in UTF-8.
    kind
        What it should be, for the message.
    several
        Whether more documents may follow, as ``rostopic echo`` writes them; the first is read.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    InvalidInputError
        If it is not YAML, or would be endless or huge with its aliases written out.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
        found = next(iter(yaml.safe_load_all(text)), None) if several else yaml.safe_load(text)
    except _FAILURES as err:
        said = " ".join(str(err).replace(' in "<unicode string>",', " at").split())
        raise InvalidInputError(f"{path}: not {kind}: {said}") from err
    if _count(found, {}) > _MAX_VALUES:
        raise InvalidInputError(
            f"{path}: not {kind}: its aliases stand for more than {_MAX_VALUES:,} values"
        )
    return found


def _count(value: Any, known: dict[int, int]) -> int:
    """Count the values of a document as if its aliases were written out, too many if endless."""
    if not isinstance(value, (dict, list, tuple)):
        return 1
    if id(value) not in known:
        known[id(value)] = _MAX_VALUES  # of itself, where it is a part of it
        parts = value.values() if isinstance(value, dict) else value
        known[id(value)] = 1 + sum(_count(part, known) for part in parts)
    return known[id(value)]


def hint(word: object, known: Collection[str]) -> str:
    """Return the end of a message about an unknown word: what was meant, or what there is.

    >>> hint("colour", ["color", "size"])
    "; did you mean 'color'?"
    """
    names = sorted(map(str, known))
    near = difflib.get_close_matches(str(word), names, n=1)
    return f"; did you mean {near[0]!r}?" if near else f"; known are {', '.join(names)}"
