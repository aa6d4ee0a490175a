"""What is left of a score on corrupted test sets.

The clean score is the model's own yardstick: mean corruption error in the manner of Hendrycks and
Dietterich (ICLR 2019), who divide by that of a fixed model instead.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.container import load_json
from semantic2d_dataset.scoring.metrics import percent

_SET = re.compile(r"-(?P<kind>[a-z]+(?:-[a-z]+)*)-(?P<severity>[1-9])(?:-seed[0-9]+)?")
_TASK = ("scheme", "split", "lidars", "evaluator_version")
_MODEL = ("features", "training_data", "parameters", "seeds")  # compared where both say it


def summarise_robustness(clean: Path, corrupted: Iterable[Path]) -> dict[str, Any]:
    """Summarise results on corrupted test sets against the one on the clean set.

    Parameters
    ----------
    clean
        Result that ``semantic2d score --out`` wrote for the test set as it is.
    corrupted
        Those of the same method for sets that ``semantic2d corrupt`` made of it.

    Returns
    -------
    dict
        ``method``; ``clean``, its mIoU; ``kinds``: for each, mIoU by ``severity``, their
        ``mean``, ``retained`` (mean / clean) and ``relative_error`` ((1 - mean) / (1 - clean),
        None where clean is 1); and ``mean``, ``retained`` and ``relative_error`` over kinds.

    Raises
    ------
    FileNotFoundError
        If a file does not exist.
    InvalidInputError
        If a file is no result, of another method or task, not of a set made of the clean one,
        or has no mIoU; or a set comes twice.
    """
    own = _read(clean)
    said = own["submission"]
    base = f"{said['dataset']}-{said['dataset_version']}"
    found: dict[str, dict[int, float]] = {}
    for path in corrupted:
        result = _read(path)
        kind, severity = _set_of(path, result, base)
        _check_alike(path, result["submission"], said)
        if severity in found.setdefault(kind, {}):
            raise InvalidInputError(f"{path}: a result for {kind} {severity} was given already")
        found[kind][severity] = result["mIoU"]
    if not found:
        raise InvalidInputError("expected at least one result for a corrupted set, found none")
    kinds = {kind: _kind(scores, own["mIoU"]) for kind, scores in sorted(found.items())}
    mean = sum(each["mean"] for each in kinds.values()) / len(kinds)
    return {
        "method": said["metadata"]["method"],
        "clean": own["mIoU"],
        "kinds": kinds,
        **_relative(mean, own["mIoU"]),
    }


def format_robustness(said: Mapping[str, Any]) -> str:
    """Lay a summary out as text, in percent."""
    severities = sorted({int(s) for kind in said["kinds"].values() for s in kind["severity"]})
    width = max(len(name) for name in (*said["kinds"], "mean"))
    header = "".join(f"{severity:>8}" for severity in severities)
    lines = [f"{'':{width}}{header}{'mean':>8}{'kept':>8}{'error x':>9}"]
    for name, kind in said["kinds"].items():
        cells = "".join(f"{percent(kind['severity'].get(s)):>8}" for s in severities)
        lines.append(f"{name:{width}}{cells}{_tail(kind)}")
    lines.append(f"{'mean':{width}}{'':{8 * len(severities)}}{_tail(said)}")
    title = f"{said['method']}: mIoU {percent(said['clean'])} without corruption, by severity:"
    return "\n".join((title, *lines))


def _tail(said: Mapping[str, Any]) -> str:
    error = said["relative_error"]
    times = "-" if error is None else f"{error:.2f}"
    return f"{percent(said['mean']):>8}{percent(said['retained']):>8}{times:>9}"


def _kind(scores: Mapping[int, float], clean: float) -> dict[str, Any]:
    mean = sum(scores.values()) / len(scores)
    return {"severity": dict(sorted(scores.items())), **_relative(mean, clean)}


def _relative(mean: float, clean: float) -> dict[str, float | None]:
    return {
        "mean": mean,
        "retained": mean / clean if clean else None,
        "relative_error": (1 - mean) / (1 - clean) if clean < 1 else None,
    }


def _read(path: Path) -> dict[str, Any]:
    try:
        result = load_json(Path(path).read_bytes())
    except InvalidInputError as err:
        raise InvalidInputError(f"{path}: {err}; make it with: semantic2d score --out") from err
    if isinstance(result, dict) and {"spread", "results"} <= {*result}:
        raise InvalidInputError(f"{path}: holds several seeds; score each alone, to compare it")
    try:
        said, score = result["submission"], result["mIoU"]
        known = isinstance(score, float | int) and 0 <= score <= 1
        texts = (said["dataset"], said["dataset_version"], said["metadata"]["method"])
        whole = known and all(isinstance(text, str) for text in texts) and {*_TASK} <= {*said}
    except (KeyError, TypeError) as err:
        raise InvalidInputError(f"{path}: not a result of semantic2d score") from err
    if not whole:
        raise InvalidInputError(f"{path}: not a result of semantic2d score that has an mIoU")
    return dict(result)


def _model_of(metadata: Mapping[str, Any]) -> dict[str, Any]:
    """Return what tells one trained model from another, as far as a file says it."""
    track = metadata.get("track")
    said = {**metadata, **(track if isinstance(track, Mapping) else {})}
    return {name: said[name] for name in ("method", *_MODEL) if name in said}


def _set_of(path: Path, result: Mapping[str, Any], base: str) -> tuple[str, int]:
    name = result["submission"]["dataset"]
    parts = _SET.fullmatch(name.removeprefix(base)) if name.startswith(base) else None
    if parts is None:
        raise InvalidInputError(
            f"{path}: scored on {name!r}, which is no corrupted set of {base}; give the result on "
            "the clean set first, and make the others with: semantic2d corrupt"
        )
    return parts["kind"], int(parts["severity"])


def _check_alike(path: Path, said: Mapping[str, Any], clean: Mapping[str, Any]) -> None:
    pairs = {name: (said[name], clean[name]) for name in _TASK}
    one, other = (_model_of(each["metadata"]) for each in (said, clean))
    pairs |= {name: (one[name], other[name]) for name in one.keys() & other.keys()}
    for name, (found, wanted) in sorted(pairs.items()):
        if found != wanted:
            raise InvalidInputError(
                f"{path}: {name} is {found!r}, but {wanted!r} in the clean result"
            )
