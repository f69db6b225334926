"""Comparisons that rounding decides are found, and no others: exact arithmetic against what a program computes."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest

from certbound.problem.model import Graph, Node, Tape, rounded_comparison


class Term:
    """An expression whose operations become nodes one by one: nothing is simplified."""

    def __init__(self, graph: Graph, index: int) -> None:
        self.graph, self.index = graph, index

    def of(self, op: str, *given: Any) -> Term:
        args = [one.index if isinstance(one, Term) else self.number(one).index for one in given]
        return Term(self.graph, self.graph._intern(Node(op, tuple(args))))

    def number(self, value: float) -> Term:
        return Term(self.graph, self.graph._intern(Node("const", (), float(value))))

    def __add__(self, other: Any) -> Term:
        return self.of("add", self, other)

    def __sub__(self, other: Any) -> Term:
        return self.of("sub", self, other)

    def __mul__(self, other: Any) -> Term:
        return self.of("mul", self, other)

    def __truediv__(self, other: Any) -> Term:
        return self.of("div", self, other)

    def __lt__(self, other: Any) -> Term:
        return self.of("lt", self, other)

    def __le__(self, other: Any) -> Term:
        return self.of("le", self, other)


Written = Callable[[Term, Term, Callable[[float], Term]], Term]


def tape(written: Written) -> Tape:
    graph = Graph(("t", "x"))
    t, x = Term(graph, graph.input(0)), Term(graph, graph.input(1))
    return graph.tape([written(t, x, t.number).index], (1,))


@pytest.mark.parametrize(
    "written",
    [
        lambda t, x, c: t - 0.1 < c(0.2) + t - 0.3,
        lambda t, x, c: c(0.3) < ((t + 0.1) - t) + 0.2,
        lambda t, x, c: t.of("sign", t - 0.1 - (c(0.2) + t - 0.3)),
        lambda t, x, c: c(0.1) * t + c(0.2) * t < c(0.3) * t,
        lambda t, x, c: (t + 1e16) - 1e16 < 0.3,
        lambda t, x, c: c(1.0) + c(1e-20) * t.of("sin", t) <= 1.0,
        lambda t, x, c: c(0.1) + 0.3 < 0.4,
        lambda t, x, c: t.of("sqrt", 2.0) < math.sqrt(2.0),
        lambda t, x, c: x - 0.1 < x + 0.2 - 0.3,
        lambda t, x, c: (x + 1e16) - 1e16 < 0.3,
        lambda t, x, c: t.of("eq", t / 3 * 3, t),
        lambda t, x, c: t.of("floor", t * 3 - (t + t + t) + 1.0),
        lambda t, x, c: t.of("min", t, 0.1) < c(0.1) + 0.3 - 0.3,
        lambda t, x, c: x <= ((t.of("min", x, 0.7) + 3) - 3) + 10 - 10,
    ],
)
def test_sides_that_differ_by_what_rounding_adds_are_found(written: Written) -> None:
    assert rounded_comparison(tape(written), 2.0) is not None


@pytest.mark.parametrize(
    "written",
    [
        lambda t, x, c: t < 0.3, lambda t, x, c: t * 10 < 3, lambda t, x, c: t + 1000 < 1000.3,
        lambda t, x, c: t < c(1.0) / 3, lambda t, x, c: t - t.of("floor", t / 2) * 2 < 1, lambda t, x, c: t < x,
        lambda t, x, c: x < 0.3, lambda t, x, c: x * x * 0.1 < x - 0.2, lambda t, x, c: t.of("sin", t) < 0.3,
        lambda t, x, c: c(0.1) + 0.2 < 0.3, lambda t, x, c: c(0.5) + 0.25 <= 0.75,
        lambda t, x, c: t.of("sqrt", 2.0) < 1.4142, lambda t, x, c: x + 42_000_000 < 42_000_300,
        lambda t, x, c: t.of("sign", t - 1) * t.of("sign", t - 0.3) < 0,
    ],
)  # fmt: skip
def test_where_both_take_one_side_but_for_an_instant_nothing_is_found(written: Written) -> None:
    assert rounded_comparison(tape(written), 2.0) is None


@pytest.mark.parametrize(
    ("written", "found"),
    [
        (lambda t, x, c: c(0.1) * t <= 0.9, True), (lambda t, x, c: t.of("floor", c(0.7) * t), True),
        (lambda t, x, c: t - 0.1 < c(0.2) + t - 0.3, True), (lambda t, x, c: t < 5, False),
        (lambda t, x, c: t * 0.5 <= 4.5, False), (lambda t, x, c: t / 10 < 0.35, False),
        (lambda t, x, c: t - t.of("floor", t / 0.3) * 0.3 < 0.1, True),
        (lambda t, x, c: (t - t.of("floor", t / 3) * 3) / 10 < 0.2, True),
        (lambda t, x, c: t.of("floor", t / 10), False), (lambda t, x, c: c(0.1) * t <= 0.85, False),
    ],
)
def test_in_discrete_time_every_step_counts(written: Written, *, found: bool) -> None:
    assert (rounded_comparison(tape(written), 20.0, 20) is not None) == found


@pytest.mark.parametrize(("time", "found"), [(0.1, True), (0.7, False), (0.3, False), (0.5, False), (0.55, False)])
def test_where_inputs_are_held_every_sampling_time_counts(time: float, *, found: bool) -> None:
    """1/10 < 0.1 is true of the float next to a tenth, and a program that is asked at 0.1 says it is not."""
    assert (rounded_comparison(tape(lambda t, x, c: t < time), 1.0, 10) is not None) == found


class Counted:
    """Counts what a search takes, and ends it beyond a limit."""

    def __init__(self, most: float = math.inf) -> None:
        self.work = self.memory = self.highest = 0
        self.most = most

    def spend(self, units: int) -> None:
        self.work += units
        if self.work > self.most:
            raise TimeoutError

    def take(self, size: int) -> None:
        self.memory += size
        self.highest = max(self.highest, self.memory)

    def give(self, size: int) -> None:
        self.memory -= size


def stairs(count: int) -> Tape:
    """Comparisons of t/10 with as many numbers, and the sum of all before each."""
    def written(t: Term, x: Term, c: Callable[[float], Term]) -> Term:
        total = x
        for k in range(count):
            total = total + (t * 0.1 < 0.03 + 0.1 * k)
        return total

    return tape(written)


def counted(given: Tape, horizon: float, samples: int = 0, most: float = math.inf) -> Counted:
    counter = Counted(most)
    assert rounded_comparison(given, horizon, samples, counter) == rounded_comparison(given, horizon, samples)
    return counter


@pytest.mark.parametrize(("horizon", "samples"), [(2.0, 0), (2.0, 20), (20.0, 20)])
def test_a_counter_changes_nothing_and_sees_all_work_and_memory(horizon: float, samples: int) -> None:
    few, many = (counted(stairs(count), horizon, samples) for count in (40, 80))
    assert many.work > 1.9 * few.work > 1e6
    assert many.highest > 1.9 * few.highest > 1e4


def test_looking_for_what_each_of_many_comparisons_needs_counts_the_operations_before_it() -> None:
    few, many = (counted(stairs(count), 20.0, 20) for count in (1000, 2000))
    assert many.work > 2.3 * few.work


def test_steps_at_which_a_comparison_is_computed_are_counted_before() -> None:
    square = tape(lambda t, x, c: t * t * t < 0.3)
    few, many = (counted(square, steps, int(steps)) for steps in (100.0, 10_000.0))
    assert many.work > 50 * few.work
    with pytest.raises(TimeoutError):
        rounded_comparison(square, 10_000.0, 10_000, Counted(few.work))
