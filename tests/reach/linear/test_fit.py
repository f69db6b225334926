"""Fitted slopes leave less to the remainder, and change nothing else."""

from __future__ import annotations

import numpy as np
import pytest

import certbound as cb
from certbound.reach.linear.answer import linear_answer
from certbound.reach.linear.fit import fitted
from certbound.reach.linear.linearisation import Linearisation
from certbound.reach.linear.run import LinearRun
from certbound.reach.linear.shares import Share

LIKELY = Share.of(1e-3)


def cubic(width: float = 0.6, sigma: float = 0.05) -> cb.Problem:
    system = cb.ContinuousSystem(lambda x: [x[1], -x[0] - x[1] - x[0] ** 3], states=2, diffusion=sigma * np.eye(2))
    start = cb.Box([-width] * 2, [width] * 2)
    safe = [cb.Inside(cb.Box([-3, -3], [3, 3]))]
    return cb.Problem(system, initial=start, safe=safe, horizon=1.5, delta=1e-3)


def test_the_fit_halves_the_remainder_and_keeps_constant_entries() -> None:
    plain = Linearisation(cubic(), pieces=50)
    engine = fitted(plain, LIKELY)
    assert engine.correction is not None
    assert np.all(engine.correction[..., 1, 0] < 0)  # the cubic spring is stiffer away from 0
    assert not np.any(engine.correction[..., [0, 0, 1], [0, 1, 1]])
    widths = []
    for own in (plain, engine):
        run = LinearRun(own)
        bounds = run.include(run.levels(LIKELY)[0], 2)
        assert bounds is not None
        widths.append(float(np.max(bounds[1] - bounds[0])))
    assert widths[1] < 0.5 * widths[0]


def test_discrete_time_is_fitted_too() -> None:
    system = cb.DiscreteSystem(lambda x: [x[0] - 0.3 * np.tanh(2 * x[0])], states=1, noise=cb.Gaussian(std=0.05))
    problem = cb.Problem(system, initial=cb.Box([-1.0], [1.0]), safe=[], horizon=6, delta=1e-2)
    engine = fitted(Linearisation(problem), Share.of(1e-2))
    assert np.all(engine.slopes[0][0, :3] > engine.tangents[0][0, :3] + 0.05)


def test_a_linear_model_is_left_alone() -> None:
    engine = Linearisation(cb.load("ou"), pieces=10)
    assert fitted(engine, LIKELY) is engine


def test_another_grid_keeps_the_fit() -> None:
    engine = fitted(Linearisation(cubic(), pieces=60), LIKELY)
    coarse = engine.on_grid(20)
    assert coarse.pieces == 20
    assert coarse.correction is not None
    assert engine.correction is not None
    np.testing.assert_allclose(coarse.correction, engine.correction[:, ::3], atol=1e-12)
    np.testing.assert_allclose(coarse.slopes[0], engine.slopes[0][:, ::3], atol=1e-6)


def test_a_fit_that_would_be_too_steep_is_not_used() -> None:
    system = cb.ContinuousSystem(lambda x: -x - 50 * x**3, states=1, diffusion=[[0.05]])
    problem = cb.Problem(system, initial=cb.Box([-4.0], [4.0]), safe=[], horizon=2.0, delta=1e-3)
    engine = Linearisation(problem, pieces=50)
    assert fitted(engine, LIKELY) is engine


@pytest.mark.parametrize(("horizon", "sigma"), [
    (2.0, 0.1), pytest.param(5.0, 0.03, marks=pytest.mark.slow),
])  # fmt: skip
def test_the_unicycle_is_safe_at_ten_times_its_noise(horizon: float, sigma: float) -> None:
    problem = cb.load("unicycle", sigma=sigma).replace(horizon=horizon)
    answer = linear_answer(problem)
    assert len(answer.run.engine.centres) == 1
    assert answer.log10_delta <= -3


def test_units_of_single_states_cost_few_pieces_of_time() -> None:
    """||J|| is 1000 in these units, and 1.4 in the states' own."""
    slope = np.array([[0.0, 1000.0], [-0.001, -0.1]])
    system = cb.linear_system(slope, diffusion=np.diag([0.1, 1e-4]))
    start, safe = cb.Box([0, 0], [0, 0]), [cb.Inside(cb.Box([-3, -3], [3, 3]))]
    problem = cb.Problem(system, initial=start, safe=safe, horizon=1.0)
    assert Linearisation.of(problem).pieces == 50
    scaled = problem.replace(safe=[cb.Inside(cb.Box([-3, -3e-3], [3, 3e-3]))])
    assert linear_answer(scaled).log10_delta <= -37.5  # what ten times as many pieces proved
