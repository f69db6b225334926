"""The remainder along the nominal curve itself."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import certbound as cb
from certbound.reach.linear.answer import linear_reach
from certbound.reach.linear.linearisation import Linearisation
from certbound.reach.nominal.flow import Flow
from certbound.reach.remainder.nominal_defect import NominalDefect, bound_defect_over_pieces


def swinging() -> cb.Problem:
    system = cb.ContinuousSystem(
        lambda t, x: [x[1], -np.sin(x[0]) * (1 + 0.5 * np.cos(3 * t))], states=2, diffusion=0.05 * np.eye(2),
    )
    return cb.Problem(system, initial=[0.5, 0.0], safe=[], horizon=1.5)


def creased() -> cb.Problem:
    """The nominal crosses a kink at about t = .5."""
    system = cb.ContinuousSystem(lambda x: [-1.0, -np.abs(x[0]) * x[1]], states=2, diffusion=0.05 * np.eye(2))
    return cb.Problem(system, initial=[0.5, 1.0], safe=[], horizon=1.0)


def sampled(engine: Linearisation, fractions: np.ndarray) -> np.ndarray:
    """f(p) - p' at fractions of every piece, straight from the Bezier points: (fractions, pieces, n)."""
    b, h = engine.controls[0], engine.step
    found = []
    for u in fractions:
        v = 1 - u
        p = v**3 * b[:, 0] + 3 * u * v**2 * b[:, 1] + 3 * u**2 * v * b[:, 2] + u**3 * b[:, 3]
        rate = 3 / h * (v**2 * (b[:, 1] - b[:, 0]) + 2 * u * v * (b[:, 2] - b[:, 1]) + u**2 * (b[:, 3] - b[:, 2]))
        d = [np.full(len(p), value) for value in engine.d_middle]
        found.append(engine._compiled(engine.times[:-1] + u * h, *p.T, *d) - rate)
    return np.array(found)


@pytest.mark.parametrize("problem", [swinging(), cb.load("unicycle")], ids=["swinging", "unicycle"])
def test_the_nominals_defect_is_enclosed_closely(problem: cb.Problem) -> None:
    engine = Linearisation(problem, pieces=40)
    bound = bound_defect_over_pieces(engine.model, engine.frame)
    values = sampled(engine, np.linspace(0, 1, 21))
    slack = 1e-12 * (1 + np.abs(engine.controls[0]).max())
    assert np.all(values >= bound.lo - slack)
    assert np.all(values <= bound.hi + slack)
    assert np.all(bound.mag.max(axis=0) <= 8 * np.abs(values).max(axis=(0, 1)))


def test_the_defect_falls_with_the_third_power_of_the_step() -> None:
    sizes = []
    for pieces in (20, 40, 80):
        engine = Linearisation(swinging(), pieces=pieces)
        sizes.append(bound_defect_over_pieces(engine.model, engine.frame).mag.max())
    assert 6 < sizes[0] / sizes[1] < 20
    assert 6 < sizes[1] / sizes[2] < 20


def test_where_a_kink_is_crossed_the_derivative_of_the_curve_takes_the_place_of_the_dynamics() -> None:
    engine = Linearisation(creased(), pieces=10)
    found, frame = NominalDefect(engine.model, engine.frame), engine.frame
    crossed = np.flatnonzero(found.curve.max(axis=1) > 0)
    assert set(crossed) <= {4, 5}
    assert len(crossed)
    assert np.all(found.defect.mag[crossed] == 0)
    assert np.array_equal(found.value.lo[crossed], frame.middle_velocity.lo[crossed])
    smooth = np.setdiff1d(np.arange(10), crossed)
    assert np.all(found.defect.mag[smooth] < 1e-3)


def test_a_trajectory_without_noise_is_enclosed_closely() -> None:
    problem = cb.load("unicycle", disturbance=0.0, x0_halfwidth=0.0).replace(horizon=2.0)
    reach = linear_reach(problem, noise=False)
    assert reach.box is not None
    assert reach.box.mag.max() < 1e-3
    flow = Flow(problem)
    end = solve_ivp(lambda t, x: flow.value(t, x, np.zeros(0)), (0, 2), problem.initial.low, rtol=1e-11, atol=1e-12)
    assert reach.contains(2.0, end.y[:, -1])
