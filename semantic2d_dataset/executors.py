"""Where pure functions run: in this process, in several of this machine, or on a Dask cluster.

An executor has one method, `Executor.map`: a function over items, results in the order of the
items. Function and items travel to where they run, so both must be picklable; a function that
touches no file but new ones may be run again where a process died.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from itertools import islice
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any, Generic, Self, TypeVar

from tqdm import tqdm

from semantic2d_dataset.errors import InvalidInputError, WorkerLostError

Item = TypeVar("Item")
Result = TypeVar("Result")

Lost = Callable[[Item, WorkerLostError], Result]

_CONNECT_S = 10
_AHEAD = 2
"""Items under way for each worker: one that is worked on, one that waits for it to be free."""


class Executor(ABC):
    """Runs pure functions; a context manager.

    Parameters
    ----------
    workers
        How many items are worked on at a time.
    """

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.close(at_once=kind is not None)

    @property
    @abstractmethod
    def workers(self) -> int:
        """How many items are worked on at a time."""

    @abstractmethod
    def map(
        self,
        function: Callable[[Item], Result],
        items: Iterable[Item],
        *,
        in_order: bool = True,
        lost: Lost[Item, Result] | None = None,
    ) -> Iterator[Result]:
        """Yield the function of each item.

        At most twice as many items as there are workers are under way, or done and not yet
        taken: memory is bounded, however many items there are.

        Parameters
        ----------
        function
            A function of a module, or a `functools.partial` of one.
        items
            Taken one by one, as there is room.
        in_order
            Whether results come in the order of the items; else as they are done.
        lost
            What stands for the result of an item whose worker died.

        Raises
        ------
        WorkerLostError
            If a worker died with an item, again where it was tried once more, and `lost` is not
            given.
        Exception
            What the function raises; no more items are begun then.
        """

    @abstractmethod
    def close(self, *, at_once: bool = False) -> None:
        """Begin nothing more, and wait for what still runs, or stop it at once."""


class Serial(Executor):
    """Runs all in this process, one item after the other."""

    @property
    def workers(self) -> int:
        """One."""
        return 1

    def map(
        self,
        function: Callable[[Item], Result],
        items: Iterable[Item],
        *,
        in_order: bool = True,  # noqa: ARG002 - they always are
        lost: Lost[Item, Result] | None = None,  # noqa: ARG002 - so would we be
    ) -> Iterator[Result]:
        """Yield the function of each item, see `Executor.map`."""
        return map(function, items)

    def close(self, *, at_once: bool = False) -> None:
        """Do nothing, see `Executor.close`."""


@dataclass(frozen=True, eq=False)
class _Task(Generic[Item, Result]):
    function: Callable[[Item], Result]
    item: Item
    future: Any


class _Distributed(Executor):
    """Keeps a bounded number of items under way, wherever they are."""

    def map(
        self,
        function: Callable[[Item], Result],
        items: Iterable[Item],
        *,
        in_order: bool = True,
        lost: Lost[Item, Result] | None = None,
    ) -> Iterator[Result]:
        """Yield the function of each item, see `Executor.map`."""
        left, limit = iter(items), _AHEAD * self.workers
        waiting: list[_Task[Item, Result]] = []
        try:
            while True:
                waiting += (
                    _Task(function, item, self._submit(function, item))
                    for item in islice(left, limit - len(waiting))
                )
                if not waiting:
                    return
                task = waiting[0] if in_order else self._first_done(waiting)
                result = self._outcome(task, lost)
                waiting.remove(task)
                yield result
        finally:
            for task in waiting:
                task.future.cancel()

    def _outcome(self, task: _Task[Item, Result], lost: Lost[Item, Result] | None) -> Result:
        try:
            return self._result(task)
        except WorkerLostError as err:
            if lost is None:
                raise
            return lost(task.item, err)

    @abstractmethod
    def _submit(self, function: Callable[[Item], Result], item: Item) -> Any:
        """Return the future of an item."""

    @abstractmethod
    def _first_done(self, waiting: list[_Task[Item, Result]]) -> _Task[Item, Result]:
        """Wait until one is done."""

    @abstractmethod
    def _result(self, task: _Task[Item, Result]) -> Result:
        """Wait for the result of a task."""


class Processes(_Distributed):
    """Processes of this machine, started anew (spawn) and kept for all calls of `map`.

    Numba uses one thread in each, unless NUMBA_NUM_THREADS says otherwise. They end with the
    process that started them, however it ends.

    Parameters
    ----------
    jobs
        How many.
    """

    def __init__(self, jobs: int) -> None:
        self._jobs = jobs
        self._start()

    @property
    def workers(self) -> int:
        """How many processes there are."""
        return self._jobs

    def close(self, *, at_once: bool = False) -> None:
        """End the processes, see `Executor.close`."""
        if at_once:
            self._lifeline.close()
        self._pool.shutdown(cancel_futures=True)
        self._lifeline.close()
        self._watched.close()

    def _start(self) -> None:
        context = get_context("spawn")
        self._watched, self._lifeline = context.Pipe(duplex=False)
        self._pool = ProcessPoolExecutor(
            self._jobs, context, initializer=_begin_worker, initargs=(self._watched,)
        )

    def _submit(self, function: Callable[[Item], Result], item: Item) -> Future[Result]:
        # Ctrl-C is for this process, which ends them: they start, and stay, with it blocked
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            return self._pool.submit(function, item)
        except BrokenProcessPool:
            self.close()
            self._start()
            return self._pool.submit(function, item)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def _first_done(self, waiting: list[_Task[Item, Result]]) -> _Task[Item, Result]:
        done = wait([task.future for task in waiting], return_when=FIRST_COMPLETED).done
        return next(task for task in waiting if task.future in done)

    def _result(self, task: _Task[Item, Result]) -> Result:
        """Wait for a result; where a process died, try once more, in a process of its own.

        One process that dies takes the items of all with it, so that none is to blame yet.
        """
        try:
            return task.future.result()  # type: ignore[no-any-return]
        except BrokenProcessPool:
            pass
        with Processes(1) as alone:
            try:
                return alone._submit(task.function, task.item).result()
            except BrokenProcessPool as err:
                raise WorkerLostError(
                    "a process was killed (is memory short?); run again to go on, with fewer jobs"
                ) from err


def _begin_worker(watched: Connection) -> None:
    threading.Thread(target=_end_with, args=(watched,), daemon=True).start()
    tqdm.set_lock(threading.RLock())  # its own spans processes, and is left behind by a sudden end
    os.environ.setdefault("NUMBA_NUM_THREADS", "1")
    if "numba" in sys.modules:  # by a script that imports it at its top
        sys.modules["numba"].set_num_threads(1)


def _end_with(watched: Connection) -> None:
    """End this process when the other end of the pipe is closed, even by a kill."""
    watched.poll(None)
    os._exit(1)


class Cluster(_Distributed):
    """The workers of a Dask cluster, which must see the same files under the same names.

    A task whose worker died is run by another one.

    Parameters
    ----------
    address
        Of the scheduler, such as ``tcp://host:8786``.

    Raises
    ------
    InvalidInputError
        If no scheduler answers there, or Dask is not installed.
    """

    def __init__(self, address: str) -> None:
        try:
            from distributed import Client
        except ImportError as err:
            raise InvalidInputError(
                "--scheduler needs Dask: pip install 'semantic2d-dataset[dask]'"
            ) from err
        try:
            self._client = Client(address, timeout=_CONNECT_S)
        except (OSError, ValueError) as err:
            raise InvalidInputError(
                f"{address}: no Dask scheduler answers there: {err}; start one with: dask scheduler"
            ) from err

    @property
    def workers(self) -> int:
        """How many threads the workers have that are there now; at least one."""
        threads: int = sum(self._client.ncores().values())
        return max(1, threads)

    def close(self, *, at_once: bool = False) -> None:  # noqa: ARG002 - its workers are not ours
        """Leave the cluster, see `Executor.close`."""
        self._client.close()

    def _submit(self, function: Callable[[Item], Result], item: Item) -> Any:
        return self._client.submit(function, item, pure=False)

    def _first_done(self, waiting: list[_Task[Item, Result]]) -> _Task[Item, Result]:
        from distributed import CancelledError
        from distributed import wait as wait_for

        try:
            done = wait_for([task.future for task in waiting], return_when="FIRST_COMPLETED").done
        except CancelledError:  # all of them: the scheduler is gone
            return waiting[0]
        return next(task for task in waiting if task.future in done)

    def _result(self, task: _Task[Item, Result]) -> Result:
        from distributed import CancelledError, KilledWorker
        from distributed.comm import CommClosedError

        try:
            return task.future.result()  # type: ignore[no-any-return]
        except (KilledWorker, CancelledError, CommClosedError, ImportError) as err:
            why = " ".join(str(err).split()) or repr(err)
            raise WorkerLostError(f"given up by the cluster: {why}") from err


def open_executor(*, jobs: int = 1, scheduler: str | None = None) -> Executor:
    """Return the executor that a user asks for.

    Parameters
    ----------
    jobs
        Processes of this machine; 1 is this one.
    scheduler
        Address of a Dask scheduler (``tcp://host:8786``), which is used instead.

    Raises
    ------
    InvalidInputError
        If the scheduler does not answer, or `jobs` is not a number above 0.
    """
    if jobs < 1:
        raise InvalidInputError(f"jobs: expected 1 or more, found {jobs}")
    if scheduler is not None:
        return Cluster(scheduler)
    return Serial() if jobs == 1 else Processes(jobs)
