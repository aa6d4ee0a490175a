"""What is in a data set, counted in one pass over its scans."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from semantic2d_dataset.access.features import Moments, Statistics, features_of
from semantic2d_dataset.access.registry import OpenDataset
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.manifest import SequenceEntry
from semantic2d_dataset.format.schema import CHUNK_ROWS
from semantic2d_dataset.format.sequence import SequenceHeader, SequenceReader
from semantic2d_dataset.format.splits import TEST, TRAIN, VAL, SplitScheme
from semantic2d_dataset.publishing.percentiles import Percentiles
from semantic2d_dataset.scene.lidars import LidarSpec
from semantic2d_dataset.scene.scans import ScanBatch
from semantic2d_dataset.scene.taxonomy import Taxonomy

SPLITS = {"train": TRAIN, "val": VAL, "test": TEST}
_BLOCK = 8 * CHUNK_ROWS

Counts = NDArray[np.int64]


@dataclass(frozen=True)
class SequenceFacts:
    """What one sequence holds.

    Parameters
    ----------
    entry
        Its entry in the manifest.
    header
        What is said of it.
    stamps_ns
        (N,) i8.
    returns
        Beams with a return.
    counts
        (C,) i8: labelled beams with a return by class id.
    accepted
        Scans whose alignment was accepted; None where none was aligned.
    """

    entry: SequenceEntry
    header: SequenceHeader
    stamps_ns: NDArray[np.int64]
    returns: int
    counts: Counts
    accepted: int | None

    @property
    def seconds(self) -> float:
        """Time from the first scan to the last."""
        return float(self.stamps_ns[-1] - self.stamps_ns[0]) / 1e9 if len(self.stamps_ns) else 0.0

    @property
    def beams(self) -> int:
        """Beams of all scans, with and without a return."""
        return self.entry.scans * self.header.lidar.beams


@dataclass(frozen=True)
class LidarFacts:
    """What all sequences of one lidar hold.

    Parameters
    ----------
    lidar
        The sensor.
    sequences
        What each holds.
    ranges, intensities
        Of the beams with a return; no intensities where a sequence has none.
    features
        Letters of the features that `moments` are of.
    moments
        Means and deviations over the train split, by scheme.
    scans, counts
        Scans and (C,) i8 labelled beams with a return, by scheme and split.
    """

    lidar: LidarSpec
    sequences: Sequence[SequenceFacts]
    ranges: Percentiles
    intensities: Percentiles
    features: str
    moments: Mapping[str, Statistics]
    scans: Mapping[tuple[str, str], int]
    counts: Mapping[tuple[str, str], Counts]


@dataclass(frozen=True)
class Facts:
    """What a data set holds.

    Parameters
    ----------
    data
        The data set.
    taxonomy
        Its classes.
    schemes
        How it is divided, by name.
    lidars
        By name.
    """

    data: OpenDataset
    taxonomy: Taxonomy
    schemes: Mapping[str, SplitScheme]
    lidars: Mapping[str, LidarFacts]

    @property
    def sequences(self) -> list[SequenceFacts]:
        """Every sequence, by id."""
        found = (each for lidar in self.lidars.values() for each in lidar.sequences)
        return sorted(found, key=lambda each: each.entry.id)

    @property
    def seconds(self) -> float:
        """Time that was recorded; lidars that recorded together count once."""
        longest: dict[tuple[str, str], float] = {}
        for each in self.sequences:
            key = (each.entry.environment, each.entry.recording)
            longest[key] = max(longest.get(key, 0.0), each.seconds)
        return sum(longest.values())


def gather_facts(data: OpenDataset) -> Facts:
    """Count what a data set holds; every scan is read once.

    Raises
    ------
    InvalidInputError
        If its sequences have several taxonomies, or lidars of one name that differ.
    CorruptFileError, ChecksumError, DatasetNotFoundError
        If a file is damaged, changed or missing.
    """
    schemes = {name: data.scheme(name) for name in sorted(data.manifest.splits)}
    taxonomy: Taxonomy | None = None
    meters: dict[str, _Meter] = {}
    with tqdm(
        total=sum(data.manifest.lengths.values()),
        desc="counting",
        unit="scan",
        disable=None,
        leave=False,
    ) as bar:
        for entry in data.manifest.sequences:
            with data.reader(entry.id) as reader:
                taxonomy = taxonomy or reader.header.taxonomy
                if reader.header.taxonomy != taxonomy:
                    raise InvalidInputError(
                        f"{reader.path}: expected the classes {', '.join(taxonomy.names)} of the "
                        f"other sequences, found {', '.join(reader.header.taxonomy.names)}; "
                        "a data set has one taxonomy"
                    )
                if entry.lidar not in meters:
                    meters[entry.lidar] = _Meter(reader.lidar, _letters(data, entry.lidar))
                meters[entry.lidar].add(entry, reader, schemes, bar)
    if taxonomy is None:
        raise InvalidInputError(f"{data.root}: has no sequence")
    return Facts(data, taxonomy, schemes, {name: meters[name].facts() for name in sorted(meters)})


def _letters(data: OpenDataset, lidar: str) -> str:
    """Return the features that every sequence of a lidar allows."""
    for entry in data.sequences(lidar):
        with data.reader(entry.id) as reader:
            if "scans/intensities" not in reader:
                return "RPA"
    return "RIPA"


@dataclass
class _Meter:
    """Counts the sequences of one lidar."""

    lidar: LidarSpec
    letters: str
    sequences: list[SequenceFacts] = field(default_factory=list)
    ranges: Percentiles = field(default_factory=Percentiles)
    intensities: Percentiles = field(default_factory=Percentiles)
    moments: dict[str, Moments] = field(default_factory=dict)
    scans: Counter[tuple[str, str]] = field(default_factory=Counter)
    counts: dict[tuple[str, str], Counts] = field(default_factory=dict)

    def add(
        self,
        entry: SequenceEntry,
        reader: SequenceReader,
        schemes: Mapping[str, SplitScheme],
        bar: Any,
    ) -> None:
        if reader.lidar != self.lidar:
            raise InvalidInputError(
                f"{reader.path}: its lidar is named {self.lidar.name} and is not that of "
                f"{self.sequences[0].entry.file}: expected {self.lidar}, found {reader.lidar}; "
                "give one of them another name"
            )
        classes = len(reader.header.taxonomy)
        total, returns = np.zeros(classes, np.int64), 0
        members = {
            n: s.membership[entry.id] for n, s in schemes.items() if entry.id in s.membership
        }
        for block, start in _blocks(reader):
            valid = block.valid
            returns += int(valid.sum())
            counted = _count(block, valid, classes)
            total += counted.sum(axis=0)
            self._add_values(block, valid)
            rows = slice(start, start + len(block))
            self._add_splits(block, valid, counted, {n: ids[rows] for n, ids in members.items()})
            bar.update(len(block))
        accepted = (
            int((reader.read("alignment/accepted") != 0).sum())
            if "alignment/accepted" in reader
            else None
        )
        stamps = reader.read("scans/stamps_ns")
        self.sequences.append(SequenceFacts(entry, reader.header, stamps, returns, total, accepted))

    def facts(self) -> LidarFacts:
        return LidarFacts(
            self.lidar,
            self.sequences,
            self.ranges,
            self.intensities,
            self.letters,
            {name: moments.compute() for name, moments in self.moments.items()},
            dict(self.scans),
            self.counts,
        )

    def _add_values(self, block: ScanBatch, valid: NDArray[np.bool_]) -> None:
        self.ranges.update(block.ranges[valid])
        if block.intensities is not None:
            values = block.intensities[valid]
            self.intensities.update(values[np.isfinite(values)])

    def _add_splits(
        self,
        block: ScanBatch,
        valid: NDArray[np.bool_],
        counted: Counts,
        members: Mapping[str, NDArray[np.uint8]],
    ) -> None:
        wanted = np.zeros(len(block), np.bool_)
        for scheme, ids in members.items():
            wanted |= ids == TRAIN
            for split, number in SPLITS.items():
                chosen, key = ids == number, (scheme, split)
                self.scans[key] += int(chosen.sum())
                self.counts[key] = self.counts.get(key, 0) + counted[chosen].sum(axis=0)
        rows = np.flatnonzero(wanted)
        if not rows.size:
            return
        raw = features_of(block.ranges, block.intensities, self.lidar, self.letters, rows=rows)
        for scheme, ids in members.items():
            chosen = ids[rows] == TRAIN
            if chosen.any():
                moments = self.moments.setdefault(scheme, Moments())
                moments.update(raw[chosen], valid[rows[chosen]])


def _blocks(reader: SequenceReader) -> Iterator[tuple[ScanBatch, int]]:
    for start in range(0, len(reader), _BLOCK):
        yield reader.batch(start, start + _BLOCK), start


def _count(block: ScanBatch, valid: NDArray[np.bool_], classes: int) -> Counts:
    """Count the labelled beams with a return of each scan by class, (n, C) i8."""
    if block.labels is None:
        return np.zeros((len(block), classes), np.int64)
    scans, beams = np.nonzero(valid & (block.labels < classes))
    keys = scans * classes + block.labels[scans, beams]
    return np.bincount(keys, minlength=len(block) * classes).reshape(len(block), classes)
