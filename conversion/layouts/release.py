"""The published Semantic2D layout as a source: one sequence for each recording session."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from conversion.layouts.field_encoding import PlacedEncoder
from conversion.layouts.fields import (
    INTENSITIES,
    LABELS,
    LINES,
    POSITIONS,
    SCANS,
    VELOCITIES,
    places,
)
from conversion.layouts.rows import SYNTHETIC_STEP_NS, refuse_options
from conversion.layouts.session_blocks import (
    MAX_KEPT_BYTES,
    blocks_of,
    encode_files,
    others_of,
)
from conversion.layouts.session_lidar import choose_lidar
from conversion.layouts.sessions import LISTS, Session, check_listing, find_sessions, is_release
from conversion.layouts.split_lists import check_lists, frame_members
from conversion.layouts.trees import Tree, open_tree
from conversion.options import Options
from conversion.plan import BLOCK, SequencePlan
from semantic2d_dataset.errors import InvalidInputError, RecordingError
from semantic2d_dataset.format.sequence import SequenceHeader, slug

__all__ = ["ReleaseSource", "find_sessions", "frame_members", "is_release"]

_LIST_FILES = frozenset(f"{split}.txt" for split in LISTS)
_WITHOUT = {
    INTENSITIES: "their intensities are NaN",
    LABELS: "they are not labelled",
    POSITIONS: "their poses are NaN",
    VELOCITIES: "their velocities are NaN",
    LINES: "they have no lines",
}


class ReleaseSource:
    """A session folder, a folder of sessions, or a downloaded archive of them.

    Parameters
    ----------
    path
        The folder or archive.
    tree
        The same, if it is open already; leaving this context closes it.

    Raises
    ------
    RecordingError
        If it cannot be opened, or holds no session.
    """

    kind = "published Semantic2D layout"

    def __init__(self, path: Path, tree: Tree | None = None) -> None:
        self.path = path
        self.versions: Mapping[str, str] = {"numpy": np.__version__}
        self._tree = open_tree(path) if tree is None else tree
        self.sessions = find_sessions(self._tree)
        if not self.sessions:
            self._tree.close()
            raise RecordingError(
                path, f"expected folders with {SCANS}/*.npy, the published layout; found none"
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._tree.close()

    def files(self) -> Sequence[Path]:
        """Return the archive, or every file of the folder."""
        return self._tree.files()

    def plans(self, options: Options) -> tuple[SequencePlan, ...]:
        """Decide what becomes of each session; reads the positions, and little else.

        Raises
        ------
        RecordingError
            If a lidar is not known, or a file is damaged.
        InvalidInputError
            If an option is set that this layout cannot honour.
        """
        refuse_options(self.path, self.kind, options, ("reverse_intensities",))
        if options.recording is not None and len(self.sessions) > 1:
            raise InvalidInputError(
                f"{self.path}: holds {len(self.sessions)} sessions, and a name for the recording "
                "fits one: convert them one by one, or let their folders name them"
            )
        found = [_Planner(session, options) for session in self.sessions]
        shared = (*self._tree.notices, *check_listing(self._tree, self.sessions).notices)
        names = self._names(found, options)
        return tuple(
            planner.plan(*name, shared) for planner, name in zip(found, names, strict=True)
        )

    def _names(self, found: Sequence[_Planner], options: Options) -> list[tuple[str, str]]:
        """Name environments and recordings by their folders, deep enough to tell them apart."""
        for depth in range(1, max(len(session.place) for session in self.sessions)):
            names = [planner.name(depth) for planner in found]
            ids = Counter((*name, each.lidar.name) for name, each in zip(names, found, strict=True))
            if max(ids.values()) == 1 or options.environment is not None:
                break
        (twice, count), *_ = ids.most_common(1)
        if count > 1:
            raise RecordingError(
                self.path,
                f"{count} sessions would all become {'--'.join(twice)}: convert them one by one, "
                "or rename their folders",
            )
        return names


class _Planner:
    """What decides about one session."""

    def __init__(self, session: Session, options: Options) -> None:
        self.session, self._options = session, options
        self.lidar, self._lidar_notices = choose_lidar(session, options)

    def name(self, depth: int) -> tuple[str, str]:
        """Name environment and recording, by so many folders above the session."""
        *above, own = self.session.place
        environment, recording = self._options.environment, self._options.recording
        return (
            slug("-".join(above[-depth:])) if environment is None else environment,
            slug(own) if recording is None else recording,
        )

    def plan(self, environment: str, recording: str, shared: tuple[str, ...]) -> SequencePlan:
        """Look at positions and lists, and say what will be read."""
        session, options, scans = self.session, self._options, self.session.scans
        known = _known_poses(session)
        keep = known if options.drop_without_pose else np.ones(len(scans), np.bool_)
        if not keep.any():
            raise RecordingError(
                session.tree.path, f"{session.folder or '.'}: no scan has a pose to be kept for"
            )
        lists = session.lists()
        check = check_lists(lists, scans)
        return SequencePlan(
            header=SequenceHeader(
                environment=environment,
                recording=recording,
                lidar=self.lidar,
                license=options.license,
                stamps_source="synthetic",
                provenance={"session": session.folder or "."},
            ),
            scans_in=len(scans),
            scans_out=int(keep.sum()),
            scans_with_pose=int(known.sum()),
            duration_s=(len(scans) - 1) * SYNTHETIC_STEP_NS / 1e9,
            blocks=partial(blocks_of, session, self.lidar.beams, options, keep),
            topic=SCANS,
            pose_source=POSITIONS if POSITIONS in session.files else "none",
            notices=(*self._lidar_notices, *_notices(session), *check.notices, *shared),
            reverse_intensities=options.reverse_intensities,
            lists=lists,
            members=check.members[keep] if lists else None,
        )


def _known_poses(session: Session) -> NDArray[np.bool_]:
    """Tell which scans have a pose, (N,)."""
    scans = session.scans
    if POSITIONS not in session.files:
        return np.zeros(len(scans), np.bool_)
    place = places(1)[POSITIONS]
    encoder = PlacedEncoder(POSITIONS, place)
    known = []
    for start in range(0, len(scans), BLOCK):
        encoded, _ = encode_files(session, POSITIONS, encoder, scans[start : start + BLOCK])
        known.append(np.isfinite(encoded.arrays[place.array]).all(axis=1))
    return np.concatenate(known)


def _notices(session: Session) -> list[str]:
    """Count what is missing, and what has no place."""
    scans, notices = frozenset(session.scans), []
    for field, what in _WITHOUT.items():
        files = session.files.get(field)
        if files is None:
            notices.append(f"no {field}/")
        elif lacking := sorted(scans.difference(files)):
            notices.append(
                f"{len(lacking)} of {len(scans)} scans have no file in {field}/ (first: "
                f"{lacking[0]}): {what}"
            )
    others = [name for name in others_of(session) if name not in _LIST_FILES]
    large = [name for name in others if session.tree.size(session.name(name)) > MAX_KEPT_BYTES]
    if large:
        notices.append(f"{len(large)} files are too large to be kept (first: {large[0]})")
    if len(others) > len(large):
        notices.append(
            f"{len(others) - len(large)} files belong to no scan: kept in /original, not converted"
        )
    return notices
