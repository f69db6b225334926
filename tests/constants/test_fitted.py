"""Constants along a tube in a fitted metric: never worse than the Euclidean ones, and as certified."""

from __future__ import annotations

import numpy as np
import pytest

import certbound as cb
from certbound.constants.bounds import constants_along
from certbound.constants.fitted import fitted_constants_along, noise_spread
from certbound.rigor.intervals import Interval

TIMES = np.linspace(0.0, 10.0, 11)


def oscillator() -> cb.ContinuousSystem:
    return cb.ContinuousSystem(lambda x: [x[1], -4 * np.sin(x[0]) - x[1]], states=2, diffusion=0.1 * np.eye(2))


def test_an_oscillator_gets_a_metric_in_which_it_contracts():
    boxes = Interval(np.full((10, 2), -0.3), np.full((10, 2), 0.3))
    plain, fitted = (f(oscillator(), TIMES, boxes) for f in (constants_along, fitted_constants_along))
    assert plain.rate.min() > 0 > fitted.rate.max()
    assert noise_spread(fitted) < noise_spread(plain) - 5
    assert fitted.certified
    assert "10 time pieces up to 10" in fitted.proof.domain
    assert np.linalg.eigvalsh(fitted.metric)[0] >= 1 - 1e-9  # so that ||x||_2 <= ||x||_P
    rng = np.random.default_rng(0)
    for x in rng.uniform(-0.3, 0.3, (200, 2)):
        jacobian = np.array([[0.0, 1.0], [-4 * np.cos(x[0]), -1.0]])
        form = jacobian.T @ fitted.metric + fitted.metric @ jacobian - 2 * fitted.rate[0] * fitted.metric
        assert np.linalg.eigvalsh(form)[-1] <= 1e-9


def test_the_identity_stays_where_nothing_is_gained():
    system = cb.ContinuousSystem(lambda x: [-x[0], -x[1] + 0.1 * np.sin(x[0])], states=2, diffusion=0.1 * np.eye(2))
    boxes = Interval(-np.ones((2, 2)), np.ones((2, 2)))
    fitted = fitted_constants_along(system, [0.0, 1.0, 2.0], boxes)
    assert noise_spread(fitted) <= noise_spread(constants_along(system, [0.0, 1.0, 2.0], boxes, refine=16))


def test_one_state_needs_no_metric():
    system = cb.DiscreteSystem(lambda x: [0.5 * np.sin(x[0])], states=1, noise=cb.Gaussian(std=0.1))
    fitted = fitted_constants_along(system, [0, 1, 2], Interval([[-1.0], [-1.0]], [[1.0], [1.0]]))
    assert fitted.metric is None
    assert noise_spread(fitted) == pytest.approx(np.log(0.01 * 1.25), abs=1e-3)


@pytest.mark.parametrize(("rate", "truth"), [(-0.5, 1 - np.exp(-2.0)), (0.0, 2.0), (1e-18, 2.0), (400.0, np.inf)])
def test_the_spread_solves_its_equation(rate, truth):
    constants = cb.Constants(rate=[rate, rate], sigma=1.0, dimension=1, times=[0.0, 0.5, 2.0])
    if np.isfinite(truth):
        assert noise_spread(constants) == pytest.approx(np.log(truth), rel=1e-9)
    else:
        assert noise_spread(constants) == pytest.approx(1600 - np.log(800), rel=1e-6)


def test_the_spread_needs_time_pieces():
    with pytest.raises(ValueError, match="time pieces"):
        noise_spread(cb.Constants(rate=1.0, sigma=1.0, dimension=1))
