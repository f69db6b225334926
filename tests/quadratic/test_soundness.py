"""Quadratic value bounds stay above what simulation finds, whatever the solver says."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.arrays import Array
from certbound.quadratic import bound_quadratic, refinement
from certbound.quadratic.inequality import prove
from certbound.quadratic.wall_attempts import Attempt, total
from certbound.quadratic.wall_program import Proposal, propose
from tests.values.random_systems import quadratic


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
    found = bound_quadratic(problem, target=1.0, seconds=60.0)  # one pass over the walls
    seen = cb.simulate_exits(problem, paths=4000, rng=np.random.default_rng(seed), halve=False)
    assert seen.lower <= 10**found.upper < 1


def test_cells_that_are_curved_at_some_times_only_have_the_same_corners() -> None:
    """Drift and noise of this one change with time: on some pieces a remainder is 0."""
    problem = quadratic(np.random.default_rng([7, 13]))
    found = bound_quadratic(problem, target=1e-6, seconds=0.5)  # a pass over the walls, and some of the search
    seen = cb.simulate_exits(problem, paths=1000, rng=np.random.default_rng(1), halve=False)
    assert seen.lower <= 10**found.upper <= 1


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
        times = np.linspace(0.0, 1.0, 9)
        stated = search.cells(times, ())
        self.cells = [one.cells for one in stated]
        found = propose(self.setting, self.wall, times, stated, seconds=10.0)
        assert found is not None
        self.proposal = found
        self.stated, self.times = stated, times
        one = cb.Problem(cb.ContinuousSystem(lambda x: -x, states=1, diffusion=0.6), initial=[0], horizon=1.0,
                         safe=[cb.Inside(cb.Box([-1], [1]))])  # fmt: skip
        seen = cb.simulate_exits(one, paths=20_000, rng=np.random.default_rng(1), halve=False)
        self.truth = float(np.log(seen.lower / 2))  # of leaving through one of two sides

    def level(self, proposal: Proposal) -> float:
        return prove(self.setting, self.wall, proposal, self.cells).level

    def other(self, **changes: Any) -> Proposal:
        """What the solver says of another degree, time, or number of walls."""
        found = propose(self.setting, self.wall, self.times, self.stated, seconds=10.0, **changes)
        assert found is not None
        return found


@pytest.fixture(scope="module")
def known() -> Known:
    return Known()


def test_an_honest_proposal_is_near_the_truth(known: Known) -> None:
    assert known.truth < known.level(known.proposal) < known.truth + 2


@pytest.mark.parametrize("size", [1e-6, 1e-3, 0.1, 3.0])
def test_a_wrong_proposal_is_never_believed(known: Known, size: float) -> None:
    for seed in range(5):
        assert known.level(spoilt(known.proposal, np.random.default_rng(seed), size)) > known.truth


def test_degree_two_follows_the_function_more_closely(known: Known) -> None:
    straight = known.other(degree=1)
    assert known.truth < known.level(known.proposal) < known.level(straight) - 0.1
    for seed in range(5):
        assert known.level(spoilt(straight, np.random.default_rng(seed), 1e-2)) > known.truth


def exits(begin: float) -> float:
    """How often paths of x' = -x + noise leave [-1, 1]^3 through the first upper side from a time on."""
    rng, x, left = np.random.default_rng(3), np.zeros((10_000, 3)), 0
    for k in range(100):
        x = x - 0.01 * x + 0.6 * 0.1 * rng.standard_normal(x.shape)
        left += int(np.sum(x[:, 0] > 1)) if 0.01 * k >= begin else 0
        x = x[np.all(np.abs(x) <= 1, axis=1)]
    return left / 10_000


def test_a_window_of_time_is_bounded_by_itself(known: Known) -> None:
    late = known.other(first=4)
    frequency = exits(0.5)
    assert np.log(frequency) < known.level(late) < known.level(known.proposal)
    assert not late.wall_weights[:8].any()
    early = propose(known.setting, known.wall, known.times[:5], known.stated[:4], seconds=10.0)
    assert early is not None
    before = prove(known.setting, known.wall, early, known.cells[:4]).level
    assert known.truth < np.log(np.exp(before) + np.exp(known.level(late)))
    for seed in range(5):
        assert known.level(spoilt(late, np.random.default_rng(seed), 1e-2)) > np.log(frequency)


def test_one_function_serves_several_walls(known: Known) -> None:
    others = [wall for wall in known.setting.walls if wall is not known.wall]
    both = known.other(others=others)
    found = prove(known.setting, known.wall, both, known.cells, others=others)
    assert found.level > known.truth + np.log(6.0)
    assert found.level < 0
    with pytest.raises(ValueError, match="argument 2"):
        prove(known.setting, known.wall, known.proposal, known.cells, others=others)
    lower = both.matrices.copy()
    lower[:, 2, -1] += 3.0  # V falls towards the last side that is served, and hardly elsewhere
    lower[:, -1, 2] += 3.0
    fallen = prove(known.setting, known.wall, replace(both, matrices=lower), known.cells, others=others)
    assert fallen.gap > found.gap + 1


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
        Attempt(wall=known.wall, during=(0.0, 1.0), proved=first, corners=np.array([-20.0, 80.0])),
        Attempt(wall=known.wall, during=(0.0, 1.0), proved=second, corners=np.array([-9.0, -20.0])),
    ]
    level, _ = total(attempts)  # at a point between, both may nearly reach their suprema
    assert level >= np.log(np.exp(-10) + np.exp(-9)) - 1e-12
    attempts[0].corners = np.array([-20.0, -10.0])
    assert total(attempts)[0] == pytest.approx(np.log(np.exp(-20) + np.exp(-9)), abs=1e-9)
