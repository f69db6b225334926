"""Noise of bounded entries never takes Z beyond its reach along a row, and does take it there."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

import certbound as cb
from certbound.arrays import Array
from certbound.gaussian.response import StepEvents, discrete_response, level_along
from certbound.gaussian.response.step_events import BoundedNoise, reach_along
from certbound.reach.linear import Linearisation

STEPS = 5
RNG = np.random.default_rng(3)
F = 0.8 * RNG.normal(size=(STEPS, 2, 2))
NOISE = BoundedNoise(matrix=RNG.normal(size=(2, 2)), halfwidth=np.array([0.1, 0.3]))
ROWS = RNG.normal(size=(STEPS + 1, 2))


def response(error: float = 0.0):
    drive = NOISE.matrix @ np.diag(NOISE.halfwidth)
    return discrete_response(F[None], drive @ drive.T, 0.0, np.zeros((2, 2)), slope_error=error)


def worst() -> Array:
    """Largest rows[t] . Z_t over all signs of all entries."""
    found = np.zeros(STEPS + 1)
    for signs in itertools.product((-1.0, 1.0), repeat=2 * STEPS):
        z = np.zeros(2)
        for t, w in enumerate(np.reshape(signs, (STEPS, 2)) * NOISE.halfwidth):
            z = F[t] @ z + NOISE.matrix @ w
            found[t + 1] = max(found[t + 1], ROWS[t + 1] @ z)
    return found


def test_the_reach_is_what_the_worst_signs_do_but_for_rounding() -> None:
    reach, exact = reach_along(response(), ROWS, NOISE), worst()
    assert np.all(reach >= exact - 1e-15)
    np.testing.assert_allclose(reach, exact, rtol=1e-12, atol=1e-290)


def test_slopes_that_are_no_floats_widen_it() -> None:
    plain, wide = (reach_along(response(error), ROWS, NOISE) for error in (0.0, 1e-6))
    assert np.all(wide[2:] > plain[2:])
    shaken = np.abs(RNG.uniform(-1e-6, 1e-6, size=F.shape))
    other = discrete_response((F + shaken)[None], np.eye(2), 0.0, np.zeros((2, 2)))
    assert np.all(reach_along(other, ROWS, NOISE) <= wide * (1 + 1e-12))


def test_a_level_at_the_reach_is_never_exceeded_and_one_below_may_be() -> None:
    event = StepEvents(response(), 0, False, (NOISE.matrix, NOISE.halfwidth)).along(ROWS)
    assert event.log_exceedance(event.reach) == -np.inf
    below = event.reach.copy()
    below[3] *= 0.999
    plain = StepEvents(response(), 0, False).along(ROWS)
    only = np.where(np.arange(STEPS + 1) == 3, below, np.inf)
    assert event.log_exceedance(below) == pytest.approx(plain.log_exceedance(only))
    assert np.all(level_along(event, -50.0) <= event.reach)
    assert event.log_exceedance(level_along(event, -50.0)) <= -50.0
    assert np.any(level_along(plain, -50.0) > event.reach)


def test_numbers_beyond_floats_prove_nothing() -> None:
    large = BoundedNoise(matrix=1e9 * np.ones((2, 2)), halfwidth=np.ones(2))
    reach = reach_along(response(), np.where(ROWS > 0, 1e308, -1e308), large)
    assert np.all(np.isinf(reach[1:]))


@pytest.mark.parametrize(("law", "bounded"), [
    (cb.Bounded(halfwidth=0.1), True), (cb.Bounded(halfwidth=0.1, independent=False), True),
    (cb.Uniform(halfwidth=0.1), True), (cb.Rademacher(scale=0.1), True), (cb.SubGaussian(proxy_std=0.1), False),
    (cb.Gaussian(std=0.1), False),
])  # fmt: skip
def test_only_laws_with_bounds_have_a_reach(law: object, bounded: bool) -> None:
    system = cb.DiscreteSystem(lambda x: [0.9 * x[0]], states=1, noise=law)
    safe = [cb.Inside(cb.Box([-1.1], [1.1]))]
    problem = cb.Problem(system, initial=[0], safe=safe, horizon=200, delta=1e-3)
    events = Linearisation.of(problem).step_events(0)
    assert (events.bounded is not None) == bounded
    verdict = cb.verify_safety(problem, method="linear")
    assert (verdict.log10_delta < -1e11) == bounded  # |x| <= .1/(1 - .9) = 1 on every path
    started = problem.replace(initial=cb.GaussianStart([0], [[0.01]]))
    assert Linearisation.of(started).step_events(0).bounded is None


def test_many_steps_are_not_looked_at() -> None:
    assert NOISE.affordable(100)
    assert not NOISE.affordable(2000)
