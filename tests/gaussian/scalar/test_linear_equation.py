"""Scalar linear equations: radii against exact ones and simulation."""

import numpy as np
import pytest
from scipy.stats import norm

from certbound.gaussian.scalar.linear_equation import linear_exceedance, linear_radius
from certbound.gaussian.scalar.normal import log_tail

LN10 = np.log(10.0)


def binomial_excess(bound, hits, count):
    """How many standard errors the observed frequency lies above the bound."""
    return (hits / count - bound) / np.sqrt(max(bound, 1 / count) / count)


@pytest.mark.parametrize(
    ("horizon", "rate", "delta", "exact"),
    [(5.0, -0.5, 1e-3, 1.2858), (2.0, -1.0, 1e-3, 0.8841), (5.0, -1.0, 1e-6, 1.2852)],
)
def test_the_radius_of_an_ornstein_uhlenbeck_process_is_within_half_a_percent(horizon, rate, delta, exact):
    radius = linear_radius(horizon, rate, np.sqrt(0.1), delta)
    assert exact * (1 - 1e-4) <= radius <= 1.005 * exact
    cut = linear_radius(np.full(50, horizon / 50), np.full(50, rate), np.sqrt(0.1), delta)
    assert cut == pytest.approx(radius, rel=1e-3)


def test_brownian_motion_gives_the_reflection_principle():
    assert linear_exceedance(4.0, 0.0, 0.5, 3.0) == pytest.approx(np.log10(2 * norm.sf(3.0)), abs=1e-4)
    assert linear_radius(1.0, 0.0, 1.0, 1e-3, two_sided=False) == pytest.approx(norm.isf(5e-4), rel=3e-4)


def test_pieces_without_noise_move_the_level():
    # grows by e after the noise: exceeds 3 e when the noise exceeds 3
    grown = linear_exceedance([1.0, 1.0], [0.0, 1.0], [1.0, 0.0], 3 * np.e)
    assert grown == pytest.approx(float(log_tail(3.0)) / LN10, abs=1e-3)
    decayed = linear_exceedance([1.0, 1.0, 1.0], [1.0, 0.0, -2.0], [0.0, 1.0, 0.0], 3.0)
    assert decayed == pytest.approx(np.log10(2 * norm.sf(3.0)), abs=1e-3)
    assert linear_exceedance(1.0, 1.0, 0.0, 1.0) == -np.inf


def test_a_level_that_dips_while_the_noise_rests_is_charged_at_its_lowest():
    # the noise of the first second is multiplied by e and back before more noise comes
    dip = linear_exceedance([1.0] * 4, [0.0, 1.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.01], 3 * np.e)
    assert float(log_tail(3.0)) / LN10 <= dip <= float(log_tail(3.0)) / LN10 + 0.02


def test_random_scalar_equations_are_never_exceeded_more_often_than_bounded():
    rng = np.random.default_rng(7)
    ratios = []
    for _ in range(4):
        count = int(rng.integers(1, 5))
        h, c, sigma = rng.uniform(0.2, 1.2, count), rng.uniform(-3, 1.5, count), rng.uniform(0.1, 1, count)
        level = linear_radius(h, c, sigma, 0.05, two_sided=False, tolerance=1e-2)
        x, hit = np.zeros(15_000), np.zeros(15_000, dtype=bool)
        for rate, noise, step in zip(np.repeat(c, 40), np.repeat(sigma, 40), np.repeat(h / 40, 40)):
            new = np.exp(rate * step) * x
            new += noise * np.sqrt(np.expm1(2 * rate * step) / (2 * rate)) * rng.standard_normal(len(x))
            gap = np.maximum(level - x, 0) * np.maximum(level - new, 0)
            hit |= (new > level) | (rng.random(len(x)) < np.exp(-2 * gap / (noise**2 * step)))
            x = new
        bound = 10 ** linear_exceedance(h, c, sigma, level)
        assert binomial_excess(bound, hit.sum(), len(x)) < 4
        ratios.append(bound / hit.mean())
    assert np.median(ratios) < 1.15


def test_malformed_equations_are_refused_by_name():
    with pytest.raises(ValueError, match="`delta` must lie"):
        linear_radius(1.0, 0.0, 1.0, 1.5)
    with pytest.raises(ValueError, match="`sigmas` must not all be 0"):
        linear_radius(1.0, 0.0, 0.0, 0.1)
    with pytest.raises(ValueError, match="`sigmas` must be finite"):
        linear_exceedance(1.0, 0.0, -1.0, 1.0)
    with pytest.raises(ValueError, match="`durations` must be positive"):
        linear_exceedance(0.0, 0.0, 1.0, 1.0)
    with pytest.raises(ValueError, match="`level` must be positive"):
        linear_exceedance(1.0, 0.0, 1.0, 0.0)
    with pytest.raises(ValueError, match="shorten the horizon"):
        linear_exceedance(1e6, -1.0, 1.0, 1.0)
