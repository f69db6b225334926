"""What the step adds: the same Brownian paths with the step and with half of it, and no refutation by one alone."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit

import certbound as cb
from certbound.simulation.compiled.streams import seed_stream, stream_of
from certbound.simulation.estimates.halving import BLOCK, composed, halved, paired_paths, step_effect
from certbound.simulation.estimates.montecarlo import simulate_exits
from certbound.simulation.estimates.preparation import prepare
from certbound.simulation.estimates.splitting import simulate_rare_exits
from certbound.simulation.stepping import Scenario


def spring(limit, drift=lambda x: [x[1], -x[0] - x[1]], *, during=None, **options):
    system = cb.ContinuousSystem(drift, states=2, diffusion=options.pop("diffusion", [[0.0], [0.5]]))
    safe = [cb.Inside(cb.Box([-limit, -np.inf], [limit, np.inf]), during=during)]
    return cb.Problem(system, **({"initial": [0.1, 0.0], "safe": safe, "horizon": 6.0} | options))


def swing(x):
    return [x[1], -25.0 * np.sin(x[0]) - 0.2 * x[1]]


def test_exact_steps_lead_to_the_same_end_whatever_the_step():
    found = simulate_exits(spring(0.4, during=(6.0, 6.0)), paths=5000, rng=1, steps=7)
    assert (found.scheme, found.step.adds, found.step.paths) == ("exact", 0.0, 5000)
    setting = prepare(spring(0.4), 7)
    fine = halved(spring(0.4), setting, None)
    both = composed(setting.model, fine.model)
    assert found.exits > 500
    assert (setting.steps, fine.steps, both.noise_count) == (7, 14, 2 * fine.model.noise_count)
    np.testing.assert_allclose(both.noise @ both.noise.T, setting.model.noise @ setting.model.noise.T, atol=1e-14)


@pytest.mark.parametrize(
    ("scheme", "diffusion", "drift"),
    [
        ("exponential", [[0.0], [0.5]], swing),
        ("exponential", lambda x: [[0.0], [0.5 + 0.1 * x[0] ** 2]], swing),
        ("euler", [[0.0], [0.5]], lambda x: [x[1], -np.tanh(x[0]) - x[1]]),
        ("euler", lambda x: [[0.0], [0.5 + 0.1 * x[0] ** 2]], lambda x: [x[1], -np.tanh(x[0]) - x[1]]),
    ],
)
def test_few_paths_end_otherwise_with_half_of_the_step(scheme, diffusion, drift):
    """Were the noise not shared, more than a sixth of all paths would differ."""
    limit = 0.25 if scheme == "exponential" else 0.6
    choice = Scenario(scheme="euler" if scheme == "euler" else "auto")
    problem = spring(limit, drift, diffusion=diffusion, initial=[0.0, 0.0])
    found = simulate_exits(problem, paths=3000, rng=2, steps=600, scenario=choice)
    assert found.scheme == scheme
    assert 0.1 < found.probability < 0.8
    assert found.step.lower < found.step.adds < found.step.upper
    assert found.step.upper - found.step.lower < 0.04


def test_a_scheme_that_drives_a_swing_is_told_by_its_halves():
    """Euler's scheme, 4 steps a radian, damps by a tenth less than the model says, of a fifth."""
    problem = spring(1.0, lambda x: [x[1], -np.sin(x[0]) - 0.2 * x[1]], diffusion=[[0.0], [0.25]], horizon=30.0)
    found = simulate_exits(problem, paths=6000, rng=3, steps=900, scenario=Scenario(scheme="euler"))
    assert found.step.lower > 0.0
    assert found.refuted < found.lower
    assert not found.refutes(found.refuted)
    better = simulate_exits(problem, paths=6000, rng=3, steps=900)
    assert better.probability < found.lower
    assert better.step.lower < 0.0 < better.step.upper


def test_nothing_is_refuted_that_half_of_the_step_does_not_refute():
    alone = step_effect(np.array([0, 200, 0]), (2000, 10_000), 1000, 0.99)
    assert (alone.adds, alone.halved_lower) == (0.2, 0.0)
    same = step_effect(np.array([200, 0, 0]), (2000, 10_000), 1000, 0.99)
    assert same.adds == 0.0
    assert 0.17 < same.halved_lower < 0.2
    assert same.lower < 0.0 < same.upper
    seldom = step_effect(np.array([2, 0, 0]), (20, 10_000), 1000, 0.99)
    assert 0.0 < seldom.halved_lower < 0.002


def test_an_eighth_of_many_paths_is_simulated_twice_and_all_of_few():
    assert [paired_paths(count) for count in (10, 32 * BLOCK, 10**5, 10**7)] == [10, 32 * BLOCK, 32 * BLOCK, 1_250_000]


def test_discrete_time_has_no_step_to_halve():
    found = simulate_exits(cb.load("chain"), paths=100, rng=1)
    assert found.step is None
    assert found.refuted == found.lower
    problem = spring(0.5)
    assert simulate_exits(problem, paths=100, rng=1, halve=False).step is None


def test_the_count_itself_does_not_depend_on_halving():
    problem = spring(0.5)
    first, second = (simulate_exits(problem, paths=3000, rng=4, steps=100, halve=halve) for halve in (True, False))
    assert np.array_equal(first.exits_by_time, second.exits_by_time)


def test_who_left_the_domain_and_has_ended_does_not_count_in_pairs_either():
    system = cb.ContinuousSystem(lambda x: -x, states=1, diffusion=[[0.5]])
    ends = cb.Problem(
        system, initial=[0.0], safe=[cb.Inside(cb.Box([-1.0], [np.inf]))], horizon=2.0,
        domain=cb.Box([-3.0], [0.3]), leaving="ends",
    )  # fmt: skip
    found = simulate_exits(ends, paths=4000, rng=5, steps=50)
    assert found.step.lower < 0.0 < found.step.upper
    assert found.step.halved_lower < found.probability < found.step.halved_lower + 0.02


def test_splitting_tells_what_the_step_adds_too():
    found = simulate_rare_exits(cb.load("ou", radius=1.6), paths=4000, rng=6, steps=50)
    assert found.step.lower < 0.0 < found.step.upper
    assert found.refuted == min(found.lower, found.step.halved_lower)
    assert simulate_rare_exits(cb.load("ou", radius=1.6), paths=4000, rng=6, steps=50, halve=False).step is None


def test_paths_of_a_block_have_streams_of_their_own():
    stream, opened = seed_stream(3, 0), njit(lambda stream, path: stream_of(stream, path))
    words = {tuple(int(word) for word in opened(stream, path)) for path in range(1000)}
    assert len(words) == 1000
    assert len({word for four in words for word in four[:3]}) == 3000
    assert np.array_equal(stream, seed_stream(3, 0))
