"""Work side by side: the same answers in the same order, and nobody is left behind."""

from __future__ import annotations

import multiprocessing
import multiprocessing.context
import os
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import certbound as cb
from certbound.errors import EngineError, SolverError
from certbound.parallel import Answer, LostError, crew, result_of, staff
from certbound.watch import OutOfTime, Watch, poll
from tests.reach.linear.test_bisection import flattening


def square(k: int) -> tuple[int, int]:
    return k * k, os.getpid()


def asked(work: Callable[[int], object], count: int, jobs: int, executor: Any = None) -> list[Answer]:
    """The answers of one function to 0, ..., count - 1, in order."""
    found: dict[int, Answer] = {}
    with staff(work, jobs, executor) as workers:
        for k in range(count):
            workers.begin(k, k)
        while len(found) < count:
            found |= dict(workers.finished())
            poll()
    return [found[k] for k in range(count)]


def sleep(_: int) -> None:
    time.sleep(60)


@pytest.mark.parametrize("jobs", [1, 2, 5])
def test_answers_come_from_as_many_processes(jobs: int) -> None:
    found = [result_of(answer) for answer in asked(square, 6, jobs)]
    assert [value for value, _ in found] == [0, 1, 4, 9, 16, 25]
    processes = {process for _, process in found}
    assert len(processes) == jobs
    assert (processes == {os.getpid()}) == (jobs == 1)


def test_while_this_process_is_at_work_fewer_are_given_more() -> None:
    with staff(square, 3) as workers:
        assert workers.apart
        for k in range(4):
            workers.begin(k, k, hands=1)
        found: list[tuple[int, Answer]] = []
        while len(found) < 4:
            found += workers.finished()
    assert [key for key, _ in found] == [0, 1, 2, 3]
    assert len({result_of(answer)[1] for _, answer in found}) == 1


@pytest.mark.parametrize("jobs", [1, 2])
def test_an_error_is_raised_here(jobs: int) -> None:
    with pytest.raises(ZeroDivisionError):
        [result_of(answer) for answer in asked(lambda k: 1 // k, 2, jobs)]


def test_a_process_that_dies_is_named() -> None:
    with pytest.raises(EngineError, match="at work on a part was ended"):
        [result_of(answer) for answer in asked(lambda k: os._exit(3), 3, 2)]


def test_the_end_of_the_time_ends_them_all() -> None:
    watch = Watch(0.2)
    began = time.monotonic()
    with pytest.raises(OutOfTime), watch.running():
        asked(sleep, 2, 2)
    assert time.monotonic() - began < 30


def test_what_is_to_interrupt_a_search_does_not_interrupt_its_copies() -> None:
    def work(k: int) -> bool:
        time.sleep(0.05)
        poll()  # where the search's alarm would be heard
        return bool(interrupted)

    interrupted: list[int] = []
    watch = Watch()
    with watch.running(), watch.after(0.01, lambda: interrupted.append(1)):
        found = asked(work, 2, 2)
    assert [result_of(answer) for answer in found] == [False, False]
    assert interrupted


def test_a_timer_is_heard_after_the_fork_in_both_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    started = multiprocessing.context.ForkProcess.start
    seen = []

    def interrupted(process: multiprocessing.context.ForkProcess) -> None:
        signal.raise_signal(signal.SIGALRM)  # the timer goes off just before the fork
        seen.append(process)
        started(process)

    monkeypatch.setattr(multiprocessing.context.ForkProcess, "start", interrupted)
    with pytest.raises(OutOfTime), Watch(30.0).running():
        asked(sleep, 2, 2)
    assert len(seen) == 1
    assert not seen[0].is_alive()
    monkeypatch.undo()
    found = asked(lambda _: signal.pthread_sigmask(signal.SIG_BLOCK, []), 2, 2)
    assert [result_of(answer) for answer in found] == [set(), set()]


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
        asked(square, 2, 1, pool)


def test_an_executor_that_breaks_down_has_lost_a_part() -> None:
    with ProcessPoolExecutor(1) as pool, pytest.raises(LostError, match="the worker of a part was lost"):
        [result_of(answer) for answer in asked(os._exit, 2, 1, pool)]


def test_nobody_works_on_for_a_process_that_was_killed(tmp_path: Path) -> None:
    script = (
        "import os, sys, time\nfrom certbound.parallel import staff\n"
        "def work():\n    os.write(1, b'%d ' % os.getpid())\n    time.sleep(600)\n"
        "with staff(work, 2) as workers:\n    workers.begin(1)\n    workers.begin(2)\n    time.sleep(600)"
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

def in_daemon(pipe: Any) -> None:
    """The answers to a task with two jobs, and what a crew of one answers, in a process that may have no others."""
    with crew(1) as workers:
        workers.begin("one", os.getpid)
        alone = workers.finished()
    pipe.send((os.getpid(), [result_of(answer) for answer in asked(square, 3, 2)], alone))


def test_a_daemonic_process_works_itself_as_it_may_have_no_copies() -> None:
    ours, theirs = multiprocessing.Pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of a fork beside threads of others
        process = multiprocessing.get_context("fork").Process(target=in_daemon, args=(theirs,), daemon=True)
        process.start()
    theirs.close()
    assert ours.poll(30)
    own, answers, found = ours.recv()
    process.join()
    assert answers == [(0, own), (1, own), (4, own)]
    assert found == [("one", (own, None))]


@pytest.mark.parametrize("jobs", [0, -1, 1.5])
def test_jobs_are_counted(jobs: float) -> None:
    with pytest.raises(ValueError, match="`jobs` must be a positive number of processes"):
        cb.verify_safety(flattening(), jobs=jobs)  # type: ignore[arg-type]
