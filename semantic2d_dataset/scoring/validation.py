"""Why predictions cannot be scored: one validator, for users and for the scorer."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from semantic2d_dataset.errors import CorruptFileError, InvalidInputError, Semantic2DError
from semantic2d_dataset.executors import Executor, Serial
from semantic2d_dataset.format.manifest import Manifest
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.format.splits import SplitScheme
from semantic2d_dataset.scene.taxonomy import Taxonomy
from semantic2d_dataset.scoring.calibration import are_probabilities
from semantic2d_dataset.scoring.predictions import MAX_SAMPLES, PredictionsReader, metadata_problems

_OPTIONAL = ("probabilities", "samples")
_LISTED, _LENGTH = 1000, 500  # problems, and characters of each: a hostile file has millions
_ROWS = 64


class ScoredDataset(Protocol):
    """What scoring needs of a data set; `access.registry.open_dataset` returns one."""

    @property
    def manifest(self) -> Manifest:
        """Name, version and sequences."""

    def scheme(self, name: str) -> SplitScheme:
        """Return which scan is in which split."""

    def reader(self, sequence_id: str) -> SequenceReader:
        """Open a sequence."""


@dataclass(frozen=True)
class Task:
    """What is scored: scan indices, ascending, by sequence id; lidars; and the classes."""

    scheme: SplitScheme
    split: str
    scans: Mapping[str, NDArray[np.int64]]
    lidars: tuple[str, ...]
    taxonomy: Taxonomy

    def share(self, part: tuple[int, int]) -> dict[str, NDArray[np.int64]]:
        """Return the scans of a part: (1, 4) to (4, 4) share the sequences among four.

        Raises
        ------
        InvalidInputError
            If there is no such part, or there are more parts than sequences.
        """
        number, of = part
        if not 1 <= number <= of:
            raise InvalidInputError(f"part {number}/{of}: expected 1/{of} to {of}/{of}")
        if of > len(self.scans):
            raise InvalidInputError(
                f"part {number}/{of}: there are {len(self.scans)} sequences to share; "
                "use no more parts than that"
            )
        return dict(list(self.scans.items())[number - 1 :: of])


def validate(
    predictions: PredictionsReader | Path,
    dataset: ScoredDataset,
    *,
    scheme: str | None = None,
    split: str | None = None,
    part: tuple[int, int] = (1, 1),
    executor: Executor | None = None,
) -> list[str]:
    """List every reason why predictions cannot be scored; the scorer asks this function.

    A file must hold every scan of the split exactly once, for each lidar that it predicts at
    all: models are often made for one lidar. Class probabilities or samples are given for all
    sequences or for none.

    Parameters
    ----------
    predictions
        The file.
    dataset
        The data set that they are for.
    scheme, split
        What to score, where the file does not say; where it does, they must agree.
    part
        Whose arrays to look at, see `Task.share`; the whole file must make sense.
    executor
        Where sequences are checked; this process if not given.

    Returns
    -------
    list of str
        One line for each problem, with its sequence and scan; empty when all is well.

    Raises
    ------
    FileNotFoundError, CorruptFileError, UnsafeFileError, FormatVersionError
        If the file cannot be opened safely, or is damaged.
    """
    if not isinstance(predictions, PredictionsReader):
        with PredictionsReader(predictions) as reader:
            return validate(
                reader, dataset, scheme=scheme, split=split, part=part, executor=executor
            )
    problems = _identity_problems(predictions, dataset.manifest, scheme, split)
    problems += _metadata_of(predictions)
    try:
        task = task_of(predictions, dataset, scheme, split)
    except Semantic2DError as err:
        return _printable([*problems, str(err)])
    if predictions.taxonomy_digest != task.taxonomy.digest:
        problems.append(
            f"taxonomy: expected digest {task.taxonomy.digest}, "
            f"found {predictions.taxonomy_digest or 'none'}; use the class ids of the data set"
        )
    for name in sorted(set(predictions.sequence_ids) - set(task.scans)):
        problems.append(f"{name}: the split has no scan of this sequence; leave it out")
    problems += _optional_problems(predictions, task)
    check = partial(_sequence_problems, predictions.path, dataset, len(task.taxonomy))
    share = task.share(part)
    found = (executor or Serial()).map(check, share.items())
    for each in tqdm(found, "validating", len(share), unit="sequence", disable=None, leave=False):
        problems += each
    return _printable(problems)


def task_of(
    predictions: PredictionsReader,
    dataset: ScoredDataset,
    scheme: str | None = None,
    split: str | None = None,
) -> Task:
    """Find the scans to score: all of the split by the lidars that the predictions are about.

    Raises
    ------
    InvalidInputError
        If there is no such scan, scheme or split, or the sequences use different classes.
    """
    scheme, split = scheme or predictions.scheme, _canonical(split or predictions.split)
    found = dataset.scheme(scheme)
    lidar_of = {entry.id: entry.lidar for entry in dataset.manifest.sequences}
    lidars = {lidar_of[name] for name in predictions.sequence_ids if name in lidar_of}
    scans = {
        name: indices
        for name in sorted(found.membership)
        if lidar_of.get(name) in lidars and (indices := found.scans_of(name, split)).size
    }
    if not scans:
        raise InvalidInputError(
            f"the file predicts no sequence that has scans in split {split!r} of scheme {scheme!r}"
        )
    taxonomies = set()
    for name in scans:
        with dataset.reader(name) as reader:
            taxonomies.add(reader.header.taxonomy)
    if len(taxonomies) != 1:
        raise InvalidInputError(
            f"{dataset.manifest.name}: its sequences use {len(taxonomies)} taxonomies; "
            "only sequences with the same classes can be scored together"
        )
    used = tuple(sorted({lidar_of[name] for name in scans}))
    return Task(found, split, scans, used, taxonomies.pop())


def _printable(problems: list[str]) -> list[str]:
    """Make text that comes from a file safe to print, and not too much of it."""
    cut = (p if len(p) <= _LENGTH else f"{p[:_LENGTH]} ..." for p in problems[:_LISTED])
    kept = ["".join(c if c.isprintable() else "?" for c in line) for line in cut]
    left = len(problems) - len(kept)
    return [*kept, f"and {left} more such problems"] if left else kept


def _metadata_of(predictions: PredictionsReader) -> list[str]:
    try:
        return metadata_problems(predictions.metadata)
    except CorruptFileError as err:
        return [str(err)]


def _identity_problems(
    predictions: PredictionsReader, manifest: Manifest, scheme: str | None, split: str | None
) -> list[str]:
    """Compare what the file says it predicts with what is scored."""
    said = predictions
    versions = [v.split(".")[:2] for v in (manifest.version, said.dataset_version)]
    expected = (
        ("dataset", manifest.name, said.dataset, manifest.name == said.dataset),
        # a PATCH changes only the packaging
        ("dataset_version", manifest.version, said.dataset_version, versions[0] == versions[1]),
        ("scheme", scheme, said.scheme, scheme in (None, said.scheme)),
        ("split", split, said.split, split is None or _canonical(split) == _canonical(said.split)),
    )
    advice = {
        "dataset_version": "; a new MAJOR or MINOR has other scans or splits: score against the "
        "version that was predicted (--data FOLDER), or predict again"
    }
    return [
        f"{name}: expected {want!r}, the file says {found!r}{advice.get(name, '')}"
        for name, want, found, same in expected
        if found and not same
    ]


def _canonical(split: str) -> str:
    return "val" if split == "dev" else split


def _optional_problems(predictions: PredictionsReader, task: Task) -> list[str]:
    """Find optional parts that only some sequences have: figures would be of the easy ones."""
    problems = []
    for part in _OPTIONAL:
        having = [name for name in task.scans if predictions.has(name, part)]
        if having and len(having) < len(task.scans):
            lacking = next(name for name in task.scans if name not in having)
            problems.append(
                f"{lacking}: {part} are missing; {len(having)} of {len(task.scans)} sequences "
                "have them: give them for all or for none"
            )
        if having and part == "samples":
            counts = {name: predictions.shape(name, part)[0] for name in having}
            first = counts[having[0]]
            problems += [
                f"{name}: samples: {count}, but {first} in {having[0]}; draw the same number"
                for name, count in counts.items()
                if count != first
            ]
    return problems


def _sequence_problems(
    path: Path, dataset: ScoredDataset, classes: int, item: tuple[str, NDArray[np.int64]]
) -> list[str]:
    name, indices = item
    with PredictionsReader(path) as predictions, dataset.reader(name) as truth:
        return list(_problems_of(predictions, name, indices, truth.lidar.beams, classes))


def _problems_of(
    predictions: PredictionsReader,
    name: str,
    indices: NDArray[np.int64],
    beams: int,
    classes: int,
) -> Iterator[str]:
    if not (predictions.has(name, "scan_index") and predictions.has(name, "labels")):
        yield f"{name}: missing; expected scan_index and labels of {len(indices)} scans"
        return
    rows = predictions.shape(name, "scan_index")[0]
    if rows > 2 * len(indices) + _ROWS:  # not read: it may be huge
        yield f"{name}: scan_index: expected {len(indices)} scans, found {rows}"
        return
    given = predictions.read(name, "scan_index")
    yield from _index_problems(name, given, indices)
    wanted = {
        "labels": (rows, beams),
        "probabilities": (rows, beams, classes),
        "samples": (None, rows, beams),
    }
    for part, shape in wanted.items():
        if not predictions.has(name, part):
            continue
        found = predictions.shape(name, part)
        if any(want not in (None, length) for want, length in zip(shape, found, strict=True)):
            text = ", ".join("any" if n is None else str(n) for n in shape)
            yield f"{name}: {part}: expected shape ({text}), found {found}"
        elif part == "samples" and not 1 <= found[0] <= MAX_SAMPLES:
            yield f"{name}: samples: expected 1 to {MAX_SAMPLES}, found {found[0]}"
        else:
            yield from _value_problems(predictions, name, part, given, classes)


def _index_problems(name: str, given: NDArray[np.int64], indices: NDArray[np.int64]) -> list[str]:
    unique, counts = np.unique(given, return_counts=True)
    kinds = {
        "missing": np.setdiff1d(indices, unique),
        "not in the split": np.setdiff1d(unique, indices),
        "given more than once": unique[counts > 1],
    }
    return [
        f"{name}/{scans[0]}: scan {kind} ({scans.size} such in this sequence)"
        for kind, scans in kinds.items()
        if scans.size
    ]


def _value_problems(
    predictions: PredictionsReader,
    name: str,
    part: str,
    given: NDArray[np.int64],
    classes: int,
) -> Iterator[str]:
    """Find values outside their domain; name the first, count all."""
    first, count, row = "", 0, 0
    for block in predictions.blocks(name, part):
        wrong = _wrong_values(block, part, classes)
        if wrong.any() and not first:
            where = np.argwhere(wrong)[0].tolist()
            scan = given[where[1] if part == "samples" else row + where[0]]
            beam = where[2] if part == "samples" else where[1]
            held = block[tuple(where)]
            first = f"{name}/{scan}: {part}: beam {beam} holds {_values(held)}"
        count += int(wrong.sum())
        row += len(block)
    domain = (
        "numbers from 0 to 1 that add up to 1"
        if part == "probabilities"
        else f"a class id 0 to {classes - 1}"
    )
    if count:
        yield f"{first}, expected {domain} ({count} such in this sequence)"


def _wrong_values(block: NDArray[Any], part: str, classes: int) -> NDArray[np.bool_]:
    """Tell which labels are no class, or which beams' probabilities are none."""
    if part != "probabilities":
        wrong: NDArray[np.bool_] = block >= classes
        return wrong
    return ~are_probabilities(block)


def _values(held: Any) -> str:
    return str(held.tolist()) if np.ndim(held) else str(held)
