"""Quadratic value bounds in discrete time: what a step is said to do, what is proved of a proposal, and the bounds."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.errors import CertificateError, EnclosureError, InfeasibleError
from certbound.problem.model import compile_numpy
from certbound.quadratic import StepsBound, bound_steps
from certbound.quadratic.steps import step_bounds
from certbound.quadratic.steps.step_program import propose_steps
from certbound.quadratic.steps.step_proof import prove_steps
from certbound.rigor.intervals import Interval
from certbound.safety.answers import Request
from certbound.safety.certificates import quadratic_proof
from certbound.safety.engines import quadratic_engine


def thermostats(std: float = 0.15, horizon: int = 20) -> cb.Problem:
    """Two rooms whose heaters saturate on both sides: a model with kinks."""

    def step(a: Any, b: Any) -> list[Any]:
        heat = [0.35 * np.maximum(0, np.minimum(2, 21.3 - x)) for x in (a, b)]
        return [a + 0.05 * (b - a) + 0.02 * (10 - a) + heat[0], b + 0.05 * (a - b) + 0.02 * (10 - b) + heat[1]]

    system = cb.DiscreteSystem(step, states=["a", "b"], noise=cb.Gaussian(std=std))
    room = cb.Inside(cb.Box([19.5, 19.5], [22.5, 22.5]))
    return cb.Problem(system, initial=cb.Box([20.4, 20.4], [20.9, 20.9]), safe=[room], horizon=horizon, delta=1e-2)


def waves(noise: Any = None, **changes: Any) -> cb.Problem:
    """Products, a quotient and a sine, with a disturbance."""
    system = cb.DiscreteSystem(
        lambda x, d: [0.7 * x[0] + 0.2 * np.sin(x[1]) + 0.05 * d[0], 0.6 * x[1] - 0.2 * x[0] * x[1] / (2 + x[0] ** 2)],
        states=2, noise=cb.Uniform(halfwidth=[0.3, 0.25]) if noise is None else noise,
        disturbance=cb.Box([-1], [1]),
    )  # fmt: skip
    given = {"initial": cb.Box([-0.1, -0.1], [0.1, 0.1]), "safe": [cb.Inside(cb.Box([-1.2, -1], [1.2, 1]))]}
    return cb.Problem(system, **{**given, "horizon": 12, "delta": 1e-2, **changes})


def stated(problem: cb.Problem) -> Any:
    setting = next(step_bounds._settings(problem))
    return setting, step_bounds._steps(problem, setting)


@pytest.mark.parametrize("problem", [thermostats(), waves()])
def test_a_step_lies_within_its_linear_form_and_terms(problem: cb.Problem) -> None:
    setting, given = stated(problem)
    rng, n, box = np.random.default_rng(0), setting.dimension, problem.system.disturbance
    xi = rng.uniform(-1, 1, (4000, n))
    xi[:40] = np.sign(xi[:40])
    d = np.zeros((4000, 0)) if box is None else rng.uniform(box.low, box.high, (4000, 1))
    x = setting.center + setting.width * xi
    y = (compile_numpy(problem.closed_loop)(0.0, *x.T, *d.T) - setting.center) / setting.width
    z, matrix, rows = np.hstack([xi, np.ones((4000, 1))]), given.secants.matrix, given.secants.rows.mid
    most = np.zeros((4000, len(rows)))  # sup |p_k| at each point
    for k, row in enumerate(rows):
        most[:, k] = np.abs(z @ row[: n + 1]) + most[:, :k] @ np.abs(row[n + 1 : n + 1 + k])
    left = np.abs(y - (z @ matrix.mid[:, : n + 1].T)[:, :n])
    assert np.all(left <= most @ np.abs(matrix.mid[:n, n + 1 :]).T + 1e-12)
    assert len(rows) in (2, 5)  # one for each heater, however many operations it has


def test_of_what_saturates_a_part_of_the_slope_is_left() -> None:
    """The heater's slope is .35 or 0, its mean from 20.67 to 22.5 at least .35 (21.3 - 20.67)/(22.5 - 20.67) = .12."""
    _, given = stated(thermostats())
    matrix, rows = given.secants.matrix.mid, given.secants.rows.mid
    slopes, terms = np.diag(matrix)[:2], np.diag(matrix[:2, 3:]) * np.diag(rows[:, :2])
    assert np.all(slopes + np.abs(terms) < 0.93 - 0.11)
    assert np.all(slopes - np.abs(terms) < 0.93 - 0.35 + 1e-3)


def test_the_expectation_of_what_is_proved_does_not_grow() -> None:
    """E exp(V_t+1(f + w)) <= exp(V_t + excess) all over the box, by Gauss and Hermite's quadrature."""
    problem = thermostats(std=0.2, horizon=6)
    setting, given = stated(problem)
    wall = setting.walls[0]
    proposal = propose_steps(given, [wall], np.arange(7), 1, seconds=20)
    assert proposal is not None
    proof = prove_steps(given, [wall], proposal)
    assert 0 <= proof.excess < 0.01
    nodes, weights = np.polynomial.hermite_e.hermegauss(40)
    noise = np.stack(np.meshgrid(nodes, nodes), axis=-1).reshape(-1, 2) * 0.2
    weight = np.outer(weights, weights).ravel() / (2 * np.pi)
    rng, step = np.random.default_rng(1), compile_numpy(problem.closed_loop)
    tight = -np.inf
    for t in range(6):
        xi = rng.uniform(-1, 1, (60, 2))
        z = np.hstack([xi, np.ones((60, 1))])
        now = np.einsum("pi,ij,pj->p", z, proof.proposal.matrices[t], z) / 2
        f = step(0.0, *(setting.center + setting.width * xi).T)
        after = (f[:, None] + noise - setting.center) / setting.width
        after = np.concatenate([after, np.ones((*after.shape[:2], 1))], axis=2)
        value = np.einsum("pqi,ij,pqj->pq", after, proof.proposal.matrices[t + 1], after) / 2
        mean = np.log(np.exp(value) @ weight)
        assert np.all(mean <= now + proof.excess + 1e-9)
        tight = max(tight, float((mean - now).max()))
    assert tight > -0.3  # and the inequality is used


@pytest.mark.parametrize("noise", [
    cb.Gaussian(covariance=[[0.04, 0.02], [0.02, 0.03]]), cb.Uniform(halfwidth=[0.35, 0.3]),
    cb.Rademacher(scale=[0.2, 0.2]), cb.Triangular(halfwidth=[0.5, 0.4]),
])  # fmt: skip
def test_bounds_lie_above_simulation_whatever_the_law(noise: Any) -> None:
    problem = waves(noise)
    bound = bound_steps(problem, target=0.5, seconds=60)
    exits = cb.simulate_exits(problem, paths=20_000, rng=np.random.default_rng(2))
    assert bound.upper < -0.3
    assert 10**bound.upper >= exits.lower


def test_a_wrong_proposal_never_proves_less_than_the_truth() -> None:
    problem = thermostats(std=0.25, horizon=5)
    setting, given = stated(problem)
    truth = cb.simulate_exits(problem, paths=50_000, rng=np.random.default_rng(3)).lower
    assert truth > 1e-4
    proposal = propose_steps(given, setting.walls, np.arange(6), 1, seconds=20)
    assert proposal is not None
    rng, found = np.random.default_rng(4), 0
    for size in (1e-6, 1e-3, 0.03, 0.3, 1.0):
        for _ in range(6):
            spoilt = replace(
                proposal, matrices=proposal.matrices * (1 + size * rng.normal(size=proposal.matrices.shape)),
                scales=proposal.scales * np.exp(size * rng.normal(size=proposal.scales.shape)),
                weights=proposal.weights - size * rng.random(proposal.weights.shape),
            )  # fmt: skip
            proof = prove_steps(given, setting.walls, spoilt)
            level = step_bounds._level([proof]) if np.isfinite(proof.excess) else 0.0
            found += level < 0
            assert 10**level >= truth
    assert found > 3
    lowered = proposal.matrices.copy()
    lowered[:, -1, -1] -= 4.0  # V lower by 2 everywhere is below 0 beyond the walls
    assert prove_steps(given, setting.walls, replace(proposal, matrices=lowered)).excess == np.inf


def test_obstacles_and_balls_may_be_jumped_into() -> None:
    system = cb.DiscreteSystem(lambda x: [0.5 * x[0], 0.5 * x[1]], states=2, noise=cb.Gaussian(std=0.25))
    safe = [cb.Inside(cb.Ball([0, 0], 1.5)), cb.Outside(cb.Box([0.9, -0.3], [1.1, 0.3]))]
    problem = cb.Problem(system, initial=[0, 0], safe=safe, horizon=15, delta=1e-3)
    bound = bound_steps(problem, target=0.2, seconds=60)
    exits = cb.simulate_exits(problem, paths=50_000, rng=np.random.default_rng(5))
    assert exits.lower < 10**bound.upper <= 0.2


def test_noise_free_states_and_correlated_noise_have_exact_columns() -> None:
    """A root of the covariance that is rounded may not be too small: what is used is proved to be no less."""
    system = cb.linear_system(
        [[1.0, 0.1], [-0.3, 0.7]], noise=cb.Gaussian(std=0.2), noise_matrix=[[0.0], [1.0]], states=["x", "v"]
    )
    problem = cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -2], [1, 2]))], horizon=10)
    setting, given = stated(problem)
    square = given.noise[:2] @ given.noise[:2].T * np.outer(setting.width, setting.width)
    assert np.array_equal(given.noise[0], [0.0])
    assert 0.04 < square[1, 1] < 0.04 * (1 + 1e-8)


@pytest.mark.parametrize(("problem", "error", "why"), [
    (cb.Problem(cb.ContinuousSystem(lambda x: -x, states=1, diffusion=[[1.0]]), initial=[0.0],
                safe=[cb.Inside(cb.Box([-1], [1]))], horizon=1), InfeasibleError, "discrete time"),
    (waves(safe=[cb.Inside(cb.Box([-1.2, -1], [1.2, 1]), during=(2, 5))]), InfeasibleError, "windows"),
    (cb.Problem(cb.DiscreteSystem(lambda x: [np.where(x[0] > 0, 0.5 * x[0], 0.5)], states=1,
                                  noise=cb.Gaussian(std=0.1)),
                initial=[0.5], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=3), EnclosureError, "jump"),
    (cb.Problem(cb.DiscreteSystem(lambda x: 0.5 * x, states=13, noise=cb.Gaussian(std=0.1)), initial=[0.0] * 13,
                safe=[cb.Inside(cb.Box([-1] * 13, [1] * 13))], horizon=3), InfeasibleError, "at most 12 states"),
])  # fmt: skip
def test_what_is_not_served_is_named(problem: cb.Problem, error: type[Exception], why: str) -> None:
    with pytest.raises(error, match=why):
        bound_steps(problem, seconds=1)


def test_the_engine_asks_for_it_and_no_certificate_states_it() -> None:
    problem = thermostats()
    answer = quadratic_engine(problem, Request(thorough=True))
    assert answer.log10_delta <= -2
    assert isinstance(answer.details, StepsBound)
    with pytest.raises(CertificateError, match="in discrete time"):
        quadratic_proof(problem, answer)
    done = Request(thorough=True, before=StepsBound(upper=-1.0, words="all of it", complete=True))
    assert quadratic_engine(problem, done).reason == "all of it."


def test_an_inverse_and_a_log_determinant_enclose(monkeypatch: pytest.MonkeyPatch) -> None:
    from certbound.quadratic.steps import step_proof

    matrix = np.array([[[1.0, 0.3], [0.3, 0.8]]])
    monkeypatch.setattr(np.linalg, "inv", lambda m: np.linalg.solve(m, np.eye(2)) * 1.1)  # a poor inverse is paid for
    upper = step_proof._inverse(Interval.point(matrix), np.array([0.5]))
    assert np.all(np.linalg.eigvalsh(upper.mid - np.linalg.solve(matrix, np.eye(2))) >= 0)
    log = step_proof._log_determinants(Interval.point(matrix))
    assert log.lo[0] - 1e-15 <= np.log(0.71) <= log.hi[0] + 1e-15 < log.lo[0] + 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(30))
def test_random_steps_fail_at_most_as_often(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 5))
    a = rng.normal(size=(n, n))
    a *= rng.uniform(0.5, 0.95) / np.abs(np.linalg.eigvals(a)).max()
    bend, w = rng.uniform(-0.4, 0.4, n), rng.normal(size=(n, n))
    kinds = [np.sin, np.tanh, lambda y: np.maximum(y, 0), lambda y: np.clip(y, -0.5, 0.8), lambda y: y * np.abs(y) / 2]
    kind = kinds[int(rng.integers(len(kinds)))]

    def step(x: Any) -> Any:
        x = np.array(x)
        return a @ x + bend * np.array([kind(value) for value in w @ x])

    std = rng.uniform(0.1, 0.3, n)
    laws = [cb.Gaussian(std=std), cb.Uniform(halfwidth=2 * std), cb.Triangular(halfwidth=2 * std)]
    system = cb.DiscreteSystem(step, states=n, noise=laws[int(rng.integers(3))])
    side = rng.uniform(0.8, 2.5, n)
    start = cb.Box(-0.1 * side, 0.1 * side)
    horizon = int(rng.integers(1, 60))
    problem = cb.Problem(system, initial=start, safe=[cb.Inside(cb.Box(-side, side))], horizon=horizon)
    try:
        bound = bound_steps(problem, target=1e-12, seconds=6).upper
    except InfeasibleError:
        return
    exits = cb.simulate_exits(problem, paths=200_000, rng=np.random.default_rng(1), confidence=0.999)
    assert 10**bound >= exits.lower
