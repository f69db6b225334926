"""First-passage tubes: series of Brownian motion, quadrature of short chains, the radial estimate, spoilt proposals."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import dblquad, quad
from scipy.stats import chi, norm

from certbound.errors import InfeasibleError
from certbound.tubes.constants import Constants
from certbound.tubes.exact.first_passage import bound_exact_exit, bound_worst_exit, chain_of
from certbound.tubes.exact.recursion import Recursion, legendre_rule
from certbound.tubes.exact.supersolution import Supersolution
from certbound.tubes.schedule import make_schedule
from certbound.tubes.tuning import bound_exit_probability, tune_tube
from experiments.limits import exact_radius
from tests.tubes.yardstick import estimate_exit_probability, estimate_radius

SLOW = pytest.mark.slow


def isotropic(n=1, **slope):
    return Constants(sigma=1.0, dimension=n, isotropic=True, **slope)


def brownian(n, radius, horizon):
    """P(sup ||W_t|| > R) by the eigenfunction series for n = 1 and 3."""
    k = np.arange(400)
    if n == 1:
        terms = 4 / np.pi * (-1.0) ** k / (2 * k + 1) * np.exp(-(((2 * k + 1) * np.pi / radius) ** 2) * horizon / 8)
    else:
        k = k + 1
        terms = -2 * (-1.0) ** k * np.exp(-((k * np.pi / radius) ** 2) * horizon / 2)
    return 1 - float(terms.sum())


@pytest.mark.parametrize(("n", "radius"), [(1, 3.6), (3, 5.0)])
def test_without_drift_the_bound_is_just_above_the_series(n, radius):
    truth = brownian(n, radius, 1.7)
    got = bound_exact_exit(isotropic(n, rate=0.0), horizon=1.7, radius=radius, target=truth)
    assert truth < got < 1.12 * truth


@pytest.mark.parametrize(
    ("n", "rate", "radius", "horizon"),
    [(1, -0.5, 4.0, 5.0), pytest.param(3, -2.0, 2.6, 2.0, marks=SLOW), pytest.param(6, 0.4, 6.5, 1.0, marks=SLOW)],
)
def test_with_drift_the_bound_is_just_above_the_estimate(n, rate, radius, horizon):
    constants = isotropic(n, rate=rate)
    truth = estimate_exit_probability(constants, horizon=horizon, radius=radius)
    got = bound_exact_exit(constants, horizon=horizon, radius=radius, target=truth)
    assert truth * (1 - 1e-3) < got < 1.1 * truth


@SLOW
def test_time_varying_data_follow_the_estimate():
    constants = Constants(
        rate=[0.6, -1.5], sigma=[0.7, 1.0], times=[0.0, 0.8, 2.0], dimension=2, isotropic=True
    )  # fmt: skip
    truth = estimate_exit_probability(constants, horizon=2.0, radius=3.0)
    got = bound_exact_exit(constants, horizon=2.0, radius=3.0, target=truth)
    assert truth * (1 - 1e-3) < got < 1.1 * truth


def test_a_chain_of_one_and_of_two_steps_is_its_integral():
    one = bound_exact_exit(isotropic(4, gain=0.5), horizon=1, radius=3.0)
    assert one == pytest.approx(chi(4).sf(3.0), rel=1e-9)
    assert one >= chi(4).sf(3.0)
    two = bound_exact_exit(isotropic(1, gain=0.8), horizon=2, radius=2.0)
    inside, _ = dblquad(
        lambda y, x: norm.pdf(x) * norm.pdf(y - 0.8 * x), -2.0, 2.0, -2.0, 2.0, epsabs=1e-12, epsrel=1e-12
    )
    assert two == pytest.approx(1 - inside, rel=1e-9)
    radial, _ = quad(lambda s: chi(2).pdf(s) * rice_sf(3.0, 0.9 * s), 0, 3.0, epsabs=1e-12)
    two = bound_exact_exit(isotropic(2, gain=0.9), horizon=2, radius=3.0)
    assert two == pytest.approx(radial + chi(2).sf(3.0), rel=1e-6)


def rice_sf(radius, shift):
    from scipy.stats import ncx2

    return ncx2.sf(radius**2, 2, shift**2)


@pytest.mark.parametrize(
    ("gains", "n", "horizon", "radius"), [((0.9,), 3, 20, 5.0), ((1.02,), 1, 12, 9.0), ((0.5, 0.95), 2, 10, 4.5)]
)
def test_chains_follow_the_estimate_from_above(gains, n, horizon, radius):
    times = None if len(gains) == 1 else [0.0, 4.0, horizon]
    constants = isotropic(n, gain=gains[0] if times is None else list(gains), times=times)
    truth = estimate_exit_probability(constants, horizon=horizon, radius=radius)
    got = bound_exact_exit(constants, horizon=horizon, radius=radius)
    assert truth * (1 - 1e-9) < got < truth * (1 + 1e-3)


def test_the_nodes_are_those_of_gauss_and_legendre():
    nodes, weights = legendre_rule()
    for power in range(27):
        exact = 0.0 if power % 2 else 2 / (power + 1)
        assert float(weights @ nodes**power) == pytest.approx(exact, abs=1e-14)
    assert math.fsum(weights) >= 2.0


def test_the_inflation_covers_the_rounding_that_is_seen():
    chain = Recursion(
        gains=np.array([0.9]), sigmas=np.array([1.0]), counts=np.array([5]), dimension=1, radius=40.0
    )  # fmt: skip
    nodes, weights = chain._grid
    rows = chain._kernel(nodes[:30], 0.9, 1.0)
    with np.errstate(under="ignore"):
        for i in (0, 17, 29):
            mean = np.longdouble(0.9) * np.longdouble(nodes[i])
            long = np.exp(-((nodes.astype(np.longdouble) - mean) ** 2) / 2)
            long += np.exp(-((nodes.astype(np.longdouble) + mean) ** 2) / 2)
            long *= weights.astype(np.longdouble) / np.sqrt(2 * np.longdouble(math.pi))
            seen = long > 1e-290
            assert np.all(rows[i][seen] >= long[seen])
            assert np.all(rows[i][seen] <= long[seen] * (1 + 2 * (chain.inflation - 1)))


@SLOW
def test_a_chain_that_is_too_long_is_compared_with_its_diffusion():
    constants = isotropic(1, gain=0.9999)
    diffusion = bound_exact_exit(constants, horizon=300_000, radius=420.0, target=1e-3)
    rate = math.log(0.9999)
    same = isotropic(1, rate=rate)
    same = replace(same, sigma=math.sqrt(2 * rate / math.expm1(2 * rate)))
    assert diffusion == pytest.approx(bound_exact_exit(same, horizon=3e5, radius=420.0, target=1e-3), rel=1e-6)


@pytest.mark.parametrize(
    ("constants", "horizon", "delta"),
    [(isotropic(1, rate=-0.5), 5.0, 1e-3), (isotropic(2, gain=0.9), 20, 1e-3), (isotropic(1, gain=0.5), 30, 1e-6)],
)
def test_the_exact_tube_is_within_one_percent_of_the_limit(constants, horizon, delta):
    tube = tune_tube(constants, horizon=horizon, delta=delta, method="exact")
    limit = estimate_radius(constants, horizon=horizon, delta=delta)
    assert 1 - 1e-6 < tube.maximum / limit < 1.01
    assert tube.certified
    assert tube.parameters["probability"] <= delta


@SLOW
@pytest.mark.parametrize(("n", "horizon", "delta"), [(1, 1.0, 1e-6), (3, 1.0, 1e-6), (1, 5.0, 1e-9)])
def test_far_out_in_the_tail_as_well(n, horizon, delta):
    constants = isotropic(n, rate=-0.5)
    tube = tune_tube(constants, horizon=horizon, delta=delta, method="exact")
    assert 1 - 1e-6 < tube.maximum / exact_radius(rate=-0.5, n=n, horizon=horizon, delta=delta) < 1.006


@SLOW
@pytest.mark.parametrize(("rate", "n", "horizon"), [(1.0, 1, 2.0), (1.0, 1, 5.0), (1.0, 3, 2.0), (0.3, 1, 5.0)])
def test_in_expanding_systems_as_well(rate, n, horizon):
    tube = tune_tube(isotropic(n, rate=rate), horizon=horizon, delta=1e-3, method="exact")
    spread = math.sqrt(math.expm1(2 * rate * horizon) / (2 * rate))
    # leaving before the end and coming back hardly ever happens there: the limit is the law of the end
    end = chi(n).isf(1e-3) * spread
    assert end < tube.maximum < 1.01 * max(end, estimate_radius(isotropic(n, rate=rate), horizon=horizon, delta=1e-3))


@SLOW
def test_thorough_answers_take_the_exact_law():
    constants = isotropic(1, rate=-0.5)
    level = bound_exit_probability(constants, horizon=5.0, clearance=4.0, thorough=True)
    truth = math.log10(estimate_exit_probability(constants, horizon=5.0, radius=4.0))
    assert truth < level < truth + 0.03
    assert bound_exit_probability(constants, horizon=5.0, clearance=4.0) > truth + 0.05


def problem(**changes):
    options = {"pieces": ((0.1, 8.0),), "dimension": 1, "nu": 1.0, "worst": False, "target": 1e-3}
    return Supersolution(**{**options, **changes})


@pytest.mark.parametrize("factor", [0.5, 0.9, 0.99])
def test_a_spoilt_proposal_is_paid_for(factor, monkeypatch):
    honest = problem()
    truth = honest.estimate()
    slabs = honest._slabs()
    for slab in slabs[len(slabs) // 2 :]:
        slab.states[:, : slab.states.shape[1] // 2] *= factor  # far from the boundary: too small a value
    monkeypatch.setattr(Supersolution, "_slabs", lambda self: slabs)
    assert honest.estimate() < truth
    assert honest.bound() >= truth * (1 - 1e-3)


def test_a_proposal_that_needs_too_much_growth_proves_nothing(monkeypatch):
    honest = problem()
    monkeypatch.setattr(Supersolution, "_payment", lambda self, slab, lift: (0.0, 1e6))
    assert honest.bound() == 1.0


def test_negative_terminal_values_prove_nothing(monkeypatch):
    honest = problem()
    slabs = honest._slabs()
    slabs[0].states[0, 0] = -1.0
    monkeypatch.setattr(Supersolution, "_slabs", lambda self: slabs)
    assert honest.bound() == 1.0


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: bound_exact_exit(Constants(rate=-1.0, sigma=1.0, dimension=1), horizon=1.0, radius=1.0), "isotropic"),
        (lambda: bound_worst_exit(isotropic(1, gain=0.5), horizon=2, radius=1.0), "is for continuous time"),
        (
            lambda: bound_exact_exit(
                Constants(rate=[1.0, -1.0], sigma=[0.0, 1.0], times=[0.0, 1.0, 2.0], dimension=1, isotropic=True),
                horizon=2.0, radius=1.0,
            ),
            "needs noise wherever the rate is positive",
        ),
    ],
)  # fmt: skip
def test_what_the_hypotheses_do_not_cover_is_refused(call, message):
    with pytest.raises((ValueError, InfeasibleError), match=message):
        call()


def test_a_chain_whose_kernel_would_not_fit_into_memory_is_not_built():
    fast = Constants(gain=2.1, sigma=0.001, dimension=1, isotropic=True)  # 24000 nodes inside, 51000 in all
    assert chain_of(fast, make_schedule(fast, 10), 3.5) is None
    tube = tune_tube(fast, horizon=10, delta=1e-3, method="exact")
    spread = 0.001 * math.sqrt(sum(2.1 ** (2 * k) for k in range(10)))
    assert norm.isf(5e-4) * spread < tube.bound(0, 10) < 1.02 * norm.isf(5e-4) * spread
