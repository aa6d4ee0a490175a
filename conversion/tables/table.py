"""Recordings in arrays or columns of any kind, which a small YAML describes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from conversion.layouts.rows import SYNTHETIC_STEP_NS, only_finite, refuse_options, to_ranges
from conversion.messages.pose_files import poses_at_scans, read_pose_file
from conversion.messages.poses import NONE, FoundPoses
from conversion.options import Options
from conversion.plan import BLOCK, Arrays, SequencePlan
from conversion.tables.arrays import ArrayRows, FolderStore, NpzStore
from conversion.tables.csv_rows import CsvRows
from conversion.tables.layout import TableLayout, example_description, read_layout
from conversion.tables.rows import Contents, RowFile, Selector
from semantic2d_dataset.errors import InvalidInputError, RecordingError
from semantic2d_dataset.format.sequence import SequenceHeader, slug
from semantic2d_dataset.scene.lidars import LidarSpec
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, UNLABELLED

__all__ = ["TableSource", "example_description", "is_table"]

_YAML = (".yaml", ".yml")
_COLUMNS = (".csv", ".tsv", ".txt")
_WIDTHS = {"poses": 3, "velocities": 2}
_HONOURED = (
    *("poses", "poses_of", "clock_offset_s", "max_gap_s"),
    *("velocity", "reverse_intensities"),
)
_MAX_PARTS = 100
_OURS = {id_: id_ for id_ in (*range(len(SEMANTIC2D)), UNLABELLED)}


class TableSource:
    """Arrays or columns with a description, as a `conversion.plan.Source`.

    Parameters
    ----------
    path
        The description, as `conversion.tables.layout.read_layout` reads it.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    RecordingError
        If it is no description, or describes what is not there. The message holds an example
        where there is no description at all.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self.kind = "table"
        self.versions: Mapping[str, str] = {}
        if self.path.suffix.lower() not in _YAML:
            raise RecordingError(
                self.path,
                "arrays and columns need a description; save this as layout.yaml, change what is "
                f"different, and convert that:\n\n{example_description()}",
            )
        self._layout = read_layout(self.path)
        self._rows = _open_rows(self._layout)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        """Leave nothing open: every pass opens the files for itself."""

    def files(self) -> Sequence[Path]:
        """Return the description, and the files that are read."""
        said = self._layout
        selectors = (said.ranges, said.intensities, said.labels)
        few = (said.stamps, said.poses, said.velocities)
        return [self.path, *self._rows.files([s for s in (*selectors, *few) if s is not None])]

    def plans(self, options: Options) -> tuple[SequencePlan, ...]:
        """Read what has a few numbers a scan, and plan one sequence for each run of stamps.

        Raises
        ------
        RecordingError
            If the description does not fit the data.
        InvalidInputError
            If an option names nothing known, or means nothing here.
        """
        refuse_options(self.path, self.kind, options, _HONOURED)
        said = self._layout
        few = {"poses": said.poses, "velocities": said.velocities}
        contents = self._rows.contents(
            said.ranges,
            said.stamps,
            said.per_second,
            {name: selector for name, selector in few.items() if selector is not None},
        )
        _check_contents(self.path, contents)
        lidar = said.lidar_of(contents.beams, options.lidar)
        if options.mount is not None:
            lidar = replace(lidar, base_T_lidar=options.mount)
        planner = _Planner(self.path, said, self._rows, contents, options, lidar)
        starts = _starts(self.path, contents.stamps_ns)
        ends = [*starts[1:], contents.rows]
        parts = list(zip(starts, ends, strict=True))
        return tuple(planner.plan(part, number, len(parts)) for number, part in enumerate(parts, 1))


@dataclass(frozen=True)
class _Planner:
    """What is known when the sequences are planned."""

    path: Path
    said: TableLayout
    rows: RowFile
    contents: Contents
    options: Options
    lidar: LidarSpec

    def plan(self, part: tuple[int, int], number: int, count: int) -> SequencePlan:
        """Plan the sequence of the scans from one to another."""
        start, stop = part
        stamps_ns, stamps_source = self._stamps(start, stop)
        poses = self._poses(start, stop, stamps_ns)
        keep = poses.known if self.options.drop_without_pose else np.ones(stop - start, np.bool_)
        if not keep.any():
            raise RecordingError(self.path, "no scan has a pose to be kept for")
        few: Arrays = {"scans/stamps_ns": stamps_ns, "poses/initial": poses.poses}
        velocities = self.contents.others.get("velocities")
        if velocities is not None and self.options.velocity != NONE:
            few["commands/velocity"] = velocities[start:stop]
        began = () if number == 1 else ("begins where stamps go backward",)
        return SequencePlan(
            header=self._header(f"-part-{number}" if count > 1 else "", stamps_source),
            scans_in=stop - start,
            scans_out=int(keep.sum()),
            scans_with_pose=int(poses.known.sum()),
            duration_s=float(stamps_ns[-1] - stamps_ns[0]) / 1e9,
            blocks=partial(self._blocks, start, keep, few),
            topic=_written(self.said.ranges),
            pose_source=poses.source,
            pose_max_gap_s=poses.max_gap_s,
            notices=(*began, *poses.notices),
            reverse_intensities=self.options.reverse_intensities,
        )

    def _header(self, part: str, stamps_source: str) -> SequenceHeader:
        said, options, where = self.said, self.options, self.path.resolve()
        recording = _first(options.recording, said.recording, slug(where.stem))
        plain = options.license == Options().license
        return SequenceHeader(
            environment=_first(options.environment, said.environment, slug(where.parent.name)),
            recording=f"{recording}{part}",
            lidar=self.lidar,
            license=_first(said.license if plain else None, options.license),
            stamps_source=stamps_source,
            provenance={"data": said.data.name},
        )

    def _stamps(self, start: int, stop: int) -> tuple[NDArray[np.int64], str]:
        known = self.contents.stamps_ns
        if known is None:
            return np.arange(stop - start, dtype=np.int64) * SYNTHETIC_STEP_NS, "synthetic"
        return known[start:stop], "header"

    def _poses(self, start: int, stop: int, stamps_ns: NDArray[np.int64]) -> FoundPoses:
        wanted, known = self.options.poses, self.contents.others.get("poses")
        if wanted not in (NONE, Options().poses):
            return self._poses_of_file(Path(wanted), stamps_ns)
        if wanted == NONE or known is None:
            why = () if wanted == NONE else ("the description names no poses",)
            return FoundPoses(NONE, np.full((stop - start, 3), np.nan), None, why)
        poses = known[start:stop] * (1.0, 1.0, self.said.radians)
        return FoundPoses(_written(self.said.poses), only_finite(poses))

    def _poses_of_file(self, file: Path, stamps_ns: NDArray[np.int64]) -> FoundPoses:
        if self.contents.stamps_ns is None:
            raise InvalidInputError(
                f"{self.path}: --poses {file}: needs the stamps of the scans, and the description "
                "names none"
            )
        return poses_at_scans(
            read_pose_file(file),
            stamps_ns,
            self.lidar.base_T_lidar,
            of=self.options.poses_of,
            clock_offset_s=self.options.clock_offset_s,
            max_gap_s=self.options.max_gap_s,
        )

    def _blocks(self, start: int, keep: NDArray[np.bool_], few: Arrays) -> Iterator[Arrays]:
        named = {
            "ranges": self.said.ranges,
            "intensities": self.said.intensities,
            "labels": self.said.labels,
        }
        wanted = {name: selector for name, selector in named.items() if selector is not None}
        at = 0
        for block in self.rows.blocks(wanted, BLOCK):
            index = np.arange(at, at + len(block["ranges"])) - start  # in this part
            chosen = (index >= 0) & (index < len(keep))
            chosen[chosen] = keep[index[chosen]]
            if chosen.any():
                rows = {name: array[chosen] for name, array in block.items()}
                yield self._finish(rows) | {name: a[index[chosen]] for name, a in few.items()}
            at += len(index)
            if start + len(keep) <= at < self.contents.rows:
                return
        if at != self.contents.rows:
            raise RecordingError(
                self.path, f"expected {self.contents.rows} scans, found {at}: the data changed"
            )

    def _finish(self, rows: Mapping[str, NDArray[Any]]) -> Arrays:
        no_return = (*self.said.no_return, *self.options.no_return)
        step = -1 if self.said.clockwise else 1
        done: Arrays = {"scans/ranges": to_ranges(rows["ranges"], self.said.metres, no_return)}
        if "labels" in rows:
            done["scans/labels"] = _class_ids(self.path, rows["labels"], self.said.classes)
        if "intensities" in rows:
            turn = -1 if self.options.reverse_intensities else 1
            done["scans/intensities"] = rows["intensities"].astype(np.float32)[:, ::turn]
        return {name: np.ascontiguousarray(array[:, ::step]) for name, array in done.items()}


def is_table(path: Path) -> bool:
    """Tell by its name whether a file holds arrays or columns that need a description."""
    return path.is_file() and path.suffix.lower() in (".npz", ".npy", *_COLUMNS[:2])


def _open_rows(said: TableLayout) -> RowFile:
    data = said.data
    if data.is_dir():
        return ArrayRows(FolderStore(data))
    if not data.exists():
        raise RecordingError(said.path, f"data: expected a file or folder, found none at {data}")
    if data.suffix.lower() == ".npz":
        return ArrayRows(NpzStore(data))
    if data.suffix.lower() in _COLUMNS:
        return CsvRows(data)
    raise RecordingError(
        said.path, f"data: expected a folder of .npy, a .npz or a .csv, found {data.name}"
    )


def _check_contents(path: Path, contents: Contents) -> None:
    if not contents.rows:
        raise RecordingError(path, "expected scans, found none")
    for name, array in contents.others.items():
        if array.shape[1] != _WIDTHS[name]:
            raise RecordingError(
                path, f"{name}: expected {_WIDTHS[name]} numbers a scan, found {array.shape[1]}"
            )


def _starts(path: Path, stamps_ns: NDArray[np.int64] | None) -> list[int]:
    """Where sequences begin: at the first scan, and wherever stamps go backward."""
    if stamps_ns is None:
        return [0]
    backward = (np.flatnonzero(np.diff(stamps_ns) < 0) + 1).tolist()
    if len(backward) >= _MAX_PARTS:
        raise RecordingError(
            path,
            f"stamps go backward {len(backward)} times, first at scan {backward[0]}: sort the "
            "scans, or leave the stamps out of the description",
        )
    return [0, *backward]


def _class_ids(path: Path, labels: NDArray[Any], classes: Mapping[int, int]) -> NDArray[np.uint8]:
    """Translate labels into class ids, u1."""
    found, inverse = np.unique(labels, return_inverse=True)
    known = classes or _OURS
    unknown = [value for value in found.tolist() if value not in known]
    if unknown:
        shown = ", ".join(f"{value:g}" for value in unknown[:8])
        raise RecordingError(
            path,
            f"labels: expected {', '.join(map(str, known))}, found {shown}; add to the description "
            f"what they are, such as 'classes: {{{shown.split(',')[0]}: Other}}'",
        )
    ids = np.array([known[int(value)] for value in found.tolist()], np.uint8)
    return ids[inverse].reshape(labels.shape)


def _written(selector: Selector | None) -> str:
    return selector if isinstance(selector, str) else ", ".join(selector or ())


def _first(*values: str | None) -> str:
    """Return the first value that was given, even if it is empty: the header refuses that."""
    return next(value for value in values if value is not None)
