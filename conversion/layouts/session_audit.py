"""What is wrong in one session of the published layout."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import compress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conversion.layouts import npy
from conversion.layouts.fields import (
    INTENSITIES,
    LABELS,
    LINES,
    POSITIONS,
    SCANS,
    VELOCITIES,
    Values,
    is_number,
)
from conversion.layouts.sessions import DATASET, LISTS, Session
from conversion.layouts.split_lists import check_lists
from conversion.plan import BLOCK
from semantic2d_dataset.errors import RecordingError
from semantic2d_dataset.scene.lidars import LIDARS
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D

EXPLANATIONS: Mapping[str, str] = {
    "unreadable file": "empty, cut off, no .npy, or pickled objects; convert refuses it",
    "wrong dtype": "no real numbers; convert keeps the file, and has no values of it",
    "wrong shape": "not (B,) as most scans, (3,) positions, (2,) velocities, or (k, 4) segments",
    "missing file": "a scan has no file in this field",
    "file without scan": "no scan has its name; convert keeps it, and does nothing with it",
    "person without return": "labelled Person where the range is 0: nobody was seen there",
    "label outside 0..9": "no class has this id; convert takes it as not labelled",
    "label not an integer": "between two classes, or NaN; convert takes it as not labelled",
    "range not finite": "NaN or inf, where the layout writes 0 for no return",
    "range below 0": "no lidar measures it",
    "value not finite": "NaN or inf in intensities, positions, velocities or segments",
    "list not there": "the session has other lists",
    "scan in several lists": "train, dev and test overlap",
    "scan in no list": "it is left out of train, dev and test",
    "listed file not there": "a list names a file that does not exist",
    "file listed twice": "one list names it more than once",
    "listed session not there": f"{DATASET} names a folder without scans",
    "session not listed": f"a session beside a {DATASET} that does not name it",
}
"""What each kind of defect means."""

_PERSON = SEMANTIC2D.names.index("Person")
_CLASSES = len(SEMANTIC2D)
_PER_BEAM = (SCANS, INTENSITIES, LABELS)
_WIDTHS = {POSITIONS: 3, VELOCITIES: 2}
_LINE_WIDTH = 4
_BLOCK_VALUES = 1 << 20


@dataclass(frozen=True)
class Finding:
    """A defect, how often it occurs, and where first.

    Parameters
    ----------
    kind
        One of `EXPLANATIONS`.
    where
        The field or list.
    count
        Files, scans, or beams.
    example
        The name of a file that has it, in the tree.
    """

    kind: str
    where: str
    count: int
    example: str


@dataclass(frozen=True)
class SessionAudit:
    """What was found in one session.

    Parameters
    ----------
    session
        Its folder in the tree.
    scans, beams
        How many there are; beams as most scans have them, 0 where no scan can be read.
    lidar
        The lidar of the release that has so many beams, if any.
    files
        Number of .npy files by field.
    findings
        Its defects.
    """

    session: str
    scans: int
    beams: int
    lidar: str | None
    files: Mapping[str, int]
    findings: tuple[Finding, ...]

    @property
    def problems(self) -> int:
        """How many defects there are."""
        return sum(found.count for found in self.findings)


def audit_session(session: Session, bar: Any) -> SessionAudit:
    """Read every file of a session once, and count; `bar` (of tqdm) counts scans."""
    return _Auditor(session).audit(bar)


class _Tally:
    """Counts of defects of a session by kind and field, with the first of each."""

    def __init__(self) -> None:
        self._found: dict[tuple[str, str], tuple[int, str]] = {}

    def add(self, kind: str, where: str, count: int, example: str) -> None:
        """Count a defect; a count of 0 is none."""
        if count:
            before, first = self._found.get((kind, where), (0, example))
            self._found[kind, where] = (before + count, first)

    def findings(self) -> tuple[Finding, ...]:
        """Return what was counted, in the order of the explanations."""
        order = list(EXPLANATIONS)
        found = sorted(self._found.items(), key=lambda item: order.index(item[0][0]))
        return tuple(Finding(*key, *value) for key, value in found)


class _Auditor:
    """Goes through the files of one session."""

    def __init__(self, session: Session) -> None:
        self._session, self._tally = session, _Tally()
        self._beams = _beams_of(session)

    def audit(self, bar: Any) -> SessionAudit:
        """Read everything, and count."""
        session, scans = self._session, self._session.scans
        self._compare_fields()
        self._check_lists()
        step = max(1, min(BLOCK, _BLOCK_VALUES // max(1, self._beams)))
        for start in range(0, len(scans), step):
            self._check_block(scans[start : start + step])
            bar.update(len(scans[start : start + step]))
        lidar = next((name for name, spec in LIDARS.items() if spec.beams == self._beams), None)
        return SessionAudit(
            session=session.folder or ".",
            scans=len(scans),
            beams=self._beams,
            lidar=lidar,
            files={name: len(files) for name, files in session.files.items()},
            findings=self._tally.findings(),
        )

    def _compare_fields(self) -> None:
        session, scans = self._session, frozenset(self._session.scans)
        for name, files in session.files.items():
            missing, extra = sorted(scans.difference(files)), sorted(set(files) - scans)
            for kind, some in (("missing file", missing), ("file without scan", extra)):
                self._tally.add(kind, name, len(some), session.name(name, *some[:1]))

    def _check_lists(self) -> None:
        session = self._session
        lists = {}
        for split in LISTS:
            name = session.name(f"{split}.txt")
            if name in session.tree:
                try:
                    lists[split] = session.tree.read(name)
                except RecordingError:
                    self._tally.add("unreadable file", f"{split}.txt", 1, name)
                    return
        check = check_lists(lists, session.scans)
        for split in sorted(set(LISTS) - set(lists)) if lists else ():
            self._tally.add("list not there", f"{split}.txt", 1, session.name(f"{split}.txt"))
        for kind, files in (
            ("scan in several lists", check.overlapping),
            ("scan in no list", check.left_out),
            ("listed file not there", check.missing),
            ("file listed twice", check.repeated),
        ):
            self._tally.add(kind, "lists", len(files), session.name(SCANS, *files[:1]))

    def _check_block(self, names: Sequence[str]) -> None:
        rows: dict[str, Values] = {}
        for field in self._session.files:
            arrays = self._read(field, names)
            if field == LINES:
                self._check_lines(names, arrays)
            elif width := self._width(field):
                rows[field], there = self._rows(field, names, arrays, width)
                self._check_values(field, [*compress(names, there)], rows[field][there])
        if SCANS in rows and LABELS in rows:
            unseen = (rows[LABELS] == _PERSON) & (rows[SCANS] == 0)
            self._count("person without return", LABELS, names, unseen)

    def _check_values(self, field: str, names: Sequence[str], values: Values) -> None:
        finite = np.isfinite(values)
        if field == LABELS:
            outside = finite & ((values < 0) | (values > _CLASSES - 1))
            self._count("label outside 0..9", field, names, outside)
            between = ~outside & (values != np.floor(values))
            self._count("label not an integer", field, names, between)
            return
        what = "range not finite" if field == SCANS else "value not finite"
        self._count(what, field, names, ~finite)
        if field == SCANS:
            self._count("range below 0", field, names, finite & (values < 0))

    def _check_lines(self, names: Sequence[str], arrays: Sequence[Values | None]) -> None:
        for name, values in zip(names, arrays, strict=True):
            if values is None:
                continue
            if values.size and (values.ndim != 2 or values.shape[1] != _LINE_WIDTH):
                self._count("wrong shape", LINES, [name], np.ones((1, 1), np.bool_))
            self._count("value not finite", LINES, [name], ~np.isfinite(values).reshape(1, -1))

    def _rows(
        self, field: str, names: Sequence[str], arrays: Sequence[Values | None], width: int
    ) -> tuple[Values, NDArray[np.bool_]]:
        """Return values as (n, width) f8, NaN where a file has not so many, and where it has."""
        rows, there = np.full((len(names), width), np.nan), np.zeros(len(names), np.bool_)
        odd = np.zeros((len(names), 1), np.bool_)
        for n, values in enumerate(arrays):
            if values is not None:
                odd[n] = values.shape != (width,)
                there[n] = values.size == width
                if there[n]:
                    rows[n] = values.reshape(-1)
        self._count("wrong shape", field, names, odd)
        return rows, there

    def _read(self, field: str, names: Sequence[str]) -> list[Values | None]:
        """Read the arrays of a field; None where a file is not there, or not fit for use."""
        session, there = self._session, frozenset(self._session.files[field])
        wanted = [session.name(field, name) for name in names if name in there]
        read = dict(zip(wanted, self._contents(wanted), strict=True))
        arrays = {
            name: None if content is None else self._array(field, name, content)
            for name, content in read.items()
        }
        for name, content in read.items():
            self._tally.add("unreadable file", field, int(content is None), name)
        return [arrays.get(session.name(field, name)) for name in names]

    def _contents(self, names: Sequence[str]) -> Sequence[bytes | None]:
        """Read files, None where one cannot be read."""
        try:
            return self._session.tree.read_many(names)
        except (RecordingError, OSError):
            return [self._content(name) for name in names]

    def _content(self, name: str) -> bytes | None:
        try:
            return self._session.tree.read(name)
        except (RecordingError, OSError):
            return None

    def _array(self, field: str, name: str, content: bytes) -> Values | None:
        try:
            values = npy.read(content)
        except npy.NpyError:
            self._tally.add("unreadable file", field, 1, name)
            return None
        if not self._width(field) and field != LINES:
            return None
        self._tally.add("wrong dtype", field, int(not is_number(values.dtype)), name)
        return values if is_number(values.dtype) else None

    def _width(self, field: str) -> int:
        """Return how many values a file of a field holds; 0 if it has no place in the format."""
        return self._beams if field in _PER_BEAM else _WIDTHS.get(field, 0)

    def _count(self, kind: str, field: str, names: Sequence[str], which: NDArray[np.bool_]) -> None:
        """Count values (n, ...) of files, the first of which is the example."""
        if which.any():
            first = names[int(np.flatnonzero(which.any(axis=1))[0])]
            self._tally.add(kind, field, int(which.sum()), self._session.name(field, first))


def _beams_of(session: Session) -> int:
    """Return how many values most scan files hold, judged by their sizes; 0 if none is read."""
    tree, names = session.tree, [session.name(SCANS, file) for file in session.scans]
    sizes = [tree.size(name) for name in names]
    for usual, _ in Counter(sizes).most_common():
        try:
            return tree.read_array(names[sizes.index(usual)]).size
        except RecordingError:
            continue
    return 0
