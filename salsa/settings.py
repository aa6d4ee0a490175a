"""Parameters of all steps of SALSA, and how they are read from plain values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from salsa.alignment import TRUSTED, Acceptance
from salsa.labelling import DEFAULT_TRANSFER, Transfer
from salsa.smoothing import Smoothing
from salsa.things import DEFAULT_PERSISTENCE, Persistence
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.documents import hint, read_yaml
from semantic2d_dataset.scene.lines import FAST, LineParameters


@dataclass(frozen=True)
class Settings:
    """Parameters of all steps.

    `smoothing` is left out where it is None; so is `persistence`, and what stays in free space is
    called Person then.
    """

    lines: LineParameters = FAST
    acceptance: Acceptance = TRUSTED
    smoothing: Smoothing | None = None
    persistence: Persistence | None = DEFAULT_PERSISTENCE
    transfer: Transfer = DEFAULT_TRANSFER


def read_settings(path: Path | None, changes: Mapping[str, Any]) -> Settings:
    """Read settings from a YAML file, the defaults where there is none, and change some of them.

    Parameters
    ----------
    path
        The file, as `settings_from` takes its content.
    changes
        By step; each is merged into what the file says of it.

    Raises
    ------
    FileNotFoundError, InvalidInputError
        If the file is missing, or names what there is not.
    """
    said = {} if path is None else read_yaml(path) or {}
    if not isinstance(said, dict):
        raise InvalidInputError(f"{path}: expected a mapping of steps to parameters")
    for step, change in changes.items():
        both = isinstance(change, Mapping) and isinstance(said.get(step), Mapping)
        said[step] = {**said[step], **change} if both else change
    try:
        return settings_from(said)
    except InvalidInputError as err:
        raise InvalidInputError(f"{path}: {err}" if path else str(err)) from err


_LARGEST = 2**31 - 1  # whole number, which no parameter comes near

_STEPS: dict[str, type] = {
    "lines": LineParameters,
    "acceptance": Acceptance,
    "smoothing": Smoothing,
    "persistence": Persistence,
    "transfer": Transfer,
}


def settings_from(values: Mapping[str, Any]) -> Settings:
    """Build settings from plain values, as a YAML file holds them.

    Parameters
    ----------
    values
        By step, then by parameter: ``{"persistence": {"min_seconds": 10}}``; what is not named
        keeps its default; ``{"persistence": None}`` leaves that step out, ``{"smoothing": {}}``
        takes one in.

    Raises
    ------
    InvalidInputError
        If a step or a parameter is unknown, or a value is not one that it can have.
    """
    return Settings(**{name: _step(name, value) for name, value in values.items()})


def _step(name: str, values: Any) -> Any:
    if name not in _STEPS:
        raise InvalidInputError(f"salsa: unknown key {name!r}{hint(name, _STEPS)}")
    if values is None and name in ("smoothing", "persistence"):
        return None
    kind = _STEPS[name]
    if not isinstance(values, Mapping):
        raise InvalidInputError(f"salsa: {name}: expected a mapping, found {values!r}")
    known: dict[str, Any] = {each.name: each.default for each in fields(kind)}
    for key, value in values.items():
        if key not in known:
            raise InvalidInputError(f"salsa: {name}: unknown key {key!r}{hint(key, known)}")
        if not _is_like(value, known[key]):
            raise InvalidInputError(
                f"salsa: {name}: {key}: expected a value like {known[key]!r}, found {value!r}"
            )
    start = getattr(Settings(), name) or kind()
    return replace(start, **{key: type(known[key])(value) for key, value in values.items()})


def _is_like(value: Any, example: Any) -> bool:
    if isinstance(example, tuple):
        return isinstance(value, list | tuple) and all(isinstance(each, str) for each in value)
    if type(value) is int and isinstance(example, int | float) and not isinstance(example, bool):
        return abs(value) <= _LARGEST
    return type(value) is type(example)
