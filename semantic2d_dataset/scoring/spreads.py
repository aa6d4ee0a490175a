"""Mean and standard deviation of scores, over samples of a model or over trainings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scoring.metrics import MEANS, class_names

_FIGURES = ("iou", "ca")
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
    said = [result["submission"] for result in results]
    for each in said[1:]:
        for name in _TASK:
            if each[name] != said[0][name]:
                raise InvalidInputError(
                    f"{name} is {said[0][name]!r} in one file and {each[name]!r} in another; "
                    "only predictions of one task have a spread"
                )
        if each["metadata"]["method"] != said[0]["metadata"]["method"]:
            raise InvalidInputError(
                f"the files are of the methods {said[0]['metadata']['method']!r} and "
                f"{each['metadata']['method']!r}; give several seeds of one method, or compare "
                "two methods with: semantic2d compare"
            )
    digests = [each["digests"]["predictions"] for each in said]
    if len({*digests}) != len(digests):
        raise InvalidInputError("two of the files are the same; give each seed once")
    return spread(results)


def _mean_and_std(figures: list[float | None]) -> dict[str, float] | None:
    there = [figure for figure in figures if figure is not None]
    return {"mean": float(np.mean(there)), "std": float(np.std(there))} if there else None
