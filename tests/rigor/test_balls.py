"""Special functions in ball arithmetic."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
from flint import arb
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import gammaln, hyp1f1, logsumexp

from certbound.rigor.balls import (
    bessel_excess,
    excess_floor,
    excess_tangent,
    kummer_excess,
    lower,
    precision,
    solve_upward,
    upper,
)


def log_kummer(a, b, z):
    """Bounds of log 1F1(a; b; z)."""
    with precision():
        value = (arb(a) * kummer_excess(arb(a), arb(b), arb(z))).log1p()
        return lower(value), upper(value)


def log_bessel0f1(b, z):
    """Bounds of log 0F1(; b; z)."""
    with precision():
        value = bessel_excess(arb(b), arb(z)).log1p()
        return lower(value), upper(value)


def exact_excess(a, b, z, terms=400):
    """(1F1 - 1)/a by exact rational partial sums: a lower bound, and the value to the last term."""
    a, b, z = Fraction(a), Fraction(b), Fraction(z)
    term = total = z / b
    for k in range(1, terms):
        term *= (a + k) * z / ((b + k) * (k + 1))
        total += term
        if term < total * Fraction(1, 2**120):
            break
    return total


@pytest.mark.parametrize("a", [0.0, 1e-300, 1e-12, 0.25, 3.0, 50.0])
@pytest.mark.parametrize("b", [0.0625, 0.5, 7.5, 500.0])
@pytest.mark.parametrize("z", [2.0**-40, 0.5, 9.0])
def test_the_excess_encloses_exact_rational_sums(a, b, z):
    value = exact_excess(a, b, z)
    with precision():
        ball = kummer_excess(arb(a), arb(b), arb(z))
        numerator = arb(value.numerator) / arb(value.denominator)
        assert abs(ball / numerator - 1) < 1e-15
        assert not ball < numerator * (1 - arb(2) ** -90)


def test_the_limit_at_zero_is_approached_from_above():
    with precision():
        limit, near = (kummer_excess(arb(a), arb(0.5), arb(6)) for a in (0.0, 1e-6))
        assert limit < near < limit * 1.0001


@pytest.mark.parametrize(("a", "z"), [(0.3, 1e5), (2.5, 1e12), (0.3, 1e17)])
def test_log_kummer_follows_its_asymptotics_at_any_size(a, z):
    lo, hi = log_kummer(a, 0.5, z)
    leading = z + (a - 0.5) * math.log(z) + math.lgamma(0.5) - math.lgamma(a)
    assert lo <= hi
    assert (lo + hi) / 2 == pytest.approx(leading, rel=1e-9)


def test_log_kummer_is_found_where_the_library_gives_up():
    lo, hi = log_kummer(0.5, 500.0, 700.0)
    assert hi - lo < 1e-12
    assert lo == pytest.approx(32.90881629253, abs=1e-9)


def test_beyond_all_reach_the_bounds_are_infinite_not_wrong():
    lo, hi = log_kummer(0.0, 0.5, 1e9)
    assert lo <= 0.0 <= hi
    assert upper(kummer_excess(arb(0), arb(0.5), arb(1e9))) == math.inf


@given(st.floats(1e-3, 30), st.floats(0.1, 40), st.floats(1e-3, 60))
@settings(max_examples=60, deadline=None)
def test_log_kummer_agrees_with_scipy(a, b, z):
    lo, hi = log_kummer(a, b, z)
    assert lo <= hi
    assert lo == pytest.approx(math.log(hyp1f1(a, b, z)), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("z", [1e-200, 1e-3, 1.0, 400.0, 1e6])
def test_log_bessel_in_one_dimension_is_log_cosh(z):
    x = 2 * math.sqrt(z)
    lo, hi = log_bessel0f1(0.5, z)
    expected = x + math.log1p(math.exp(-2 * x)) - math.log(2) if x > 1e-3 else 2 * z
    assert lo - 1e-13 * abs(lo) <= expected <= hi + 1e-13 * abs(hi)


def test_bessel_excess_at_zero_is_zero():
    assert bessel_excess(arb(0.5), arb(0)).is_zero()
    assert kummer_excess(arb(0.5), arb(0.5), arb(0)).is_zero()


@given(st.integers(-(10**30), 10**30), st.integers(1, 10**20))
@settings(max_examples=60, deadline=None)
def test_conversion_to_floats_rounds_outward(numerator, denominator):
    with precision():
        ball = arb(numerator) / arb(denominator)
        lo, hi = lower(ball), upper(ball)
    exact = Fraction(numerator, denominator)
    assert Fraction(lo) <= exact <= Fraction(hi)
    assert hi - lo <= 4 * math.ulp(max(abs(lo), abs(hi)))


def test_indeterminate_balls_become_infinite():
    assert upper(arb.nan()) == math.inf
    assert lower(arb.nan()) == -math.inf


def test_the_solution_found_upward_is_proved():
    with precision():
        for guess in (math.sqrt(2), 1.0, math.nan):
            z = solve_upward(lambda x: x * x, arb(2), guess)
            assert arb(z) ** 2 >= 2
        assert solve_upward(lambda x: x * x, arb(2), math.sqrt(2)) == pytest.approx(math.sqrt(2), rel=1e-12)
        assert solve_upward(lambda x: arb(0), arb(1), 1.0) == math.inf


@pytest.mark.parametrize(
    ("a", "b", "z", "bessel"),
    [(0.0, 0.5, 3.0, False), (0.0, 0.5, 8e3, False), (9e3, 0.5, 700.0, False), (0.3, 3.0, 1e5, False),
     (2.0, 500.0, 1e3, True), (1e4, 0.15, 2e4, False)],
)  # fmt: skip
def test_the_floor_is_below_the_excess_and_close_to_it(a, b, z, bessel):
    k = np.arange(1.0, 120_000.0)
    terms = k * math.log(z) + gammaln(b) - gammaln(b + k) - gammaln(k + 1)
    terms += (k - 1) * math.log(a) if bessel else gammaln(a + k) - gammaln(a + 1)
    exact = logsumexp(terms)
    with precision():
        floor = excess_floor(arb(a), arb(b), arb(z), bessel=bessel).log()
    assert exact - 0.7 < lower(floor) <= exact + 1e-9 * abs(exact)


def test_the_floor_answers_at_any_size():
    for z in (1e9, 1e20, 1e300):
        for a in (0.0, 1e-9, 0.5, 1e4):
            with precision():
                assert lower(excess_floor(arb(a), arb(0.15), arb(z)).log()) > 0.99 * min(z, 1e14)
                if a > 0:
                    assert excess_floor(arb(a), arb(0.15), arb(z), bessel=True).log() > 0


@pytest.mark.parametrize("bessel", [False, True])
@pytest.mark.parametrize("a", [0.0, 0.3, 40.0, 1e4])
@pytest.mark.parametrize("place", [1e-3, 2.0, 30.0, 1e5, 1e16])
def test_a_tangent_of_the_logarithms_never_rises_above_the_function(a, place, bessel):
    if bessel and a == 0:
        pytest.skip("the Bessel form has a > 0")
    power, half, z = arb(a), arb(1.5), arb(place)
    with precision(300):
        value, slope = excess_tangent(power, half, z, bessel=bessel)
        assert value > 0
        factors = (0.5, 0.9, 0.999, 1.001, 1.1, 2.0)
        for factor in factors if slope is not None else [x for x in factors if x > 1]:
            line = value.log() + (arb(1) if slope is None else slope) * arb(factor).log()
            exact = excess_floor(power, half, z * arb(factor), bessel=bessel).log()
            if place < 1e5:
                assert line < exact + arb(2) ** -40
                assert slope is None or exact < line + slope * (arb(factor) - 1) ** 2 * (place + 1) * 3
