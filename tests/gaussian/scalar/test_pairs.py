"""Pairs, chains, unions and martingale windows: never below the truth, and close to it."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.stats import norm

from certbound.gaussian.scalar.normal import log_tail
from certbound.gaussian.scalar.ornstein_uhlenbeck import log_line_crossing
from certbound.gaussian.scalar.pairs import exceedance_chain, log_pair, log_window, total_symmetric, union

LN10 = np.log(10.0)


def binomial_excess(bound, hits, count):
    """How many standard errors the observed frequency lies above the bound."""
    return (hits / count - bound) / np.sqrt(max(bound, 1 / count) / count)


def random_walk_moments(steps):
    variance = np.cumsum(steps**2)
    return variance, variance[:-1]  # cov(W_t, W_{t+1}) = Var W_t


def test_one_step_is_a_normal_tail_and_no_step_ahead_changes_that():
    assert exceedance_chain([2.0], [4.0], np.empty(0)) == pytest.approx(float(log_tail(1.0)) / LN10, rel=1e-12)


def test_the_chain_bounds_simulated_walks_and_autoregressions_closely():
    rng = np.random.default_rng(1)
    for gain, level, length in ((1.0, 8.0, 20), (0.8, 3.2, 40), (-0.5, 2.5, 30), (0.3, 1.8, 5)):
        x, hit, variance = np.zeros(80_000), np.zeros(80_000, dtype=bool), [0.0]
        for _ in range(length):
            x = gain * x + rng.standard_normal(len(x))
            hit |= x > level
            variance.append(gain**2 * variance[-1] + 1)
        v = np.array(variance[1:])
        bound = 10 ** exceedance_chain(np.full(length, level), v, gain * v[:-1])
        assert binomial_excess(bound, hit.sum(), len(x)) < 4
        assert bound < 1.6 * hit.mean()
        assert bound <= 10 ** union(np.full(length, level), v, gaussian=True) * (1 + 1e-9)


def test_two_steps_are_exact():
    rho, a, b = 0.7, 1.3, 1.9
    tail = quad(lambda x: norm.pdf(x) * norm.sf((b - rho * x) / np.sqrt(1 - rho**2)), -12, a, epsabs=1e-14)[0]
    exact = np.log10(norm.sf(a) + tail)
    assert exact <= exceedance_chain([a, 2 * b], [1.0, 4.0], [2 * rho]) <= exact + 1e-6


def test_a_deterministic_start_is_ignored_or_decides():
    walk = exceedance_chain([3.0, 3.0], [0.0, 1.0], [0.0])
    assert walk == pytest.approx(float(log_tail(3.0)) / LN10)
    assert exceedance_chain([-1.0, 3.0], [0.0, 1.0], [0.0]) == 0.0
    assert exceedance_chain([1.0], [0.0], np.empty(0)) == -np.inf
    assert exceedance_chain([np.inf, 2.0], [1.0, 1.0], [0.5]) == pytest.approx(float(log_tail(2.0)) / LN10)


def test_wider_enclosures_never_lower_the_chain():
    v, c = random_walk_moments(np.ones(12))
    z = np.linspace(6, 8, 12)
    point = exceedance_chain(z, v, c)
    for width in (1e-12, 1e-6, 1e-3):
        wide = exceedance_chain(z, (v * (1 - width), v * (1 + width)), (c * (1 - width), c * (1 + width)))
        assert wide >= point
        point = wide


def test_directions_in_a_batch_give_what_each_gives_alone():
    rng = np.random.default_rng(2)
    v, c = random_walk_moments(np.ones(15))
    z = rng.uniform(5, 12, (4, 15)) * np.array([[1], [1], [30], [1000]])
    together = exceedance_chain(z, v, c)
    alone = [exceedance_chain(row, v, c) for row in z]
    assert together.shape == (4,)
    assert np.allclose(together, alone, rtol=1e-12)
    assert together[-1] < -1e5


@given(st.lists(st.floats(0.5, 6), min_size=2, max_size=8), st.floats(-0.99, 0.99), st.floats(0, 0.5))
@settings(max_examples=25, deadline=None, derandomize=True)
def test_higher_levels_never_raise_the_union_and_the_chain_stays_below_it(levels, rho, step):
    z = np.array(levels)
    v, c = np.ones(len(z)), np.full(len(z) - 1, rho)
    chain = exceedance_chain(z, v, c)
    assert chain <= union(z, v, gaussian=True) + 1e-9
    assert union(z + step, v) <= union(z, v) + 1e-12
    assert chain >= float(np.max(log_tail(z))) / LN10 - 1e-9


def test_the_sub_gaussian_union_holds_for_sums_of_random_signs():
    length, level = 12, 5.0
    walks = np.cumsum(np.array(list(itertools.product([-1.0, 1.0], repeat=length))), axis=1)
    truth = np.mean(np.any(walks > level, axis=1))
    assert 10 ** union(np.full(length, level), np.arange(1.0, length + 1)) >= truth
    assert union([-1.0], [1.0]) == 0.0
    assert union([1.0], [0.0]) == -np.inf


def test_pair_bounds_cover_every_matrix_in_the_enclosure():
    rng = np.random.default_rng(3)
    for below, above, least in itertools.product((1.0, -0.5, 2.0), (2.0, -1.0), (-0.2, 0.3)):
        v, w, c = (0.8, 1.3), (1.5, 2.0), (least, 0.6)
        wide = log_pair(below, v, above, w, c)
        inner = [
            log_pair(below, rng.uniform(*v), above, rng.uniform(*w), rng.uniform(*c)) for _ in range(15)
        ]
        assert np.all(np.array(inner) <= wide + 1e-12)


def test_a_window_from_rest_is_the_reflection_principle():
    assert log_window(3.0, 0.0, 1.0) == pytest.approx(np.log(2) + float(log_tail(3.0)), abs=1e-12)


def test_windows_agree_with_lines_of_constant_brownian_height():
    for v0, gain, z in ((1.0, 0.1, 2.0), (0.5, 3.0, 1.5), (2.0, 1e-3, 6.0)):
        span = 0.5 * np.log1p(gain / v0)
        line = log_line_crossing(z / np.sqrt(v0), z / np.sqrt(v0 + gain), span)
        assert log_window(z, v0, gain) == pytest.approx(float(line), abs=1e-6)


def test_a_window_bounds_simulated_martingales():
    rng = np.random.default_rng(4)
    start = rng.standard_normal(100_000)
    end = start + 0.6 * rng.standard_normal(len(start))
    peak = 0.5 * (start + end + np.sqrt((end - start) ** 2 - 2 * 0.36 * np.log(rng.random(len(start)))))
    hits = np.sum((start <= 2.0) & (peak > 2.0))
    bound = float(np.exp(log_window(2.0, (0.999, 1.0), (0.36, 0.361))))
    assert binomial_excess(bound, hits, len(start)) < 4
    assert bound < 1.05 * hits / len(start)


def test_symmetric_events_multiply_and_never_exceed_their_sum():
    rng = np.random.default_rng(8)
    mixed = rng.standard_normal((100_000, 3)) @ np.array([[1, 0.5, -0.3], [0, 1, 0.8], [0, 0, 1.0]])
    levels = np.array([1.0, 1.5, 2.5])
    logs = np.log(2) + log_tail(levels / mixed.std(axis=0))
    bound = 10 ** total_symmetric(logs)
    assert binomial_excess(bound, np.sum(np.any(np.abs(mixed) > levels, axis=1)), len(mixed)) < 4
    assert bound < np.exp(logs).sum()
    assert total_symmetric([0.0, -3.0]) == 0.0
    assert total_symmetric([-2e6, -2e6]) == pytest.approx((np.log(2) - 2e6) / LN10)
    assert total_symmetric([-np.inf]) == -np.inf


def test_malformed_events_are_refused_by_name():
    with pytest.raises(ValueError, match="`levels` and `variances` must have T entries"):
        exceedance_chain([1.0, 2.0], [1.0, 1.0], [0.5, 0.5])
    with pytest.raises(ValueError, match="`variances` must be at least 0"):
        exceedance_chain([1.0], [-1.0], np.empty(0))
    with pytest.raises(ValueError, match="`variances` must satisfy lo <= hi"):
        union([1.0], ([2.0], [1.0]))
    with pytest.raises(ValueError, match="pair"):
        union([1.0], ([2.0], [1.0], [3.0]))
    with pytest.raises(ValueError, match="`levels` must not contain NaN"):
        union([np.nan], [1.0])
