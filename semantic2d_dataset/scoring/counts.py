"""What was counted of a submission, or of a part of it: files that merge into one result.

Several machines share the work of scoring: each counts a part of the sequences, and a result is
computed from all counts together. Counts are integers, so that the result is the same to the
byte, however the sequences were shared.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.errors import CorruptFileError, InvalidInputError
from semantic2d_dataset.format.container import check_version, read_json_file
from semantic2d_dataset.format.schema_check import check_document
from semantic2d_dataset.format.writing import write_text_atomically
from semantic2d_dataset.scene.taxonomy import Taxonomy
from semantic2d_dataset.scoring.calibration import Calibration
from semantic2d_dataset.scoring.conditions import BANDS
from semantic2d_dataset.scoring.metrics import Evaluator
from semantic2d_dataset.scoring.tallies import Tally, merge_tallies

FORMAT = "semantic2d-counts"
FORMAT_VERSION = "1.0"

_MAX_BYTES = 1 << 28
_SHOWN = 3  # missing sequences


@dataclass(frozen=True, eq=False)
class Counts:
    """What was counted of a submission.

    Parameters
    ----------
    submission
        What was scored against what, see `submission.score_predictions`.
    taxonomy
        The classes.
    sequences
        Ids of all sequences that a score needs.
    tallies
        Counts of those that were counted here, by sequence id.
    """

    submission: Mapping[str, Any]
    taxonomy: Taxonomy
    sequences: tuple[str, ...]
    tallies: tuple[Tally, ...]

    @property
    def missing(self) -> tuple[str, ...]:
        """Ids of the sequences that were not counted."""
        counted = {tally.sequence_id for tally in self.tallies}
        return tuple(name for name in self.sequences if name not in counted)


def merge_counts(parts: Iterable[Counts]) -> Counts:
    """Put the counts of parts of one submission together.

    Raises
    ------
    InvalidInputError
        If they are of different submissions, or a sequence comes twice or not at all.
    """
    first, *others = parts
    for other in others:
        _check_alike(_identity(first), _identity(other))
    tallies = merge_tallies(tally for part in (first, *others) for tally in part.tallies)
    if len({(len(tally.samples), tally.calibration is None) for tally in tallies}) > 1:
        raise InvalidInputError("only some sequences have samples or probabilities, or as many")
    merged = Counts(first.submission, first.taxonomy, first.sequences, tallies)
    missing = merged.missing
    if missing:
        more = f" and {len(missing) - _SHOWN} more" if len(missing) > _SHOWN else ""
        raise InvalidInputError(
            f"{len(missing)} of {len(merged.sequences)} sequences were counted in no part: "
            f"{', '.join(missing[:_SHOWN])}{more}; count them with: semantic2d score-part"
        )
    return merged


def write_counts(counts: Counts, path: Path) -> None:
    """Write counts as a JSON file, atomically."""
    said = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "submission": counts.submission,
        "taxonomy": counts.taxonomy.as_dict(),
        "sequences": counts.sequences,
        "counted": [_tally_to_dict(tally) for tally in counts.tallies],
    }
    write_text_atomically(path, json.dumps(said, allow_nan=False, ensure_ascii=False) + "\n")


def read_counts(path: Path) -> Counts:
    """Read counts that `write_counts` wrote, and check that they add up.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    CorruptFileError
        If it holds no counts, or counts that contradict each other.
    FormatVersionError
        If it was written in a newer major format.
    """
    path = Path(path)
    said = _read_document(path)
    try:
        return _counts_from(said)
    except InvalidInputError as err:
        raise CorruptFileError(f"{path}: {err}") from err


def _read_document(path: Path) -> Mapping[str, Any]:
    """Read the file, and check its form."""
    said = read_json_file(path, _MAX_BYTES)
    if not isinstance(said, dict) or said.get("format") != FORMAT:
        raise CorruptFileError(f"{path}: expected counts, which semantic2d score-part writes")
    check_version(path, str(said.get("format_version")))
    try:
        check_document(path, said, _schema())
    except InvalidInputError as err:
        raise CorruptFileError(str(err)) from err
    return said


def _counts_from(said: Mapping[str, Any]) -> Counts:
    taxonomy, sequences = Taxonomy.from_dict(said["taxonomy"]), tuple(said["sequences"])
    tallies = merge_tallies(_tally_from(each, taxonomy) for each in said["counted"])
    strange = sorted({tally.sequence_id for tally in tallies} - set(sequences))
    if strange:
        raise InvalidInputError(f"{strange[0]}: counted, and not one of the sequences to count")
    return Counts(said["submission"], taxonomy, sequences, tallies)


def _identity(counts: Counts) -> dict[str, Any]:
    """Everything that must be the same in all parts, by its name."""
    said = dict(counts.submission)
    digests = {f"digests.{name}": digest for name, digest in said.pop("digests").items()}
    return digests | said | {"classes": counts.taxonomy, "sequences": counts.sequences}


def _check_alike(one: Mapping[str, Any], other: Mapping[str, Any]) -> None:
    for name in sorted({*one, *other}):
        if one.get(name) != other.get(name):
            raise InvalidInputError(
                f"the parts are not of one submission: {name} is {one.get(name)!r} in one and "
                f"{other.get(name)!r} in another; count all parts of the same file, against the "
                "same data set, with the same version of this package"
            )


def _tally_to_dict(tally: Tally) -> dict[str, Any]:
    calibration = tally.calibration
    return {
        "sequence_id": tally.sequence_id,
        "environment": tally.environment,
        "lidar": tally.lidar,
        "ignored": tally.evaluator.ignored,
        "confusion": tally.evaluator.confusion.tolist(),
        "windows": [[*window, table.tolist()] for window, table in tally.windows.items()],
        "conditions": {name: table.tolist() for name, table in tally.conditions.items()},
        "samples": [[sample.ignored, sample.confusion.tolist()] for sample in tally.samples],
        "calibration": None
        if calibration is None
        else {
            "ignored": calibration.ignored,
            "by_confidence": calibration.by_confidence.tolist(),
            "by_entropy": calibration.by_entropy.tolist(),
        },
    }


def _tally_from(said: Mapping[str, Any], taxonomy: Taxonomy) -> Tally:
    name, square = said["sequence_id"], (len(taxonomy),) * 2
    evaluator = _evaluator(f"{name}: confusion", said["ignored"], said["confusion"], taxonomy)
    if set(said["conditions"]) != set(BANDS):
        raise InvalidInputError(f"{name}: conditions: expected {', '.join(BANDS)}")
    tally = Tally(
        sequence_id=name,
        environment=said["environment"],
        lidar=said["lidar"],
        evaluator=evaluator,
        windows={
            (recording, number): _table(f"{name}: windows", rows, square)
            for recording, number, rows in said["windows"]
        },
        conditions={
            condition: _table(
                f"{name}: conditions.{condition}",
                said["conditions"][condition],
                (len(bands), *square),
            )
            for condition, bands in BANDS.items()
        },
        samples=tuple(
            _evaluator(f"{name}: samples", ignored, rows, taxonomy)
            for ignored, rows in said["samples"]
        ),
        calibration=_calibration(name, said["calibration"], taxonomy),
    )
    for part, counted, expected in _sums(tally):
        if not np.array_equal(counted, expected):
            raise InvalidInputError(f"{name}: {part} do not add up to its confusion matrix")
    return tally


def _sums(tally: Tally) -> Iterator[tuple[str, Any, Any]]:
    """Yield what counts the same points: its name, what it adds up to, and what it should."""
    total = tally.evaluator.confusion
    yield "windows", sum(tally.windows.values()), total
    for name, table in tally.conditions.items():
        yield f"conditions.{name}", table.sum(axis=0), total
    for sample in tally.samples:
        yield "samples", sample.confusion.sum(axis=1), total.sum(axis=1)
    if tally.calibration is not None:
        for table in (tally.calibration.by_confidence, tally.calibration.by_entropy):
            yield "points of its calibration", table[:, 0].sum(), total.sum()


def _evaluator(where: str, ignored: int, rows: Any, taxonomy: Taxonomy) -> Evaluator:
    evaluator = Evaluator(taxonomy)
    evaluator.ignored = ignored
    evaluator.confusion = _table(where, rows, (len(taxonomy),) * 2)
    return evaluator


def _calibration(
    name: str, said: Mapping[str, Any] | None, taxonomy: Taxonomy
) -> Calibration | None:
    if said is None:
        return None
    calibration = Calibration(taxonomy)
    calibration.ignored = said["ignored"]
    for key in ("by_confidence", "by_entropy"):
        table = _table(f"{name}: calibration.{key}", said[key], getattr(calibration, key).shape)
        setattr(calibration, key, table)
    return calibration


def _table(where: str, rows: Any, shape: Sequence[int]) -> NDArray[np.int64]:
    """Turn lists into counts of a shape, refusing all that is no count."""
    expected = f"{where}: expected whole numbers from 0 of shape {tuple(shape)}"
    try:
        table = np.array(rows)
    except ValueError as err:
        raise InvalidInputError(f"{expected}, found rows of different lengths") from err
    if table.dtype != np.int64 or table.shape != tuple(shape):
        raise InvalidInputError(f"{expected}, found {table.dtype} of {table.shape}")
    if (table < 0).any():
        raise InvalidInputError(f"{expected}, found {table.min()}")
    return table


@cache
def _schema() -> Any:
    text = resources.files(__package__).joinpath("counts.schema.json").read_text("utf-8")
    return json.loads(text)
