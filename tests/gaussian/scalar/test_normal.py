"""Normal tails and bivariate probabilities against ball arithmetic."""

from itertools import pairwise

import flint
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from certbound.gaussian.scalar.normal import (
    MILLS_ERROR,
    gauss_rule,
    log_below_above,
    log_between,
    log_tail,
    mills,
    mills_deficit,
)

LEVEL = st.floats(-6, 12)


@pytest.fixture(autouse=True)
def precise():
    before, flint.ctx.prec = flint.ctx.prec, 1500
    yield
    flint.ctx.prec = before


def tail(x):
    return (flint.arb(float(x)) / flint.arb(2).sqrt()).erfc() / 2


@flint.ctx.workprec(120)
def log_pair_exact(a, b, rho, scale):
    """log P(X <= a, Y > b) by adaptive integration of phi(x) Q((b - rho x)/s), scaled by exp(-scale)."""
    a, b, rho = (flint.acb(float(v)) for v in (a, b, rho))
    s = (1 - rho * rho).sqrt()
    shift = flint.acb(float(scale))
    root = flint.acb(2).sqrt()
    weight = (2 * flint.acb.pi()).sqrt() * 2

    def density(x, analytic):
        return (-x * x / 2 - shift).exp() * ((b - rho * x) / (s * root)).erfc() / weight

    low = float(a.real) - 80 - abs(float(b.real))
    ends = sorted({low, *(float(a.real) - d for d in (40, 15, 6, 2, 0.6, 0.2, 0.05)), float(a.real)})
    value = sum(
        (flint.acb.integral(density, flint.acb(p), flint.acb(q)).real for p, q in pairwise(ends)),
        flint.arb(0),
    )
    return float(value.log() + flint.arb(float(scale)))


def test_mills_ratio_keeps_its_stated_relative_error():
    rng = np.random.default_rng(0)
    x = np.concatenate([rng.uniform(0, 20, 400), np.arange(0, 129) / 8, [15.999999999999998, 1e3, 1e8]])
    value = mills(x)
    assert [float(mills(point)) for point in x] == value.tolist()  # one number takes a way of its own
    assert np.array_equal(mills(np.tile(x, 8)), np.tile(value, 8))  # and so do many
    assert mills(np.array([[np.nan]])).tolist() == [[mills(np.zeros(1))[0]]]
    for point, got in zip(x.tolist(), value.tolist()):
        z = flint.arb(point)
        if point > 100:
            exact = 1 / z * (1 - 1 / z**2 + 3 / z**4 - 15 / z**6)
        else:
            exact = (flint.arb.pi() / 2).sqrt() * (z * z / 2).exp() * (z / flint.arb(2).sqrt()).erfc()
        assert abs(float((flint.arb(got) - exact) / exact)) < MILLS_ERROR


def test_mills_deficit_lies_above_the_exact_value():
    x = np.array([0.0, 0.3, 1.0, 4.0, 9.0, 15.9, 16.0, 40.0])
    for point, got in zip(x.tolist(), mills_deficit(x).tolist()):
        z = flint.arb(point)
        exact = 1 - z * (flint.arb.pi() / 2).sqrt() * (z * z / 2).exp() * (z / flint.arb(2).sqrt()).erfc()
        assert got >= float(exact)
        assert got <= float(exact) * 1.02 + 1e-12


def test_gauss_rule_integrates_polynomials_of_twice_its_degree():
    nodes, weights = gauss_rule(16)
    for power in range(0, 31, 2):
        assert weights @ nodes**power == pytest.approx(2 / (power + 1), rel=1e-13)


def test_log_tail_is_an_upper_bound_close_to_the_exact_tail_at_any_depth():
    x = np.array([-38.0, -12.5, -3.0, -1e-9, 0.0, 1e-12, 0.7, 3.0, 8.0, 15.99, 16.0, 37.5, 100.0, 2146.0])
    for point, got in zip(x.tolist(), log_tail(x).tolist()):
        exact = tail(point).log()
        assert flint.arb(got) >= exact
        assert got - float(exact) <= 1e-13 * (1 + abs(float(exact)))


def test_log_tail_of_far_levels_stays_finite_and_of_infinite_ones_is_exact():
    assert log_tail(1e150) == pytest.approx(-5e299)
    assert log_tail(1e200) == log_tail(1e150)
    assert log_tail(np.inf) == -np.inf
    assert log_tail(-np.inf) == 0.0
    assert log_tail(np.nan) == 0.0


@pytest.mark.parametrize(
    ("low", "high"),
    [(0.5, 0.5 + 1e-9), (3.0, 3.0 + 1e-13), (-2.0, -1.9), (-1.0, 2.0), (-1e-9, 1e-9), (5.0, 40.0), (30.0, 30.01),
     (-41.0, -40.0), (-50.0, 50.0), (20.0, np.inf), (-np.inf, 1.0), (-np.inf, -25.0)],
)  # fmt: skip
def test_log_between_bounds_the_probability_of_a_strip(low, high):
    upper = flint.arb(0) if high == np.inf else tail(high)
    lower = flint.arb(1) if low == -np.inf else tail(low)
    exact = (lower - upper).log()
    got = float(log_between(low, high))
    assert flint.arb(got) >= exact
    assert got - float(exact) < 1e-6


def test_an_empty_strip_has_probability_zero():
    assert log_between([1.0, 2.0, np.inf, -np.inf], [1.0, 1.0, np.inf, -np.inf]).tolist() == [-np.inf] * 4


LEVELS = [(0.03, -0.02), (3.0, 3.0), (3.0, 3.2), (4.0, 3.9), (-1.0, 0.5), (0.0, 6.0), (8.0, 7.5), (20.0, 20.1)]
CORRELATIONS = (-0.999999, -0.999, -0.5, -1e-6, 0.0, 1e-4, 0.6, 0.95, 0.9999, 1 - 1e-8)
CASES = [(a, b, rho) for a, b in [*LEVELS, (30.0, 29.0)] for rho in CORRELATIONS]


@pytest.mark.parametrize(("a", "b", "rho"), CASES)
def test_pair_probabilities_are_bounded_from_above_within_a_thousandth(a, b, rho):
    got = float(log_below_above(a, b, rho))
    exact = log_pair_exact(a, b, rho, got)
    excess = 1e-3 if rho < -0.9999 else 1e-5
    assert -1e-14 * (1 + abs(got)) < got - exact < excess * (1 + 1e-6 * abs(got))


def test_closed_forms_are_met_at_the_special_correlations():
    levels = np.array([-2.0, 0.5, 3.0, 7.0])
    a, b = np.meshgrid(levels, levels + 0.25)
    independent = log_tail(-a) + log_tail(b)
    assert np.allclose(log_below_above(a, b, 0.0), independent, rtol=0, atol=1e-6)
    strip = np.minimum(log_between(b, a), np.minimum(log_tail(b), log_tail(-a)))
    assert np.allclose(log_below_above(a, b, 1.0), strip, rtol=1e-13, atol=0)
    opposite = log_tail(-np.minimum(a, -b))
    assert np.allclose(log_below_above(a, b, -1.0), opposite, rtol=1e-9, atol=1e-6)
    rho = np.array([-0.9, -0.2, 0.3, 0.99])
    assert np.allclose(log_below_above(0.0, 0.0, rho), np.log(np.arccos(rho) / (2 * np.pi)), atol=1e-6)


def test_probabilities_of_ten_to_the_minus_million_do_not_underflow():
    level = 2146.0
    got = log_below_above(level, level, np.array([0.5, 1 - 1e-8, 1 - 1e-12]))
    assert np.all(got <= log_tail(level))
    assert np.all(got > log_tail(level) - 10)
    assert np.all(np.diff(got) < 0)
    assert got[0] / np.log(10) == pytest.approx(-1.0000e6, rel=1e-3)


def test_infinite_levels_leave_the_marginal_tail():
    assert log_below_above(np.inf, 3.0, 0.5) == log_tail(3.0)
    assert log_below_above(3.0, -np.inf, 0.5) == log_tail(-3.0)
    assert log_below_above(3.0, np.inf, 0.5) == -np.inf
    assert log_below_above(-np.inf, 3.0, 0.5) == -np.inf
    assert log_below_above(1e80, 3.0, 0.5) == log_tail(3.0)


def test_spread_and_correlation_are_two_ways_to_say_the_same():
    rho = np.array([-0.5, 0.1, 0.9])
    spread = np.sqrt((1 - rho) / (1 + rho))
    assert np.allclose(log_below_above(2.0, 2.5, rho), log_below_above(2.0, 2.5, spread=spread), atol=1e-12)


@given(LEVEL, LEVEL, st.floats(-1, 1), st.floats(0, 0.3))
@settings(max_examples=60, deadline=None, derandomize=True)
def test_the_bound_is_monotone_in_the_levels_and_the_correlation(a, b, rho, step):
    value = float(log_below_above(a, b, rho))
    slack = 1e-5 + 1e-10 * abs(value) if np.isfinite(value) else 0.0
    assert float(log_below_above(a + step, b, rho)) >= value - slack
    assert float(log_below_above(a, b - step, rho)) >= value - slack
    assert float(log_below_above(a, b, max(rho - step, -1.0))) >= value - slack


@given(LEVEL, LEVEL, st.floats(-1, 1))
@settings(max_examples=60, deadline=None, derandomize=True)
def test_the_two_halves_of_a_tail_add_up_to_at_least_the_tail(a, b, rho):
    # P(X <= a, Y > b) + P(X > a, Y > b) = Q(b), and the second is P(-X <= -a, Y > b) with correlation -rho
    both = np.logaddexp(float(log_below_above(a, b, rho)), float(log_below_above(-a, b, -rho)))
    assert log_tail(b) - 1e-12 * (1 + abs(log_tail(b))) <= both <= log_tail(b) + 1e-4


def test_malformed_correlations_are_refused():
    with pytest.raises(ValueError, match="exactly one"):
        log_below_above(1.0, 1.0)
    with pytest.raises(ValueError, match="exactly one"):
        log_below_above(1.0, 1.0, 0.5, spread=0.5)
    with pytest.raises(ValueError, match="must lie in"):
        log_below_above(1.0, 1.0, 1.5)
    with pytest.raises(ValueError, match="must not be negative"):
        log_below_above(1.0, 1.0, spread=-0.5)
