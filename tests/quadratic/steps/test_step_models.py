"""Quadratic value bounds in discrete time: which models are stated, in which units, and what is refused in words."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest
from flint import arb

import certbound as cb
from certbound.errors import InfeasibleError
from certbound.problem.model import Graph, Tape
from certbound.quadratic import bound_steps
from certbound.quadratic.steps import step_bounds
from certbound.quadratic.steps.step_program import StepProposal
from certbound.quadratic.steps.step_proof import StepProof, prove_steps
from certbound.rigor.intervals import Interval


def of(f: Any, noise: Any = None, **changes: Any) -> cb.Problem:
    system = cb.DiscreteSystem(f, states=2, noise=cb.Gaussian(std=0.1) if noise is None else noise)
    given: dict[str, Any] = {"initial": [0, 0], "safe": [cb.Inside(cb.Box([-1, -1], [1, 1]))], "horizon": 4}
    return cb.Problem(system, **(given | changes))


def stated(problem: cb.Problem) -> Any:
    return step_bounds._steps(problem, next(step_bounds._settings(problem)))


def test_constants_that_are_no_floats_are_no_terms() -> None:
    """exp(1) is an interval; x / exp(1) is linear but for its width, and sin(x / exp(1)) a function of x alone."""
    graph = Graph(("t", "x1", "x2"))
    e = graph.apply("exp", graph.const(1.0))
    first = graph.apply("div", graph.input(1), e)
    second = graph.apply("sin", graph.apply("div", graph.input(2), e))
    tape = Tape(inputs=graph.inputs, nodes=tuple(graph.nodes), outputs=(first, second), shape=(2,))
    given = stated(of(tape))
    assert given.secants.matrix[0, 0].contains(np.exp(-1.0))
    assert given.secants.rows.shape == (1, 4)


def test_a_constant_is_all_that_it_may_be() -> None:
    """exp(9) - sinh(9) - cosh(9) is 0, and known to a few units in the last place of exp(9) alone."""
    graph = Graph(("t", "x1", "x2"))
    nine = graph.const(9.0)
    rest = graph.apply("exp", nine)
    for part in ("sinh", "cosh"):
        rest = graph.apply("sub", rest, graph.apply(part, nine))
    outputs = rest, graph.apply("add", graph.input(1), rest)
    tape = Tape(inputs=graph.inputs, nodes=tuple(graph.nodes), outputs=outputs, shape=(2,))
    said = stated(of(tape)).secants.matrix[:2, 2]
    assert np.all((said.lo > -1e-9) & (said.lo < -1e-13) & (said.hi > 1e-13) & (said.hi < 1e-9))


def test_a_slope_that_hardly_varies_is_an_interval() -> None:
    given = stated(of(lambda x: [0.5 * x[0] + 1e-13 * np.sin(9 * x[0]), x[1]]))
    assert len(given.secants.rows) == 0
    assert 9e-13 < given.secants.matrix[0, 0].width < 2e-12


def test_a_long_chain_of_operations_is_one_function() -> None:
    def step(x: Any) -> list[Any]:
        y = x[0]
        for _ in range(560):
            y = np.sin(y)
        return [y, 0.5 * x[1]]

    assert stated(of(step)).secants.rows.shape == (1, 4)


@pytest.mark.parametrize("unit", [1.0, 1e6, 1e-6])
def test_units_do_not_matter(unit: float) -> None:
    """A p is of size 1 whatever it is made of: programs whose p are millions come to nothing."""
    problem = of(
        lambda x: [unit * 0.5 * np.tanh(x[0] / unit), 0.5 * x[1]], noise=cb.Gaussian(std=[0.2 * unit, 0.2]),
        safe=[cb.Inside(cb.Box([-unit, -1], [unit, 1]))],
    )  # fmt: skip
    given = stated(problem)
    assert 0.2 < np.abs(given.secants.rows.mid).sum() <= 1
    assert bound_steps(problem, target=1e-2, seconds=60).upper < -2


@pytest.mark.parametrize(("problem", "why"), [
    (of(lambda x: [np.sqrt(np.abs(x[0])), x[1]]), r"the slope of `sqrt\(abs\(x1\)\)` is not bounded"),
    (of(lambda x: [np.tanh(x[1] * np.exp(800 * x[0])), 0.5 * x[1]]), "overflows"),
    (of(lambda x: [0.5 * x[0], 0.5 * x[1]], horizon=np.inf), "at most 32000 steps"),
    (of(lambda x: [0.5 * x[0], 0.5 * x[1]], horizon=40_000), "at most 32000 steps"),
    (of(lambda x: [0.5 * x[0], 0.5 * x[1]], noise=cb.Gaussian(std=0.0)), "need noise"),
])  # fmt: skip
def test_what_is_not_served_is_named(problem: cb.Problem, why: str) -> None:
    with pytest.raises(InfeasibleError, match=why):
        bound_steps(problem, seconds=1)


def test_noise_whose_variance_is_no_float_is_not_left_out() -> None:
    system = cb.DiscreteSystem(
        lambda x: [0.5 * x[0], 0.5 * x[1]], states=2, noise=cb.Gaussian(std=[1.0, 1e-170]),
        noise_matrix=[[0.1, 0.0], [0.0, 0.1]],
    )  # fmt: skip
    with pytest.raises(InfeasibleError, match="no root"):
        stated(cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=4))


def test_all_starts_lie_in_the_box_of_states_that_nothing_bounds() -> None:
    """Uniform points of a ball in eight states do not come near the ends of its hull."""
    system = cb.DiscreteSystem(lambda x: [0.1 * value for value in x], states=8, noise=cb.Gaussian(std=1e-4))
    limit = cb.Inside(cb.HalfSpace([1.0] + [0.0] * 7, 2.0))
    problem = cb.Problem(system, initial=cb.Ball([0.0] * 8, 0.5), safe=[limit], horizon=3)
    low, high = step_bounds._sampled(problem, np.full(8, -np.inf), np.full(8, np.inf))[:2]
    assert np.all((low <= -0.5) & (high >= 0.5))


def test_a_proof_that_outlasts_its_time_proves_nothing() -> None:
    given = stated(of(lambda x: [0.5 * x[0], 0.5 * x[1]]))
    steps, flat = np.array([0, 4]), np.zeros((2, 3, 3))
    flat[:, range(3), range(3)] = 1e-3
    proposal = StepProposal(
        steps=steps, window=1, matrices=flat, weights=np.zeros((1, 2, 2)), scales=np.zeros((1, 2, 0)),
        wall_weights=tuple(np.zeros((2, 1)) for _ in given.setting.walls),
    )  # fmt: skip
    assert prove_steps(given, given.setting.walls, proposal).excess < 1
    assert prove_steps(given, given.setting.walls, proposal, time.perf_counter() - 1).excess == np.inf


def test_a_number_that_is_none_is_no_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    proof = StepProof(excess=0.0, starts=Interval.point(np.zeros((1, 1))), proposal=None)  # type: ignore[arg-type]
    monkeypatch.setattr(StepProof, "at_corners", lambda self: [arb.nan()])
    assert step_bounds._level([proof]) == 0.0
