"""The best tube: never worse than any other, near the best of a dense grid, and defined for every input."""

from __future__ import annotations

import contextlib
import math
from dataclasses import replace

import numpy as np
import pytest

from certbound.tubes.constants import Constants
from certbound.tubes.kummer.profile import kummer_tube
from certbound.tubes.kummer.search import Search
from certbound.tubes.objective import make_objective
from certbound.tubes.question import Start
from certbound.tubes.tuning import METHODS, applicable_methods, bound_exit_probability, tube_objective, tune_tube

OU = Constants(rate=-0.5, sigma=0.1**0.5, dimension=1)
CHAIN = Constants(gain=0.8, sigma=1.0, dimension=3)
WALK = Constants(rate=0.0, sigma=1.0, dimension=2)
MOVING = Constants(
    rate=np.array([0.4, -1.0, -0.2]), sigma=np.array([0.5, 1.0, 0.7]), dimension=2, times=[0.0, 1.0, 2.5, 4.0]
)


def tune(constants=OU, **changes):
    return tune_tube(constants, **{"horizon": 4.0, "delta": 1e-3, **changes})


@pytest.mark.parametrize("constants", [OU, CHAIN, WALK, MOVING, Constants(gain=0.1, sigma=1.0, dimension=1)])
@pytest.mark.parametrize("objective", ["max", "final", ((0.0, 2.0, 4.0), (1.0, 2.0))])
def test_auto_is_at_most_every_other_method(constants, objective):
    goal = make_objective(objective, 4.0)
    best = tube_objective(tune(constants, objective=objective), goal)
    for method in applicable_methods(constants):
        assert best <= tube_objective(tune(constants, objective=objective, method=method), goal) * (1 + 1e-9)


@pytest.mark.parametrize("constants", [OU, CHAIN, MOVING])
def test_the_kummer_search_is_optimal_against_a_dense_grid(constants):
    from certbound.tubes.schedule import make_schedule

    schedule = make_schedule(constants, 4.0)
    search = Search(
        schedule=schedule.graded(6), kind="scale", weights=np.ones(len(schedule.graded(6).times)),
        log_delta=math.log(1e-3),
    )  # fmt: skip
    found = search.scale(*search.solve())
    powers = np.concatenate([[0.0], np.geomspace(1e-2, 20, 12)])
    dense = min(search.scale(float(a), float(v)) for a in powers for v in np.geomspace(1e-2, 20, 16))
    assert found <= dense * (1 + 1e-6)


@pytest.mark.parametrize("seed", range(6))
def test_several_deciding_nodes_do_not_stop_the_search_early(seed):
    rng = np.random.default_rng(seed)
    pieces, horizon = 6, 30.0
    constants = Constants(
        gain=rng.uniform(0.3, 1.1, pieces), sigma=rng.uniform(0.1, 2.0, pieces), dimension=int(rng.integers(1, 6)),
        times=np.linspace(0.0, horizon, pieces + 1),
    )  # fmt: skip
    goal = make_objective(((0.0, 8.0, 21.0, horizon), tuple(rng.uniform(0.8, 2.5, 3))), horizon)
    tube = tune_tube(constants, horizon=horizon, delta=1e-3, method="kummer", objective=goal.given)
    found = tube_objective(tube, goal)
    a, v0 = tube.parameters["a"], tube.parameters["v0"]
    near = [
        kummer_tube(constants, horizon=horizon, delta=1e-3, a=math.expm1(math.log1p(a) * x), v0=v0 * y)
        for x in (0.8, 0.9, 0.97, 1.0, 1.03, 1.1, 1.2)
        for y in (0.7, 0.9, 0.97, 1.0, 1.03, 1.1, 1.4)
    ]
    assert found <= min(tube_objective(other, goal) for other in near) * (1 + 1e-3)


def test_the_step_after_the_start_is_not_forgotten():
    # judged at the ends of long pieces alone, a huge v_0 costs nothing
    constants = Constants(gain=[0.3] * 6, sigma=[1.0] + [0.2] * 5, dimension=2, times=np.arange(7) * 10.0)
    tube = tune_tube(constants, horizon=60, delta=1e-3, method="kummer", objective=((0.0, 10.0, 60.0), (1.0, 0.5)))
    assert tube.maximum <= 12.0


@pytest.mark.parametrize("horizon", [2.0, 50.0, 330.0, 1000.0, 1e6])
@pytest.mark.parametrize("rate", [-1.0, -30.0])
def test_the_final_radius_is_the_sharp_one_time_bound_however_long_the_contraction(horizon, rate):
    constants = Constants(rate=rate, sigma=1.0, dimension=3, effective_dimension=2.0)
    found = tune(constants, horizon=horizon, objective="final")
    single = tune(constants, horizon=horizon, method="prop1_sharp").radius(horizon)
    # Mbar = 1 + (A_0 - 1)/delta against (e^k - 1)/(Phi - 1): the same number
    assert found.bound(horizon, horizon) == pytest.approx(single, rel=1e-6)


def test_the_final_radius_in_discrete_time_and_after_a_change_of_sign():
    chain = Constants(gain=0.5, sigma=1.0, dimension=2)
    found = tune(chain, horizon=5000, objective="final").radius(5000)
    assert found == pytest.approx(tune(chain, horizon=5000, method="prop2_sharp").radius(5000), rel=1e-6)
    late = Constants(rate=[-1.0, -2.0, 0.3], times=[0.0, 300.0, 700.0, 701.0], sigma=1.0, dimension=2)
    found = tune(late, horizon=701.0, objective="final").radius(701.0)
    assert found == pytest.approx(tune(late, horizon=701.0, method="prop1_sharp").radius(701.0), rel=1e-6)


def test_a_clearance_profile_is_met_at_the_scale_that_is_reported():
    profile = ((0.0, 1.0, 4.0), (0.4, 0.9))
    tube = tune(MOVING, objective=profile)
    scale = tube_objective(tube, make_objective(profile, 4.0))
    t = np.linspace(0, 4, 401)
    held = np.where(t < 1, 0.4, 0.9)
    assert np.all(tube.radius(t) <= scale * held * (1 + 1e-12))
    assert np.max(tube.radius(t) / held) >= scale * (1 - 1e-3)


def test_everything_worse_makes_the_largest_radius_larger():
    base = tune().maximum
    for worse in (tune(delta=1e-4), tune(horizon=6.0), tune(replace(OU, sigma=0.4)), tune(replace(OU, rate=-0.4))):
        assert worse.maximum > base
    assert tune(replace(CHAIN, effective_dimension=1.5), horizon=9).maximum < tune(CHAIN, horizon=9).maximum


def test_bounded_noise_cuts_the_tube_at_the_almost_sure_bound():
    constants = Constants(gain=0.5, sigma=1 / 3**0.5, dimension=1, noise_bound=1.0)
    tube = tune(constants, horizon=30, delta=1e-6)
    assert tube.maximum <= 2.0 * (1 + 1e-12)
    assert tune(replace(constants, noise_bound=None), horizon=30, delta=1e-6).maximum > 2.5
    assert tune(constants, horizon=30, method="prop2").maximum > 2.5  # a one-time bound is left as it is


EXTREMES = [
    Constants(rate=-1e3, sigma=1.0, dimension=3),
    Constants(rate=-1e-17, sigma=1.0, dimension=1000),
    Constants(rate=0.0, sigma=1e-150, dimension=1, effective_dimension=0.3),
    Constants(rate=1e-17, sigma=1e150, dimension=6, effective_dimension=2.5),
    Constants(gain=1 - 1e-12, sigma=1.0, dimension=1),
    Constants(gain=1e-300, sigma=1.0, dimension=3),
    Constants(gain=1 + 1e-12, sigma=1.0, dimension=1000, effective_dimension=0.7),
]


@pytest.mark.parametrize("constants", EXTREMES)
def test_extreme_constants_give_finite_tubes_and_levels(constants):
    horizons = (1e-12, 1e9) if constants.continuous else (1, 10**6)
    for horizon in horizons:
        for delta in (0.5, 1e-12, 1e-300):
            tube = tune(constants, horizon=horizon, delta=delta)
            assert 0 < tube.maximum < math.inf
            for factor in (1.2, 1e9):
                level = bound_exit_probability(constants, horizon=horizon, clearance=factor * tube.maximum)
                assert -1e12 <= level <= 0.97 * math.log10(delta)


def test_an_expansion_beyond_all_floats_is_infinite_and_no_error():
    constants = Constants(rate=10.0, sigma=1.0, dimension=2)
    assert tune(constants, horizon=1e9).maximum == math.inf
    assert bound_exit_probability(constants, horizon=1e9, clearance=1.0) == 0.0


def test_without_noise_the_radius_is_zero():
    still = Constants(rate=-1.0, sigma=0.0, dimension=2)
    assert tune(still).maximum == 0.0
    assert bound_exit_probability(still, horizon=4.0, clearance=0.1) == -1e12


def test_printed_and_one_time_variants_are_never_chosen():
    for constants in (OU, CHAIN, WALK):
        names = applicable_methods(constants)
        assert not any("printed" in name or name.startswith(("prop1", "prop2", "markov")) for name in names)
        assert tune(constants).level == "trajectory"
        assert tune(constants).certified


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "thm9"}, r"`method` must be one of auto, kummer.*got 'thm9'"),
        ({"delta": 0.0}, r"`delta` must lie in \(0, 1\), got 0.0"),
        ({"delta": 1.5}, r"`delta` must lie in \(0, 1\), got 1.5"),
        ({"horizon": 0.0}, "`horizon` must be positive and finite, got 0"),
        ({"horizon": math.inf}, "`horizon` must be positive and finite, got inf"),
        ({"epsilon": 0.5}, "`epsilon` and `step` belong to the paper's methods"),
        ({"method": "thm3", "epsilon": 1.0}, r"`epsilon` must lie in \(0, 1\), got 1.0"),
        ({"method": "thm3", "step": 0.0}, r"`step` must lie in \(0, 4\], got 0.0"),
        ({"method": "thm3", "step": 9.0}, r"`step` must lie in \(0, 4\], got 9.0"),
        ({"objective": "least"}, "`objective` must be 'max', 'final', 'mean' or a pair"),
        ({"objective": lambda t: 1.0}, "nothing can be proved between"),
        ({"objective": ((0.0, 4.0), (0.0,))}, "must be positive everywhere, its least value is 0"),
        ({"objective": ((0.0, 3.0), (1.0,))}, "must rise strictly from 0 to the horizon 4 or beyond"),
        ({"objective": ((0.0, 2.0, 4.0), (1.0,))}, "one entry more in times than in values"),
        ({"method": "thm3", "start": Start(offset=0.1)}, "`start` needs `method` 'auto', 'kummer' or 'bessel'"),
        ({"method": "exact"}, "'exact' needs `isotropic=True`"),
        ({"method": "thm4"}, "needs constants with `gain`"),
    ],
)
def test_questions_that_make_no_sense_are_refused(options, message):
    with pytest.raises((ValueError, TypeError), match=message):
        tune(**options)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Constants(rate=-1.0, sigma=math.nan, dimension=1), "`sigma` must be finite"),
        (lambda: Constants(rate=-1.0, sigma=-1.0, dimension=1), "`sigma` must not be negative"),
        (lambda: Constants(rate=[-1.0, 0.0], sigma=1.0, dimension=1, times=[0.0, 1.0]), "`rate` must be 1 values"),
        (lambda: Constants(rate=-1.0, gain=0.5, sigma=1.0, dimension=1), "exactly one of `rate`"),
        (lambda: tune(CHAIN, horizon=2.5), "`horizon` must be a whole number of steps"),
        (lambda: tune(MOVING, horizon=5.0), "`horizon` must not exceed the last entry of `times`"),
        (lambda: tune(CHAIN, horizon=4, method="thm5", step=1.5), "`step` must be a whole number"),
        (lambda: tune(CHAIN, horizon=4, method="worst_case"), "'worst_case' is for continuous time"),
        (lambda: tune(replace(CHAIN, gain=1.1), method="thm5"), "needs gain < 1.*Thm 4 applies: use 'thm4'"),
        (lambda: tune(WALK, method="thm3"), "needs rate < 0.*Thm 2 applies: use 'thm2'"),
        (lambda: tune(replace(OU, sigma=0.0), method="mixture"), "'mixture' needs noise"),
    ],
)
def test_constants_that_make_no_sense_are_refused(build, message):
    with pytest.raises((ValueError, RuntimeError), match=message):
        build()


@pytest.mark.parametrize("method", [m for m in METHODS if m not in ("mixture", "exact", "worst_case")])
def test_every_method_name_is_served_in_continuous_or_in_discrete_time(method):
    served = []
    for constants in (OU, Constants(gain=0.8, sigma=1.0, dimension=1)):
        with contextlib.suppress(ValueError):
            served.append(tune(constants, method=method).method)
    assert served in ([method], [method, method], ["kummer", "kummer"]) or method == "auto"
