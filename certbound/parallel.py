"""Tasks of one proof side by side, in processes that begin as copies of this one and hand back what they found."""

from __future__ import annotations

import multiprocessing
import os
import warnings
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

from certbound.errors import EngineError
from certbound.watch import OutOfTime, poll, silenced

T = TypeVar("T")

_LOOK = 0.1  # seconds between two looks at the clock


def side_by_side(tasks: Sequence[Callable[[], T]], jobs: int) -> list[T]:
    """What the tasks return, in their order: the same whatever ``jobs``, the number that run at a time.

    A task is called in a copy of this process and what it returns is pickled, so that nothing else that it does is
    seen here. One process does all where there is one task or job, or where the system cannot copy processes.
    ``OutOfTime`` ends them all; what else a task raises is raised here.
    """
    if min(jobs, len(tasks)) < 2 or "fork" not in multiprocessing.get_all_start_methods():
        return [task() for task in tasks]
    found: dict[int, Any] = {}
    running: dict[Connection, tuple[int, Any]] = {}
    waiting = list(enumerate(tasks))
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                index, task = waiting.pop(0)
                ours, process = _begun(task)
                running[ours] = index, process
            for pipe in wait(list(running), _LOOK):
                assert isinstance(pipe, Connection)
                index, process = running.pop(pipe)
                found[index] = _received(pipe)
                process.join()
            poll()
    finally:
        for pipe, (_, process) in running.items():
            process.kill()
            process.join()
            pipe.close()
    return [found[index] for index in range(len(tasks))]


def _begun(task: Callable[[], Any]) -> tuple[Connection, Any]:
    ours, theirs = multiprocessing.Pipe(duplex=False)
    process = multiprocessing.get_context("fork").Process(target=_work, args=(task, theirs), daemon=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of copies beside a thread that only writes lines
        process.start()
    theirs.close()
    return ours, process


def _work(task: Callable[[], Any], pipe: Connection) -> None:
    """In the copy: what the task returns, or raises, as a pair."""
    silenced()
    try:
        answer: tuple[Any, BaseException | None] = task(), None
    except BaseException as error:  # noqa: BLE001  (whatever it is, it is raised again in the first process)
        answer = None, error
    pipe.send(answer)
    pipe.close()
    os._exit(0)  # nothing that belongs to the first process is cleaned up here


def _received(pipe: Connection) -> Any:
    try:
        result, error = pipe.recv()
    except EOFError:
        raise EngineError("a process at work on a part was ended; give it fewer jobs, or more memory.") from None
    finally:
        pipe.close()
    if isinstance(error, OutOfTime):
        raise OutOfTime
    if error is not None:
        raise error
    return result
