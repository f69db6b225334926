"""Terminal sets and costs."""

from __future__ import annotations

import numpy as np
import pytest

import certbound as cb
from certbound.synthesis.faces import faces_of
from certbound.synthesis.terminal import (
    TerminalSet,
    check_terminal,
    contraction_terminal,
    linearise,
    riccati,
    riccati_terminal,
)
from tests.synthesis.conftest import A, B, cart


def stable(pushed: float = 0.0) -> cb.Problem:
    slope, b = [[0.8, 0.2], [0.0, 0.7]], [0.0, pushed]
    system = cb.linear_system(slope, [[0], [1]], b, inputs=cb.Box([-1], [1]), noise=cb.Gaussian(std=0.01))
    safe = [cb.Inside(cb.Box([-1, -1], [1, 1]))]
    return cb.Problem(system, initial=[0, 0], safe=safe, horizon=10, cost=([1, 2], [1]))


def test_the_linearisation_of_a_linear_system_is_its_matrices() -> None:
    a, b = linearise(cart(), [0.3, 0.1], [0.2])
    np.testing.assert_allclose(a, A)
    np.testing.assert_allclose(b, B)


def test_the_riccati_matrix_solves_its_equation() -> None:
    value, gain, closed = riccati(cart())
    assert np.abs(np.linalg.eigvals(closed)).max() < 1
    step = np.eye(2) + 0.01 * gain.T @ gain + closed.T @ value @ closed
    np.testing.assert_allclose(value, step, rtol=1e-8)


def test_a_system_that_cannot_be_stabilised_has_no_riccati_gain() -> None:
    system = cb.linear_system(np.diag([1.5, 0.5]), [[0], [1]], inputs=cb.Box([-1], [1]), noise=cb.Gaussian(std=0.01))
    problem = cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=5)
    with pytest.raises(ValueError, match="`feedback`"):
        cb.synthesize_plan(problem, feedback="riccati")


def test_the_contraction_set_is_invariant_and_its_cost_falls_by_the_stage_cost() -> None:
    problem = stable()
    constants = cb.bound_constants(problem.replace(plan=np.zeros((10, 1))))
    faces = faces_of(problem)
    found = contraction_terminal(problem, constants, faces, np.full(4, 0.1), 10.0)
    rng = np.random.default_rng(0)
    inside = found.region.sample(rng, 500)
    a = linearise(problem, [0, 0], [0])[0]
    assert np.all(np.abs(inside) <= 0.9 + 1e-9)
    assert np.all(found.region.contains(inside @ a.T))
    assert found.cost is not None
    before, after = (np.einsum("ki,ij,kj->k", x, found.cost, x) for x in (inside, inside @ a.T))
    assert np.all(before - after >= np.einsum("ki,i,ki->k", inside, [1, 2], inside) - 1e-9)


def test_on_the_riccati_set_states_and_inputs_keep_their_bounds() -> None:
    problem = cart()
    found = riccati_terminal(problem, faces_of(problem), np.full(4, 0.1), 20.0)
    _, gain, closed = riccati(problem)
    inside = found.region.sample(np.random.default_rng(0), 500)
    assert np.all(np.abs(inside @ gain.T) <= 3 + 1e-9)
    assert np.all(found.region.contains(inside @ closed.T))
    assert np.all(problem.safe[0].satisfied(inside))


def test_a_plan_ends_in_its_terminal_set() -> None:
    target = cb.Box([0.1, -0.1], [0.2, 0.1])
    found = cb.synthesize_plan(cart(), method="linear", terminal=target)
    assert found.status == "SAFE"
    assert np.all(found.states[-1] >= target.low - 1e-6)
    assert np.all(found.states[-1] <= target.high + 1e-6)


@pytest.mark.parametrize(
    "terminal", ["riccati", TerminalSet(region=cb.Ball([0.3, 0], 0.05)), cb.Box([0.5, 0], [0.5, 0])]
)
def test_every_kind_of_terminal_set_is_met(terminal: object) -> None:
    found = cb.synthesize_plan(cart(), method="linear", terminal=terminal)  # type: ignore[arg-type]
    assert found.feasible
    if isinstance(terminal, cb.Box):
        np.testing.assert_allclose(found.states[-1], [0.5, 0], atol=1e-5)
    if isinstance(terminal, TerminalSet):
        assert terminal.room(found.states[-1]) >= -1e-5


def test_sets_that_stick_out_are_refused_with_the_constraint() -> None:
    faces = faces_of(cart(safe=[cb.Outside(cb.Ball([2, 0], 0.5)), cb.Inside(cb.Ball([0, 0], 3))]))
    good = TerminalSet(region=cb.Ball([0, 0], 1.0))
    check_terminal(good, faces, np.array([0.3, 0.3]), 20.0)
    with pytest.raises(ValueError, match="misses 'outside the ball"):
        check_terminal(good, faces, np.array([0.6, 0.3]), 20.0)
    with pytest.raises(ValueError, match="misses 'inside the ball"):
        check_terminal(good, faces, np.array([0.3, 2.5]), 20.0)


def test_a_contraction_set_needs_contraction_and_an_equilibrium_inside() -> None:
    problem, faces = stable(), faces_of(stable())
    constants = cb.Constants(gain=1.0, sigma=0.1, dimension=2)
    with pytest.raises(ValueError, match="gain < 1"):
        contraction_terminal(problem, constants, faces, np.full(4, 0.1), 10.0)
    constants = cb.Constants(gain=0.9, sigma=0.1, dimension=2)
    with pytest.raises(ValueError, match="needs an equilibrium"):
        contraction_terminal(stable(pushed=0.1), constants, faces, np.full(4, 0.1), 10.0)
    with pytest.raises(ValueError, match="must have its centre inside"):
        contraction_terminal(problem, constants, faces, np.full(4, 1.1), 10.0)
