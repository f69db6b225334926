"""Running blocks on threads, processes or a cluster, with progress and a checkpoint."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ThreadPoolExecutor,
    wait,
)
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from certbound.errors import SolverError
from certbound.parallel import lent
from certbound.simulation.blocks import Tally, Work, run_blocks
from certbound.simulation.checkpoint import Checkpoint

_STEPS_PER_CHUNK = 4e7  # about a quarter of a second
_FEWEST_CHUNKS = 64
_SAVE_EVERY = 2.0  # seconds between two checkpoints


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Progress:
    """Where a run stands."""

    # paths done, and asked for
    paths: int
    total: int
    rate: float  # path-steps per second, of this run
    remaining: float  # estimated seconds left


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Outcome:
    """A finished run: what was counted, in how many seconds, at how many path-steps each."""

    tally: Tally
    seconds: float
    rate: float


def run_work(
    work: Work,
    executor: Any = None,
    checkpoint: str | Path | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> Outcome:
    """Run all blocks of a piece of work.

    Parameters
    ----------
    executor : concurrent.futures.Executor or dask Client, optional
        Threads of this process when omitted. The answer is the same on any.
    checkpoint : path, optional
        File that keeps finished chunks; an existing one is continued.
    progress : callable, optional
        Called with a `Progress` after each chunk.

    Raises
    ------
    SolverError
        If the executor breaks down; finished chunks are in the checkpoint.
    """
    work.compile()
    chunk = _chunk(work)
    record = Checkpoint.open(checkpoint, work, chunk) if checkpoint is not None else Checkpoint.fresh(work, chunk)
    begin = time.perf_counter()
    steps_before, saved = record.tally.steps, begin
    todo = record.missing()
    with _pool(executor) as (pool, width):
        try:
            for number, tally in _completed(pool, width, work, chunk, todo):
                record.add(number, tally)
                now = time.perf_counter()
                if progress is not None:
                    progress(_progress(record, work, now - begin, steps_before))
                if now - saved > _SAVE_EVERY:
                    record.save()
                    saved = now
        except (BrokenExecutor, CancelledError, OSError, TimeoutError) as error:
            raise SolverError(_breakdown(error, record, work, checkpoint)) from error
        finally:
            record.save()
    seconds = time.perf_counter() - begin
    return Outcome(tally=record.tally, seconds=seconds, rate=(record.tally.steps - steps_before) / max(seconds, 1e-9))


def _breakdown(error: BaseException, record: Checkpoint, work: Work, checkpoint: Any) -> str:
    """Message for an executor that broke down."""
    why = "its tasks were cancelled: the scheduler is gone" if isinstance(error, CancelledError) else str(error)
    cure = f"run again with the checkpoint {checkpoint} to go on" if checkpoint else "give `checkpoint=` to keep work"
    return (
        f"the executor broke down after {record.tally.paths} of {work.paths} paths "
        f"({type(error).__name__}: {why}); {cure}."
    )


def _chunk(work: Work) -> int:
    """Blocks per chunk: it depends on the work alone, so that any executor can go on with a checkpoint."""
    by_time = int(_STEPS_PER_CHUNK // (work.block * work.steps))
    return max(1, min(by_time, work.blocks // _FEWEST_CHUNKS))


def _progress(record: Checkpoint, work: Work, seconds: float, steps_before: int) -> Progress:
    done = record.tally.paths
    fresh = max(done - record.paths_before, 1)
    return Progress(
        paths=done,
        total=work.paths,
        rate=(record.tally.steps - steps_before) / max(seconds, 1e-9),
        remaining=seconds / fresh * (work.paths - done),
    )


def _completed(pool: Executor, width: int, work: Work, chunk: int, todo: list[int]) -> Iterator[tuple[int, Tally]]:
    """Chunks as they finish, with a bounded number in flight."""
    waiting: dict[Future[Tally], int] = {}
    queue = iter(todo)
    try:
        while True:
            for number in queue:
                waiting[_submit(pool, work, number, chunk)] = number
                if len(waiting) >= 2 * width + 1:
                    break
            if not waiting:
                return
            finished, _ = wait(waiting, return_when=FIRST_COMPLETED)
            failed = [future for future in finished if _error(future) is not None]
            for future in finished.difference(failed):
                yield waiting.pop(future), future.result()
            if failed:
                _first_error(failed, waiting).result()  # raises, once what is finished has been kept
    finally:
        for future in waiting:
            future.cancel()


def _error(future: Future[Tally]) -> BaseException | None:
    return CancelledError() if future.cancelled() else future.exception()


def _first_error(failed: list[Future[Tally]], waiting: dict[Future[Tally], int]) -> Future[Tally]:
    """The failed chunk of the lowest number, so that a defect of the model is reported the same way always."""
    if isinstance(_error(failed[0]), ValueError):
        last = min(waiting[future] for future in failed)
        before = [future for future, number in waiting.items() if number < last]
        wait(before)
        failed = failed + [future for future in before if _error(future) is not None]
    return min(failed, key=lambda future: waiting[future])


def _submit(pool: Executor, work: Work, number: int, chunk: int) -> Future[Tally]:
    return pool.submit(run_blocks, work, number * chunk, min((number + 1) * chunk, work.blocks))


@contextmanager
def _pool(executor: Any) -> Iterator[tuple[Executor, int]]:
    """The executor to use and how many chunks it runs at a time."""
    if executor is None:
        width = _cores()
        pool = ThreadPoolExecutor(width, thread_name_prefix="certbound")
        try:
            yield pool, width
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
    else:
        with lent(executor) as taken:
            yield taken


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
