"""Pairs, sums and unions: never below the truth, and close to it."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from certbound.gaussian.scalar.normal import log_tail
from certbound.gaussian.scalar.pairs import log_pair, total, union

LN10 = np.log(10.0)


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


def test_sums_are_rounded_upward():
    assert total([np.log(0.5), np.log(0.5)]) == 0.0
    assert total([]) == -np.inf
    assert total([-np.inf, -np.inf]) == -np.inf
    assert total([np.log(1e-3)] * 7) >= np.log10(7e-3)
    assert total(np.full((2, 3), -2e6), axis=-1).shape == (2,)


@given(st.lists(st.floats(0.5, 6), min_size=2, max_size=8), st.floats(0, 0.5))
@settings(max_examples=25, deadline=None, derandomize=True)
def test_higher_levels_never_raise_the_union(levels, step):
    z, v = np.array(levels), np.ones(len(levels))
    assert union(z + step, v) <= union(z, v) + 1e-12
    assert union(z, v, gaussian=True) >= float(np.max(log_tail(z))) / LN10 - 1e-9


def test_malformed_events_are_refused_by_name():
    with pytest.raises(ValueError, match="`variances` must be at least 0"):
        union([1.0], [-1.0])
    with pytest.raises(ValueError, match="`variances` must satisfy lo <= hi"):
        union([1.0], ([2.0], [1.0]))
    with pytest.raises(ValueError, match="pair"):
        union([1.0], ([2.0], [1.0], [3.0]))
    with pytest.raises(ValueError, match="`levels` must not contain NaN"):
        union([np.nan], [1.0])
