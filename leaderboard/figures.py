"""Whether the figures of an entry follow from its own counts.

The confusion matrix gives every mean and every figure by class: they are computed again by the
evaluator itself, and compared one by one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from semantic2d_dataset.scene.taxonomy import Taxonomy
from semantic2d_dataset.scoring.metrics import MEANS, Evaluator

Problem = tuple[str, str]
"""JSON path of a field, and what is wrong with it."""

_MOST_PLACES = 1e-9  # other machines may round the last places of a float otherwise


def find_inconsistencies(said: Mapping[str, Any], taxonomy: Taxonomy) -> Iterator[Problem]:
    """Yield every figure of a scored entry that its own counts contradict.

    Parameters
    ----------
    said
        The document; its form was checked.
    taxonomy
        Its classes.
    """
    result = said["result"]
    if said["digests"]["taxonomy"] != taxonomy.digest:
        yield "digests.taxonomy", f"expected {taxonomy.digest}, the digest of the classes named"
    yield from recount("result", result, taxonomy)
    lidars = sorted(result["per_lidar"])
    if lidars != sorted(said["track"]["lidars"]):
        yield "track.lidars", f"expected {', '.join(lidars)}, which the result is of"
    broken = False
    for lidar in lidars:
        found = list(recount(f"result.per_lidar.{lidar}", result["per_lidar"][lidar], taxonomy))
        broken = broken or any(path.endswith(".confusion") for path, _ in found)
        yield from found
    if not broken:
        yield from _compare_sum(result, taxonomy)
    yield from _check_bands(result, taxonomy)
    yield from _check_intervals("result", result, taxonomy)
    for lidar in lidars:
        path = f"result.per_lidar.{lidar}"
        yield from _check_intervals(path, result["per_lidar"][lidar], taxonomy)


def recount(path: str, scores: Mapping[str, Any], taxonomy: Taxonomy) -> Iterator[Problem]:
    """Yield every score that is not the one which its confusion matrix gives.

    Parameters
    ----------
    path
        JSON path of the scores.
    scores
        As `Evaluator.compute` returns them; they may hold more.
    taxonomy
        Their classes.
    """
    classes, rows = len(taxonomy), scores["confusion"]
    if len(rows) != classes or any(len(row) != classes for row in rows):
        yield f"{path}.confusion", f"expected {classes} rows of {classes} counts"
        return
    evaluator = Evaluator(taxonomy)
    evaluator.confusion = np.array(rows, np.int64)
    evaluator.ignored = scores["ignored"]
    expected = evaluator.compute()
    found = {name: scores[name] for name in expected if name in scores}
    yield from differences(expected, found, path)


def differences(expected: Any, found: Any, path: str) -> Iterator[Problem]:
    """Yield the JSON path of every value that differs from what was expected."""
    if isinstance(expected, Mapping) and isinstance(found, Mapping):
        for name in sorted({*expected, *found}):
            where = f"{path}.{name}"
            if name not in found:
                yield where, "missing"
            elif name not in expected:
                yield where, "expected nothing here"
            else:
                yield from differences(expected[name], found[name], where)
    elif isinstance(expected, list) and isinstance(found, list) and len(expected) == len(found):
        for i, (one, other) in enumerate(zip(expected, found, strict=True)):
            yield from differences(one, other, f"{path}[{i}]")
    elif not _same(expected, found):
        yield path, f"expected {_short(expected)}, found {_short(found)}"


def _compare_sum(result: Mapping[str, Any], taxonomy: Taxonomy) -> Iterator[Problem]:
    """Compare the whole with the sum over the lidars."""
    parts = result["per_lidar"].values()
    if len(result["confusion"]) != len(taxonomy):
        return
    total = np.sum([np.array(part["confusion"], np.int64) for part in parts], axis=0)
    yield from differences(total.tolist(), result["confusion"], "result.confusion")
    ignored = sum(part["ignored"] for part in parts)
    if ignored != result["ignored"]:
        yield "result.ignored", f"expected {ignored}, the sum over the lidars"


def _check_bands(result: Mapping[str, Any], taxonomy: Taxonomy) -> Iterator[Problem]:
    """Compare the means and points of conditions with what their bands hold."""
    scored = [taxonomy.names[c] for c in taxonomy.scored_ids]
    for name, bands in result.get("conditions", {}).items():
        path = f"result.conditions.{name}"
        for label, band in bands.items():
            for mean in ("mIoU", "mCA"):
                figures = [band[MEANS[mean]].get(each) for each in scored]
                there = [figure for figure in figures if figure is not None]
                expected = sum(there) / len(there) if there else None
                yield from differences(expected, band[mean], f"{path}.{label}.{mean}")
        points = sum(band["points"] for band in bands.values())
        if points != result["points"]:
            yield path, f"expected {result['points']} points in its bands, found {points}"


def _check_intervals(path: str, scores: Mapping[str, Any], taxonomy: Taxonomy) -> Iterator[Problem]:
    """Find intervals that are none, or of no class."""
    said = scores.get("intervals", {"classes": {}})
    strange = sorted({*said["classes"]} - {*taxonomy.names})
    if strange:
        yield f"{path}.intervals.classes.{strange[0]}", "expected nothing here"
    limits = {f"classes.{name}": each for name, each in said["classes"].items()}
    limits |= {mean: said[mean] for mean in ("mIoU", "mCA") if mean in said}
    for name, each in limits.items():
        if each is not None and each[0] > each[1]:
            yield f"{path}.intervals.{name}", f"expected the lower limit first, found {each}"


def _same(expected: Any, found: Any) -> bool:
    numbers = all(
        isinstance(value, int | float) and not isinstance(value, bool)
        for value in (expected, found)
    )
    if numbers and isinstance(expected, float):
        return math.isclose(expected, found, rel_tol=_MOST_PLACES, abs_tol=1e-12)
    return type(expected) is type(found) and bool(expected == found)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
