"""What a run did, for people and for programs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from semantic2d_dataset.pipeline.config import Config
from semantic2d_dataset.pipeline.labelling import Labelled


@dataclass(frozen=True)
class Row:
    """What became of a recording.

    Parameters
    ----------
    recording
        Its id.
    sequences
        Its labelled sequences.
    converted
        Whether any of these was converted anew.
    seconds
        How long it took, s.
    error
        Why there is none.
    """

    recording: str
    sequences: tuple[Labelled, ...] = ()
    converted: bool = False
    seconds: float = 0.0
    error: str | None = None

    @property
    def state(self) -> str:
        """``failed``, ``kept`` (all was there), ``labelled`` (from what was there), ``made``."""
        if self.error is not None:
            return "failed"
        if self.converted:
            return "made"
        return "kept" if all(each.kept for each in self.sequences) else "labelled"

    @property
    def scans(self) -> int:
        """Scans of all its sequences."""
        return sum(each.scans for each in self.sequences)

    @property
    def accepted(self) -> int:
        """How many of these fit the map."""
        return sum(each.accepted for each in self.sequences)

    @property
    def labelled_share(self) -> float:
        """Share of the beams that have a label, the mean over the scans."""
        total = sum(each.scans * each.labelled_share for each in self.sequences)
        return total / max(1, self.scans)


@dataclass(frozen=True)
class Report:
    """What became of all recordings, and of the data set.

    Parameters
    ----------
    config
        What was to be made.
    rows
        One for each recording.
    published
        Whether the data set is what the configuration says.
    changed
        Whether it was another one, or none, before.
    """

    config: Config
    rows: tuple[Row, ...]
    published: bool
    changed: bool

    @property
    def failed(self) -> int:
        """How many recordings failed."""
        return sum(row.error is not None for row in self.rows)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "out": str(self.config.out),
            "published": self.published,
            "changed": self.changed,
            "recordings": [
                {
                    "recording": row.recording,
                    "state": row.state,
                    "error": row.error,
                    "sequences": [each.sequence_id for each in row.sequences],
                    "scans": row.scans,
                    "accepted": row.accepted,
                    "labelled_share": row.labelled_share,
                    "seconds": row.seconds,
                }
                for row in self.rows
            ],
        }

    def __str__(self) -> str:
        width = max(len("recording"), *(len(row.recording) for row in self.rows))
        head = f"{'recording':<{width}}  sequences    scans  accepted  labelled  seconds  state"
        return "\n".join([head, *(_line(row, width) for row in self.rows), self._end()])

    def _end(self) -> str:
        out, failed = self.config.out, self.failed
        if failed:
            return (
                f"{failed} of {len(self.rows)} recordings failed, so nothing was published; "
                "run again to go on from what is done"
            )
        if not self.published:
            return f"nothing was published: {len(self.rows)} recordings were chosen, not all"
        name = f"{self.config.name} {self.config.version}"
        if not self.changed:
            return f"{out}: {name} is complete already"
        return f"{out}: published {name}; look at it with: semantic2d info {out}"


def _line(row: Row, width: int) -> str:
    start = f"{row.recording:<{width}}"
    if row.error is not None:
        return f"{start}  {row.seconds:>47.1f}  failed: {row.error}"
    return (
        f"{start}  {len(row.sequences):>9}  {row.scans:>7}  {row.accepted:>8}  "
        f"{row.labelled_share:>8.1%}  {row.seconds:>7.1f}  {row.state}"
    )
