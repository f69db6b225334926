"""Simulated paths of inputs that are held."""

from __future__ import annotations

import numpy as np
import pytest

import certbound as cb
from certbound.errors import InfeasibleError
from certbound.simulation.estimates.deviations import sup_deviation
from certbound.simulation.estimates.splitting import simulate_rare_exits


def loud(hold: float | None, diffusion: float = 0.4) -> cb.Problem:
    system = cb.ContinuousSystem(
        lambda x, u: 0.5 * x + u, states=["x"], inputs=cb.Box([-9], [9]), diffusion=[[diffusion]]
    )
    safe = [cb.Inside(cb.Box([-1.2], [1.2]))]
    return cb.Problem(system, initial=[1.0], safe=safe, horizon=4, plan=lambda x: -1.5 * x, hold=hold)


def test_paths_keep_their_inputs_between_sampling_times() -> None:
    paths = cb.sample_paths(loud(1.0, 0.0), paths=1, rng=0, steps=4)[0, :, 0]
    factor = np.exp(0.5) - 1.5 * (np.exp(0.5) - 1) / 0.5  # of the exact step with the input held
    assert paths == pytest.approx(factor ** np.arange(5), abs=1e-12)
    finer = cb.sample_paths(loud(1.0, 0.0), paths=1, rng=0, steps=400, points=4)[0, :, 0]
    assert finer == pytest.approx(paths, abs=1e-12)


def test_counts_agree_with_a_loop_of_ones_own() -> None:
    found = cb.simulate_exits(loud(1.0), paths=20_000, rng=1, steps=800, halve=False)
    rng, h = np.random.default_rng(2), 4 / 800
    x, u, left = np.ones(20_000), np.zeros(20_000), np.zeros(20_000, dtype=bool)
    for k in range(800):
        u = -1.5 * x if k % 200 == 0 else u
        x = x + h * (0.5 * x + u) + 0.4 * np.sqrt(h) * rng.standard_normal(len(x))
        left |= np.abs(x) > 1.2 - 0.5826 * 0.4 * np.sqrt(h)  # what is missed between two steps
    assert found.probability == pytest.approx(left.mean(), abs=0.02)


def test_the_steps_end_at_sampling_times() -> None:
    assert cb.simulate_exits(loud(0.8, 0.0).replace(horizon=2.4), paths=10, rng=0, halve=False).steps == 1002
    with pytest.raises(ValueError, match="`steps` must be a multiple of the 5 sampling times, got 12"):
        cb.simulate_exits(loud(0.8), paths=10, rng=0, steps=12)


def test_what_knows_no_sampling_times_is_refused() -> None:
    with pytest.raises(InfeasibleError, match="splitting knows no inputs that are held"):
        simulate_rare_exits(loud(1.0), paths=1000, rng=0)
    with pytest.raises(InfeasibleError, match="a simulation of deviations knows no inputs"):
        sup_deviation(loud(1.0), paths=1000, rng=0)
    with pytest.raises(InfeasibleError, match="a sample of deviations knows no inputs"):
        cb.sample_paths(loud(1.0), paths=10, deviation=True)
