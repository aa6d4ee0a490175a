"""Several trainings of one method as one entry: what is kept of each, and which one is shown.

A method is ranked by its mean over the trainings. The confusion matrix, the conditions and the
samples are those of one of them: the one with the median mIoU, the lower of two, so that nobody
gains by the order in which files are given.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from leaderboard.figures import Problem, differences, recount
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.taxonomy import Taxonomy
from semantic2d_dataset.scoring.metrics import Evaluator
from semantic2d_dataset.scoring.spreads import spread, spread_of_seeds


def summarise(
    results: Sequence[Mapping[str, Any]], urls: Sequence[str] = ()
) -> tuple[Mapping[str, Any], dict[str, Any]]:
    """Return the result that is shown, and what an entry says of all of them.

    Parameters
    ----------
    results
        Of `score_predictions`, one for each training; their order does not matter.
    urls
        Where the predictions of each are, in the same order; empty if nowhere.

    Returns
    -------
    result
        The one with the median mIoU.
    seeds
        ``runs``, of each training what `run_of` returns, in the order of their seeds; ``spread``,
        what `spreads.spread` returns, and in ``per_lidar`` the same for each lidar.

    Raises
    ------
    InvalidInputError
        If they are not trainings of one method on one task, or two are the same.
    """
    spread_of_seeds(results)  # refuses other tasks and methods, and a file that is given twice
    places: Sequence[str | None] = urls or [None] * len(results)
    pairs = [(run_of(one, url), one) for one, url in zip(results, places, strict=True)]
    pairs.sort(key=lambda pair: _order(pair[0]))
    runs, ordered = [run for run, _ in pairs], [result for _, result in pairs]
    twins = _twins(runs)
    if twins:
        raise InvalidInputError(
            f"predictions {' and '.join(runs[i]['predictions'][:12] for i in twins[0])} score the "
            "same in every count: they are one training under two names; give each training once"
        )
    shown = _median([result["mIoU"] for result in ordered], runs)
    return ordered[shown], {"runs": runs, "spread": _spread(ordered)}


def run_of(result: Mapping[str, Any], url: str | None) -> dict[str, Any]:
    """Return what an entry says of one training: digest, seeds, address, and scores by lidar."""
    said = result["submission"]
    run = {"predictions": said["digests"]["predictions"], "seeds": said["metadata"].get("seeds")}
    run |= {"url": url, "per_lidar": _without_intervals(result["per_lidar"])}
    return {name: value for name, value in run.items() if value is not None}


def names_of_runs(runs: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    """Return what to call each training: its seeds, where those tell the trainings apart."""
    said = [" ".join(map(str, run.get("seeds", ()))) for run in runs]
    if all(said) and len({*said}) == len(said):
        return tuple(f"seed {seeds}" for seeds in said)
    return tuple(f"training {i + 1}" for i in range(len(runs)))


def find_slips_of_seeds(said: Mapping[str, Any], taxonomy: Taxonomy) -> Iterator[Problem]:
    """Yield every figure of the trainings of an entry that their own counts contradict.

    Parameters
    ----------
    said
        The document; its form was checked, and it has ``seeds``.
    taxonomy
        Its classes.
    """
    runs = said["seeds"]["runs"]
    yield from _check_digests(runs)
    slips = [
        slip
        for i, run in enumerate(runs)
        for slip in _recount_run(f"seeds.runs[{i}].per_lidar", run, said, taxonomy)
    ]
    yield from slips
    if any(field.endswith((".confusion", ".per_lidar")) for field, _ in slips):
        return  # there are no counts to go on with
    for i, run in enumerate(runs):
        yield from _compare_truth(f"seeds.runs[{i}].per_lidar", run, said["result"])
    for i, j in _twins(runs):
        yield f"seeds.runs[{j}].per_lidar", f"has the very counts of seeds.runs[{i}]"
    results = [_scores_of(run, taxonomy) for run in runs]
    yield from differences(_spread(results), said["seeds"]["spread"], "seeds.spread")
    shown = _median([result["mIoU"] for result in results], runs)
    digest = runs[shown]["predictions"]
    if digest != said["digests"]["predictions"]:
        yield "digests.predictions", f"expected {digest}, the seed with the median mIoU"
    else:
        path = f"seeds.runs[{shown}].per_lidar"
        expected = _without_intervals(said["result"]["per_lidar"])
        yield from differences(expected, runs[shown]["per_lidar"], path)


def _without_intervals(per_lidar: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return the scores that follow from counts: a row of seeds shows their deviation instead."""
    return {
        lidar: {name: value for name, value in scores.items() if name != "intervals"}
        for lidar, scores in per_lidar.items()
    }


def _order(run: Mapping[str, Any]) -> tuple[list[int], str]:
    return run.get("seeds", []), run["predictions"]


def _median(means: Sequence[float | None], runs: Sequence[Mapping[str, Any]]) -> int:
    """Return which training has the median mIoU, the lower of two; one without is lowest."""

    def order(i: int) -> tuple[float, str]:
        mean = means[i]
        return -1.0 if mean is None else mean, runs[i]["predictions"]

    return sorted(range(len(runs)), key=order)[(len(runs) - 1) // 2]


def _spread(results: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    by_lidar = {
        lidar: spread([result["per_lidar"][lidar] for result in results])
        for lidar in sorted(results[0]["per_lidar"])
    }
    return spread(results) | {"per_lidar": by_lidar}


def _scores_of(run: Mapping[str, Any], taxonomy: Taxonomy) -> dict[str, Any]:
    """Return the scores of a training over all lidars and by lidar, from its counts alone."""
    total, by_lidar = Evaluator(taxonomy), {}
    for lidar, scores in run["per_lidar"].items():
        evaluator = Evaluator(taxonomy)
        evaluator.confusion += np.array(scores["confusion"], np.int64)
        total.merge(evaluator)
        by_lidar[lidar] = evaluator.compute()
    return total.compute() | {"per_lidar": by_lidar}


def _check_digests(runs: Sequence[Mapping[str, Any]]) -> Iterator[Problem]:
    digests = [run["predictions"] for run in runs]
    for i, digest in enumerate(digests):
        if digests.count(digest) > 1:
            yield f"seeds.runs[{i}].predictions", "two of the seeds have the same predictions"
    if sorted(runs, key=_order) != runs:
        yield "seeds.runs", "expected in the order of their seeds and digests"


def _recount_run(
    path: str, run: Mapping[str, Any], said: Mapping[str, Any], taxonomy: Taxonomy
) -> Iterator[Problem]:
    expected, found = (", ".join(sorted(x)) for x in (said["track"]["lidars"], run["per_lidar"]))
    if expected != found:
        yield path, f"expected {expected}, found {found}"
        return
    for lidar, scores in run["per_lidar"].items():
        yield from recount(f"{path}.{lidar}", scores, taxonomy)


def _compare_truth(
    path: str, run: Mapping[str, Any], result: Mapping[str, Any]
) -> Iterator[Problem]:
    """Compare what does not depend on a training: the points of every class, and those ignored."""
    for lidar, scores in run["per_lidar"].items():
        shown = result["per_lidar"].get(lidar)
        if shown is None:
            continue  # said of the result itself
        points, expected = (list(map(sum, s["confusion"])) for s in (scores, shown))
        where = f"{path}.{lidar}"
        for field, what in differences(expected, points, f"{where}.confusion"):
            yield field, f"{what} points: the truth is not that of the result"
        yield from differences(shown["ignored"], scores["ignored"], f"{where}.ignored")


def _twins(runs: Sequence[Mapping[str, Any]]) -> list[tuple[int, int]]:
    """Return pairs of trainings with equal counts: one file, packed twice, has two digests."""
    first: dict[str, int] = {}
    found = []
    for i, run in enumerate(runs):
        counts = {lidar: scores["confusion"] for lidar, scores in run["per_lidar"].items()}
        earlier = first.setdefault(json.dumps(counts, sort_keys=True), i)
        if earlier != i:
            found.append((earlier, i))
    return found
