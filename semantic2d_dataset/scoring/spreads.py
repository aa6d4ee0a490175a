"""Mean and standard deviation of scores, over samples of a model or over trainings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scoring.metrics import MEANS, class_names

_FIGURES = ("iou", "ca")
OF_A_TRAINING = ("seeds", "hardware", "scans_per_second", "scans_per_second_measured")
"""Metadata in which the trainings of one method may differ."""

_TASK = ("dataset", "dataset_version", "scheme", "split", "lidars", "scans", "evaluator_version")


def spread(results: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the mean and standard deviation of every score over several results.

    Parameters
    ----------
    results
        As `Evaluator.compute` returns them.

    Returns
    -------
    dict
        ``count``; for each mean, and in ``classes`` for ``iou`` and ``ca`` of each, a dict of
        ``mean`` and ``std`` (of the population, as the published tables have it), fractions;
        None where no result has the score.
    """
    said: dict[str, Any] = {"count": len(results)}
    said |= {mean: _mean_and_std([result[mean] for result in results]) for mean in MEANS}
    said["classes"] = {
        name: {key: _mean_and_std([result[name][key] for result in results]) for key in _FIGURES}
        for name in class_names(results[0])
    }
    return said


def spread_of_seeds(results: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the `spread` over results of one method that was trained several times.

    Raises
    ------
    InvalidInputError
        If they are of different methods or tasks, or two are of the same predictions.
    """
    first, *others = [result["submission"] for result in results]
    for other in others:
        _check_alike({name: (first[name], other[name]) for name in _TASK}, "one task")
        own, its = (shared_metadata(said["metadata"]) for said in (first, other))
        pairs = {f"metadata.{name}": (own.get(name), its.get(name)) for name in {*own, *its}}
        _check_alike(pairs, "one method")
    digests = [result["submission"]["digests"]["predictions"] for result in results]
    if len({*digests}) != len(digests):
        raise InvalidInputError("two of the files are the same; give each seed once")
    return spread(results)


def shared_metadata(metadata: Mapping[str, Any]) -> dict[str, Any]:
    """Return what every training of a method must say alike."""
    return {name: value for name, value in metadata.items() if name not in OF_A_TRAINING}


def _check_alike(pairs: Mapping[str, tuple[Any, Any]], of: str) -> None:
    for name, (one, other) in sorted(pairs.items()):
        if one != other:
            raise InvalidInputError(
                f"{name} is {one!r} in one file and {other!r} in another; only results of {of} "
                "have a spread; put two beside each other with: semantic2d compare"
            )


def _mean_and_std(figures: list[float | None]) -> dict[str, float] | None:
    there = [figure for figure in figures if figure is not None]
    return {"mean": float(np.mean(there)), "std": float(np.std(there))} if there else None
