"""What a submission says about its method: written by people as YAML, put into a file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.container import ContainerReader
from semantic2d_dataset.format.schema import PREDICTIONS
from semantic2d_dataset.format.writing import ContainerWriter
from semantic2d_dataset.scene.documents import read_yaml
from semantic2d_dataset.scoring.predictions import (
    PredictionsReader,
    metadata_problems,
    metadata_schema,
)

_EXAMPLES: Mapping[str, Any] = {
    "method": "My method",
    "authors": ["A. Author", "B. Author"],
    "paper": "https://example.org/paper",
    "code": "https://example.org/code",
    "track": {
        "features": "RIA",
        "training_data": "semantic2d 1.0.0, train of block",
        "other_data": "none",
    },
    "parameters": 100000,
    "hardware": "processor or card, memory",
    "scans_per_second": 100.0,
    "scans_per_second_measured": "from features to labels, one scan at a time, 1 thread",
    "seeds": [0],
}
_IN_TRACK = ("features", "training_data")


def write_template(predictions: Path) -> str:
    """Return a YAML text to fill in, with what a predictions file says already.

    What is not known stands as a comment, with an example.

    Raises
    ------
    FileNotFoundError, CorruptFileError, UnsafeFileError, FormatVersionError
        If the file cannot be opened safely, or is damaged.
    """
    with PredictionsReader(predictions) as reader:
        said = reader.metadata
    if metadata_problems(said):  # nothing of it is trusted
        said = {}
    known = {key: value for key, value in said.items() if key not in _IN_TRACK}
    track = dict(known.pop("track", {}))
    track |= {key: said[key] for key in _IN_TRACK if key in said and key not in track}
    properties = metadata_schema()["properties"]
    lines = ["# About a submission. Remove the # where you fill a line in."]
    for key, example in _EXAMPLES.items():
        meaning = properties[key].get("description")
        lines += ["", *([f"# {meaning}"] if meaning else [])]
        if key == "track":
            lines += _track_lines(track, example, properties[key]["properties"])
        else:
            lines.append(_line(key, known.pop(key, None), example))
    lines += ["", *(_line(key, value, None) for key, value in known.items())] if known else []
    return "\n".join(lines) + "\n"


def read_about(path: Path) -> dict[str, Any]:
    """Read what people wrote about a method.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    InvalidInputError
        If it is not YAML, or does not fit ``metadata.schema.json``.
    """
    said = read_yaml(path)
    problems = metadata_problems(said)
    if problems:
        raise InvalidInputError("\n  - ".join((f"{path}: does not describe a method", *problems)))
    return dict(said)


def pack(predictions: Path, about: Mapping[str, Any], out: Path) -> None:
    """Write a predictions file with another description; its arrays are copied as they are stored.

    Raises
    ------
    InvalidInputError
        If the description does not fit its schema.
    WriteError
        If the file cannot be written.
    FileNotFoundError, CorruptFileError, UnsafeFileError, FormatVersionError
        If the predictions cannot be opened safely, or are damaged.
    """
    problems = metadata_problems(dict(about))
    if problems:
        raise InvalidInputError(f"{out}: {'; '.join(problems)}")
    with ContainerReader(predictions, PREDICTIONS) as reader:
        root = {key: str(value) for key, value in reader.attributes().items()}
        with ContainerWriter(Path(out), PREDICTIONS, {"": root}) as writer:
            writer.append_json("metadata", dict(about))
            for name in reader.names:
                if name != "metadata":
                    writer.copy(reader, name)


def _track_lines(
    said: Mapping[str, Any], example: Mapping[str, Any], properties: Mapping[str, Any]
) -> list[str]:
    lines = ["track:" if said else "# track:"]
    for key, value in example.items():
        shown = "" if key in said else "# "
        text = _line(key, said.get(key, value), None)
        lines.append(f"{shown}  {text}  # {properties[key]['description']}")
    return lines


def _line(key: str, value: Any, example: Any) -> str:
    """Write a line of YAML, which JSON is too; an example as a comment where nothing is known."""
    known = example if value is None else value
    return f"{'# ' if value is None else ''}{key}: {json.dumps(known, ensure_ascii=False)}"
