"""Floating-point excesses against ball arithmetic."""

from __future__ import annotations

import math

import numpy as np
import pytest
from flint import arb

from certbound.rigor.balls import bessel_excess, kummer_excess, precision
from certbound.tubes.excess import (
    log_excess,
    log_excess_one,
    log_excess_value,
    log_phi,
    log_phi_one,
    solve_excess,
    solve_excess_one,
)

CASES = [
    (a, b, z, bessel)
    for a in (0.0, 1e-12, 0.3, 40.0, 1e5)
    for b in (0.02, 0.5, 3.0, 400.0)
    for z in (1e-6, 0.7, 25.0, 900.0)
    for bessel in (False, True)
    if not (bessel and a == 0) and not (a == 1e5 and not bessel and z > 30)
]


def reference(a, b, z, bessel):
    with precision():
        ball = bessel_excess(arb(b), arb(a) * arb(z)) / arb(a) if bessel else kummer_excess(arb(a), arb(b), arb(z))
        return float(ball.log())


@pytest.mark.parametrize(("a", "b", "z", "bessel"), CASES)
def test_the_excess_agrees_with_ball_arithmetic(a, b, z, bessel):
    expected = reference(a, b, z, bessel)
    vector, _ = log_excess(np.array([a]), b, np.array([z]), bessel=bessel)
    scalar, _ = log_excess_one(a, b, z, bessel=bessel)
    assert vector[0] == pytest.approx(expected, rel=1e-11, abs=1e-11)
    assert scalar == pytest.approx(expected, rel=1e-11, abs=1e-11)


@pytest.mark.parametrize("bessel", [False, True])
def test_each_of_many_arguments_gets_the_terms_that_it_needs(bessel):
    a, z = (part.ravel() for part in np.meshgrid([0.3, 4.0, 50.0], np.geomspace(1e-3, 400.0, 30)))
    many = np.array(log_excess(a, 1.5, z, bessel=bessel))
    alone = [[float(part[0]) for part in log_excess(a[[k]], 1.5, z[[k]], bessel=bessel)] for k in range(len(z))]
    np.testing.assert_allclose(many.T, alone, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize(("a", "b", "z", "bessel"), CASES[::3])
def test_the_inverse_returns_the_argument(a, b, z, bessel):
    target = reference(a, b, z, bessel)
    assert solve_excess_one(a, b, target, bessel=bessel) == pytest.approx(z, rel=1e-9)
    assert solve_excess(np.array([a]), b, np.array([target]), bessel=bessel)[0] == pytest.approx(z, rel=1e-9)


def test_the_slope_is_the_elasticity():
    for bessel in (False, True):
        z, h = np.array([0.2, 5.0, 30.0]), 1e-6
        up, down = (log_excess(0.7, 0.5, z * math.exp(s * h), bessel=bessel)[0] for s in (1, -1))
        _, slope = log_excess(0.7, 0.5, z, bessel=bessel)
        np.testing.assert_allclose(slope, (up - down) / (2 * h), rtol=1e-7)


def test_infinite_and_empty_targets_have_their_limits():
    assert solve_excess_one(0.3, 0.5, -math.inf) == 0
    assert solve_excess_one(0.3, 0.5, math.inf) == math.inf
    np.testing.assert_array_equal(solve_excess(0.3, 0.5, np.array([-np.inf, np.inf])), [0, np.inf])


@pytest.mark.parametrize("x", [-800.0, -3.0, -1e-9, 0.0, 1e-12, 2.0, 800.0])
def test_log_phi_is_log_of_expm1_over_x(x):
    with precision():
        expected = float((arb(x).expm1() / arb(x)).log()) if x else 0.0
    assert log_phi_one(x) == pytest.approx(expected, rel=1e-12, abs=1e-14)
    assert log_phi(np.array([x]))[0] == pytest.approx(expected, rel=1e-12, abs=1e-14)


def test_values_by_scipy_agree_with_the_series():
    rng = np.random.default_rng(4)
    for _ in range(400):
        a, b, z = 10 ** rng.uniform(-7, 2.5), 10 ** rng.uniform(-1, 1.8), 10 ** rng.uniform(-1, 2.6)
        a = 0.0 if a < 1e-6 else a
        for bessel in (False, True)[: 1 + (a > 0)]:
            expected = log_excess_one(a, b, z, bessel=bessel)[0]
            assert log_excess_value(a, b, z, bessel=bessel) == pytest.approx(expected, abs=2e-7)


def test_far_out_the_scalar_sum_agrees_with_the_array():
    rng = np.random.default_rng(5)
    for _ in range(200):
        a, b, z = 10 ** rng.uniform(-2, 4), 10 ** rng.uniform(-1, 2.7), 10 ** rng.uniform(2.5, 7)
        for bessel in (False, True):
            value, slope = log_excess(np.asarray(a), b, np.asarray(z), bessel=bessel)
            got = log_excess_one(a, b, z, bessel=bessel)
            assert got == pytest.approx((float(value), float(slope)), rel=1e-6)


@pytest.mark.parametrize("z", [5e-324, 1e-310, 1e-205, 1e-150])
def test_next_to_zero_the_first_term_is_all(z):
    value, slope = log_excess_one(20.0, 0.56, z)
    assert value == pytest.approx(math.log(z / 0.56) if z > 1e-300 else math.log(z) - math.log(0.56), rel=1e-13)
    assert slope == pytest.approx(1.0)
