"""Files below 1 MB that would take hours or tens of gigabytes are refused by the count of work and memory."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flint import arb, ctx

from certbound.checker import check_data, claims, parse
from certbound.checker.check import SECONDS
from certbound.checker.expressions import Graph, Program
from certbound.checker.expressions.arithmetic import cos, sin, sin_cos, tan
from certbound.checker.report import BALL, BALL_BYTES, SECOND, STEP, Budget, Unproved
from certbound.checker.statement import turned
from certbound.checker.statement.tapes import canonical
from certbound.checker.values import batches as tm
from certbound.checker.values.hermite import Surface
from tests.checker.bombs import BOMBS, MEMORY, MOST_BYTES, ONE, WORK, ZERO, barrier, content, file, hexed, problem

ROOT = Path(__file__).resolve().parents[2]
Check = Callable[[str, float], dict[str, Any]]


@pytest.fixture(scope="module")
def check() -> Iterator[Check]:
    """Checks a file in a process that was forked for it, of a program that has loaded nothing but the checker."""
    program = subprocess.Popen(
        [sys.executable, "-m", "tests.checker.bombs"], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        text=True, env={**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"},
    )  # fmt: skip
    assert program.stdin is not None
    assert program.stdout is not None

    def ask(name: str, seconds: float) -> dict[str, Any]:
        program.stdin.write(json.dumps([name, seconds]) + "\n")
        program.stdin.flush()
        found: dict[str, Any] = json.loads(program.stdout.readline())
        return found

    yield ask
    program.stdin.close()
    program.stdout.close()
    program.wait()


def is_refused(found: dict[str, Any], *reasons: str) -> bool:
    """Whether a small file was refused for one of these reasons, within its memory."""
    small = found["bytes"] < 1_000_000 and found["memory"] < MOST_BYTES
    return small and any(reason in found["says"] for reason in reasons)


def test_there_are_forty_files_and_more() -> None:
    assert len(BOMBS) == 62


@pytest.mark.parametrize("name", list(BOMBS))
def test_two_seconds_of_work_and_memory_end_a_check_by_their_count(check: Check, name: str) -> None:
    found = check(name, 2.0)
    assert is_refused(found, BOMBS[name][1], WORK), found


ENDS = {  # these are dear, but end within the usual limits
    "two hundred bends of a long line in time": "no bound below 1",
    "the reach of bounded noise along many rows": "it is proved",
    "functions of time on sixteen thousand slabs of a solution": "no bound below 1",
    "comparisons of what reads 400 states": MEMORY,  # with more work, memory is what is short
    "boxes of many sides, many times": WORK,
}


@pytest.mark.slow
@pytest.mark.parametrize("name", list(BOMBS))
def test_the_usual_limits_end_a_check_by_their_count(check: Check, name: str) -> None:
    found = check(name, SECONDS)
    assert is_refused(found, ENDS.get(name, BOMBS[name][1])), found


# ---- the budget itself ---------------------------------------------------------------------------------------


def test_work_is_counted_in_whole_numbers_of_any_size() -> None:
    budget = Budget(1.0)
    budget.spend(SECOND)
    with pytest.raises(Unproved, match="more work than its limit of 1 s"):
        budget.spend(1)
    with pytest.raises(Unproved, match="more work"):
        Budget(1e9).balls(2**64)  # which is 0 in 64 bits
    with pytest.raises(Unproved, match="more memory"):
        Budget(1.0).take(2**64)


def test_what_is_sure_to_come_is_refused_before_it_is_done_and_not_counted() -> None:
    budget = Budget(1.0)
    budget.expect(SECOND)
    assert budget.work == SECOND
    with pytest.raises(Unproved, match="more work"):
        budget.expect(SECOND + 1)


def test_arrays_that_are_gone_soon_must_fit_beside_what_is_held() -> None:
    budget = Budget(1.0, balls=10)
    budget.hold(6)
    budget.fits(4 * BALL_BYTES)
    with pytest.raises(Unproved, match="more memory"):
        budget.fits(4 * BALL_BYTES + 1)
    budget.give(BALL_BYTES)
    budget.fits(5 * BALL_BYTES)


def test_the_clock_ends_what_the_count_does_not() -> None:
    with pytest.raises(Unproved, match="not finished within its limit of 5 s"):
        Budget(5.0, clock=-1.0).check()


def test_balls_of_more_bits_cost_more_than_in_proportion() -> None:
    budget, fine = Budget(1.0), Budget(1.0)
    budget.balls(10)
    with ctx.workprec(1280):
        fine.balls(10)
    assert SECOND - budget.work == 10 * BALL
    assert SECOND - fine.work > 10 * (SECOND - budget.work)


def test_what_is_made_once_is_made_again_for_other_objects_only() -> None:
    budget, made = Budget(1.0), []
    first, second = [1], [1]
    for about, key in ((first, 0), (first, 0), (first, 1), (second, 0)):
        budget.once(about, (key,), lambda: made.append(1))
    assert len(made) == 3


# ---- parts of the checker -------------------------------------------------------------------------------------


def test_a_program_counts_all_its_operations_before_it_runs() -> None:
    budget = Budget(60.0)
    graph = Graph(budget)
    node = graph.input(0)
    for _ in range(100):
        node = graph.apply("mul", node, graph.input(0))
    program = Program(graph, [node], variables=1)
    program.prepare([])
    before = budget.work
    program.run([arb(1)])
    assert before - budget.work >= 100 * BALL


def test_exponents_of_powers_of_powers_count_as_memory() -> None:
    short, long = Graph(Budget(60.0)), Graph(Budget(60.0))
    taken = []
    for graph, exponent in ((short, "sin"), (long, "pow")):
        node = graph.input(0)
        for _ in range(4000):
            node = graph.apply(exponent, node, value=1e4 if exponent == "pow" else 0.0)
        before = graph.budget.memory
        Program(graph, [node], variables=1)
        taken.append(before - graph.budget.memory)
    assert taken[1] > 4 * taken[0]


def test_waves_of_numbers_beyond_all_floats_are_bounded_at_once() -> None:
    far = arb(2) ** 60_000
    assert all(bool(wave(far).contains(end)) for wave in (sin, cos) for end in (-1, 1))
    assert [bool(x.contains(1)) for x in sin_cos(far)] == [True, True]
    assert tan(far).is_nan()
    assert abs(sin(arb(1)) - arb(1).sin()) < 1e-30


def test_a_derivative_that_is_known_is_not_looked_for_again() -> None:
    graph = Graph(Budget(60.0))
    node = graph.input(0)
    for _ in range(1000):
        node = graph.apply("sin", node)
    found = graph.derivative(node, 0)
    before = graph.budget.work
    assert graph.derivative(graph.apply("sin", node), 0) != found
    assert before - graph.budget.work < 100 * STEP


def test_tables_of_monomials_are_made_once_in_a_check() -> None:
    budget = Budget(60.0)
    first = tm.terms(3, 6, budget)
    before = budget.work, budget.memory
    assert tm.terms(3, 6, budget) is first
    assert (budget.work, budget.memory) == before


def test_blocks_of_a_surface_are_all_of_its_patches_once() -> None:
    rng = np.random.default_rng(0)
    for cells in ((3, 5), (90, 70), (2, 9000), (9000, 2), (7000,)):
        axes = tuple(np.sort(rng.random(count + 1)) for count in cells)
        shape = (3, *(size for count in cells for size in (count + 1, 3)))
        values = rng.random(shape)
        surface = Surface(np.array([0.0, 0.5, 1.0]), axes, values, rng.random(shape))
        parts = [surface.patches(*block) for block in surface.blocks()]
        assert max(part.low.shape[1] for part in parts) <= 4096
        low = np.concatenate([part.low for part in parts], axis=1)
        assert len(np.unique(low, axis=1).T) == low.shape[1] == 2 * int(np.prod(cells))


def test_cells_that_are_chosen_are_those_of_all_patches() -> None:
    rng = np.random.default_rng(1)
    axes = (np.sort(rng.random(5)), np.sort(rng.random(4)))
    surface = Surface(np.array([0.0, 1.0]), axes, rng.random((2, 5, 3, 4, 3)), rng.random((2, 5, 3, 4, 3)))
    (block,) = surface.frozen(1).blocks()
    every = surface.frozen(1).patches(*block)
    found = surface.chosen(1, [np.array([0, 3, 2]), np.array([2, 1, 0])])
    places = [0 * 3 + 2, 3 * 3 + 1, 2 * 3]
    for mine, theirs in zip((found.low, found.high, found.data), (every.low, every.high, every.data)):
        np.testing.assert_array_equal(mine, theirs[..., places])


def test_a_network_of_many_inputs_is_put_in_order_in_one_go() -> None:
    """The order of what an operation takes stays, and each of its arguments is looked at once."""
    data = {"nodes": [["input", k] for k in range(300)] + [["network", 0, 0, *range(299, -1, -1)]], "outputs": [300],
            "networks": [[]]}  # fmt: skip
    nodes, outputs = canonical(data)
    assert [node[:2] for node in nodes[:3]] == [["input", 299], ["input", 298], ["input", 297]]
    assert outputs == [300]


def test_a_model_in_other_coordinates_is_made_once_for_all_members_that_take_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made, compose = [], turned._composed
    monkeypatch.setattr(turned, "_composed", lambda *given: made.append(1) or compose(*given))
    same = {"engine": "coordinates", "matrix": hexed([[2.0]]), "inverse": hexed([[0.5]]), "proof": barrier(1)}
    start = problem(1)["initial"]
    about = problem(1, initial={"kind": "union", "members": [start] * 3}, noise={"law": "wiener", "diffusion": [[ONE]]})
    check_data(file(about, {"engine": "union", "members": [same] * 3}))
    assert len(made) == 1


def test_probabilities_of_cells_are_computed_once_in_a_check(monkeypatch: pytest.MonkeyPatch) -> None:
    asked, weigh = [], claims.weights_of
    monkeypatch.setattr(claims, "weights_of", lambda *given: asked.append(1) or weigh(*given))
    drawn = {"d0": {"law": "uniform", "level": "halfwidth", "value": hexed(0.1), "mean": ZERO}}
    cells = [{"low": hexed([-0.1]), "high": hexed([0.1]), "proof": barrier(1)}]
    check_data(file(problem(1, pushes=1, random=drawn), {"engine": "random", "cells": cells}))
    assert len(asked) == 1


def test_the_files_are_read_as_they_are_written() -> None:
    for name in ("pieces of noise in 400 entries", "corners of forty disturbances"):
        assert parse(content(name))["version"] == 1
