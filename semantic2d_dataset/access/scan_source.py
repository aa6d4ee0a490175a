"""The scans of one lidar in one split, from memory or streamed by whole chunks."""

from __future__ import annotations

import contextlib
import itertools
import os
from collections import OrderedDict
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

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
_CACHED_CHUNKS = 64
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
        self.data, self.split, self.scheme = data, split, scheme
        self._readers = [data.reader(entry.id) for entry in data.sequences(lidar)]
        header = self._readers[0].header
        self.lidar, self.taxonomy = header.lidar, header.taxonomy
        self._check_alike()
        self._rows = [self._members(reader) for reader in self._readers]
        self._all_rows = np.concatenate(self._rows)
        self._starts = np.cumsum([0, *map(len, self._rows)]).tolist()
        if not len(self):
            raise DatasetNotFoundError(
                f"{data.manifest.name}: {self.lidar.name} has no scan in the split {split!r} "
                f"of the scheme {scheme!r}"
            )
        self.has_intensities = all("scans/intensities" in reader for reader in self._readers)
        self.in_memory = self._fits() if in_memory is None else in_memory
        self._chunks: OrderedDict[tuple[int, int], Fields] = OrderedDict()
        if self.in_memory:
            self._memory  # noqa: B018 - read now, so that workers started by fork share it

    def __len__(self) -> int:
        return int(self._starts[-1])

    def __getstate__(self) -> dict[str, Any]:
        """Pickle without data: a process started by spawn reads its own."""
        large = ("_memory", "scan_ids")
        kept = {key: value for key, value in self.__dict__.items() if key not in large}
        return kept | {"_chunks": OrderedDict()}

    def fetch(self, wanted: NDArray[np.int64]) -> tuple[Fields, NDArray[np.int64]]:
        """Return arrays and the rows in them that hold the wanted scans.

        Fields are ``ranges`` (N, B) f4, ``intensities`` (N, B) f4 where the lidar gives them,
        ``labels`` (N, B) u1 and ``poses`` (N, 3) f8.
        """
        if self.in_memory:
            return self._memory, wanted
        return self._gather(wanted), np.arange(len(wanted))

    @cached_property
    def scan_ids(self) -> NDArray[np.object_]:
        """Id of every scan, (N,) str."""
        names = (reader.header.sequence_id for reader in self._readers)
        pairs = zip(names, self._rows, strict=True)
        return np.array([f"{name}/{row}" for name, rows in pairs for row in rows], np.object_)

    def chunk_runs(self) -> list[range]:
        """Return the runs of scans that lie in one chunk of one file."""
        runs = []
        for start, rows in zip(self._starts[:-1], self._rows, strict=True):
            borders = np.flatnonzero(np.diff(rows // CHUNK_ROWS, prepend=-1, append=-1))
            runs += [range(start + int(a), start + int(b)) for a, b in itertools.pairwise(borders)]
        return runs

    def compute_statistics(self, which: str) -> Statistics:
        """Compute mean and standard deviation of feature channels over beams with a return.

        At most 20,000 scans, evenly spaced, are read.
        """
        step = -(-len(self) // _STATISTICS_SCANS)
        moments = Moments()
        for run in self.chunk_runs():
            first = -(-run.start // step) * step
            fields, rows = self.fetch(np.arange(first, run.stop, step))
            ranges = fields["ranges"]
            raw = features_of(ranges, fields.get("intensities"), self.lidar, which, rows=rows)
            moments.update(raw, self.lidar.has_return(ranges[rows]))
        return moments.compute()

    def class_counts(self) -> NDArray[np.int64]:
        """Count the labelled beams with a return by class id, (C,) i8."""
        counts = np.zeros(256, np.int64)
        for run in self.chunk_runs():
            fields, rows = self.fetch(np.arange(run.start, run.stop))
            labels, ranges = fields["labels"][rows], fields["ranges"][rows]
            counts += np.bincount(labels[self.lidar.has_return(ranges)], minlength=256)
        return counts[: len(self.taxonomy)]

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
            for name, values in self._read(reader, 0, None).items():
                if name not in kept:
                    kept[name] = np.empty((len(self), *values.shape[1:]), values.dtype)
                kept[name][start : start + len(rows)] = values[rows]
            start += len(rows)
        return kept

    def _gather(self, wanted: NDArray[np.int64]) -> Fields:
        """Collect scans from whole chunks, each read once."""
        if not wanted.size:
            return {name: values[:0] for name, values in self._chunk(0, 0).items()}
        numbers = np.searchsorted(self._starts, wanted, side="right") - 1
        rows = self._all_rows[wanted]
        keys = numbers * (1 << 40) + rows // CHUNK_ROWS
        order = np.argsort(keys, kind="stable")
        groups = np.split(order, np.flatnonzero(np.diff(keys[order])) + 1)
        parts = []
        for group in groups:
            number, chunk = int(numbers[group[0]]), int(rows[group[0]] // CHUNK_ROWS)
            local = rows[group] - chunk * CHUNK_ROWS
            parts.append({n: v[local] for n, v in self._chunk(number, chunk).items()})
        back = np.argsort(order)
        return {n: np.concatenate([part[n] for part in parts])[back] for n in parts[0]}

    def _chunk(self, number: int, chunk: int) -> Fields:
        key = (number, chunk)
        if key not in self._chunks:
            start = chunk * CHUNK_ROWS
            self._chunks[key] = self._read(self._readers[number], start, start + CHUNK_ROWS)
            if len(self._chunks) > _CACHED_CHUNKS:
                self._chunks.popitem(last=False)
        self._chunks.move_to_end(key)
        return self._chunks[key]

    def _read(self, reader: SequenceReader, start: int, stop: int | None) -> Fields:
        ranges = reader.read("scans/ranges", start, stop)
        fields = {"ranges": ranges, "poses": reader.read_poses(start, stop)}
        fields["labels"] = (
            reader.read("scans/labels", start, stop)
            if "scans/labels" in reader
            else np.full(ranges.shape, UNLABELLED, np.uint8)
        )
        if self.has_intensities:
            fields["intensities"] = reader.read("scans/intensities", start, stop)
        return fields

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
