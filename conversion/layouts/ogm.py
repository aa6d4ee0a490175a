"""OGM-Turtlebot2 and its siblings: scans, positions and velocities in .npy, with split lists."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from conversion.layouts import npy
from conversion.layouts.rows import (
    SYNTHETIC_STEP_NS,
    natural_order,
    only_finite,
    refuse_options,
    to_ranges,
)
from conversion.layouts.trees import open_tree
from conversion.messages.poses import NONE
from conversion.options import Options
from conversion.plan import BLOCK, Arrays, SequencePlan
from semantic2d_dataset.errors import RecordingError
from semantic2d_dataset.format.sequence import SequenceHeader, slug
from semantic2d_dataset.format.splits import NONE as IN_NO_SPLIT
from semantic2d_dataset.scene.lidars import LidarSpec, find_lidar, read_lidar

_SCANS, _POSITIONS, _VELOCITIES = "scans", "positions", "velocities"
_WIDTHS = {_POSITIONS: 3, _VELOCITIES: 2}
_YAML = (".yaml", ".yml")
_ARRAY = ".npy"
# The lists of the layout, what they are called here, and the split that each names.
_LISTS = {
    "train.txt": ("train", 0),
    "val.txt": ("dev", 1),
    "dev.txt": ("dev", 1),
    "test.txt": ("test", 2),
}

_HALF_FIELD = math.radians(135)
_BEAMS = 1080
_FAR_M = 30.0

# The reader published with the data set (TempleRAIL/SOGMP, scripts/decode_demo.py and model.py)
# spreads 1080 beams over -135 to 135 degrees, ends included, at the robot's own pose, and takes
# NaN, inf and exactly 30 m for no return. 0.1 m is the near limit of the Hokuyo UTM-30LX, whose
# field and reach these are (its data sheet).
TURTLEBOT2 = LidarSpec(
    name="turtlebot2-1080",
    model="simulated lidar of OGM-Turtlebot2",
    beams=_BEAMS,
    angle_min=-_HALF_FIELD,
    angle_increment=2 * _HALF_FIELD / (_BEAMS - 1),
    range_min=0.1,
    range_max=_FAR_M,
)


@dataclass(frozen=True)
class _Session:
    """One folder with ``scans/``: its name in the tree, and its .npy by their names."""

    folder: str
    scans: tuple[str, ...]
    others: Mapping[str, frozenset[str]]

    def path(self, kind: str, name: str) -> str:
        return "/".join(filter(None, (self.folder, kind, name)))


class OgmSource:
    """A folder or archive in the layout of OGM-Turtlebot2, as a `conversion.plan.Source`.

    Each folder that holds ``scans/`` becomes a sequence (``train``, ``val`` and ``test`` of
    OGM-Turtlebot2), and its lists say what split each scan is in.

    Parameters
    ----------
    path
        A folder at or above these, or an archive that holds them.

    Raises
    ------
    FileNotFoundError
        If there is no such file or folder.
    RecordingError
        If it holds no such folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self.kind = "OGM layout"
        self.versions: Mapping[str, str] = {}
        self._tree = open_tree(self.path)
        self._sessions = _sessions_in(self._tree.names)
        if not self._sessions:
            self._tree.close()
            raise RecordingError(
                self.path,
                "expected folders such as train/ with scans/, positions/ and velocities/ of .npy "
                f"(OGM-Turtlebot2), found {', '.join(self._tree.names[:5]) or 'nothing'}",
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._tree.close()

    def files(self) -> Sequence[Path]:
        """Return the archive, or all files of the folder."""
        return self._tree.files()

    def plans(self, options: Options) -> tuple[SequencePlan, ...]:
        """Read positions and velocities, and plan a sequence for each folder.

        Raises
        ------
        RecordingError
            If an array is not what it should be, or the lidar is not known.
        InvalidInputError
            If an option names nothing known, or means nothing here.
        """
        refuse_options(self.path, self.kind, options, ("velocity", "poses"))
        if options.poses not in (NONE, Options().poses):
            raise RecordingError(
                self.path, f"--poses {options.poses}: this layout has no stamps to find poses by"
            )
        return tuple(self._plan(session, options) for session in self._sessions)

    def _plan(self, session: _Session, options: Options) -> SequencePlan:
        lidar = self._lidar(session, options)
        few: Arrays = {"scans/stamps_ns": np.arange(len(session.scans)) * SYNTHETIC_STEP_NS}
        poses = np.full((len(session.scans), 3), np.nan)
        if options.poses != NONE:
            poses = only_finite(self._few(session, _POSITIONS))
        known = np.isfinite(poses[:, 0])
        keep = known if options.drop_without_pose else np.ones(len(poses), np.bool_)
        if not keep.any():
            raise RecordingError(self.path, f"{session.folder or 'it'}: no scan has a position")
        few["poses/initial"] = poses
        if session.others[_VELOCITIES] and options.velocity != NONE:
            few["commands/velocity"] = self._few(session, _VELOCITIES)
        lists, members, notices = self._splits(session)
        environment, recording = self._parts_of_id(session, options)
        return SequencePlan(
            header=SequenceHeader(
                environment=environment,
                recording=recording,
                lidar=lidar,
                license=options.license,
                stamps_source="synthetic",
                provenance={"folder": session.folder},
            ),
            scans_in=len(keep),
            scans_out=int(keep.sum()),
            scans_with_pose=int(known.sum()),
            duration_s=(len(keep) - 1) * SYNTHETIC_STEP_NS / 1e9,
            blocks=partial(self._blocks, session, lidar, few, keep, options),
            topic=session.path(_SCANS, ""),
            pose_source=NONE if options.poses == NONE else session.path(_POSITIONS, ""),
            notices=(
                *_assumed(lidar, options),
                *self._missing(session),
                *notices,
                *self._tree.notices,
            ),
            reverse_intensities=options.reverse_intensities,
            lists=lists,
            members=members[keep] if lists else None,
        )

    def _lidar(self, session: _Session, options: Options) -> LidarSpec:
        first = session.path(_SCANS, session.scans[0])
        beams = self._tree.read_array(first).size
        spec = TURTLEBOT2
        if options.lidar is not None:
            is_file = options.lidar.lower().endswith(_YAML)
            spec = read_lidar(Path(options.lidar)) if is_file else find_lidar(options.lidar)
        if spec.beams != beams:
            raise RecordingError(
                self.path,
                f"{first}: expected the {spec.beams} beams of {spec.name}, found {beams}; pass "
                "--lidar LIDAR.yaml with the lidar of this robot, and one folder at a time",
            )
        return spec if options.mount is None else replace(spec, base_T_lidar=options.mount)

    def _few(self, session: _Session, kind: str) -> NDArray[np.float64]:
        """Read what has a few numbers a scan, (N, W) f8; NaN where there is no file."""
        rows = np.full((len(session.scans), _WIDTHS[kind]), np.nan)
        there = [row for row, name in enumerate(session.scans) if name in session.others[kind]]
        with tqdm(
            total=len(there), desc=f"read {kind}", unit="file", disable=None, leave=False
        ) as bar:
            for start in range(0, len(there), BLOCK):
                some = there[start : start + BLOCK]
                paths = [session.path(kind, session.scans[row]) for row in some]
                rows[some] = self._read(paths, _WIDTHS[kind], np.dtype(np.float64))
                bar.update(len(some))
        return rows

    def _read(
        self, paths: Sequence[str], width: int, dtype: np.dtype[Any]
    ) -> NDArray[np.floating[Any]]:
        """Read arrays of so many numbers, (n, width)."""
        rows = np.empty((len(paths), width), dtype)
        contents = self._tree.read_many(paths)
        for row, path, content in zip(rows, paths, contents, strict=True):
            try:
                found = npy.read(content)
            except npy.NpyError as err:
                raise RecordingError(self.path, f"{path}: {err}") from err
            if found.size != width or found.dtype.kind not in "iuf":
                raise RecordingError(
                    self.path,
                    f"{path}: expected {width} numbers, found {found.shape} of {found.dtype}",
                )
            row[:] = found.reshape(-1)
        return rows

    def _splits(
        self, session: _Session
    ) -> tuple[dict[str, bytes], NDArray[np.uint8], tuple[str, ...]]:
        """Return the lists beside the scans, what they make of each scan, and what is odd."""
        row_of = {name: row for row, name in enumerate(session.scans)}
        members = np.full(len(row_of), IN_NO_SPLIT, np.uint8)
        lists: dict[str, bytes] = {}
        notices = []
        for file, (name, code) in _LISTS.items():
            path = session.path(_SCANS, file)
            if path not in self._tree:
                continue
            lists[name] = self._tree.read(path)
            listed = _listed(lists[name])
            rows = [row_of[scan] for scan in listed if scan in row_of]
            members[rows] = code
            lost = len(set(listed) - row_of.keys())
            if lost:
                notices.append(f"{path} names {lost} scans that are not there")
            others = [session.path(kind, file) for kind in _WIDTHS]
            if any(self._tree.read(o) != lists[name] for o in others if o in self._tree):
                notices.append(
                    f"{path} differs from the lists of positions or velocities: it counts"
                )
        unlisted = int((members == IN_NO_SPLIT).sum())
        if lists and unlisted:
            notices.append(f"{unlisted} scans are in no list: in no split")
        return lists, members, tuple(notices)

    def _missing(self, session: _Session) -> Iterator[str]:
        for kind in _WIDTHS:
            lost = len(set(session.scans) - session.others[kind])
            if lost:
                yield f"{lost} scans have no {kind}: NaN"

    def _parts_of_id(self, session: _Session, options: Options) -> tuple[str, str]:
        root = self.path.resolve()
        stem = root if root.is_dir() else root.with_name(root.name.split(".")[0])
        whole = stem / PurePosixPath(session.folder)
        environment = options.environment
        recording = slug(whole.name)
        if options.recording is not None:
            several = len(self._sessions) > 1
            recording = f"{options.recording}-{recording}" if several else options.recording
        return slug(whole.parent.name) if environment is None else environment, recording

    def _blocks(
        self,
        session: _Session,
        lidar: LidarSpec,
        few: Arrays,
        keep: NDArray[np.bool_],
        options: Options,
    ) -> Iterator[Arrays]:
        kept, no_return = np.flatnonzero(keep), (_FAR_M, *options.no_return)
        with tqdm(total=len(kept), desc="convert", unit="scan", disable=None, leave=False) as bar:
            for start in range(0, len(kept), BLOCK):
                rows = kept[start : start + BLOCK]
                paths = [session.path(_SCANS, session.scans[row]) for row in rows.tolist()]
                scans = self._read(paths, lidar.beams, np.dtype(np.float32))
                ranges = to_ranges(scans, 1.0, no_return)
                yield {"scans/ranges": ranges} | {name: array[rows] for name, array in few.items()}
                bar.update(len(rows))


def is_ogm(names: Collection[str]) -> bool:
    """Tell by the names of its files whether a tree is in this layout."""
    return bool(_sessions_in(names))


def _sessions_in(names: Collection[str]) -> tuple[_Session, ...]:
    """Return the folders that hold scans and positions, in the order of their names."""
    found: dict[str, dict[str, set[str]]] = {}
    for name in names:
        *above, kind, file = ("", *name.rsplit("/", 2))[-3:]
        if kind in (_SCANS, *_WIDTHS) and file.endswith(_ARRAY):
            found.setdefault(above[0], {}).setdefault(kind, set()).add(file)
    return tuple(
        _Session(
            folder,
            tuple(sorted(kinds[_SCANS], key=natural_order)),
            {kind: frozenset(kinds.get(kind, ())) for kind in _WIDTHS},
        )
        for folder, kinds in sorted(found.items())
        if kinds.keys() >= {_SCANS, _POSITIONS}
    )


def _assumed(lidar: LidarSpec, options: Options) -> tuple[str, ...]:
    far = f"{_FAR_M:g} m read as no return (+inf), as the published reader does"
    if options.lidar is not None:
        return (far,)
    field = f"{lidar.beams} beams over 270 degrees, ends included, at the robot's own pose"
    return (f"lidar: {field}: as the published reader takes it; --lidar and --mount override", far)


def _listed(content: bytes) -> list[str]:
    """Return the names in a list, which may have a path before them."""
    lines = (line.strip() for line in content.decode(errors="replace").splitlines())
    return [PurePosixPath(line).name for line in lines if line.endswith(_ARRAY)]
