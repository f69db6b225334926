"""Work side by side: the same answers in the same order, and nobody is left behind."""

from __future__ import annotations

import multiprocessing.context
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import certbound as cb
from certbound.errors import EngineError, SolverError
from certbound.parallel import LostError, side_by_side
from certbound.watch import OutOfTime, Watch
from tests.reach.linear.test_bisection import flattening


def squares(count: int) -> list[Callable[[], tuple[int, int]]]:
    return [lambda k=k: (k * k, os.getpid()) for k in range(count)]


@pytest.mark.parametrize("jobs", [1, 2, 5])
def test_answers_come_in_order_from_as_many_processes(jobs: int) -> None:
    found = side_by_side(squares(4), jobs)
    assert [square for square, _ in found] == [0, 1, 4, 9]
    assert ({process for _, process in found} == {os.getpid()}) == (jobs == 1)


def test_an_error_is_raised_here() -> None:
    def wrong() -> int:
        raise ValueError("this one")

    with pytest.raises(ValueError, match="this one"):
        side_by_side([wrong, lambda: 1], 2)


def test_a_process_that_dies_is_named() -> None:
    with pytest.raises(EngineError, match="at work on a part was ended"):
        side_by_side([lambda: os._exit(3), lambda: 1], 2)


def test_the_end_of_the_time_ends_them_all() -> None:
    watch = Watch(0.2)
    began = time.monotonic()
    with pytest.raises(OutOfTime), watch.running():
        side_by_side([lambda: time.sleep(60), lambda: time.sleep(60)], 2)
    assert time.monotonic() - began < 30


def test_a_timer_is_heard_after_the_fork_in_both_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    started = multiprocessing.context.ForkProcess.start
    seen = []

    def interrupted(process: multiprocessing.context.ForkProcess) -> None:
        signal.raise_signal(signal.SIGALRM)  # the timer goes off just before the fork
        seen.append(process)
        started(process)

    monkeypatch.setattr(multiprocessing.context.ForkProcess, "start", interrupted)
    with pytest.raises(OutOfTime), Watch(30.0).running():
        side_by_side([lambda: time.sleep(60)] * 2, 2)
    assert len(seen) == 1
    assert not seen[0].is_alive()
    monkeypatch.undo()
    assert side_by_side([lambda: signal.pthread_sigmask(signal.SIG_BLOCK, [])] * 2, 2) == [set(), set()]


def test_a_verdict_has_one_thread_of_linear_algebra_and_gives_the_others_back(monkeypatch: pytest.MonkeyPatch) -> None:
    def threads() -> set[int]:
        return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}

    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    seen: list[set[int]] = []
    system = cb.linear_system([[-1.0]], diffusion=[[0.1]])
    problem = cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=1)
    with threadpool_limits(2, "blas"):
        given = threads()
        cb.verify_safety(problem, method="linear", progress=lambda _: seen.append(threads()))
        after = threads()
    assert seen
    assert set.union(*seen) == {1}
    assert 2 in given
    assert after == given


@pytest.fixture(scope="module")
def one() -> cb.Verdict:
    """From one process: the initial set is split."""
    return cb.verify_safety(flattening(0.7), method="linear", jobs=1)


def test_two_jobs_give_the_same_answer_bit_for_bit(one: cb.Verdict) -> None:
    two = cb.verify_safety(flattening(0.7), method="linear", jobs=2)
    assert one.status == "SAFE"
    assert one.log10_delta == two.log10_delta
    assert one.deviation is not None
    assert two.deviation is not None
    np.testing.assert_array_equal(one.deviation.extent, two.deviation.extent)


def test_an_executor_gives_the_same_answer_bit_for_bit(one: cb.Verdict) -> None:
    with ThreadPoolExecutor(2) as pool:
        two = cb.verify_safety(flattening(0.7), method="linear", executor=pool)
    assert one.log10_delta == two.log10_delta
    assert one.deviation is not None
    assert two.deviation is not None
    np.testing.assert_array_equal(one.deviation.extent, two.deviation.extent)


def test_an_executor_that_was_shut_down_is_named() -> None:
    pool = ThreadPoolExecutor(1)
    pool.shutdown()
    with pytest.raises(SolverError, match="takes no more tasks"):
        side_by_side([lambda: 1, lambda: 2], 1, pool)


def test_an_executor_that_breaks_down_has_lost_a_part() -> None:
    with ProcessPoolExecutor(1) as pool, pytest.raises(LostError, match="the worker of a part was lost"):
        side_by_side([partial(os._exit, 3), partial(os._exit, 3)], 1, pool)


def test_nobody_works_on_for_a_process_that_was_killed(tmp_path: Path) -> None:
    script = (
        "import os, sys, time\nfrom certbound.parallel import side_by_side\n"
        "def work():\n    os.write(1, b'%d ' % os.getpid())\n    time.sleep(600)\n"
        "side_by_side([work, work], 2)"
    )
    process = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    written = ""
    while written.count(" ") < 2 and process.poll() is None:
        written += process.stdout.read(1)
    children = [int(word) for word in written.split()]
    process.kill()
    process.wait()
    process.stdout.close()
    deadline = time.monotonic() + 20
    assert len(children) == 2
    while any(map(alive, children)) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not any(map(alive, children))


def alive(process: int) -> bool:
    """Whether a process runs (one that ended and is not waited for does not)."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.parametrize("jobs", [0, -1, 1.5])
def test_jobs_are_counted(jobs: float) -> None:
    with pytest.raises(ValueError, match="`jobs` must be a positive number of processes"):
        cb.verify_safety(flattening(), jobs=jobs)  # type: ignore[arg-type]
