"""Where a topic's scans are divided: one sequence has one set of beams, and stamps that go on."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from conversion.messages.survey import Run, ScanLog, Survey
from conversion.ros.bags import seconds
from semantic2d_dataset.errors import RecordingError

_MAX_PARTS = 100
_OFTEN = 10  # backward steps: not a clock that was set, but stamps that cannot be used
_MAX_LEAD_DIFFERENCE_NS = 5_000_000_000


@dataclass(frozen=True)
class Part:
    """Scans of one topic that become one sequence.

    Parameters
    ----------
    log
        The topic.
    run
        The beams that its scans share.
    stamps_ns, record_ns
        (n,) i8, stamps of the sequence and times of recording; neither goes backward.
    skip
        Scans of the topic with the record time of the first one that belong before it.
    number, count
        Which part of the topic it is, from 1.
    notices
        What was noticed about it, for the user.
    """

    log: ScanLog
    run: Run
    stamps_ns: NDArray[np.int64]
    record_ns: NDArray[np.int64]
    skip: int
    number: int
    count: int
    notices: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.stamps_ns)


def choose_stamps(path: Path, found: Survey, wanted: str) -> tuple[str, tuple[str, ...]]:
    """Choose between header stamps and times of recording.

    ``auto`` takes the headers', unless they are all the same, the scans' and the poses' are of
    clocks that differ, or they go backward so often that little would be left in one piece.

    Returns
    -------
    stamps, notices
        ``header`` or ``record``, and why where that is not what one would expect.

    Raises
    ------
    RecordingError
        If the stamps that were asked for are all the same.
    """
    for log in found.scans:
        same = _all_same(log.record_ns if wanted == "record" else log.header_ns)
        if same and wanted == "auto":
            why = f"all headers of {log.topic.name} have one stamp"
            return "record", (f"{why}: record times taken",)
        if same:
            advice = "its times of recording are damaged"
            if wanted == "header":
                advice = "pass --stamps record to use the times of recording"
            raise RecordingError(
                path, f"{log.topic.name}: all {len(log)} scans have one stamp; {advice}"
            )
        backward = int((np.diff(log.header_ns) < 0).sum())
        if backward >= _OFTEN and wanted == "auto":
            why = f"headers of {log.topic.name} go backward {backward} times"
            return "record", (f"{why}: record times taken; --stamps header divides there",)
        apart = _clocks_apart_ns(found, log)
        if apart and wanted == "auto":
            why = f"headers of {log.topic.name} are {apart / 1e9:.1f} s off the poses'"
            return "record", (f"{why}: record times taken; --stamps header overrides",)
    return ("header" if wanted == "auto" else wanted), ()


def divide(path: Path, log: ScanLog, stamps: str) -> tuple[Part, ...]:
    """Divide the scans of a topic where the beams change or the stamps go backward.

    Raises
    ------
    RecordingError
        If that would be more parts than a person wants.
    """
    stamps_ns, record_ns = log.header_ns if stamps == "header" else log.record_ns, log.record_ns
    backward = np.flatnonzero(np.diff(stamps_ns) < 0) + 1
    starts = np.union1d([run.first for run in log.runs], backward).astype(np.int64)
    if len(starts) > _MAX_PARTS:
        raise RecordingError(path, _too_many(log, stamps_ns, backward, len(starts)))
    ends = [*starts[1:].tolist(), len(stamps_ns)]
    firsts = np.array([run.first for run in log.runs])
    parts = []
    for number, (start, end) in enumerate(zip(starts.tolist(), ends, strict=True), 1):
        run = log.runs[int(np.searchsorted(firsts, start, side="right")) - 1]
        back = f"stamps go back by {_step_back(stamps_ns, start)}"
        why = run.change if run.first == start else back
        inside = slice(start, end)
        parts.append(
            Part(
                log,
                run,
                stamps_ns[inside],
                record_ns[inside],
                skip=start - int(np.searchsorted(record_ns, record_ns[start], side="left")),
                number=number,
                count=len(starts),
                notices=(
                    *((f"begins where {why}",) if number > 1 else ()),
                    *_oddities(log, run, stamps_ns[inside]),
                ),
            )
        )
    return tuple(parts)


def _all_same(stamps_ns: NDArray[np.int64]) -> bool:
    return len(stamps_ns) > 1 and not np.ptp(stamps_ns)


def _too_many(
    log: ScanLog, stamps_ns: NDArray[np.int64], backward: NDArray[np.int64], count: int
) -> str:
    why = []
    if backward.size:
        first = _step_back(stamps_ns, int(backward[0]))
        why.append(f"stamps go backward {len(backward)} times, first by {first}")
    if len(log.runs) > 1:
        changes = "; ".join(run.change for run in log.runs[1:4])
        why.append(f"beams change {len(log.runs) - 1} times ({changes} ...)")
    return (
        f"{log.topic.name}: would be {count} sequences: {'; '.join(why)}; pass --stamps record to "
        "use the times of recording, or mend the recording"
    )


def _step_back(stamps_ns: NDArray[np.int64], at: int) -> str:
    return f"{(stamps_ns[at - 1] - stamps_ns[at]) / 1e9:.3f} s to {seconds(int(stamps_ns[at]))}"


def _clocks_apart_ns(found: Survey, log: ScanLog) -> int:
    """How far headers of scans and of every source of poses differ, 0 where any of them agrees."""
    leads = [track.lead_ns for track in (*found.transforms.moving(), *found.poses.tracks.values())]
    apart = [abs(log.lead_ns - lead) for lead in leads]
    return min(apart, default=0) if min(apart, default=0) > _MAX_LEAD_DIFFERENCE_NS else 0


def _oddities(log: ScanLog, run: Run, stamps_ns: NDArray[np.int64]) -> tuple[str, ...]:
    notices = []
    repeated = int((np.diff(stamps_ns) == 0).sum())
    if repeated:
        notices.append(f"{repeated} scans repeat the stamp before them: kept")
    usual = {run.beams.count} if run.has_intensities else {0, run.beams.count}
    odd = sum(n for count, n in run.intensity_counts.items() if count not in usual)
    if odd:
        notices.append(f"{odd} scans lack one intensity for each beam: NaN, or left out if all do")
    if log.empty:
        notices.append(f"{log.empty} messages of {log.topic.name} without beams: left out")
    return tuple(notices)
