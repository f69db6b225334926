"""Tasks side by side, in copies of this process or on somebody's executor: the answers are the same on any.

A task is a call without arguments. Wherever it runs, linear algebra has one thread, because sums that are shared among
threads round otherwise; and no two tasks run at a time in one process, because ball arithmetic has its precision in
common.
"""

from __future__ import annotations

import contextlib
import importlib
import multiprocessing
import os
import sys
import threading
import warnings
from collections.abc import Callable, Hashable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future
from concurrent.futures import wait as first_of
from functools import lru_cache
from multiprocessing.connection import Connection, wait
from typing import Any, Protocol, TypeVar

from certbound.errors import EngineError, SolverError
from certbound.watch import OutOfTime, Watch, poll, seconds_left, silenced, undisturbed

T = TypeVar("T")
Answer = tuple[Any, BaseException | None]
"""What a task returned, or what it raised."""

_LOOK = 0.1  # seconds between two looks at the clock
_ONE = threading.Lock()


class LostError(EngineError):
    """The process at work on a task is gone, and its answer with it."""


class Crew(Protocol):
    """Who works on tasks: `begin` gives one out under a key, `finished` waits a little and collects answers."""

    width: int  # tasks at a time

    def begin(self, key: Hashable, task: Callable[[], Any]) -> None: ...

    def finished(self) -> list[tuple[Any, Answer]]: ...

    def close(self) -> None: ...


@contextlib.contextmanager
def crew(jobs: int, executor: Any = None) -> Iterator[Crew]:
    """Copies of this process, ``jobs`` at a time, or an executor; what is unfinished at the end is given up."""
    copies = "fork" in multiprocessing.get_all_start_methods()
    with contextlib.nullcontext() if executor is None else lent(executor) as taken:
        found: Crew = _Pool(*taken) if taken is not None else _Copies(jobs) if copies else _Nobody()
        try:
            yield found
        finally:
            found.close()


def side_by_side(tasks: Sequence[Callable[[], T]], jobs: int, executor: Any = None) -> list[T]:
    """What the tasks return, in their order: the same whatever ``jobs``, the number that run at a time.

    A task is called in a copy of this process, or on an executor that it is pickled for, and what it returns is
    pickled, so that nothing else that it does is seen here. One process does all where there is one task or job, or
    where the system cannot copy processes. ``OutOfTime`` ends them all; what else a task raises is raised here.
    """
    if len(tasks) < 2 or (executor is None and jobs < 2):
        with alone():
            return [task() for task in tasks]
    found: dict[int, T] = {}
    waiting = list(enumerate(tasks))
    with crew(jobs, executor) as workers:
        while len(found) < len(tasks):
            while waiting and len(tasks) - len(waiting) - len(found) < workers.width:
                workers.begin(*waiting.pop(0))
            for index, answer in workers.finished():
                found[index] = result_of(answer)
            poll()
    return [found[index] for index in range(len(tasks))]


def result_of(answer: Answer) -> Any:
    """What a task returned; what it raised is raised here."""
    value, error = answer
    if error is not None:
        raise OutOfTime if isinstance(error, OutOfTime) else error
    return value


@contextlib.contextmanager
def alone() -> Iterator[None]:
    """One thread of linear algebra in the block, or in a function that this decorates.

    Our matrices are small: threads that wait for each other take twice the processor time, and a busy machine's time.
    """
    if os.environ.get("OPENBLAS_NUM_THREADS") != "1":
        importlib.import_module("scipy.linalg")  # has a library of its own, and only what is loaded is held back

    with _libraries(len(sys.modules)).limit(limits=1, user_api="blas"):
        yield


@lru_cache(maxsize=1)
def _libraries(modules: int) -> Any:
    """Those of linear algebra, which are looked for (for some milliseconds) only where modules were loaded since."""
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


def _answer(task: Callable[[], Any]) -> Answer:
    try:
        with alone():
            return task(), None
    except BaseException as error:  # noqa: BLE001  (whatever it is, it is raised again in the first process)
        return None, error


def _elsewhere(task: Callable[[], Any], left: float | None) -> Answer:
    """On an executor: the answer within the seconds that are left, of one task of a process after the other."""
    with _ONE, Watch(left).running():
        return _answer(task)


class _Copies:
    """Processes that begin as copies of this one; each does one task and sends the answer back."""

    def __init__(self, jobs: int) -> None:
        self.width = jobs
        self._running: dict[Connection, tuple[Hashable, Any]] = {}

    def begin(self, key: Hashable, task: Callable[[], Any]) -> None:
        ours, theirs = multiprocessing.Pipe(duplex=False)
        process = multiprocessing.get_context("fork").Process(target=_work, args=(task, theirs), daemon=True)
        with undisturbed():  # what is interrupted at the fork loses the process, or its locks
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DeprecationWarning)  # of copies beside a thread that only writes lines
                process.start()
            self._running[ours] = key, process
        theirs.close()

    def finished(self) -> list[tuple[Any, Answer]]:
        found = []
        for pipe in wait(list(self._running), _LOOK):
            assert isinstance(pipe, Connection)
            key, process = self._running.pop(pipe)
            found.append((key, _received(pipe)))
            process.join()
        return found

    def close(self) -> None:
        for pipe, (_, process) in self._running.items():
            process.kill()
            process.join()
            pipe.close()


class _Nobody:
    """This process, where copies cannot be had."""

    width = 1

    def __init__(self) -> None:
        self._found: list[tuple[Any, Answer]] = []

    def begin(self, key: Hashable, task: Callable[[], Any]) -> None:
        self._found.append((key, _answer(task)))

    def finished(self) -> list[tuple[Any, Answer]]:
        found, self._found = self._found, []
        for _, (_, error) in found:
            if isinstance(error, (KeyboardInterrupt, SystemExit)):
                raise error
        return found

    def close(self) -> None:
        self._found = []


class _Pool:
    """An executor, twice as many tasks in its queue as it has hands."""

    def __init__(self, pool: Executor, hands: int) -> None:
        self.width = 2 * hands
        self._pool = pool
        self._waiting: dict[Future[Answer], Hashable] = {}

    def begin(self, key: Hashable, task: Callable[[], Any]) -> None:
        left = seconds_left()
        try:
            future = self._pool.submit(_elsewhere, task, left if left < float("inf") else None)
        except RuntimeError as error:  # the executor is broken, or was shut down
            raise SolverError(f"the executor takes no more tasks ({error}); give another one, and go on.") from error
        self._waiting[future] = key

    def finished(self) -> list[tuple[Any, Answer]]:
        done, _ = first_of(self._waiting, _LOOK, FIRST_COMPLETED)
        return [(self._waiting.pop(future), _of(future)) for future in done]

    def close(self) -> None:
        for future in self._waiting:
            future.cancel()


def _of(future: Future[Answer]) -> Answer:
    """What a future holds; an executor that broke down has lost its tasks."""
    try:
        return future.result()
    except (TypeError, AttributeError, ImportError) as error:  # what cannot be pickled, or is not known over there
        raise SolverError(f"the executor could not be given a task ({error}).") from error
    except CancelledError:
        return None, LostError("its task was cancelled: the executor is gone.")
    except Exception as error:  # noqa: BLE001  (each executor has errors of its own for workers that are gone)
        return None, LostError(f"the worker of a part was lost ({type(error).__name__}: {error}).")


def _work(task: Callable[[], Any], pipe: Connection) -> None:
    """In the copy: the answer of a task."""
    silenced()
    threading.Thread(target=_end_with_parent, daemon=True).start()
    pipe.send(_answer(task))
    pipe.close()
    os._exit(0)  # nothing that belongs to the first process is cleaned up here


def _end_with_parent() -> None:
    """Leave nobody at work for a process that was killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _received(pipe: Connection) -> Answer:
    try:
        answer: Answer = pipe.recv()
    except EOFError:
        words = "a process at work on a part was ended; give it fewer jobs, or more memory."
        return None, LostError(words)
    finally:
        pipe.close()
    return answer


@contextlib.contextmanager
def lent(executor: Any) -> Iterator[tuple[Executor, int]]:
    """Somebody's executor, or dask Client, and how many tasks it does at a time; it is left open."""
    if hasattr(executor, "get_executor"):  # a dask Client
        with executor.get_executor(pure=False, retries=10) as pool:
            yield pool, sum(executor.ncores().values()) or 1
    elif hasattr(executor, "submit"):
        yield executor, int(getattr(executor, "_max_workers", 8))
    else:
        kind = type(executor).__name__
        raise TypeError(f"`executor` must be a concurrent.futures.Executor or a dask Client, got a {kind}.")


def connect(address: str, timeout: float = 10.0) -> Any:
    """A dask Client for a scheduler's address, such as ``tcp://host:8786``.

    Raises
    ------
    ValueError
        If dask is not installed, or no scheduler answers there.
    """
    try:
        import distributed
    except ImportError as error:
        raise ValueError("a cluster needs dask; install it with: pip install 'certbound[cluster]'.") from error
    try:
        client: Any = distributed.Client
        return client(address, timeout=timeout)
    except (OSError, TimeoutError, ValueError) as error:
        raise ValueError(
            f"`cluster` must be the address of a running dask scheduler, got {address!r} ({error})."
        ) from error
