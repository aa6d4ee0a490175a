"""A ranking of results that were scored alike."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jsonschema

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.container import load_json
from semantic2d_dataset.scoring.metrics import class_names, percent

_FRACTION = {"type": ["number", "null"], "minimum": 0, "maximum": 1}
_TEXT = {"type": "string"}
_TASK = ("dataset", "dataset_version", "scheme", "split", "lidars", "evaluator_version")
_DIGESTS = ("split", "taxonomy")

# What ranking needs of a file that `semantic2d score --out` wrote.
_RESULT_SCHEMA = {
    "type": "object",
    "required": ["mIoU", "mCA", "submission"],
    "properties": {
        "mIoU": _FRACTION,
        "mCA": _FRACTION,
        "submission": {
            "type": "object",
            "required": [*_TASK, "metadata", "digests"],
            "properties": {
                "metadata": {
                    "type": "object",
                    "required": ["method"],
                    "properties": {"method": _TEXT},
                },
                "digests": {
                    "type": "object",
                    "required": list(_DIGESTS),
                    "additionalProperties": _TEXT,
                },
                "lidars": {"type": "array", "items": _TEXT},
                **dict.fromkeys((name for name in _TASK if name != "lidars"), _TEXT),
            },
        },
    },
    "additionalProperties": {"properties": {"iou": _FRACTION}},
}


@dataclass(frozen=True)
class Row:
    """One method: its means and its IoU by class, fractions 0 to 1, None where there is none."""

    method: str
    mIoU: float | None
    mCA: float | None
    iou: Mapping[str, float | None]

    @property
    def cells(self) -> tuple[str, ...]:
        """Means and class IoU in percent."""
        return tuple(percent(figure) for figure in (self.mIoU, self.mCA, *self.iou.values()))


def read_result(path: Path) -> dict[str, Any]:
    """Read a result that ``semantic2d score --out`` wrote.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    InvalidInputError
        If it is not such a result, or not all of one.
    """
    path = Path(path)
    if path.is_dir():
        raise InvalidInputError(f"{path}: expected a result file, found a folder")
    try:
        result = load_json(path.read_bytes())
    except InvalidInputError as err:
        raise InvalidInputError(
            f"{path}: not a whole JSON file ({err}); make it with: semantic2d score --out"
        ) from err
    validator = jsonschema.Draft202012Validator(_RESULT_SCHEMA)
    problem = jsonschema.exceptions.best_match(validator.iter_errors(result))
    if problem is not None:
        where = problem.json_path.removeprefix("$").removeprefix(".") or "the file"
        raise InvalidInputError(
            f"{path}: not a result of semantic2d score: {where}: {_cut(problem.message)}"
        )
    return dict(result)


def rank(paths: Iterable[Path]) -> list[Row]:
    """Rank results by mIoU, best first; methods without one come last.

    Parameters
    ----------
    paths
        Files that ``semantic2d score --out`` wrote.

    Returns
    -------
    list of Row

    Raises
    ------
    FileNotFoundError
        If a file does not exist.
    InvalidInputError
        If a file is not a result, or two were not scored alike: on the same data set, version,
        scheme, split, lidars and classes by the same evaluator.
    """
    results = {Path(path): read_result(path) for path in paths}
    _refuse_mixture(results)
    rows = [
        Row(
            _plain(result["submission"]["metadata"]["method"]),
            result["mIoU"],
            result["mCA"],
            {name: result[name]["iou"] for name in class_names(result)},
        )
        for result in results.values()
    ]
    return sorted(rows, key=lambda row: (row.mIoU is None, -(row.mIoU or 0.0), row.method))


def to_text(rows: Sequence[Row]) -> str:
    """Lay a ranking out in columns, in percent."""
    table = [_header(rows), *_body(rows)]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if n == 1 else cell.rjust(width)
            for n, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in table
    )


def to_markdown(rows: Sequence[Row]) -> str:
    """Write a ranking as a Markdown table, in percent."""
    header = _header(rows)
    marks = [":--" if n == 1 else "--:" for n in range(len(header))]
    escaped = ([_escape(cell) for cell in line] for line in (header, *_body(rows)))
    lines = [f"| {' | '.join(cells)} |" for cells in escaped]
    return "\n".join((lines[0], f"| {' | '.join(marks)} |", *lines[1:]))


def to_json(rows: Sequence[Row]) -> str:
    """Write a ranking as a JSON list, in fractions."""
    return json.dumps([asdict(row) for row in rows], indent=1, ensure_ascii=False)


def _header(rows: Sequence[Row]) -> list[str]:
    classes = [f"{_plain(name)} IoU" for name in rows[0].iou] if rows else []
    return ["#", "Method", "mIoU", "mCA", *classes]


def _body(rows: Sequence[Row]) -> list[list[str]]:
    return [[str(place), row.method, *row.cells] for place, row in enumerate(rows, start=1)]


def _refuse_mixture(results: Mapping[Path, Mapping[str, Any]]) -> None:
    """Raise where a result was not scored as the first one was."""
    tasks = {path: _task_of(result) for path, result in results.items()}
    first = next(iter(tasks), Path())
    for path, task in tasks.items():
        for name, value in task.items():
            wanted = tasks[first][name]
            if value != wanted:
                raise InvalidInputError(
                    f"{path}: {name} is {value!r}, but {wanted!r} in {first}; "
                    "only results that were scored alike can be ranked together"
                )


def _task_of(result: Mapping[str, Any]) -> dict[str, Any]:
    said = result["submission"]
    digests = {f"digest of the {name}": said["digests"][name] for name in _DIGESTS}
    return {name: said[name] for name in _TASK} | {"classes": class_names(result)} | digests


def _plain(name: str) -> str:
    """Make a name safe to print: one line, no control characters."""
    return "".join(c for c in " ".join(name.split()) if c.isprintable()) or "(no name)"


def _escape(cell: str) -> str:
    for mark in ("\\", "|", "`", "*", "_", "[", "]", "<", ">"):
        cell = cell.replace(mark, f"\\{mark}")
    return cell


def _cut(message: str) -> str:
    return message if len(message) <= 200 else f"{message[:200]} ..."
