"""Scores of a private test set, told so that little can be learnt from asking often.

The Ladder (Blum and Hardt, ICML 2015, algorithm 1): a new score is told only where it is better
than the best one told so far by a step, and then rounded to the step; else the best one so far is
told again. What was told is all that the ledger holds. Each of its lines carries the digest of the
line before, so that a change to any line is found; the last digest, published from time to time,
also tells of lines that were cut off.
"""

from __future__ import annotations

import datetime
import hashlib
import json
import unicodedata
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from filelock import FileLock

from leaderboard.entries import file_digest
from semantic2d_dataset.access.registry import OpenDataset
from semantic2d_dataset.errors import CorruptFileError, InvalidInputError
from semantic2d_dataset.format.container import load_json
from semantic2d_dataset.format.writing import check_target, write_text_atomically
from semantic2d_dataset.scoring.submission import score_predictions

STEP = 0.01
"""Step of mIoU, fraction: about what a confidence interval of a small test set is wide."""

_SMALLEST_STEP = 0.0001  # of a finer one, rounding hides nothing
_START = "0" * 64
_LINE = {
    "number": int,
    "at": str,
    "submitter": str,
    "task": str,
    "predictions": str,
    "step": float,
    "mIoU": float,
    "mCA": float,
    "better": bool,
    "before": str,
    "digest": str,
}
_TASK = ("dataset", "dataset_version", "scheme", "split", "lidars")


def climb(best: float | None, score: float, step: float) -> float | None:
    """Return the score to tell, or None where the best one so far is told again.

    Parameters
    ----------
    best
        The best score told so far, None where none was.
    score
        The new one.
    step
        By how much it must be better; what is told is rounded to it.

    Examples
    --------
    >>> climb(0.5, 0.508, 0.01) is None, climb(0.5, 0.523, 0.01)
    (True, 0.52)
    """
    if best is not None and score <= best + step:
        return None
    return _rounded(score, step)


def score_privately(
    predictions: Path,
    private: OpenDataset,
    ledger: Path,
    submitter: str,
    *,
    step: float = STEP,
    per_day: int | None = None,
) -> dict[str, Any]:
    """Score predictions against private labels, and add what is told of it to the ledger.

    Parameters
    ----------
    predictions
        The predictions file.
    private
        The data set with the private labels.
    ledger
        The ledger; it is made where there is none.
    submitter
        Who asks: a name that the maintainer has checked.
    step
        See `climb`; a ledger keeps the step that it began with.
    per_day
        How many submissions a submitter has on a day (UTC), or None.

    Returns
    -------
    dict
        The new line of the ledger: ``mIoU`` and ``mCA`` are what may be told, and ``better`` is
        whether they are new.

    Raises
    ------
    SubmissionError
        If the predictions cannot be scored; that is not counted.
    InvalidInputError
        If the submitter has no name or no submission left, the step is another one, or the data
        set has no label to score against.
    CorruptFileError
        If the ledger was changed.
    WriteError
        If it cannot be written.
    """
    if not submitter.strip() or not submitter.isprintable() or len(submitter) > 200:
        raise InvalidInputError(f"{submitter!r}: expected a name of one line")
    if not _SMALLEST_STEP <= step < 1:
        raise InvalidInputError(
            f"step: expected a fraction from {_SMALLEST_STEP} to below 1, found {step}"
        )
    check_target(ledger, (predictions,), force=True)
    _check_limits(read_ledger(ledger), ledger, submitter, step, per_day)  # before any work
    result = score_predictions(predictions, private)
    if not result["points"]:  # as in the public part
        raise InvalidInputError(
            f"{private.root}: has no label of what was predicted; "
            "give the folder of the private labels"
        )
    with FileLock(ledger.with_name(f"{ledger.name}.lock")):
        lines = read_ledger(ledger)
        _check_limits(lines, ledger, submitter, step, per_day)
        line = _next_line(lines, result, submitter, step, file_digest(predictions))
        write_text_atomically(ledger, "".join(f"{_text_of(each)}\n" for each in [*lines, line]))
    return line


def read_ledger(path: Path, *, head: str | None = None) -> list[dict[str, Any]]:
    """Read a ledger, and check that no line of it was changed; nothing where there is no file.

    Parameters
    ----------
    path
        The file.
    head
        A digest that it must hold, because it was published: lines up to there are as they were.

    Raises
    ------
    CorruptFileError
        If a line was changed, moved, put in or taken out, or it is no ledger at all.
    """
    if not path.exists():
        return []
    if not path.is_file():  # a pipe would be waited for
        raise CorruptFileError(f"{path}: expected a ledger, found no file")
    lines: list[dict[str, Any]] = []
    before = _START
    for number, text in enumerate(path.read_bytes().splitlines(), start=1):
        try:
            line = load_json(text)
        except InvalidInputError as err:
            raise CorruptFileError(f"{path}: line {number}: {err}") from err
        if not isinstance(line, dict) or list(line) != list(_LINE):
            raise CorruptFileError(f"{path}: line {number}: no line of a ledger")
        # also the text: of a member that stands there twice, people may read the other one
        as_made = line["digest"] == _digest(line) and text == _text_of(line).encode()
        if not as_made or line["before"] != before or line["number"] != number:
            raise CorruptFileError(
                f"{path}: line {number}: was changed, or one before it was; "
                "go back to a copy whose last digest was published"
            )
        if any(type(line[name]) is not kind for name, kind in _LINE.items()):
            raise CorruptFileError(f"{path}: line {number}: no line of a ledger")
        before = line["digest"]
        lines.append(line)
    if head is not None and head not in [line["digest"] for line in lines]:
        raise CorruptFileError(f"{path}: holds no line of the digest {head}: lines were cut off")
    return lines


def bests_of(lines: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the best line of each submitter and task, best first: what may be published."""
    found = {(line["task"], _who(line["submitter"])): line for line in lines if line["better"]}
    return sorted(found.values(), key=lambda line: (line["task"], -line["mIoU"], line["number"]))


def _next_line(
    lines: list[dict[str, Any]],
    result: Mapping[str, Any],
    submitter: str,
    step: float,
    digest: str,
) -> dict[str, Any]:
    said = result["submission"]
    task = " ".join(" ".join(said[name]) if name == "lidars" else str(said[name]) for name in _TASK)
    own = [
        line
        for line in lines
        if (_who(line["submitter"]), line["task"]) == (_who(submitter), task) and line["better"]
    ]
    best = own[-1] if own else None
    # no class of the truth has a score: as bad as can be
    told = climb(best["mIoU"] if best else None, result["mIoU"] or 0.0, step)
    if told is None and best is not None:
        shown = {"mIoU": best["mIoU"], "mCA": best["mCA"]}
    else:
        shown = {"mIoU": told, "mCA": _rounded(result["mCA"] or 0.0, step)}
    line = {
        "number": len(lines) + 1,
        "at": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "submitter": submitter,
        "task": task,
        "predictions": digest,
        "step": step,
        **shown,
        "better": told is not None,
        "before": lines[-1]["digest"] if lines else _START,
    }
    return line | {"digest": _digest(line)}


def _check_limits(
    lines: list[dict[str, Any]], ledger: Path, submitter: str, step: float, per_day: int | None
) -> None:
    if lines and lines[0]["step"] != step:
        raise InvalidInputError(
            f"{ledger}: began with the step {lines[0]['step']}, found {step}; keep the step: "
            "a smaller one later tells what the ledger was to hide"
        )
    today = datetime.datetime.now(datetime.UTC).date().isoformat()
    mine = [line for line in lines if _who(line["submitter"]) == _who(submitter)]
    own = [line for line in mine if line["at"][:10] == today]
    if per_day is not None and len(own) >= per_day:
        raise InvalidInputError(
            f"{submitter}: has had {len(own)} of {per_day} submissions today (UTC); "
            "come again tomorrow"
        )


def _who(submitter: str) -> str:
    """Return what names of one submitter share, however their letters and spaces are typed."""
    return " ".join(unicodedata.normalize("NFKC", submitter).casefold().split())


def _rounded(score: float, step: float) -> float:
    return min(round(round(score / step) * step, 9), 1.0)  # 1 need not be a multiple of the step


def _text_of(line: Mapping[str, Any]) -> str:
    return json.dumps(line, ensure_ascii=False)


def _digest(line: Mapping[str, Any]) -> str:
    said = {name: value for name, value in line.items() if name != "digest"}
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()
