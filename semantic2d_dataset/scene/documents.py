"""YAML and JSON documents that people write: configurations, maps, calibrations."""

from __future__ import annotations

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
        If it is not YAML.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
        return next(iter(yaml.safe_load_all(text)), None) if several else yaml.safe_load(text)
    except _FAILURES as err:
        said = " ".join(str(err).split())
        raise InvalidInputError(f"{path}: not {kind}: {said}") from err
