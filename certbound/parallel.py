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
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future
from concurrent.futures import wait as first_of
from functools import lru_cache, partial
from multiprocessing.connection import Connection, wait
from typing import Any, Protocol

from certbound.errors import EngineError, SolverError
from certbound.watch import OutOfTime, Watch, seconds_left, silenced, undisturbed

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


class Staff(Protocol):
    """Who is given arguments under a key; ``apart``: whether this process is free for work of its own meanwhile."""

    width: int
    apart: bool

    def begin(self, key: Hashable, *arguments: Any, hands: int | None = None) -> None: ...

    def finished(self) -> list[tuple[Any, Answer]]: ...


@contextlib.contextmanager
def crew(jobs: int, executor: Any = None) -> Iterator[Crew]:
    """Copies of this process, ``jobs`` at a time, or an executor; what is unfinished at the end is given up."""
    with contextlib.nullcontext() if executor is None else lent(executor) as taken:
        found: Crew = _Pool(*taken) if taken is not None else _Copies(jobs) if _can_copy() else _Nobody()
        try:
            yield found
        finally:
            found.close()


@contextlib.contextmanager
def staff(work: Callable[..., Any], jobs: int, executor: Any = None) -> Iterator[Staff]:
    """Who calls one function with one task's arguments after the other's: the same answers whoever it is.

    Copies of this process that stay, ``jobs`` at a time, which are sent arguments and send answers back, both pickled;
    or an executor, for which the function is pickled too. One process does all where there is one job, or where it
    cannot be copied.
    """
    found: Staff
    if executor is not None:
        with crew(jobs, executor) as taken:
            yield _Asked(work, taken)
    elif jobs < 2 or not _can_copy():
        with alone():
            yield _Asked(work, _Nobody())
    else:
        found = _Servants(work, jobs)
        try:
            yield found
        finally:
            found.close()


def _can_copy() -> bool:
    """Whether this process may have copies: a worker of somebody's ``multiprocessing.Pool`` may not."""
    return "fork" in multiprocessing.get_all_start_methods() and not multiprocessing.current_process().daemon


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
        with undisturbed():  # what is interrupted at the fork loses the process, or its locks
            pipe, process = _copied(_work, task)
            self._running[pipe] = key, process

    def finished(self) -> list[tuple[Any, Answer]]:
        found = []
        for pipe in wait(list(self._running), _LOOK):
            assert isinstance(pipe, Connection)
            key, process = self._running.pop(pipe)
            found.append((key, _received(pipe)))
            pipe.close()
            process.join()
        return found

    def close(self) -> None:
        _ended((pipe, process) for pipe, (_, process) in self._running.items())


class _Servants:
    """Copies of this process that stay until the end; arguments wait in the pipe of one that is at work."""

    apart = True

    def __init__(self, work: Callable[..., Any], jobs: int) -> None:
        self.width = jobs
        self._work = work
        self._processes: dict[Connection, Any] = {}
        self._given: dict[Connection, deque[Hashable]] = {}

    def begin(self, key: Hashable, *arguments: Any, hands: int | None = None) -> None:
        """Give it to whoever has the least to do of ``hands`` processes (all)."""
        pipe = min(self._given, key=lambda one: len(self._given[one]), default=None)
        if pipe is None or (self._given[pipe] and len(self._given) < (hands or self.width)):
            with undisturbed():
                pipe, process = _copied(_serve, self._work)
                self._processes[pipe], self._given[pipe] = process, deque()
        self._given[pipe].append(key)
        with contextlib.suppress(BrokenPipeError):  # of one that was ended: its answer says so
            pipe.send(arguments)

    def finished(self) -> list[tuple[Any, Answer]]:
        at_work = [pipe for pipe, keys in self._given.items() if keys]
        ready: list[Any] = wait(at_work, _LOOK)
        return [(self._given[pipe].popleft(), _received(pipe)) for pipe in ready]

    def close(self) -> None:
        _ended(self._processes.items())


class _Asked:
    """A crew that calls one function."""

    apart = False

    def __init__(self, work: Callable[..., Any], workers: Crew) -> None:
        self.width = workers.width
        self._work, self._workers = work, workers
        self.finished = workers.finished

    def begin(self, key: Hashable, *arguments: Any, hands: int | None = None) -> None:
        self._workers.begin(key, partial(self._work, *arguments))


def _copied(target: Callable[[Any, Connection], None], given: Any) -> tuple[Connection, Any]:
    """Our end of a pipe to a copy of this process, which calls ``target`` with what is given and its end; the copy."""
    ours, theirs = multiprocessing.Pipe()
    process = multiprocessing.get_context("fork").Process(target=target, args=(given, theirs), daemon=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of copies beside a thread that only writes lines
        process.start()
    theirs.close()
    return ours, process


def _ended(copies: Iterable[tuple[Connection, Any]]) -> None:
    for pipe, process in copies:
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


def _serve(work: Callable[..., Any], pipe: Connection) -> None:
    """In the copy: an answer for each tuple of arguments."""
    silenced()
    threading.Thread(target=_end_with_parent, daemon=True).start()
    while True:
        pipe.send(_answer(partial(work, *pipe.recv())))


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
    except (EOFError, ConnectionResetError):
        words = "a process at work on a part was ended; give it fewer jobs, or more memory."
        return None, LostError(words)
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
