"""Quadratic value bounds stay above what simulation finds, whatever the solver says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import certbound as cb
from certbound.arrays import Array
from certbound.quadratic import bound_quadratic, refinement
from certbound.quadratic.inequality import prove
from certbound.quadratic.wall_program import Proposal, propose


def random_problem(seed: int) -> cb.Problem:
    """A stable system of three states with a quadratic and a sine term, noise that may depend on the state."""
    rng = np.random.default_rng(seed)
    n = 3
    linear = 0.6 * rng.standard_normal((n, n)) - 1.2 * np.eye(n)
    bent = 0.3 * rng.standard_normal((n, 3)) * (np.arange(n) < 2)[:, None]
    picks = rng.integers(0, n, (n, 3))
    noise, tilt = 0.25 * rng.standard_normal((n, 2)), 0.1 * rng.standard_normal(n) * (seed % 3 == 0)

    def f(x: Array) -> list[object]:
        rows = []
        for i in range(n):
            a, b, c = picks[i]
            rows.append(linear[i] @ x + bent[i, 0] * x[a] * x[b] + bent[i, 1] * np.sin(x[c]) + bent[i, 2] * 0.2)
        return rows

    def g(x: Array) -> list[list[object]]:
        return [[noise[i, j] + tilt[i] * x[picks[0, 0]] for j in range(2)] for i in range(n)]

    system = cb.ContinuousSystem(f, states=n, diffusion=g if seed % 3 == 0 else noise)
    return cb.Problem(system, initial=cb.Box([-0.1] * n, [0.1] * n), horizon=1.0,
                      safe=[cb.Inside(cb.Box([-1.2] * n, [1.2] * n))])  # fmt: skip


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3, 5))])
def test_the_bound_is_above_the_frequency_of_failures(seed: int) -> None:
    problem = random_problem(seed)
    found = bound_quadratic(problem, target=1.0, seconds=20.0)  # one pass over the walls
    seen = cb.simulate_exits(problem, paths=4000, rng=np.random.default_rng(seed))
    assert seen.lower <= 10**found.upper < 1


def spoilt(proposal: Proposal, rng: np.random.Generator, size: float) -> Proposal:
    """The proposal with everything that the solver gave moved at random."""

    def moved(values: Array) -> Array:
        return values + size * rng.standard_normal(values.shape)

    matrices = moved(proposal.matrices)
    return replace(
        proposal, matrices=(matrices + matrices.swapaxes(1, 2)) / 2, moves=moved(proposal.moves),
        weights=moved(proposal.weights), wall_weights=moved(proposal.wall_weights),
        wall_rows=moved(proposal.wall_rows), start_weights=moved(proposal.start_weights),
        level=proposal.level - abs(float(rng.standard_normal())) * size,
    )  # fmt: skip


class Known:
    """x' = -x + noise in three states: the truth is known from one state; an honest proposal for one side."""

    def __init__(self) -> None:
        system = cb.ContinuousSystem(lambda x: [-x[0], -x[1], -x[2]], states=3, diffusion=0.6 * np.eye(3))
        safe = [cb.Inside(cb.Box([-1] * 3, [1] * 3))]
        problem = cb.Problem(system, initial=[0, 0, 0], safe=safe, horizon=1.0)
        search = refinement.make_search(problem, np.full(3, -1.0), np.full(3, 1.0))
        self.setting, self.wall = search.setting, search.setting.walls[1]
        stated = search.cells(8, ())
        self.cells = [one.cells for one in stated]
        found = propose(self.setting, self.wall, np.linspace(0.0, 1.0, 9), stated, seconds=10.0)
        assert found is not None
        self.proposal = found
        one = cb.Problem(cb.ContinuousSystem(lambda x: -x, states=1, diffusion=0.6), initial=[0], horizon=1.0,
                         safe=[cb.Inside(cb.Box([-1], [1]))])  # fmt: skip
        seen = cb.simulate_exits(one, paths=20_000, rng=np.random.default_rng(1))
        self.truth = float(np.log(seen.lower / 2))  # of leaving through one of two sides

    def level(self, proposal: Proposal) -> float:
        return prove(self.setting, self.wall, proposal, self.cells).level


@pytest.fixture(scope="module")
def known() -> Known:
    return Known()


def test_an_honest_proposal_is_near_the_truth(known: Known) -> None:
    assert known.truth < known.level(known.proposal) < known.truth + 2


@pytest.mark.parametrize("size", [1e-6, 1e-3, 0.1, 3.0])
def test_a_wrong_proposal_is_never_believed(known: Known, size: float) -> None:
    for seed in range(10):
        assert known.level(spoilt(known.proposal, np.random.default_rng(seed), size)) > known.truth


def test_a_steeper_function_pays_for_its_growth(known: Known) -> None:
    """V times 3 is far below at the start and still 0 on the wall: only the inequality of the generator is broken."""
    p = known.proposal
    steep = replace(p, matrices=3 * p.matrices, moves=3 * p.moves, weights=3 * p.weights,
                    wall_weights=3 * p.wall_weights, wall_rows=3 * p.wall_rows, start_weights=3 * p.start_weights,
                    level=3 * p.level)  # fmt: skip
    assert known.level(steep) > known.truth


def test_a_lower_function_pays_on_the_wall(known: Known) -> None:
    matrices = known.proposal.matrices.copy()
    matrices[:, -1, -1] -= 20.0
    assert known.level(replace(known.proposal, matrices=matrices, level=known.proposal.level - 10)) > known.truth


def test_a_level_below_the_start_is_raised(known: Known) -> None:
    assert known.level(replace(known.proposal, level=known.proposal.level - 20)) > known.truth


def test_the_worst_start_may_lie_between_the_corners_of_functions_that_are_cut_off(known: Known) -> None:
    """min(U, -10) of a convex U is not convex: its corners bound no sum."""
    honest = prove(known.setting, known.wall, known.proposal, known.cells)
    first = replace(honest, growth=0.0, gap=0.0, top=-10.0)
    second = replace(honest, growth=0.0, gap=0.0, top=-9.0)
    attempts = [
        refinement.Attempt(wall=known.wall, proved=first, corners=np.array([-20.0, 80.0])),
        refinement.Attempt(wall=known.wall, proved=second, corners=np.array([-9.0, -20.0])),
    ]
    level, _ = refinement.total(attempts)  # at a point between, both may nearly reach their suprema
    assert level >= np.log(np.exp(-10) + np.exp(-9)) - 1e-12
    attempts[0].corners = np.array([-20.0, -10.0])
    assert refinement.total(attempts)[0] == pytest.approx(np.log(np.exp(-20) + np.exp(-9)), abs=1e-9)
