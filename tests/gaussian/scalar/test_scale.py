"""Least scales and splits of a probability."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm

from certbound.errors import InfeasibleError
from certbound.gaussian.scalar.normal import log_tail
from certbound.gaussian.scalar.pairs import double, exceedance_chain, total, union
from certbound.gaussian.scalar.scale import least_scale, split_levels

LN10 = np.log(10.0)


@given(st.floats(-40, -0.5), st.floats(0.01, 100), st.floats(0.1, 10))
@settings(max_examples=50, deadline=None, derandomize=True)
def test_the_least_scale_meets_the_target_and_no_smaller_one_does(target, start, spread):
    def bound(q):
        return union([q, 2 * q], [spread**2, spread**2], gaussian=True)

    q = least_scale(bound, target, start=start)
    assert bound(q) <= target
    assert bound(q * (1 - 1.5e-4)) > target


def test_the_least_scale_needs_few_evaluations():
    calls = []

    def bound(q):
        calls.append(q)
        return double(exceedance_chain(np.full(5, q), np.ones(5), np.full(4, 0.5)))

    least_scale(bound, -6.0, start=3.0)
    assert len(calls) <= 9


def test_splitting_a_probability_beats_equal_shares():
    bounds = [lambda q: float(log_tail(q)) / LN10, lambda q: float(log_tail(q)) / LN10]
    scales, shares = split_levels(bounds, -3.0, weights=[10.0, 1.0])
    equal = least_scale(bounds[0], -3.0 - np.log10(2))
    assert np.sum(10.0**shares) <= 1e-3
    assert all(bound(q) <= share for bound, q, share in zip(bounds, scales.tolist(), shares.tolist()))
    assert 10 * scales[0] + scales[1] < 11 * equal * (1 - 1e-3)
    grid = [10 * norm.isf(1e-3 * s) + norm.isf(1e-3 * (1 - s)) for s in np.linspace(0.5, 0.999, 500)]
    assert 10 * scales[0] + scales[1] <= min(grid) * (1 + 3e-4)


def test_sums_and_doubles_are_rounded_upward():
    assert total([np.log(0.5), np.log(0.5)]) == 0.0
    assert total([]) == -np.inf
    assert total([-np.inf, -np.inf]) == -np.inf
    assert total([np.log(1e-3)] * 7) >= np.log10(7e-3)
    assert total(np.full((2, 3), -2e6), axis=-1).shape == (2,)
    assert double(-3.0) == pytest.approx(np.log10(2e-3))
    assert double(-0.1) == 0.0


def test_malformed_targets_are_refused_by_name():
    with pytest.raises(ValueError, match="`log10_delta` must be negative"):
        least_scale(lambda q: -q, 0.0)
    with pytest.raises(ValueError, match="`start` and `tolerance`"):
        least_scale(lambda q: -q, -1.0, start=0.0)
    with pytest.raises(InfeasibleError, match="no scale up to"):
        least_scale(lambda q: 0.0, -1.0)
    with pytest.raises(ValueError, match="`bounds` must hold"):
        split_levels([], -1.0)
    with pytest.raises(ValueError, match="`log10_delta` must be negative"):
        split_levels([lambda q: -q], 0.5)
    with pytest.raises(ValueError, match="`weights` must be 1 positive"):
        split_levels([lambda q: -q], -1.0, weights=[-1.0])
