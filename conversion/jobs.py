"""Many recordings: one after the other, in several processes, or on a Dask cluster."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from conversion.convert import Result, convert_recording
from conversion.options import Options
from conversion.provenance import Done, find_done
from semantic2d_dataset.errors import InvalidInputError, Semantic2DError, WorkerLostError
from semantic2d_dataset.executors import Executor, Serial, open_executor


@dataclass(frozen=True)
class Job:
    """One recording to convert: a pure function of what it holds."""

    recording: tuple[Path, ...]
    out: Path
    options: Options
    force: bool
    done: Done
    replace_outdated: bool = False


@dataclass(frozen=True)
class Outcome:
    """What became of a recording: its sequences, or why there are none; where, and how long."""

    recording: str
    results: tuple[Result, ...] = ()
    error: str | None = None
    out: Path | None = None
    seconds: float = 0.0

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        sequences = [result.as_dict() for result in self.results]
        return {"recording": self.recording, "error": self.error, "sequences": sequences}


def convert_recordings(
    recordings: Sequence[Sequence[Path]],
    out: Path,
    options: Options | None = None,
    *,
    force: bool = False,
    jobs: int = 1,
    scheduler: str | None = None,
) -> Iterator[Outcome]:
    """Convert recordings, and yield what became of each as it is done.

    Of several, one that fails stops no other; what is wrong with a single one is raised.

    Parameters
    ----------
    recordings
        Each by its file or folder, or by its several files.
    out
        A folder; a file name that ends with ``.h5`` for one recording.
    options, force
        As `conversion.convert.convert_recording` takes them.
    jobs
        Processes of this machine.
    scheduler
        Address of a Dask scheduler (``tcp://host:8786``) whose workers see the same files; it is
        used instead of processes.

    Raises
    ------
    InvalidInputError
        If several recordings were to become one file, or the scheduler does not answer.
    Semantic2DError, OSError
        What `conversion.convert.convert_recording` raises, of a single recording.
    """
    options = options or Options()
    if len(recordings) > 1 and out.suffix == ".h5":
        raise InvalidInputError(f"{out}: {len(recordings)} recordings need a folder as --out")
    out = out.resolve() if scheduler else out
    done = find_done(out)
    todo = [
        Job(tuple(p.resolve() if scheduler else p for p in paths), out, options, force, done)
        for paths in recordings
    ]
    if scheduler is None and len(todo) == 1:
        yield _convert(todo[0])
        return
    with open_executor(jobs=jobs, scheduler=scheduler) as executor:
        yield from run_all(todo, executor)


def run_all(todo: Sequence[Job], executor: Executor) -> Iterator[Outcome]:
    """Convert recordings, and yield what became of each as it is done."""
    outcomes = executor.map(run, todo, in_order=False, lost=_lost)
    if not isinstance(executor, Serial):  # where each recording shows a bar of its own
        outcomes = iter(
            tqdm(outcomes, total=len(todo), desc="convert", unit="recording", disable=None)
        )
    yield from outcomes


def run(job: Job) -> Outcome:
    """Convert one recording; what is wrong with it is part of the outcome."""
    name = str(job.recording[0])
    try:
        return _convert(job)
    except Semantic2DError as err:
        return Outcome(name, error=str(err), out=job.out)
    except OSError as err:
        why = f"{err.filename or name}: {(err.strerror or str(err)).lower()}"
        return Outcome(name, error=why, out=job.out)


def _convert(job: Job) -> Outcome:
    began = time.monotonic()
    results = convert_recording(
        job.recording,
        job.out,
        job.options,
        force=job.force,
        replace_outdated=job.replace_outdated,
        done=job.done,
    )
    seconds = time.monotonic() - began
    return Outcome(str(job.recording[0]), results, out=job.out, seconds=seconds)


def _lost(job: Job, error: WorkerLostError) -> Outcome:
    name = str(job.recording[0])
    return Outcome(name, error=f"{name}: {error}", out=job.out)
