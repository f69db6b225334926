"""The averaged moment generating function: its four properties (Lemma 2 of the paper) by quadrature."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import gamma

from certbound.tubes.paper.energy import log_energy


def sphere_mean(n, product):
    """E exp(product * l_1) for l uniform on the unit sphere of R^n, by quadrature over l_1."""
    if n == 1:
        return math.cosh(product)
    density = gamma(n / 2) / (math.sqrt(math.pi) * gamma((n - 1) / 2))
    value, _ = quad(lambda t: math.exp(product * math.cos(t)) * math.sin(t) ** (n - 2), 0, math.pi, epsabs=1e-13)
    return density * value


@pytest.mark.parametrize("n", [1, 2, 3, 7])
def test_it_is_the_average_over_the_sphere(n):
    x = np.zeros(n)
    x[-1] = 1.7
    for rate in (1e-3, 0.8, 3.0):
        assert math.exp(log_energy(x, rate)) == pytest.approx(sphere_mean(n, 1.7 * rate), rel=1e-9)


def test_it_depends_on_the_length_alone_and_rises_with_it():
    rng = np.random.default_rng(0)
    directions = rng.standard_normal((30, 4))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    np.testing.assert_allclose(log_energy(2.5 * directions, 1.3), log_energy([2.5, 0, 0, 0], 1.3), rtol=1e-12)
    assert np.all(np.diff(log_energy(np.linspace(0, 9, 40)[:, None] * directions[0], 1.3)) > 0)


@pytest.mark.parametrize("n", [1, 2, 5])
@pytest.mark.parametrize("epsilon", [0.1, 0.7, 15 / 16])
def test_it_grows_at_least_like_an_exponential(n, epsilon):
    x = np.zeros((60, n))
    x[:, 0] = np.linspace(0, 40, 60)
    gap = log_energy(x, 1.1) - n / 2 * math.log1p(-(epsilon**2)) - epsilon * 1.1 * x[:, 0]
    assert np.all(gap > 0)
    assert np.min(gap) < 3.0  # not a bound for the sake of one


@pytest.mark.parametrize("n", [1, 2])
def test_gaussian_noise_multiplies_it_by_the_factor_itself(n):
    nodes, weights = np.polynomial.hermite_e.hermegauss(60)
    rate, sigma = 0.9, 0.8
    x = np.array([1.2, -0.4])[:n]
    mean = sum(
        math.prod(weights[list(index)]) * math.exp(log_energy(x + sigma * nodes[list(index)], rate))
        for index in itertools.product(range(60), repeat=n)
    ) / math.sqrt(2 * math.pi) ** n
    assert mean == pytest.approx(math.exp(rate**2 * sigma**2 / 2 + log_energy(x, rate)), rel=1e-9)


@pytest.mark.parametrize("rate", [0.3, 1.5, 4.0])
def test_rademacher_noise_multiplies_it_by_less(rate):
    for x in itertools.product((-1.0, 0.0, 0.7), repeat=3):
        corners = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
        mean = float(np.mean(np.exp(log_energy(np.array(x) + corners, rate))))
        assert mean <= math.exp(rate**2 / 2 + log_energy(x, rate))


def test_it_does_not_overflow():
    assert log_energy([1e6, 0.0], 1e3) == pytest.approx(1e9, rel=1e-6)
    assert log_energy([0.0, 0.0], 5.0) == 0.0


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: log_energy(2.0, 1.0), "`x` must be finite, of shape"),
        (lambda: log_energy([math.nan], 1.0), "`x` must be finite"),
        (lambda: log_energy([1.0], math.inf), "`rate` finite"),
    ],
)
def test_arguments_out_of_range_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
