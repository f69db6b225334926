"""Confidence limits and order statistics."""

import numpy as np
import pytest
from scipy.stats import beta, binom

from certbound.simulation.estimates.statistics import bound_binomial, check_confidence, order_ranks


def test_limits_are_those_of_clopper_and_pearson():
    successes = np.array([0, 1, 7, 999, 1000])
    lower, upper = bound_binomial(successes, 1000, 0.95)
    np.testing.assert_allclose(lower[1:], beta.ppf(0.025, successes[1:], 1001 - successes[1:]), rtol=1e-10)
    np.testing.assert_allclose(upper[:-1], beta.ppf(0.975, successes[:-1] + 1, 1000 - successes[:-1]), rtol=1e-10)
    assert (lower[0], upper[-1]) == (0.0, 1.0)
    np.testing.assert_allclose(upper[0], 1 - 0.025 ** (1 / 1000))


@pytest.mark.parametrize("truth", [0.001, 0.02, 0.5])
def test_limits_miss_the_truth_no_more_often_than_promised(truth):
    counts = np.arange(501)
    weights = binom.pmf(counts, 500, truth)
    lower, upper = bound_binomial(counts, 500, 0.9)
    assert weights[truth < lower].sum() <= 0.05
    assert weights[truth > upper].sum() <= 0.05


@pytest.mark.parametrize("level", [0.5, 0.999, 0.99999])
@pytest.mark.parametrize("trials", [100, 10_000, 3_000_000])
def test_order_statistics_bracket_a_quantile_as_often_as_promised(level, trials):
    lower, upper = order_ranks(level, trials, 0.99)
    # the quantile lies below the order statistic of rank r (from 0) when at most r values lie below the quantile
    assert binom.cdf(lower, trials, level) <= 0.005
    assert upper == trials or binom.sf(upper, trials, level) <= 0.005
    assert lower < trials * level < upper + 1


@pytest.mark.parametrize("confidence", [0.0, 1.0, -1.0, float("nan")])
def test_a_confidence_outside_the_unit_interval_is_refused(confidence):
    with pytest.raises(ValueError, match=r"`confidence` must lie in \(0, 1\)"):
        check_confidence(confidence)


def test_more_successes_than_trials_are_refused():
    with pytest.raises(ValueError, match="`successes` must lie between 0 and `trials` = 3"):
        bound_binomial(4, 3)
