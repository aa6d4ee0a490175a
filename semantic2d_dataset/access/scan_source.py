"""The scans of one lidar in one split, from memory or streamed by whole chunks."""

from __future__ import annotations

import contextlib
import copy
import itertools
import os
from collections.abc import Collection, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from semantic2d_dataset.access.chunk_cache import ChunkCache
from semantic2d_dataset.access.class_counts import count_classes
from semantic2d_dataset.access.features import Moments, Statistics, features_of
from semantic2d_dataset.access.registry import OpenDataset
from semantic2d_dataset.errors import CorruptFileError, DatasetNotFoundError
from semantic2d_dataset.format.schema import CHUNK_ROWS
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.format.splits import SplitScheme
from semantic2d_dataset.scene.taxonomy import UNLABELLED

Fields = Mapping[str, NDArray[Any]]

_STATISTICS_SCANS = 20_000
_MEMORY_SHARE = 0.5
_MAX_ROWS = 1 << 40  # more than a sequence can have
_CONTROL_GROUP = Path("/sys/fs/cgroup")


class ScanSource:
    """Reads fields of scans by their number in a split.

    Parameters
    ----------
    data
        An open data set.
    lidar
        Id or short name of the lidar.
    split
        ``train``, ``val`` (or ``dev``), ``test``; None takes every scan.
    scheme
        How the data set is divided.
    in_memory
        Keep everything in memory; where not given, when it fits in half of what is free.

    Raises
    ------
    DatasetNotFoundError, InvalidInputError
        If the lidar, split or scheme is unknown, or the split is empty.
    CorruptFileError
        If a file is damaged, or sequences of the lidar differ in their geometry.
    """

    def __init__(
        self,
        data: OpenDataset,
        *,
        lidar: str,
        split: str | None,
        scheme: str,
        in_memory: bool | None = None,
    ) -> None:
        self.data, self.scheme = data, scheme
        self._readers = [data.reader(entry.id) for entry in data.sequences(lidar)]
        header = self._readers[0].header
        self.lidar, self.taxonomy = header.lidar, header.taxonomy
        self._check_alike()
        self.has_intensities = all("scans/intensities" in reader for reader in self._readers)
        self._chunks = ChunkCache()
        self._choose(split)
        self._keep(in_memory=in_memory)

    def __len__(self) -> int:
        return int(self._starts[-1])

    def __getstate__(self) -> dict[str, Any]:
        """Pickle without data: a process started by spawn reads its own."""
        large = ("_memory", "scan_ids", "scan_class_counts")
        return {key: value for key, value in self.__dict__.items() if key not in large}

    def of_split(self, split: str | None) -> Self:
        """Return the scans of another split, streamed from the same open files.

        Raises
        ------
        DatasetNotFoundError, InvalidInputError
            If the split is unknown or empty.
        """
        other = copy.copy(self)
        other.in_memory = False
        other._choose(split)  # noqa: SLF001 - a copy of this one
        return other

    def fetch(
        self, wanted: NDArray[np.int64], names: Collection[str] | None = None
    ) -> tuple[Fields, NDArray[np.int64]]:
        """Return arrays and the rows in them that hold the wanted scans.

        Fields are ``ranges`` (N, B) f4, ``intensities`` (N, B) f4 where the lidar gives them,
        ``labels`` (N, B) u1 and ``poses`` (N, 3) f8.

        Parameters
        ----------
        wanted
            (n,) i8, numbers of scans in the split.
        names
            Fields that are needed, if not all are: no others are read.
        """
        if self.in_memory:
            return self._memory, wanted
        chosen = [name for name in self.fields if names is None or name in names]
        return self._gather(wanted, chosen), np.arange(len(wanted))

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the fields there are."""
        return ("ranges", "poses", "labels") + ("intensities",) * self.has_intensities

    def places_of(self, numbers: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the sequence, counted from 0, and the index in it of scans of the split."""
        return np.searchsorted(self._starts, numbers, side="right") - 1, self._all_rows[numbers]

    def numbers_at(
        self, sequences: NDArray[np.int64], rows: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        """Return the number in the split of the scans at some places, -1 where it has no such."""
        keys = sequences * _MAX_ROWS + rows
        found = np.minimum(np.searchsorted(self._keys, keys), len(self) - 1)
        return np.where(self._keys[found] == keys, found, -1)

    def read_stamps(self) -> list[NDArray[np.int64]]:
        """Read the stamps of every scan of every sequence, of any split, (N,) i8 each."""
        return [reader.read("scans/stamps_ns") for reader in self._readers]

    @cached_property
    def scan_ids(self) -> NDArray[np.object_]:
        """Id of every scan, (N,) str."""
        names = (reader.header.sequence_id for reader in self._readers)
        pairs = zip(names, self._rows, strict=True)
        return np.array([f"{name}/{row}" for name, rows in pairs for row in rows], np.object_)

    def chunk_runs(self, chunks: int = 1) -> list[range]:
        """Return the runs of scans that lie in one chunk of one file, or in so many neighbours."""
        runs = []
        for start, rows in zip(self._starts[:-1], self._rows, strict=True):
            numbers = rows // (chunks * CHUNK_ROWS)
            borders = np.flatnonzero(np.diff(numbers, prepend=-1, append=-1))
            runs += [range(start + int(a), start + int(b)) for a, b in itertools.pairwise(borders)]
        return runs

    def compute_statistics(self, which: str) -> Statistics:
        """Compute mean and standard deviation of feature channels over beams with a return.

        Of a split of more than 20,000 scans, whole chunks are read, evenly spaced, that hold
        about as many.
        """
        step = -(-len(self) // _STATISTICS_SCANS)
        moments = Moments()
        names = {"ranges", "intensities"} if "I" in which else {"ranges"}
        for run in self.chunk_runs()[::step]:
            fields, rows = self.fetch(np.arange(run.start, run.stop), names)
            ranges = fields["ranges"]
            raw = features_of(ranges, fields.get("intensities"), self.lidar, which, rows=rows)
            moments.update(raw, self.lidar.has_return(ranges[rows]))
        return moments.compute()

    @cached_property
    def scan_class_counts(self) -> NDArray[np.int32]:
        """Labelled beams with a return of each scan by class id, (N, K) i4; reads every chunk."""
        counts = np.empty((len(self), len(self.taxonomy)), np.int32)
        bar = tqdm(self.chunk_runs(), desc="counting classes", disable=None, leave=False, delay=2)
        for run in bar:
            fields, rows = self.fetch(np.arange(run.start, run.stop), {"ranges", "labels"})
            ranges, labels = fields["ranges"][rows], fields["labels"][rows]
            found, _ = count_classes(ranges, labels, self.lidar, len(self.taxonomy))
            counts[run.start : run.stop] = found
        return counts

    def class_counts(self) -> NDArray[np.int64]:
        """Count the labelled beams with a return by class id, (C,) i8."""
        total: NDArray[np.int64] = self.scan_class_counts.sum(axis=0, dtype=np.int64)
        return total

    def _keep(self, *, in_memory: bool | None) -> None:
        self.in_memory = self._fits() if in_memory is None else in_memory
        if self.in_memory:
            self._memory  # noqa: B018 - read now, so that workers started by fork share it

    def _choose(self, split: str | None) -> None:
        """Take the scans of a split."""
        self.split = split
        self._rows = [self._members(reader) for reader in self._readers]
        self._all_rows = np.concatenate(self._rows)
        self._starts = np.cumsum([0, *map(len, self._rows)]).tolist()
        if not len(self):
            others = ", ".join(self.data.lidars_of(self.scheme, split)) if split else ""
            raise DatasetNotFoundError(
                f"{self.data.manifest.name}: {self.lidar.name} has no scan in the split "
                f"{split!r} of the scheme {self.scheme!r}"
                + (f"; that split has scans of {others}" if others else "")
            )
        sequences = np.repeat(np.arange(len(self._rows)), [len(rows) for rows in self._rows])
        self._keys = sequences * _MAX_ROWS + self._all_rows

    @cached_property
    def _memory(self) -> Fields:
        bar = tqdm(
            zip(self._readers, self._rows, strict=True),
            total=len(self._rows),
            desc=f"reading {self.split or 'scans'}",
            unit="file",
            disable=None,
            leave=False,
        )
        kept: dict[str, NDArray[Any]] = {}
        start = 0
        for reader, rows in bar:
            for name in self.fields:
                values = self._read(reader, name, 0, None)
                if name not in kept:
                    kept[name] = np.empty((len(self), *values.shape[1:]), values.dtype)
                kept[name][start : start + len(rows)] = values[rows]
            start += len(rows)
        return kept

    def _gather(self, wanted: NDArray[np.int64], names: list[str]) -> Fields:
        """Collect scans from whole chunks, each read once."""
        if not wanted.size:
            return {name: values[:0] for name, values in self._chunk(0, 0, names).items()}
        numbers, rows = self.places_of(wanted)
        keys = numbers * _MAX_ROWS + rows // CHUNK_ROWS
        order = np.argsort(keys, kind="stable")
        groups = np.split(order, np.flatnonzero(np.diff(keys[order])) + 1)
        parts = []
        for group in groups:
            number, chunk = int(numbers[group[0]]), int(rows[group[0]] // CHUNK_ROWS)
            local = rows[group] - chunk * CHUNK_ROWS
            parts.append({n: v[local] for n, v in self._chunk(number, chunk, names).items()})
        back = np.argsort(order)
        return {n: np.concatenate([part[n] for part in parts])[back] for n in names}

    def _chunk(self, number: int, chunk: int, names: list[str]) -> Fields:
        kept = self._chunks.take(number, chunk)
        start = chunk * CHUNK_ROWS
        for name in names:
            if name not in kept:
                kept[name] = self._read(self._readers[number], name, start, start + CHUNK_ROWS)
        return {name: kept[name] for name in names}

    def _read(
        self, reader: SequenceReader, name: str, start: int, stop: int | None
    ) -> NDArray[Any]:
        if name == "poses":
            return reader.read_poses(start, stop)
        if name == "labels" and "scans/labels" not in reader:
            rows = len(range(*slice(start, stop).indices(len(reader))))
            return np.full((rows, reader.lidar.beams), UNLABELLED, np.uint8)
        return reader.read(f"scans/{name}", start, stop)

    def _members(self, reader: SequenceReader) -> NDArray[np.int64]:
        if self.split is None:
            return np.arange(len(reader))
        return self._membership.scans_of(reader.header.sequence_id, self.split)

    @cached_property
    def _membership(self) -> SplitScheme:
        return self.data.scheme(self.scheme)

    def _check_alike(self) -> None:
        for reader in self._readers:
            if (reader.lidar, reader.header.taxonomy) != (self.lidar, self.taxonomy):
                raise CorruptFileError(
                    f"{reader.path}: its lidar or taxonomy differs from that of "
                    f"{self._readers[0].path}, though both are named {self.lidar.name}"
                )

    def _fits(self) -> bool:
        bytes_a_scan = self.lidar.beams * (9 if self.has_intensities else 5) + 24
        return len(self) * bytes_a_scan < _MEMORY_SHARE * _available_bytes()


def _available_bytes() -> int:
    """Memory that a process may still take: what the kernel tells, within a container's limit."""
    return min(_free_bytes(), *_container_limits())


def _container_limits() -> list[int]:
    """Limits that a control group sets, bytes; a huge one where there is none."""
    found = [1 << 62]
    for name in ("memory.max", "memory/memory.limit_in_bytes"):
        with contextlib.suppress(OSError, ValueError):
            found.append(int((_CONTROL_GROUP / name).read_text(encoding="ascii")))
    return found


def _free_bytes() -> int:
    try:
        with open("/proc/meminfo", encoding="ascii") as lines:  # noqa: PTH123 - not a file of ours
            found = dict(line.split(":", 1) for line in lines)
        return int(found["MemAvailable"].split()[0]) * 1024
    except (OSError, KeyError, ValueError):
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2
