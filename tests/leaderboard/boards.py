"""Predictions and entries for tests, made from a small data set."""

import copy
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from leaderboard.adding import add_entry, make_entry, make_entry_of_seeds
from leaderboard.at_hand import AtHand
from leaderboard.checking import WRONG, check_entry
from leaderboard.entries import seal, to_json
from semantic2d_dataset.access.registry import open_dataset
from semantic2d_dataset.scoring.predictions import PredictionsWriter

DERIVED = ("conditions", "intervals", "calibration", "samples")
"""Parts of a result that do not follow from its confusion matrix."""


def write_predictions(path: Path, folder: Path, *, right=0.5, seed=0, **metadata) -> Path:
    """Write predictions of the test split of `block` of which a share is right."""
    data = open_dataset(folder)
    scheme = data.scheme("block")
    taxonomy = data.reader(data.manifest.sequences[0].id).header.taxonomy
    rng = np.random.default_rng(seed)
    with PredictionsWriter(
        path,
        dataset=data.manifest.name,
        dataset_version=data.manifest.version,
        scheme="block",
        split="test",
        taxonomy=taxonomy,
        metadata={"method": "Guess"} | metadata,
    ) as writer:
        for entry in data.manifest.sequences:
            indices = scheme.scans_of(entry.id, "test")
            truth = data.reader(entry.id).read("scans/labels")[indices]
            noise = rng.integers(0, len(taxonomy), truth.shape).astype(np.uint8)
            kept = (rng.random(truth.shape) < right) & (truth != 255)
            writer.add(entry.id, indices, np.where(kept, truth, noise))
    return path


def add(predictions: Path, folder: Path, entries: Path, **options) -> Path:
    return add_entry(make_entry(predictions, open_dataset(folder), **options), entries)


def add_seeds(predictions: Iterable[Path], folder: Path, entries: Path, **options) -> Path:
    entry = make_entry_of_seeds(list(predictions), open_dataset(folder), **options)
    return add_entry(entry, entries)


def leaves_of(value: Any, path: tuple = ()) -> Iterator[tuple]:
    """Yield the way to every value that holds no other."""
    if not isinstance(value, dict | list):
        yield path
        return
    inner = value.items() if isinstance(value, dict) else enumerate(value)
    for key, each in inner:
        yield from leaves_of(each, (*path, key))


def edited(said: dict, path: tuple) -> dict:
    """Return a document with one value changed into another of its kind."""
    changed = copy.deepcopy(said)
    owner = changed
    for key in path[:-1]:
        owner = owner[key]
    value = owner[path[-1]]
    if isinstance(value, str):
        last = "0" if value[-1] != "0" else "1"
        owner[path[-1]] = value[:-1] + last
    elif isinstance(value, int):
        owner[path[-1]] = value + 1 if value < 200 else value - 1
    elif value is None:
        owner[path[-1]] = 0.5
    else:
        owner[path[-1]] = value * 0.999 if value else 0.001
    return changed


def json_path(path: tuple) -> str:
    parts = (f"[{key}]" if isinstance(key, int) else f".{key}" for key in path)
    return "".join(parts).removeprefix(".")


def assert_every_edit_is_named(path: Path, said: dict, leaves: Iterable[tuple]) -> None:
    """Edit one value after another, and let the entry alone be checked."""
    for leaf in leaves:
        path.write_text(to_json(edited(said, leaf)))
        found = check_entry(path, AtHand())
        assert found.status == WRONG, leaf
        where = leaf[1] if leaf[0] == "seals" else json_path(leaf)
        named = [name for name, _ in found.problems]
        assert any(where.startswith(name) or name == "the file" for name in named), (leaf, named)


def with_extras(said: dict) -> dict:
    """Return an entry with the parts that a result may have, plausible in form."""
    names = said["taxonomy"]["names"]
    result = copy.deepcopy(said["result"])
    points = result["points"] // 3

    def band(share, count):
        figures = dict.fromkeys(names, share)
        means = {"mIoU": share, "mCA": share, "mCA_tn": share}
        return means | {"iou": figures, "ca": figures, "points": count}

    rest = result["points"] - 2 * points
    parts = {"0-1": band(0.5, points), "1-2": band(0.75, points), "2 and more": band(0.25, rest)}
    result["conditions"] = dict.fromkeys(("range_m", "incidence_deg", "motion"), parts)
    low, high = (lambda v: max(0.0, v - 0.05)), (lambda v: min(1.0, v + 0.05))
    result["intervals"] = {
        "level": 0.95,
        "blocks": 6,
        "mIoU": [low(result["mIoU"]), high(result["mIoU"])],
        "mCA": None,
        "classes": {
            n: None if result[n]["iou"] is None else [low(result[n]["iou"]), high(result[n]["iou"])]
            for n in names
        },
    }
    bins = [{"points": 5, "confidence": c / 10, "accuracy": c / 12} for c in range(1, 10)]
    result["calibration"] = {"points": 45, "ece": 0.1, "mce": 0.2, "aurc": None}
    result["calibration"]["confidence_bins"] = [
        *bins,
        {"points": 0, "confidence": None, "accuracy": None},
    ]
    spread = {"mean": 0.5, "std": 0.01}
    result["samples"] = {"count": 32, "mIoU": spread, "mCA": spread}
    return seal(said | {"result": result})
