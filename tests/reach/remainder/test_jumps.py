"""Jumps have the derivative 0: they must be decided over whole boxes and pieces, or nothing may be claimed."""

from __future__ import annotations

import numpy as np
import pytest

import certbound as cb


def test_a_jump_that_multiplies_its_own_state_is_seen():
    # .9 x, but 2.9 x where .2502 <= x < .2506: every second derivative is 0
    def problem(initial):
        system = cb.DiscreteSystem(
            lambda x: [x[0] * (0.9 + 2 * np.floor(x[0] + 0.7498) - 2 * np.floor(x[0] + 0.7494))],
            states=1, noise=cb.Gaussian(std=1e-6),
        )  # fmt: skip
        safe = [cb.Inside(cb.Box([-1.0], [0.6]))]
        return cb.Problem(system, initial=initial, safe=safe, horizon=2, delta=1e-3)

    assert cb.simulate_exits(problem(cb.Box([0.2503], [0.2505])), paths=2000, halve=False).probability > 0.99
    assert cb.verify_safety(problem(cb.Box([0.2], [0.3])), method="linear", cells=1).status != "SAFE"


def test_a_jump_couples_the_states_that_decide_it():
    # x and y enter side by side, and alone neither reaches the jump
    system = cb.DiscreteSystem(
        lambda x: [0.1 * x[0] ** 2 + 0.1 * x[1] ** 2 + 5.0 * np.floor(x[0] + x[1] + 0.5), 0.1 * x[1]],
        states=2, noise=cb.Gaussian(std=0.13),
    )  # fmt: skip
    problem = cb.Problem(
        system, initial=[0.0, 0.0], safe=[cb.Inside(cb.Box([-1.0, -1.0], [1.0, 1.0]))], horizon=3, delta=1e-2
    )
    counts = cb.simulate_exits(problem, paths=100_000, rng=np.random.default_rng(1), halve=False)
    assert counts.lower > 0.01  # so SAFE would be wrong
    assert counts.lower <= 10 ** cb.verify_safety(problem, method="linear").log10_delta


def pulse(limit):
    """50 for 3 ms, within one piece of time."""
    system = cb.ContinuousSystem(
        lambda t, x: [-x[0] + 50.0 * (np.floor(t - 0.0095) - np.floor(t - 0.0125))], states=1, diffusion=[[1e-3]]
    )
    safe = [cb.Inside(cb.Box([-1.0], [limit]))]
    return cb.Problem(system, initial=[0.0], safe=safe, horizon=1.6, delta=1e-3)


def test_a_jump_in_time_inside_a_piece_is_seen():
    assert cb.simulate_exits(pulse(0.1), paths=200, steps=16_000, halve=False).probability > 0.9
    assert cb.verify_safety(pulse(0.1), method="linear").status != "SAFE"
    with pytest.raises(ArithmeticError, match="jump"):
        cb.bound_reach(pulse(1.0), noise=False, method="linear")
