"""What is wrong in a release of the published layout: every defect counted, none stopped at."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from conversion.layouts.fields import SCANS
from conversion.layouts.session_audit import EXPLANATIONS, Finding, SessionAudit, audit_session
from conversion.layouts.sessions import DATASET, Session, check_listing, find_sessions
from conversion.layouts.trees import Tree, open_tree
from semantic2d_dataset.errors import RecordingError


@dataclass(frozen=True)
class Audit:
    """What was found in a release; `as_dict` for programs, `str` for people.

    Parameters
    ----------
    path
        The folder or archive.
    sessions
        What was found in each session.
    findings
        Defects of the whole.
    notes
        What was not read, and is no defect.
    """

    path: str
    sessions: tuple[SessionAudit, ...]
    findings: tuple[Finding, ...]
    notes: tuple[str, ...]

    @property
    def problems(self) -> int:
        """How many defects there are: files, scans and beams together."""
        return sum(found.count for found in self.all_findings)

    @property
    def all_findings(self) -> tuple[Finding, ...]:
        """The defects of all sessions, and of the whole."""
        return tuple(f for each in self.sessions for f in each.findings) + self.findings

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "path": self.path,
            "problems": self.problems,
            "totals": self.totals,
            "sessions": [
                {**vars(each), "files": dict(each.files), "findings": [*map(vars, each.findings)]}
                for each in self.sessions
            ],
            "findings": [*map(vars, self.findings)],
            "notes": list(self.notes),
        }

    @property
    def totals(self) -> dict[str, dict[str, Any]]:
        """Defects by kind, over everything: count, explanation and an example."""
        totals: dict[str, dict[str, Any]] = {}
        for kind, why in EXPLANATIONS.items():
            found = [each for each in self.all_findings if each.kind == kind]
            if found:
                count = sum(each.count for each in found)
                totals[kind] = {"count": count, "means": why, "example": found[0].example}
        return totals

    def __str__(self) -> str:
        scans = sum(each.scans for each in self.sessions)
        lines = [f"{self.path}: {len(self.sessions)} sessions, {scans} scans", ""]
        lines += _table(
            ("session", "scans", "beams", "lidar", "problems"),
            [
                (each.session, each.scans, each.beams, each.lidar or "unknown", each.problems)
                for each in self.sessions
            ],
        )
        lines.append("")
        for kind, total in self.totals.items():
            lines.append(f"  {total['count']:>9} x {kind}: {total['means']}")
            lines += [f"{'':14}{place}" for place in _places(self.all_findings, kind)]
        lines += [f"  {note}" for note in self.notes]
        if not self.problems:
            lines.append("  nothing is wrong with it")
        return "\n".join(lines)


def audit(path: Path) -> Audit:
    """Count what is wrong in a session, a folder of sessions, or an archive of them.

    Reads every file once, in bounded memory, and goes on after every defect.

    Raises
    ------
    FileNotFoundError
        If there is nothing at the path.
    RecordingError
        If the archive as a whole cannot be read, or holds no session.
    """
    with open_tree(path) as tree:
        sessions = find_sessions(tree)
        if not sessions:
            raise RecordingError(
                path, f"expected folders with {SCANS}/*.npy, the published layout; found none"
            )
        total = sum(len(session.scans) for session in sessions)
        with tqdm(total=total, desc="audit", unit="scan", disable=None, leave=False) as bar:
            found = tuple(audit_session(session, bar) for session in sessions)
        return Audit(str(path), found, tuple(_audit_listing(tree, sessions)), tree.notices)


def _audit_listing(tree: Tree, sessions: Sequence[Session]) -> Iterator[Finding]:
    """Compare the sessions with what ``dataset.txt`` names."""
    try:
        listing = check_listing(tree, sessions)
    except RecordingError:
        yield Finding("unreadable file", DATASET, 1, DATASET)
        return
    for kind, folders in (
        ("listed session not there", listing.missing),
        ("session not listed", listing.unlisted),
    ):
        if folders:
            yield Finding(kind, DATASET, len(folders), folders[0])


def _places(findings: Iterable[Finding], kind: str) -> Iterator[str]:
    """Say in which fields a defect occurs, how often, and where first."""
    found: dict[str, list[Finding]] = {}
    for each in findings:
        if each.kind == kind:
            found.setdefault(each.where, []).append(each)
    for where, some in found.items():
        yield f"{sum(each.count for each in some)} in {where}, first {some[0].example}"


def _table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> Iterator[str]:
    """Yield lines of aligned columns, numbers to the right."""
    cells = [[*map(str, row)] for row in (head, *rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    right = [isinstance(value, int) for value in rows[0]]
    for row in cells:
        texts = (
            text.rjust(width) if to_right else text.ljust(width)
            for text, width, to_right in zip(row, widths, right, strict=True)
        )
        yield f"  {'  '.join(texts)}".rstrip()
