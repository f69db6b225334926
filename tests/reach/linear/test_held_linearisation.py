"""The linear response where inputs are held: against closed forms, simulations, and inputs that follow at once."""

from __future__ import annotations

import math

import numpy as np
import pytest

import certbound as cb
from certbound.problem.held import held_loop
from certbound.reach.linear import HeldLinearisation
from certbound.reach.linear.rows import inner_rows


def scalar(hold: float, *, a: float = 0.5, gain: float = 1.5, **changes: object) -> cb.Problem:
    system = cb.ContinuousSystem(
        lambda x, u: a * x + u, states=["x"], inputs=cb.Box([-9], [9]), diffusion=[[0.4]]
    )
    given: dict[str, object] = {
        "initial": [0.1], "safe": [cb.Inside(cb.Box([-1.2], [1.2]))], "horizon": 4, "hold": hold, "delta": 1e-2,
        "plan": lambda x: -gain * x,
    }
    return cb.Problem(system, **(given | changes))


def test_variances_at_sampling_times_are_those_of_the_exact_recursion() -> None:
    hold, a, gain = 0.5, 0.5, 1.5
    engine = HeldLinearisation(held_loop(scalar(hold)))
    nodes = engine.sampling
    factor = math.exp(a * hold) - gain * math.expm1(a * hold) / a
    added = 0.16 * math.expm1(2 * a * hold) / (2 * a)
    variance = 0.0
    for k, node in enumerate(nodes):
        low, high = engine.response.variance(np.array([[[1.0, 0.0]]]), np.array([node]))
        assert low[0, 0] <= variance * (1 + 1e-12)
        assert variance * (1 - 1e-12) <= high[0, 0]
        assert engine.nodes[0, node, 0] == pytest.approx(0.1 * factor**k, abs=1e-9)
        assert engine.times[node] == pytest.approx(k * hold)
        held = engine.response.covariance[0, node + 1]  # after the jump u = -gain x
        assert held == pytest.approx(held[0, 0] * np.array([[1, -gain], [-gain, gain**2]]), abs=1e-12)
        variance = factor**2 * variance + added


def test_a_bound_lies_above_what_is_simulated_and_near_it() -> None:
    for hold in (0.05, 0.5):
        problem = scalar(hold)
        found = 10 ** cb.verify_safety(problem, method="linear").log10_delta
        seen = cb.simulate_exits(problem, paths=10_000, rng=1, halve=False)
        assert seen.lower <= found <= 8 * seen.upper


def test_a_longer_hold_is_worse_and_a_short_one_is_next_to_none() -> None:
    levels = [cb.verify_safety(scalar(hold), method="linear").log10_delta for hold in (0.02, 0.2, 1.0)]
    plain = cb.verify_safety(scalar(0.2).replace(hold=None), method="linear").log10_delta
    assert plain - 1e-9 <= levels[0] < levels[1] < levels[2]
    assert levels[0] < plain + 0.9


def test_a_law_that_a_hold_makes_unstable_is_not_safe() -> None:
    problem = scalar(1.0, gain=4.0)  # each hold multiplies x by -3.5
    assert cb.verify_safety(problem, method="linear").status != "SAFE"
    assert cb.verify_safety(problem.replace(hold=None), method="linear").status == "SAFE"


def test_where_nothing_is_nonlinear_no_remainder_is_paid_for() -> None:
    loop = held_loop(scalar(0.5))
    engine = HeldLinearisation(loop)
    assert not len(engine.model.active)
    low, high = engine.model.bound(engine.frame, *(np.zeros((engine.pieces, 0)),) * 2, np.zeros((engine.pieces, 0, 0)))
    assert np.abs([low, high]).max() < 1e-8  # the nominal's own defect


def test_remainders_of_law_and_flow_hold_at_random_points() -> None:
    system = cb.ContinuousSystem(
        lambda x, u: [np.sin(x[1]), np.tan(u[0])], states=["y", "h"], inputs=cb.Box([-1], [1]),
        diffusion=0.1 * np.eye(2),
    )
    problem = cb.Problem(
        system, initial=[0.3, 0.1], safe=[cb.Inside(cb.Box([-2, -2], [2, 2]))], horizon=1, hold=0.25,
        plan=lambda x: 0.5 * np.tanh(-x[0] - x[1]),
    )
    engine = HeldLinearisation(held_loop(problem))
    count, n = len(engine.model.active), engine.n
    assert engine.model.active.tolist() == [0, 1, 2]
    reach = np.full((engine.pieces, count), 0.2)
    low, high = engine.model.bound(engine.frame, -reach, reach, np.zeros((engine.pieces, 0, count)))
    rng, slopes = np.random.default_rng(0), engine.slopes[0][0]
    for shift in rng.uniform(-0.2, 0.2, (50, n)):
        for i, k in enumerate(engine.sampling):
            x = engine.nodes[0, k] + shift
            jumped = np.array([x[0], x[1], 0.5 * np.tanh(-x[0] - x[1])])
            beta = (jumped - engine.nodes[0, k + 1] - engine.jumps[0, i] @ shift) / engine.step
            assert np.all(low[k] <= beta + 1e-9)
            assert np.all(beta - 1e-9 <= high[k])
        for k in engine.flowing[::7]:  # at the start of a piece, where the slope is A
            x, h = engine.nodes[0, k] + shift, engine.step
            velocity = 3 * (engine.controls[0, k, 1] - engine.controls[0, k, 0]) / h
            beta = np.array([np.sin(x[1]), np.tan(x[2]), 0.0]) - velocity - slopes[k] @ shift
            assert np.all(low[k] <= beta + 1e-9)
            assert np.all(beta - 1e-9 <= high[k])


def saturated(**changes: object) -> cb.Problem:
    """A mass that is pushed back by at most 1.6, and is now and then pushed by so much."""
    system = cb.ContinuousSystem(
        lambda x, v, u: [v, u - 0.5 * v], states=["x", "v"], inputs=cb.Box([-1.6], [1.6]), diffusion=[[0.0], [0.25]]
    )
    given: dict[str, object] = {
        "initial": [0.1, 0.0], "safe": [cb.Inside(cb.Box([-0.6, -np.inf], [0.6, np.inf]))], "horizon": 2, "hold": 0.1,
        "plan": lambda x, v: np.clip(-6 * x - 3 * v, -1.6, 1.6), "delta": 1e-3,
    }
    return cb.Problem(system, **(given | changes))


@pytest.mark.slow
def test_a_law_that_saturates_along_a_sum_of_states_is_bounded_along_it() -> None:
    verdict = cb.verify_safety(saturated(), method="linear")
    assert verdict.status == "SAFE"


def test_remainders_of_a_law_hold_where_rows_cut_what_saturates() -> None:
    engine = HeldLinearisation(held_loop(saturated(plan=lambda x, v: np.clip(-6 * x - 6 * v, -1.6, 1.6))))
    extra = inner_rows(engine)[1][0]
    assert extra.shape == (engine.pieces, 1, 2)
    assert extra == pytest.approx(np.full(extra.shape, extra[0, 0, 0]))  # of the flow's pieces as well
    reach = np.concatenate([np.full((engine.pieces, 2), 0.4), np.full((engine.pieces, 1), 0.2)], axis=1)
    low, high = engine.model.bound(engine.frame, -reach, reach, extra)
    whole = engine.model.bound(engine.frame, -reach[:, :2], reach[:, :2], extra[:, :0])
    rng, inside = np.random.default_rng(0), 0
    for i, k in enumerate(engine.sampling):
        shift = np.concatenate([rng.uniform(-0.4, 0.4, (400, 2)), np.zeros((400, 1))], axis=1)
        shift = shift[np.abs(shift[:, :2] @ extra[k, 0]) <= 0.2]
        x = engine.nodes[0, k] + shift
        law = np.clip(-6 * x[:, 0] - 6 * x[:, 1], -1.6, 1.6)
        beta = (law - engine.nodes[0, k + 1, 2] - shift @ engine.jumps[0, i, 2]) / engine.step
        assert low[k, 2] - 1e-9 <= beta.min()
        assert beta.max() <= high[k, 2] + 1e-9
        inside += len(beta)
    assert inside > 1000
    assert (high - low)[engine.sampling, 2].sum() < 0.5 * (whole[1] - whole[0])[engine.sampling, 2].sum()


def test_every_cell_of_a_set_of_starts_is_bounded() -> None:
    problem = scalar(0.5, initial=cb.Box([-0.3], [0.3]), delta=0.3)
    whole, parts = (cb.verify_safety(problem, method="linear", cells=cells).log10_delta for cells in (1, 3))
    assert -3 < parts <= whole + 1e-9


def test_deviations_are_told_of_the_states_alone() -> None:
    verdict = cb.verify_safety(scalar(0.5, delta=0.5), method="linear")
    answer = verdict.answers["linear"]
    assert answer.deviation is not None
    assert answer.deviation.extent.shape == (len(answer.deviation.times) - 1, 1)
    assert np.all(np.diff(answer.deviation.times) > 0)


def test_other_engines_say_that_they_do_not_serve_it() -> None:
    for method in ("constants", "barrier", "quadratic", "values"):
        verdict = cb.verify_safety(scalar(0.5), method=method)
        assert verdict.status == "UNKNOWN"
        assert "the inputs are held for 0.5 s" in verdict.reason
