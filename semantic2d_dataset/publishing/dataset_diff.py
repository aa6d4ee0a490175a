"""``semantic2d diff``: what changed from one version of a data set to another."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from tqdm import tqdm

from semantic2d_dataset.access.registry import OpenDataset
from semantic2d_dataset.format.manifest import find_file
from semantic2d_dataset.format.splits import NONE, TEST, TRAIN, VAL
from semantic2d_dataset.publishing.sequence_diff import (
    SequenceDiff,
    count_classes,
    diff_sequences,
)
from semantic2d_dataset.publishing.versions import (
    Change,
    Difference,
    change_of,
    compare,
    next_version,
)

_SPLITS = {TRAIN: "train", VAL: "val", TEST: "test", NONE: "none"}
_MOST_PAIRS = 8

Moves = Mapping[tuple[str, str], int]


@dataclass(frozen=True)
class DatasetDiff:
    """What changed.

    Parameters
    ----------
    old, new
        Name and version of both.
    differences
        What differs, and how much that changes.
    sequences
        Sequences that both have, with other data.
    moved
        Scans that both have and that moved, by scheme and by old and new split.
    classes_before, classes_after
        Labelled beams with a return by class, in the sequences that differ, are gone or new.
    version
        The number that the change calls for.
    """

    old: str
    new: str
    differences: tuple[Difference, ...]
    sequences: tuple[SequenceDiff, ...]
    moved: Mapping[str, Moves]
    classes_before: Mapping[str, int]
    classes_after: Mapping[str, int]
    version: str

    @property
    def change(self) -> Change:
        """The largest change."""
        return change_of([*self.differences])

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "old": self.old,
            "new": self.new,
            "change": self.change.name,
            "calls_for_version": self.version,
            "differences": [
                {"change": each.change.name, "what": each.text} for each in self.differences
            ],
            "sequences": [
                {
                    "id": each.id,
                    "differs": list(each.texts),
                    "beams": each.beams,
                    "relabelled": _plain(each.relabelled),
                }
                for each in self.sequences
            ],
            "moved": {name: _plain(moves) for name, moves in self.moved.items()},
            "class_beams": {
                name: [self.classes_before.get(name, 0), self.classes_after.get(name, 0)]
                for name in {**self.classes_before, **self.classes_after}
            },
        }

    def __str__(self) -> str:
        return "\n".join(self._lines())

    def _lines(self) -> Iterator[str]:
        yield f"{self.old} -> {self.new}"
        yield from (f"  {each}" for each in self.differences)
        for each in self.sequences:
            yield f"sequence {each.id}"
            yield from (f"  {text}" for text in each.texts)
            if each.relabelled:
                total = sum(each.relabelled.values())
                share = f"{total / each.beams:.1%}"
                yield f"  scans/labels: {total:,} of {each.beams:,} beams ({share}) differ"
                yield from _table(each.relabelled)
        for name, moves in self.moved.items():
            yield f"scheme {name}: {sum(moves.values()):,} scans moved"
            yield from _table(moves)
        if self.classes_before or self.classes_after:
            yield "labelled beams with a return, in the sequences that differ, are gone or new"
            yield from self._classes()
        if self.change is Change.NONE:
            yield "nothing differs: no new version is needed"
        else:
            yield f"this is a {self.change.name} change: version {self.version}"

    def _classes(self) -> Iterator[str]:
        names = {**self.classes_before, **self.classes_after}
        before, after = (
            max(1, sum(counts.values())) for counts in (self.classes_before, self.classes_after)
        )
        for name in names:
            one, other = self.classes_before.get(name, 0), self.classes_after.get(name, 0)
            yield (
                f"  {name:<12} {one:>12,} ({one / before:>5.1%}) -> {other:>12,} "
                f"({other / after:>5.1%})"
            )


def diff_datasets(old: OpenDataset, new: OpenDataset) -> DatasetDiff:
    """Compare two versions of a data set; sequences of one content digest are not read.

    As the manifests are taken at their word then, files must be there with the sizes they tell.

    Raises
    ------
    DatasetNotFoundError, CorruptFileError, ChecksumError
        If a file is missing, or one that must be read is damaged, or one was changed.
    """
    for data in (old, new):
        for entry in data.manifest.sequences:
            find_file(data.root, entry)
    schemes = [{name: data.scheme(name) for name in data.manifest.splits} for data in (old, new)]
    differences = compare(old.manifest, new.manifest, *schemes)
    digests = [
        {entry.id: entry.content_digest for entry in data.manifest.sequences} for data in (old, new)
    ]
    sequences: list[SequenceDiff] = []
    counts: tuple[Counter[str], Counter[str]] = (Counter(), Counter())
    unequal = sorted({i for i, _ in digests[0].items() ^ digests[1].items()})
    for sequence_id in tqdm(unequal, desc="comparing", unit="file", disable=None, leave=False):
        readers = []
        for data, known, counter in zip((old, new), digests, counts, strict=True):
            if sequence_id in known:
                readers.append(data.reader(sequence_id))
                counter.update(count_classes(readers[-1]))
        if len(readers) == 2:
            sequences.append(diff_sequences(*readers))
        for reader in readers:
            reader.close()
    moved = {
        name: moves
        for name in sorted(schemes[0].keys() & schemes[1].keys())
        if (moves := _moves(schemes[0][name].membership, schemes[1][name].membership))
    }
    return DatasetDiff(
        old=f"{old.manifest.name} {old.manifest.version}",
        new=f"{new.manifest.name} {new.manifest.version}",
        differences=tuple(differences),
        sequences=tuple(sequences),
        moved=moved,
        classes_before=counts[0],
        classes_after=counts[1],
        version=next_version(old.manifest.version, change_of(differences)),
    )


def _moves(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[tuple[str, str], int]:
    """Count scans by old and new split, in sequences of the same length."""
    found: Counter[tuple[str, str]] = Counter()
    for sequence_id in old.keys() & new.keys():
        before, after = old[sequence_id], new[sequence_id]
        if len(before) == len(after):
            pairs, counts = np.unique(np.stack((before, after)), axis=1, return_counts=True)
            for (one, other), count in zip(pairs.T.tolist(), counts.tolist(), strict=True):
                found[_SPLITS[one], _SPLITS[other]] += count
    moved = ((pair, count) for pair, count in found.items() if pair[0] != pair[1])
    return dict(sorted(moved, key=lambda each: (-each[1], each[0])))


def _table(counts: Mapping[tuple[str, str], int]) -> Iterator[str]:
    for (before, after), count in [*counts.items()][:_MOST_PAIRS]:
        yield f"    {before} -> {after}: {count:,}"
    rest = sum([*counts.values()][_MOST_PAIRS:])
    if rest:
        yield f"    others: {rest:,}"


def _plain(counts: Mapping[tuple[str, str], int]) -> list[list[str | int]]:
    return [[before, after, count] for (before, after), count in counts.items()]
