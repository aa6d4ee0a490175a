"""What a submission says about its method: written by people as YAML, put into a file."""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

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
_MADE_UP = ("authors", "paper", "code", "hardware")  # whose example is nobody's own
_NEAR = 0.8  # "hardwre" is near "hardware", "note" is not near "code"


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
    lines = ["# About a submission. Where you fill a line in, take the # at its start away."]
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
        If it is not YAML, does not fit ``metadata.schema.json``, says a field twice, or still
        holds an example of the template; all problems are listed, with their lines.
    """
    said, lines = read_yaml(path), _lines_of_fields(path)
    problems = [_with_line(problem, lines) for problem in metadata_problems(said)]
    for name, numbers in lines.items():
        if len(numbers) > 1:
            problems.append(f"{name}: given in lines {', '.join(map(str, numbers))}; keep one")
        if name in _MADE_UP and said[name] == _EXAMPLES[name]:
            problems.append(
                f"line {numbers[0]}: {name}: still the example; fill it in, or put a # before it"
            )
    if problems:
        raise InvalidInputError("\n  - ".join((f"{path}: does not describe a method", *problems)))
    return dict(said)


def remarks_on(about: Mapping[str, Any]) -> list[str]:
    """Say what a valid description leaves out, and which of its own fields may be slips."""
    track = about.get("track", {})
    known = [name for name in _EXAMPLES if name != "track"]
    silent = [name for name in known if name not in about]
    silent += [n for n in _EXAMPLES["track"] if n not in track and n not in about]
    remarks = [f"does not say: {', '.join(silent)}"] if silent else []
    own = [name for name in about if name not in metadata_schema()["properties"]]
    near = ((name, difflib.get_close_matches(name, _EXAMPLES, 1, _NEAR)) for name in own)
    return remarks + [
        f"{name}: a field of your own; did you mean {meant[0]!r}?" for name, meant in near if meant
    ]


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


def _lines_of_fields(path: Path) -> dict[str, list[int]]:
    """Find the lines in which a YAML document that can be read has its fields."""
    root = yaml.compose(Path(path).read_text(encoding="utf-8"), yaml.SafeLoader)
    lines: dict[str, list[int]] = {}
    for key, _ in root.value if isinstance(root, yaml.MappingNode) else ():
        lines.setdefault(str(key.value), []).append(key.start_mark.line + 1)
    return lines


def _with_line(problem: str, lines: Mapping[str, list[int]]) -> str:
    """Write a problem for people who look at a text: with the line of its field."""
    text = problem.removeprefix("metadata").removeprefix(".").removeprefix(": ")
    name = re.split(r"[.:\[]", text)[0]
    return f"line {lines[name][-1]}: {text}" if name in lines else text


def _track_lines(
    said: Mapping[str, Any], example: Mapping[str, Any], properties: Mapping[str, Any]
) -> list[str]:
    lines = ["track:" if said else "#track:"]
    for key, value in example.items():
        shown = "" if key in said else "#"
        text = _line(key, said.get(key, value), None)
        lines.append(f"{shown}  {text}  # {properties[key]['description']}")
    return lines


def _line(key: str, value: Any, example: Any) -> str:
    """Write a line of YAML, which JSON is too; an example as a comment where nothing is known."""
    known = example if value is None else value
    return f"{'#' if value is None else ''}{key}: {json.dumps(known, ensure_ascii=False)}"
