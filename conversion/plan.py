"""What a conversion will write, and where it comes from."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from conversion.options import Options
from semantic2d_dataset.format.sequence import SequenceHeader
from semantic2d_dataset.scene.maps import SemanticMap

BLOCK = 512
"""Scans held at once."""

Arrays = dict[str, NDArray[Any]]
"""Rows by the names of `semantic2d_dataset.format.schema.SEQUENCE`."""


@dataclass(frozen=True)
class SequencePlan:
    """One sequence, decided upon before the first range of it is written.

    Parameters
    ----------
    header
        What is said of the sequence; sources, versions and options join its provenance later.
    scans_in, scans_out
        Scans that the source holds for this sequence, and how many of them are written.
    scans_with_pose
        How many of the scans of the source have a pose.
    duration_s
        From the first scan to the last, s.
    blocks
        Reads the source (again), and yields rows of up to `BLOCK` scans at a time; arrays that
        are not per scan (streams, original) may join any of them.
    topic, frame
        Of the scans, as the source names them.
    pose_source, pose_max_gap_s
        Where poses come from, and over what time they were interpolated.
    notices
        What was guessed, for the user.
    reverse_intensities
        Whether intensities were reversed.
    lists
        Split lists of a published layout, their bytes by name (``train``, ``dev``, ``test``).
    members
        (scans_out,) u1, what these lists make of each scan: 0 train, 1 val, 2 test, 255 none.
    scene
        The map, where the source brings one.
    """

    header: SequenceHeader
    scans_in: int
    scans_out: int
    scans_with_pose: int
    duration_s: float
    blocks: Callable[[], Iterator[Arrays]]
    topic: str
    frame: str = ""
    pose_source: str = "none"
    pose_max_gap_s: float | None = None
    notices: tuple[str, ...] = ()
    reverse_intensities: bool = False
    lists: Mapping[str, bytes] = field(default_factory=dict)
    members: NDArray[np.uint8] | None = None
    scene: SemanticMap | None = None


class Source(Protocol):
    """Anything that sequences can be made of, open for reading; a context manager.

    Every failure is a `RecordingError` that names the path.
    """

    path: Path
    kind: str
    """Such as ``ROS 1 bag`` or ``published Semantic2D layout``, for people."""
    versions: Mapping[str, str]
    """Versions of the libraries that read it, for the provenance."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *error: object) -> None: ...

    def files(self) -> Sequence[Path]:
        """Return the files that are read, for digests."""
        ...

    def plans(self, options: Options) -> tuple[SequencePlan, ...]:
        """Decide what becomes of it; at least one sequence."""
        ...
