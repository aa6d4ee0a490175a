"""Many recordings: one after the other, in several processes, or on a Dask cluster."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from tqdm import tqdm

from conversion.convert import Result, convert_recording
from conversion.options import Options
from conversion.provenance import Done, find_done
from semantic2d_dataset.errors import InvalidInputError, Semantic2DError

_CONNECT_S = 10
_RETRIES = 3  # of a recording whose worker died: Dask runs it on another


@dataclass(frozen=True)
class Job:
    """One recording to convert: a pure function of what it holds."""

    recording: tuple[Path, ...]
    out: Path
    options: Options
    force: bool
    done: Done


@dataclass(frozen=True)
class Outcome:
    """What became of a recording: its sequences, or why there are none."""

    recording: str
    results: tuple[Result, ...] = ()
    error: str | None = None

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
    if scheduler is not None:
        yield from _with_bar(_on_cluster(todo, scheduler), len(todo))
    elif len(todo) == 1:
        yield _convert(todo[0])
    elif jobs > 1:
        yield from _with_bar(_in_processes(todo, jobs), len(todo))
    else:
        yield from map(run, todo)


def run(job: Job) -> Outcome:
    """Convert one recording; what is wrong with it is part of the outcome."""
    name = str(job.recording[0])
    try:
        return _convert(job)
    except Semantic2DError as err:
        return Outcome(name, error=str(err))
    except OSError as err:
        return Outcome(name, error=f"{err.filename or name}: {(err.strerror or str(err)).lower()}")


def _convert(job: Job) -> Outcome:
    results = convert_recording(job.recording, job.out, job.options, force=job.force, done=job.done)
    return Outcome(str(job.recording[0]), results)


def _in_processes(todo: Sequence[Job], jobs: int) -> Iterator[Outcome]:
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        waiting = {pool.submit(run, job): job for job in todo}
        try:
            for future in as_completed(waiting):
                yield _outcome(future, waiting[future])
        finally:
            pool.shutdown(cancel_futures=True)


def _outcome(future: Future[Outcome], job: Job) -> Outcome:
    try:
        return future.result()
    except BrokenProcessPool:
        why = "a process was killed (is memory short?); run again to convert what is missing"
        return Outcome(str(job.recording[0]), error=f"{job.recording[0]}: {why}")


def _on_cluster(todo: Sequence[Job], address: str) -> Iterator[Outcome]:
    from distributed import as_completed as done_first

    with _client(address) as client:
        waiting = client.map(run, todo, pure=False, retries=_RETRIES)
        jobs = dict(zip((future.key for future in waiting), todo, strict=True))
        for future, outcome in done_first(waiting, with_results=True, raise_errors=False):
            if future.status == "finished":
                yield outcome
            else:
                name = str(jobs[future.key].recording[0])
                yield Outcome(name, error=f"{name}: given up by the cluster: {outcome[1]!r}")


@contextmanager
def _client(address: str) -> Iterator[Any]:
    try:
        from distributed import Client
    except ImportError as err:
        raise InvalidInputError(
            "--scheduler needs Dask: pip install 'semantic2d-dataset[dask]'"
        ) from err
    try:
        client = Client(address, timeout=_CONNECT_S)
    except (OSError, ValueError) as err:
        raise InvalidInputError(
            f"{address}: no Dask scheduler answers there: {err}; start one with: dask scheduler"
        ) from err
    try:
        yield client
    finally:
        client.close()


def _with_bar(outcomes: Iterator[Outcome], total: int) -> Iterator[Outcome]:
    yield from tqdm(outcomes, total=total, desc="convert", unit="recording", disable=None)
