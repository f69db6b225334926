"""Rice's formula with enclosures."""

import numpy as np
import pytest
from scipy.stats import norm

from certbound.gaussian.scalar.normal import log_tail
from certbound.gaussian.scalar.rice import crossing_rate

LN10 = np.log(10.0)


def binomial_excess(bound, hits, count):
    """How many standard errors the observed frequency lies above the bound."""
    return (hits / count - bound) / np.sqrt(max(bound, 1 / count) / count)


def test_rice_is_exact_for_a_random_sinusoid():
    # A cos t + B sin t passes a level upward at most once in less than a period
    for level, horizon in ((1.0, 2.0), (3.0, 5.0), (5.0, 1.0)):
        exact = np.log10(norm.sf(level) + horizon / (2 * np.pi) * np.exp(-(level**2) / 2))
        pieces = np.full(10, horizon / 10)
        got = crossing_rate(pieces, np.full(10, level), np.ones(10), np.zeros(10), np.ones(10))
        assert exact <= got <= exact + 1e-10


def test_rice_bounds_integrated_brownian_motion_from_rest():
    rng = np.random.default_rng(6)
    step, count, level = 0.005, 200, 1.2
    w, x = np.zeros((2, 30_000))
    hit = np.zeros(len(x), dtype=bool)
    for _ in range(count):
        a, b = rng.standard_normal((2, len(x)))
        x = x + step * w + step**1.5 * (a / 2 + b / np.sqrt(12))
        w = w + np.sqrt(step) * a
        hit |= x > level
    edges = np.linspace(0, 1, 101)
    ends = edges[:-1], edges[1:]
    moments = [(ends[0] ** p / d, ends[1] ** p / d) for p, d in ((3, 3), (2, 2), (1, 1))]
    bound = crossing_rate(np.diff(edges), np.full(100, level), *moments, start_variance=0.0)
    assert binomial_excess(10**bound, hit.sum(), len(x)) < 4
    assert 10**bound < 1.15 * hit.mean()


def test_rice_handles_lines_and_jumps_of_the_level():
    one, none, pieces = np.ones(20), np.zeros(20), np.full(20, 0.1)
    flat = crossing_rate(pieces, np.full(20, 3.0), one, none, one)
    t = np.linspace(0, 2, 21)
    falling = np.stack([3.5 - 0.25 * t[:-1], 3.5 - 0.25 * t[1:]], axis=-1)
    stairs = falling.min(axis=1)
    line, steps = (crossing_rate(pieces, z, one, none, one) for z in (falling, stairs))
    assert line < steps < flat
    # a level that jumps down at once costs what it sweeps
    drop = crossing_rate([1e-9, 1e-9], [9.0, 2.0], np.ones(2), np.zeros(2), np.ones(2))
    assert drop == pytest.approx(float(log_tail(2.0)) / LN10, abs=1e-6)
    rise = crossing_rate([1e-9, 1e-9], [2.0, 9.0], np.ones(2), np.zeros(2), np.ones(2))
    assert rise == pytest.approx(float(log_tail(2.0)) / LN10, abs=1e-6)


def test_rice_takes_batches_and_enclosures():
    levels = np.array([[3.0] * 4, [6.0] * 4, [2000.0] * 4])
    point = crossing_rate(np.ones(4), levels, np.ones(4), np.zeros(4), np.ones(4))
    variance, covariance = (np.full(4, 0.99), np.full(4, 1.01)), (np.full(4, -0.01), np.full(4, 0.01))
    wide = crossing_rate(np.ones(4), levels, variance, covariance, np.ones(4))
    assert point.shape == (3,)
    assert np.all(wide > point)
    assert point[2] < -8e5


def test_levels_that_run_away_keep_a_tiny_probability():
    rising = [[10.0, 60.0], [60.0, 110.0]]
    got = crossing_rate([1.0, 1.0], rising, ([1.0, 1.0], [1.0, 1.0]), np.zeros(2), np.full(2, 1e-4), start_variance=0.0)
    # E(eta - 50)^+ = .01 phi(5000) / 5000^2 against the density of the level 10
    exact = (np.log(0.01) - 0.5 * 5000.0**2 - 2 * np.log(5000.0) - 50 - np.log(2 * np.pi)) / np.log(10)
    assert exact <= got <= exact + 1e-6


def test_malformed_pieces_are_refused_by_name():
    with pytest.raises(ValueError, match="`durations`"):
        crossing_rate([-1.0], [1.0], [1.0], [0.0], [1.0])
    with pytest.raises(ValueError, match="`levels` must be finite"):
        crossing_rate([1.0], [np.inf], [1.0], [0.0], [1.0])
    with pytest.raises(ValueError, match="`levels` must end in"):
        crossing_rate([1.0], [1.0, 2.0, 3.0], [1.0], [0.0], [1.0])
    with pytest.raises(ValueError, match="`covariance` must end"):
        crossing_rate([1.0, 1.0], [1.0, 1.0], np.ones(2), np.ones(3), np.ones(2))
