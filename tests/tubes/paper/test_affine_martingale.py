"""Affine martingales: the bound against an ODE and a recursion, thresholds, what Lemma 3 lacks, sampled refutation."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from certbound.tubes.paper.affine_martingale import AffineMartingale, estimate_affine_excess
from certbound.tubes.paper.energy import log_energy

TIMES, SLOPE, OFFSET = [0.0, 1.0, 1.5, 4.0], [0.7, -1.2, 0.0], [0.3, 2.0, 0.1]


def test_continuous_coefficients_are_those_of_the_differential_equation():
    flow = AffineMartingale(times=TIMES, slope=SLOPE, offset=OFFSET, continuous=True)
    # the mean of M solves m' = a m + b; the bound is m_T/level
    m = 0.4
    for begin, end, a, b in zip(TIMES, TIMES[1:], SLOPE, OFFSET):
        m = solve_ivp(lambda t, y, a=a, b=b: a * y + b, (begin, end), [m], rtol=1e-11, atol=1e-13).y[0, -1]
    assert flow.bound(0.4, 50.0) == pytest.approx(m / 50.0, rel=1e-8)


def test_discrete_coefficients_are_those_of_the_recursion():
    chain = AffineMartingale(times=[0, 2, 5, 6], slope=[0.9, 1.0, 0.0], offset=[0.5, 0.2, 3.0], continuous=False)
    m = 0.4
    for a, b in [(0.9, 0.5)] * 2 + [(1.0, 0.2)] * 3 + [(0.0, 3.0)]:
        m = a * m + b
    assert chain.bound(0.4, 100.0) == pytest.approx(m / 100.0, rel=1e-12)
    assert chain.bound(0.4, 1.0) == 1.0


def test_thresholds_invert_the_supermartingale():
    flow = AffineMartingale(times=TIMES, slope=SLOPE, offset=OFFSET, continuous=True)
    for t in (0.0, 0.6, 1.0, 2.0, 4.0):
        m = flow.threshold(8.0, t)
        # carried on to T by m' = a m + b, a path at its threshold ends at the level
        for begin, end, a, b in zip(TIMES, TIMES[1:], SLOPE, OFFSET):
            if end > t:
                h = end - max(begin, t)
                m = m * math.exp(a * h) + (b * math.expm1(a * h) / a if a else b * h)
        assert m == pytest.approx(8.0, rel=1e-10)


def test_the_bound_holds_for_an_energy_of_a_random_walk():
    # M = cosh(k S) under Rademacher steps: E[M+] = cosh(k) M <= e^{k^2/2} M
    k, steps, level = 0.4, 25, 40.0
    chain = AffineMartingale(times=[0, steps], slope=math.exp(k * k / 2), offset=0.0, continuous=False)
    rng = np.random.default_rng(5)
    walk = np.cumsum(rng.integers(0, 2, (40_000, steps)) * 2 - 1, axis=1)
    radius = [math.acosh(chain.threshold(level, float(t))) / k for t in range(1, steps + 1)]
    share = np.mean((np.abs(walk) > radius).any(axis=1))
    assert 0 < share < chain.bound(1.0, level)


def test_lemma_3_with_a_negative_slope_would_prove_something_false():
    # M = 0, 0, 1 obeys E[M+] <= -M + 1, and the formula gives P(M > 1/2 some time) <= 0
    m, a, b = [0.0, 0.0, 1.0], -1.0, 1.0
    assert all(after <= a * now + b for now, after in itertools.pairwise(m))
    formula = (m[0] * a * a + b * a + b) / 0.5
    assert formula == 0.0
    assert max(m) > 0.5
    with pytest.raises(ValueError, match=r"`slope` must not be negative in discrete time: Lemma 3 is false there"):
        AffineMartingale(times=[0, 2], slope=a, offset=b, continuous=False)


def test_expectations_that_do_not_rise_prove_nothing():
    # U uniform on {0, ..., 9}: M_t = 10 where U = t, else 0. Every mean is 1, and some M_t is 10 for sure
    path = 10.0 * np.eye(10)
    assert np.all(path.mean(axis=1) == 1.0)
    truth = np.mean(path.max(axis=0) >= 10.0)
    formula = AffineMartingale(times=[0, 9], slope=1.0, offset=0.0, continuous=False).bound(1.0, 10.0)
    assert formula == pytest.approx(0.1)
    assert truth == 1.0
    # given M_0 = 0 the next mean is 10/9, which the conditional inequality forbids: samples from there show it
    after = np.array([10.0] + 8 * [0.0]).reshape(1, 9, 1)
    excess, _ = estimate_affine_excess(lambda x: x[..., 0], np.array([[0.0]]), after, 1.0, 0.0)
    assert excess[0] == pytest.approx(10 / 9)


@pytest.mark.parametrize(("slope", "refuted"), [(math.exp(0.5 * 0.6**2), False), (1.05, True)])
def test_samples_refute_an_energy_with_a_slope_that_is_too_small(slope, refuted):
    rng = np.random.default_rng(2)
    states = rng.standard_normal((20, 3))
    after = states[:, None, :] + rng.standard_normal((20, 20_000, 3))
    excess, error = estimate_affine_excess(lambda x: np.exp(log_energy(x, 0.6)), states, after, slope, 0.0)
    assert bool(np.any(excess > 5 * error)) is refuted


def test_samples_of_a_diffusion_agree_with_its_generator():
    # M = x^2 along dX = -X dt + dW: d E[M] = -2 M + 1
    rng = np.random.default_rng(6)
    states, step = np.linspace(-2, 2, 9)[:, None], 1e-3
    after = states[:, None, :] * (1 - step) + math.sqrt(step) * rng.standard_normal((9, 40_000, 1))
    excess, error = estimate_affine_excess(lambda x: x[..., 0] ** 2, states, after, -2.0, 1.0, step=step)
    assert np.all(np.abs(excess) < 5 * error + 1e-5)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: AffineMartingale(times=[1.0, 2.0], slope=0.0, offset=0.0, continuous=True), "`times` must rise"),
        (lambda: AffineMartingale(times=[0, 1.5], slope=0.0, offset=0.0, continuous=False), "`times` must be whole"),
        (lambda: AffineMartingale(times=[0, 1], slope=[1.0, 2.0], offset=0.0, continuous=True), "`slope` must be a"),
        (lambda: AffineMartingale(times=[0, 1], slope=0.0, offset=math.inf, continuous=True), "`offset` must be fin"),
        (
            lambda: AffineMartingale(times=[0, 1], slope=0.0, offset=0.0, continuous=True).bound(-1.0, 1.0),
            "`initial` must not be negative",
        ),
        (
            lambda: AffineMartingale(times=[0, 1], slope=0.0, offset=0.0, continuous=True).threshold(1.0, 2.0),
            r"`t` must lie in \[0, 1.0\]",
        ),
    ],
)
def test_coefficients_out_of_range_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
