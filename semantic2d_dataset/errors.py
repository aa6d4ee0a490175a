"""Every error that this package raises on purpose.

::

    Exception
    └── Semantic2DError
        ├── DatasetNotFoundError (FileNotFoundError)   a data set or a part of one is not there
        ├── InvalidInputError (ValueError)             a value, name or shape that cannot be used
        ├── ChecksumError                              bytes differ from their recorded digest
        ├── DownloadError                              a server did not deliver
        ├── OfflineError                               a download was needed, and is not allowed
        ├── CorruptFileError                           a file is truncated, damaged or not complete
        ├── UnsafeFileError                            a file holds what this package never opens
        ├── FormatVersionError                         a file of a newer major format
        ├── RecordingError                             a recording that cannot be converted
        ├── AlignmentError                             scans that do not fit their map
        ├── SubmissionError (ValueError)               predictions that cannot be scored
        ├── WorkerLostError                            a process or worker died with its task
        └── WriteError (OSError)                       a file could not be written

``FileNotFoundError`` and ``PermissionError`` of single files pass through as they are.

There is one warning, which stops nothing: ``LeakageWarning`` (UserWarning), about training on a
split whose test scans are as good as trained on.
"""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from typing import Self


class Semantic2DError(Exception):
    """Root of the tree: catch it to catch all that this package reports."""


class DatasetNotFoundError(Semantic2DError, FileNotFoundError):
    """A data set, or a sequence or split of one, does not exist."""


class InvalidInputError(Semantic2DError, ValueError):
    """A value, name, shape or dtype given by the caller cannot be used."""


class ChecksumError(Semantic2DError):
    """The bytes of a file differ from the digest that was recorded for them."""


class DownloadError(Semantic2DError):
    """A server did not deliver what was asked for."""


class OfflineError(Semantic2DError):
    """A download would be needed, and offline mode forbids it."""


class CorruptFileError(Semantic2DError):
    """A file is truncated, damaged, or not of the kind that it should be."""


class UnsafeFileError(Semantic2DError):
    """A file holds links, filters, types or sizes that this package never opens."""


class FormatVersionError(Semantic2DError):
    """A file was written in a newer major format than this package reads."""


class RecordingError(Semantic2DError):
    """A recording cannot be converted.

    Parameters
    ----------
    path
        The recording.
    message
        What was expected, what was found, and what to do.
    """

    def __init__(self, path: str | PathLike[str], message: str) -> None:
        super().__init__(f"{path}: {message}")
        self.path = path
        self.message = message

    def __reduce__(self) -> tuple[type[Self], tuple[object, ...]]:
        return type(self), (self.path, self.message)


class AlignmentError(Semantic2DError):
    """Scans cannot be aligned with the map that they are said to belong to."""


class SubmissionError(Semantic2DError, ValueError):
    """Predictions cannot be scored; ``problems`` lists every reason found.

    Parameters
    ----------
    path
        The predictions file.
    problems
        One line for each problem.
    """

    def __init__(self, path: str | PathLike[str], problems: Sequence[str]) -> None:
        lines = "".join(f"\n  - {problem}" for problem in problems)
        super().__init__(f"{path}: {len(problems)} problem(s) found{lines}")
        self.path = path
        self.problems = tuple(problems)

    def __reduce__(self) -> tuple[type[Self], tuple[object, ...]]:
        return type(self), (self.path, self.problems)


class WorkerLostError(Semantic2DError):
    """A process of this machine, or a worker of a cluster, died with what it was working on."""


class LeakageWarning(UserWarning):
    """Test scans of a split lie next to train scans, so that scores say little of new scans."""


class WriteError(Semantic2DError, OSError):
    """A file could not be written; nothing was left under its final name."""
