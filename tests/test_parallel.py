"""Work side by side: the same answers in the same order, and nobody is left behind."""

from __future__ import annotations

import os
import time
from collections.abc import Callable

import numpy as np
import pytest

import certbound as cb
from certbound.errors import EngineError
from certbound.parallel import side_by_side
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


def test_two_jobs_give_the_same_answer_bit_for_bit() -> None:
    one, two = (cb.verify_safety(flattening(), method="linear", jobs=jobs) for jobs in (1, 2))
    assert one.status == "SAFE"
    assert one.log10_delta == two.log10_delta
    assert one.deviation is not None
    assert two.deviation is not None
    np.testing.assert_array_equal(one.deviation.extent, two.deviation.extent)


@pytest.mark.parametrize("jobs", [0, -1, 1.5])
def test_jobs_are_counted(jobs: float) -> None:
    with pytest.raises(ValueError, match="`jobs` must be a positive number of processes"):
        cb.verify_safety(flattening(), jobs=jobs)  # type: ignore[arg-type]
