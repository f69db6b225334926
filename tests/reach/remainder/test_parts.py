"""Many coupled coordinates: the remainder bounded output by output, each over its own coordinates."""

from __future__ import annotations

import numpy as np
import pytest

import certbound as cb
from certbound.reach.linear.linearisation import Linearisation
from certbound.reach.remainder.bound import Remainder

N = 8


def ring(name: str = "smooth") -> cb.Problem:
    """Eight states, each output with two or three of them, one with explicit time."""

    def flow(t, x):  # type: ignore[no-untyped-def]
        rates = [np.sin(x[(i + 1) % N]) - x[i] + 0.3 * x[(i + 3) % N] * x[(i + 4) % N] for i in range(N)]
        rates[2] = rates[2] + 0.2 * np.cos(3 * t) * x[4] ** 2
        if name == "kinked":
            rates[3] = rates[3] + 0.1 * np.abs(x[3])
        if name == "defined above -1":
            rates[0] = rates[0] + np.log(1 + x[1])
        return rates

    system = cb.ContinuousSystem(flow, states=N, diffusion=0.05 * np.eye(N))
    return cb.Problem(system, initial=cb.Box([-0.1] * N, [0.2] * N), safe=[], horizon=0.2, delta=1e-2)


@pytest.fixture(scope="module")
def engine() -> Linearisation:
    return Linearisation(ring(), pieces=2)


def test_bounds_hold_in_the_polytope_and_say_more_than_those_of_all_coordinates_at_once(engine: Linearisation) -> None:
    rng, model = np.random.default_rng(3), engine.model
    whole = Remainder(engine.problem)
    vars(whole)["parts"] = []
    # faces of two coordinates of one output, of two that no output has in common with it, and of all
    rows = np.zeros((2, 4, N))
    rows[:, 0, [3, 4]], rows[:, 1, [4, 5]], rows[:, 2, [0, 4]], rows[:, 3] = 1.0, [1.0, -1.0], 1.0, 1.0
    half = np.broadcast_to(0.4, (2, N))
    faces = np.array([0.3, 0.25, 0.05, 0.2])
    high = np.concatenate([half, np.broadcast_to(faces, (2, 4))], axis=1)
    low, upper = model.bound(engine.frame, -high, high, rows, 0)
    wide_low, wide_upper = whole.bound(engine.frame, -high, high, rows, 0)
    points = rng.uniform(-0.4, 0.4, (20_000, N)) * rng.choice([0.2, 1.0], (20_000, N))
    points = points[(np.abs(points @ rows[0].T) <= faces).all(axis=1)][:400]
    assert len(points) > 100
    for k in range(2):
        own, (slope, drift, _) = engine.controls[0][k], engine.slopes
        for theta in (0.0, 0.5, 1.0):
            rest, h = 1 - theta, engine.step
            p = rest**3 * own[0] + 3 * theta * rest**2 * own[1] + 3 * theta**2 * rest * own[2] + theta**3 * own[3]
            rate = 3 / h * (rest**2 * (own[1] - own[0]) + 2 * theta * rest * (own[2] - own[1])
                            + theta**2 * (own[3] - own[2]))
            value = engine._compiled(engine.times[k] + theta * h, *(p + points).T)
            beta = value - rate - points @ (slope[0, k] + theta * h * drift[0, k]).T
            assert np.all((beta >= low[k] - 1e-14) & (beta <= upper[k] + 1e-14))
    assert len(model.parts) == N
    assert np.all(upper <= wide_upper) and np.all(low >= wide_low)
    assert np.all((upper - low)[:, 0] < 0.85 * (wide_upper - wide_low)[:, 0])


def test_sampled_ranges_lie_in_the_bounds_and_slopes_fit_all_outputs(engine: Linearisation) -> None:
    rows, half = np.zeros((2, 0, N)), np.broadcast_to(0.3, (2, N))
    low, high = engine.model.bound(engine.frame, -half, half, rows, 2)
    least, most = engine.model.sampled(engine.frame, -half, half, rows)
    assert np.all((low <= least) & (most <= high)) and np.all(most - least > 0.7 * (high - low))
    fitted = engine.model.fitted(engine.frame, -half, half, rows)
    assert np.allclose(fitted[0][np.arange(N), (np.arange(N) + 1) % N], -0.009, atol=0.006)


@pytest.mark.parametrize("name", ["kinked", "defined above -1"])
def test_kinks_are_left_whole_and_what_is_undefined_is_not_bounded(name: str) -> None:
    engine = Linearisation(ring(name), pieces=2)
    rows, half = np.zeros((2, 0, N)), np.broadcast_to(1.3, (2, N))
    low, high = engine.model.bound(engine.frame, -half, half, rows, 0)
    assert bool(engine.model.parts) == (name != "kinked")
    assert np.all(np.isinf(high[:, 0])) == (name != "kinked") and np.all(np.isfinite(high[:, 1:]))
    assert np.all(low <= high)
