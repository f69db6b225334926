"""The probability of given clearances: the formula of Thm K2 in floats, the union bound, and what lies far out."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest
from flint import arb
from scipy.integrate import quad
from scipy.special import gamma, hyp1f1, iv

from certbound.rigor.balls import excess_floor, precision
from certbound.tubes.constants import Constants
from certbound.tubes.kummer.exit import Tangents, exit_level, union_level, union_may_help
from certbound.tubes.kummer.profile import kummer_tube, log_initial
from certbound.tubes.kummer.search import log_gain
from certbound.tubes.objective import read_clearance
from certbound.tubes.question import Start
from certbound.tubes.schedule import make_schedule
from certbound.tubes.tuning import bound_exit_probability, tune_tube
from tests.tubes.yardstick import estimate_exit_probability

OU = Constants(rate=-0.5, sigma=0.1**0.5, dimension=1)
CHAIN = Constants(gain=0.6, sigma=1.0, dimension=2)


def level(constants, horizon, clearance, **options):
    schedule, held = make_schedule(constants, horizon), read_clearance(clearance, horizon)
    return exit_level(schedule.refined(held.ends(schedule)), held, **options)


def test_the_level_is_the_formula_of_the_theorem_on_a_dense_grid_of_times():
    # sigma = .1^.5: unit^2 = .1; v' = -v + 1 in units; I by quadrature
    a, v0, horizon = 0.7, 0.2, 5.0

    def v(t):
        return v0 * math.exp(-t) + 1 - math.exp(-t)

    def info(t):
        return quad(lambda s: 1 / v(s), t, horizon)[0]

    t = np.linspace(0, horizon, 400)
    radius = np.where(t < 2.0, 0.9, 1.4)
    gain = [math.exp(a * info(s)) * hyp1f1(a, 0.5, r * r / 0.1 / (2 * v(s))) for s, r in zip(t, radius)]
    expected = math.log10(math.expm1(a * info(0)) / (min(gain) - 1))
    got = level(OU, horizon, ((0.0, 2.0, 5.0), (0.9, 1.4)), a=a, v0=v0)
    assert expected - 1e-3 < got < expected + 0.02


@pytest.mark.parametrize("seed", range(12))
def test_the_level_lies_above_every_point_of_a_grid_and_near_the_worst(seed):
    rng = np.random.default_rng(seed)
    pieces, bessel = int(rng.integers(1, 5)), seed % 3 == 0
    times = np.arange(pieces + 1) * 6.0
    data = {"sigma": rng.uniform(0.2, 1.5, pieces), "dimension": int(rng.integers(1, 5)), "times": times}
    if seed % 2:
        constants = Constants(gain=rng.uniform(0.5, 1.1, pieces), **data)
    else:
        constants = Constants(rate=rng.uniform(-1.0, 0.2, pieces), **data)
    a, v0 = float(rng.uniform(0.05, 9)), float(np.exp(rng.uniform(-2, 3)))
    schedule = make_schedule(constants, times[-1])
    t = np.arange(1.0, times[-1] + 1) if seed % 2 else np.linspace(0, times[-1], 2000)
    v, info = schedule.path_at(v0, t, bessel=bessel)
    radius = float(np.sqrt(np.max(v) * schedule.unit**2) * rng.uniform(2, 4))
    start = Start(offset=0.01) if bessel else Start()
    gain = [log_gain(a, schedule.nu / 2, i, (radius / schedule.unit) ** 2 / (2 * w), bessel) for w, i in zip(v, info)]
    whole = float(schedule.path(np.asarray(v0), bessel=bessel)[1][0])
    expected = (log_initial(schedule, a, v0, whole, start, bessel) - min(gain)) / math.log(10)
    got = level(constants, times[-1], radius, a=a, v0=v0, bessel=bessel, start=start)
    assert min(0.0, expected) - 1e-6 <= got <= min(0.0, expected) + 0.008


def test_a_tube_at_delta_leaves_at_most_about_delta_as_clearance():
    for constants, horizon in ((OU, 5.0), (CHAIN, 20)):
        tube = tune_tube(constants, horizon=horizon, delta=1e-4, method="kummer")
        a, v0 = tube.parameters["a"], tube.parameters["v0"] / make_schedule(constants, horizon).unit ** 2
        assert level(constants, horizon, tube.maximum, a=a, v0=v0) <= -4 + 0.01
        assert bound_exit_probability(constants, horizon=horizon, clearance=tube.maximum) <= -4 + 0.01


@pytest.mark.parametrize("radius", [0.9, 1.2, 1.6])
def test_the_bound_is_above_the_probability_itself_and_near_it(radius):
    truth = math.log10(estimate_exit_probability(OU, horizon=5.0, radius=radius))
    assert truth < bound_exit_probability(OU, horizon=5.0, clearance=radius) < truth + 0.5


def one_time_tail(dimension, x):
    """inf over k of (e^k - 1)/(0F1(; n/2; k x) - 1) by a dense grid, 0F1 from the Bessel function."""
    k = np.geomspace(0.05, 100, 4000)
    order, root = dimension / 2 - 1, 2 * np.sqrt(k * x)
    phi = gamma(dimension / 2) * (root / 2) ** -order * iv(order, root)
    return float(np.min(np.expm1(k) / (phi - 1)))


@pytest.mark.parametrize("dimension", [1, 2, 5])
def test_the_union_bound_adds_the_one_time_tails_of_the_steps(dimension):
    constants = Constants(gain=0.6, sigma=1.0, dimension=dimension)
    schedule, radii = make_schedule(constants, 4), (4.0, 5.0, 4.5, 6.0, 5.5)
    held = read_clearance(((0, 1, 2, 3, 4, 5), radii), 4)
    variance = np.cumsum(0.6 ** (2 * np.arange(4)))
    # what is asked at the horizon is asked a step before as well, and both steps share the larger variance
    pairs = zip((5.0, 4.5, 5.5, 5.5), variance[[0, 1, 3, 3]])
    expected = sum(one_time_tail(dimension, r * r / (2 * v)) for r, v in pairs)
    got = union_level(schedule.refined(held.ends(schedule)), held)
    assert math.log10(expected) - 1e-3 < got < math.log10(expected) + 0.01


def test_the_union_bound_claims_nothing_where_it_is_not_proved():
    held = read_clearance(3.0, 5)
    rough = Constants(gain=0.5, sigma=1.0, dimension=3, effective_dimension=1.2)
    assert union_level(make_schedule(rough, 5), held) == 0.0
    assert union_level(make_schedule(OU, 5.0), held) == 0.0
    # there bound_exit_probability takes the full dimension for it
    assert bound_exit_probability(rough, horizon=5, clearance=9.0) < -6


def test_weak_gains_profit_from_the_union_bound():
    constants = Constants(gain=1e-3, sigma=1.0, dimension=1)
    tube = tune_tube(constants, horizon=10, delta=1e-3)
    assert tube.method == "prop3_sharp"
    assert bound_exit_probability(constants, horizon=10, clearance=tube.maximum) < -3 + 0.01


def test_in_discrete_time_a_piece_counts_at_its_own_whole_steps_only():
    base = bound_exit_probability(CHAIN, horizon=6, clearance=9.0)
    hollow = ((0, 2.2, 2.8, 6), (9.0, 0.01, 9.0))  # no whole step in [2.2, 2.8)
    assert base - 0.3 < bound_exit_probability(CHAIN, horizon=6, clearance=hollow) < base + 0.05
    assert bound_exit_probability(CHAIN, horizon=6, clearance=((0, 2, 2.8, 6), (9.0, 0.01, 9.0))) > -0.01


@pytest.mark.parametrize(
    "profile",
    [
        ((0, 1, 2, 3), (30.0, 30.0, 3.0)),
        ((0, 1, 2, 3), (math.inf, math.inf, 3.0)),
        ((0, 1.5, 2, 7), (30.0, 40.0, 3.0)),
        ((0, 1.5, 2), (30.0, 3.0)),
        ((0, 2, 3), (30.0, 3.0)),
    ],
)
def test_a_clearance_that_shrinks_at_the_horizon_counts_there(profile):
    walk, motion = Constants(gain=1.0, sigma=1.0, dimension=1), Constants(rate=1e-15, sigma=1.0, dimension=1)
    truth = math.log10(math.erfc(3 / 2))  # P(|S_2| > 3), of variance 2
    assert bound_exit_probability(walk, horizon=2, clearance=profile) > truth
    assert bound_exit_probability(motion, horizon=2.0, clearance=profile) > truth
    tube = tune_tube(walk, horizon=2, delta=1e-3, objective=profile)
    assert tube.bound(0, 2) < 12


def test_a_profile_that_ends_at_the_horizon_is_kept_as_it_is_in_continuous_time():
    held = read_clearance(((0.0, 0.3, 0.7), (5.0, 2.0)), 0.7, continuous=True)
    assert (held.times.tolist(), held.values.tolist()) == ([0.0, 0.3, 0.7], [5.0, 2.0])


def test_a_clearance_that_grows_beyond_the_horizon_changes_nothing():
    constants = Constants(gain=1.0, sigma=1.0, dimension=1)
    short = bound_exit_probability(constants, horizon=2, clearance=((0, 1, 2), (30.0, 3.0)))
    assert bound_exit_probability(constants, horizon=2, clearance=((0, 1, 2, 3), (30.0, 3.0, 9.0))) == short


def test_a_short_narrow_piece_counts_in_continuous_time():
    wide = bound_exit_probability(OU, horizon=5.0, clearance=2.0)
    narrow = bound_exit_probability(OU, horizon=5.0, clearance=((0, 2.2, 2.2001, 5), (2.0, 0.9, 2.0)))
    assert narrow > wide / 2
    truth = math.log10(math.erfc(0.9 / math.sqrt(2 * 0.1 * (1 - math.exp(-2.2)))))
    assert narrow > truth  # P(|S_t| > .9) at that time alone


@pytest.mark.parametrize("factor", [30.0, 1e3, 1e6, 1e12, 1e100])
def test_far_clearances_are_answered_quickly_and_fall_to_the_floor(factor):
    for constants in (OU, CHAIN, Constants(rate=0.3, sigma=1.0, dimension=6)):
        begin = time.perf_counter()
        got = bound_exit_probability(constants, horizon=4, clearance=factor)
        assert time.perf_counter() - begin < 2.0
        variance = make_schedule(constants, 4).nodes[1][-1] * make_schedule(constants, 4).unit ** 2
        gaussian = factor**2 / (2 * float(variance) * math.log(10))
        assert -1e12 <= got <= max(-1e12, -0.6 * gaussian)


def test_levels_fall_with_the_clearance_without_a_gap():
    levels = [bound_exit_probability(OU, horizon=5.0, clearance=float(r)) for r in np.geomspace(0.5, 1e4, 13)]
    assert np.all(np.diff(levels) <= 1e-9)


def test_a_start_in_the_middle_of_the_clearance_costs():
    base = bound_exit_probability(OU, horizon=5.0, clearance=1.5)
    offset = bound_exit_probability(OU, horizon=5.0, clearance=1.5, start=Start(offset=0.3))
    assert base < offset < 0
    tube = kummer_tube(OU, horizon=5.0, delta=1e-3, a=0.3, v0=0.1, start=Start(offset=0.3))
    assert level(OU, 5.0, tube.maximum, a=0.3, v0=1.0, start=Start(offset=0.3)) <= -3 + 0.01


@pytest.mark.parametrize(
    ("clearance", "message"),
    [
        (0.0, "`clearance` must be positive everywhere"),
        (-1.0, "`clearance` must be positive everywhere"),
        (math.nan, "`clearance` must be positive everywhere"),
        (lambda t: 1.0, "got a callable"),
        (np.ones(3), r"a number or a pair \(times, values\), got shape \(3,\)"),
        ((0.0, 1.0, 2.0), "got 3 entries"),
        (((0.0, 2.0, 1.0, 5.0), (1.0, 1.0, 1.0)), "must rise strictly"),
    ],
)
def test_clearances_that_make_no_sense_are_refused(clearance, message):
    with pytest.raises((ValueError, TypeError), match=message):
        bound_exit_probability(OU, horizon=5.0, clearance=clearance)


def test_a_floor_without_a_slope_is_not_carried_to_places_that_only_balls_tell_from_it():
    with precision():
        tangents, touched = Tangents(arb(0), 1.0, False), arb(1e12)
        assert tangents.touch(touched)
        before = touched * (1 - arb(2) ** -56)
        assert float(before.log()) == float(touched.log())
        truth = excess_floor(arb(0), arb(1), before)
        assert tangents.floor(before)[0] <= truth < tangents.floor(touched)[0]
        assert tangents.floor(touched)[1] == 0.0
        assert tangents.touch(before)
        assert 0 < tangents.floor(before)[0] < tangents.floor(touched)[0]


@pytest.mark.parametrize("seed", range(20))
def test_the_union_is_left_out_only_where_it_would_not_help(seed):
    rng = np.random.default_rng(seed)
    pieces = int(rng.integers(1, 7))
    times = np.cumsum(np.append(0, rng.integers(1, 12, pieces))).astype(float)
    constants = Constants(
        gain=rng.uniform(0.1, 1.05, pieces), sigma=rng.uniform(0.2, 1.5, pieces), dimension=int(rng.integers(1, 6)),
        times=times,
    )  # fmt: skip
    schedule = make_schedule(constants, times[-1])
    held = read_clearance((times, rng.uniform(1.5, 9.0, pieces)), times[-1])
    cut = schedule.refined(held.ends(schedule))
    found = union_level(cut, held)
    assert union_may_help(cut, held, found + 1e-9) or found == 0
    assert not union_may_help(cut, held, -300.0) or found < -250
