"""Session folders of the published layout, found in a tree of files."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from sys import intern

from conversion.layouts.fields import SCANS
from conversion.layouts.trees import Tree, stem_of

LISTS = ("train", "dev", "test")
DATASET = "dataset.txt"

_NPY = ".npy"
_FIELD_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")
_MARK = f"/{SCANS}/"


@dataclass(frozen=True)
class Session:
    """One recording session: a folder that holds ``scans_lidar/``.

    Parameters
    ----------
    tree
        Where it lies.
    folder
        Its name in the tree, "" for the tree itself.
    nested
        Sessions that lie below it, which are no part of it.
    """

    tree: Tree
    folder: str
    nested: tuple[str, ...] = field(default=(), repr=False)

    @property
    def place(self) -> tuple[str, ...]:
        """The folders that lead to it, itself the last, from the folder that holds the tree."""
        path = self.tree.path.resolve()
        return (path.parent.name, stem_of(path), *filter(None, self.folder.split("/")))

    @cached_property
    def files(self) -> Mapping[str, tuple[str, ...]]:
        """Names of the .npy files of each field, sorted; of scans by their number."""
        found: dict[str, list[str]] = {}
        for name in self.inside:
            folder, _, file = name.partition("/")
            if file.endswith(_NPY) and "/" not in file and is_field_name(folder):
                found.setdefault(folder, []).append(intern(file))  # shared by all fields
        found[SCANS].sort(key=_number)
        return {folder: tuple(files) for folder, files in found.items()}

    @property
    def inside(self) -> Sequence[str]:
        """Names of all its files, relative to its folder."""
        start = len(self.folder) + 1 if self.folder else 0
        below = tuple(f"{each}/" for each in self.nested)
        names = self.tree.under(self.folder)
        return [name[start:] for name in names if not (below and name.startswith(below))]

    @property
    def scans(self) -> tuple[str, ...]:
        """File names of its scans, in their order."""
        return self.files[SCANS]

    def name(self, *parts: str) -> str:
        """Return the name of one of its files in the tree."""
        return "/".join(filter(None, (self.folder, *parts)))

    def lists(self) -> dict[str, bytes]:
        """Read its split lists, as many as there are."""
        names = {split: self.name(f"{split}.txt") for split in LISTS}
        return {split: self.tree.read(name) for split, name in names.items() if name in self.tree}


def is_release(names: Sequence[str]) -> bool:
    """Tell by the names of its files whether a tree holds sessions of the published layout."""
    return any(_session_of(name) is not None for name in names)


def find_sessions(tree: Tree) -> tuple[Session, ...]:
    """Return the sessions of a tree, at whatever depth, sorted by their folders."""
    found = {_session_of(name) for name in tree.names} - {None}
    folders = sorted(folder for folder in found if folder is not None)
    return tuple(
        Session(tree, folder, tuple(other for other in folders if _is_below(other, folder)))
        for folder in folders
    )


def is_field_name(folder: str) -> bool:
    """Tell whether a folder may be a field: its name is part of names in ``/original``."""
    return _FIELD_NAME.fullmatch(folder) is not None


@dataclass(frozen=True)
class Listing:
    """What the ``dataset.txt`` files of a tree say, against the sessions that there are.

    Parameters
    ----------
    missing
        Folders that are listed, and are no session.
    unlisted
        Sessions beside a ``dataset.txt`` that does not name them.
    """

    missing: tuple[str, ...]
    unlisted: tuple[str, ...]

    @property
    def notices(self) -> tuple[str, ...]:
        """What does not fit, in words."""
        found = (
            (self.missing, "folders are listed and hold no session"),
            (self.unlisted, "sessions are not listed: converted all the same"),
        )
        return tuple(f"{DATASET}: {len(n)} {what} (first: {n[0]})" for n, what in found if n)


def check_listing(tree: Tree, sessions: Sequence[Session]) -> Listing:
    """Compare every ``dataset.txt`` with the sessions below its folder.

    Only lines that hold a ``-`` count, as for other readers of the layout.
    """
    missing, unlisted = [], []
    folders = {session.folder for session in sessions}
    for name in tree.names:
        above, _, file = name.rpartition("/")
        if file != DATASET:
            continue
        lines = tree.read(name).decode("utf-8", "replace").splitlines()
        wanted = [line.strip().strip("/") for line in lines if "-" in line]
        listed = {f"{above}/{line}" if above else line for line in wanted}
        missing += sorted(listed - folders)
        below = {folder for folder in folders if not above or _is_below(folder, above)}
        unlisted += sorted(below - listed)
    return Listing(tuple(missing), tuple(unlisted))


def _session_of(name: str) -> str | None:
    """Return the session folder that a scan file lies in; None for any other file."""
    at = f"/{name}".find(_MARK)
    if at < 0 or not name.endswith(_NPY) or "/" in name[at + len(_MARK) :]:
        return None
    return name[: max(at - 1, 0)]


def _is_below(folder: str, above: str) -> bool:
    return folder != above and (not above or folder.startswith(f"{above}/"))


def _number(file: str) -> tuple[float, str]:
    """Sort numbers by their value, also those without leading zeros; other names last."""
    stem = file[: -len(_NPY)]
    return (int(stem) if stem.isascii() and stem.isdigit() else float("inf"), file)
