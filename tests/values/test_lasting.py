"""Infinite horizons where failing is not certain: closed forms, simulation, refusals."""

import json
import math

import numpy as np
import pytest
from scipy.integrate import quad

import certbound as cb
from certbound.checker import check_data
from certbound.cli.commands.check import proved_certificate
from certbound.errors import InfeasibleError
from certbound.values.chains import bound_by_drift, bound_drifting
from certbound.values.continuous import bound_lasting

HALF = [cb.Inside(cb.HalfSpace([-1.0], 0.0))]


def drifting(f, g=1.0, **options):
    system = cb.ContinuousSystem(f, states=["x"], diffusion=g)
    return cb.Problem(system, **({"initial": [1.0], "safe": HALF, "horizon": math.inf} | options))


def hit(f, g, start, low, high):
    """P(at low before high), by the scale function."""

    def falls(x):
        return math.exp(-quad(lambda y: 2 * f(y) / g(y) ** 2, low, x)[0])

    return quad(falls, start, high)[0] / quad(falls, low, high)[0]


@pytest.mark.parametrize("start", [0.01, 1.0, 200.0])
def test_brownian_motion_with_drift_hits_a_barrier_with_the_exponential(start):
    found = bound_lasting(drifting(lambda x: 0 * x + 1.0, initial=[start]))
    assert found.lower <= -2 * start <= found.upper
    assert found.upper - found.lower < 2e-4 * max(1.0, start)
    mirrored = drifting(lambda x: 0 * x - 1.0, initial=[-start], safe=[cb.Inside(cb.HalfSpace([1.0], 0.0))])
    assert bound_lasting(mirrored).upper == pytest.approx(found.upper, rel=1e-9)


def test_geometric_growth_falls_to_a_level_with_a_power():
    safe = [cb.Inside(cb.HalfSpace([-1.0], -1.0))]
    found = bound_lasting(drifting(lambda x: 0.1 * x, lambda x: [[0.2 * x[0]]], initial=[2.0], safe=safe))
    assert found.lower <= -4 * math.log(2) <= found.upper < found.lower + 0.005
    assert found.tail[0] == "power"


def test_what_grows_by_itself_leaves_with_an_error_function():
    found = bound_lasting(drifting(lambda x: x))
    assert found.lower <= math.log(math.erfc(1.0)) <= found.upper < found.lower + 0.001


@pytest.mark.parametrize("seed", range(6))
def test_a_target_is_met_or_missed_as_the_scale_function_says(seed):
    rng = np.random.default_rng(seed)
    a, b, c, d = rng.uniform(-1.0, 1.0, 4)
    s = float(rng.uniform(0.3, 1.0))
    start, goal = 1.0 + 0.5 * d, 2.0 + rng.uniform(0, 1)
    problem = drifting(
        lambda x: a + b * np.sin(2 * x) + c * x, lambda x: [[s * (1 + 0.2 * np.cos(x[0]))]], initial=[start],
        reach=cb.Reach(cb.Box([goal], [goal + 1])),
    )
    truth = hit(lambda x: a + b * math.sin(2 * x) + c * x, lambda x: s * (1 + 0.2 * math.cos(x)), start, 0.0, goal)
    found = bound_lasting(problem)
    assert found.lower <= math.log(truth) <= found.upper < found.lower + 0.02
    verdict = cb.verify_safety(problem.replace(delta=min(max(truth / 1.3, 1e-9), 0.9)))
    assert verdict.status in ("UNSAFE", "UNSAFE_NOMINAL")


def test_every_disturbance_counts():
    system = cb.ContinuousSystem(
        lambda x, d: [1.0 + d[0]], states=["x"], diffusion=1.0, disturbance=cb.Box([-0.2], [0.2])
    )
    problem = drifting(lambda x: x, reach=cb.Reach(cb.Box([3.0], [4.0]))).replace(system=system)
    found = bound_lasting(problem)
    worst, best = ((math.exp(-2 * u) - math.exp(-6 * u)) / (1 - math.exp(-6 * u)) for u in (0.8, 1.2))
    assert math.log(worst) <= found.upper < math.log(worst) + 1e-6
    assert math.log(best) - 1e-6 < found.lower <= math.log(best)


def test_a_long_horizon_is_bounded_by_an_infinite_one():
    problem = drifting(lambda x: 0 * x + 1.0, initial=[5.0], horizon=1e9, delta=1e-4)
    assert cb.verify_safety(problem).status == "SAFE"  # by whoever comes first
    verdict = cb.verify_safety(problem, method="values")
    assert verdict.status == "SAFE"
    assert -10.001 < verdict.log10_delta * math.log(10) < -9.999


@pytest.mark.parametrize(
    ("problem", "match"),
    [
        (drifting(lambda x: 0 * x - 1.0), "no drift was found"),
        (drifting(lambda x: np.sin(x)), "a polynomial"),
        (drifting(lambda t, x: 1 + np.sin(t) + 0 * x), "does not depend on time"),
        (drifting(lambda x: 1 - 0 * x, lambda x: [[1.5 - x[0]]], reach=cb.Reach(cb.Box([2.0], [4.0]))), "vanishes"),
        (drifting(lambda x: 1 - 0 * x, reach=cb.Reach(cb.Box([0.1], [0.5]))), "starts between the target and a limit"),
        (drifting(lambda x: 1 - 0 * x, safe=[cb.Inside(cb.Box([0.0], [2.0]))]), "a limit on one side only"),
    ],
)
def test_what_is_not_served_is_refused(problem, match):
    with pytest.raises(InfeasibleError, match=match):
        bound_lasting(problem)


def test_what_is_proved_from_below_is_of_a_point_that_surely_is_a_start():
    """The ends of a ball's box are starts up to a rounding only."""
    system = cb.ContinuousSystem(lambda x: 0 * x + 1.0, states=["x"], diffusion=1.0)
    bounds = [
        bound_lasting(cb.Problem(system, initial=start, safe=HALF, horizon=math.inf))
        for start in (cb.Box([2.0], [3.0]), cb.Ball([2.5], 0.5))
    ]
    assert bounds[0].lower - 1e-6 < bounds[1].lower < bounds[0].lower - 1e-10
    assert bounds[1].upper == pytest.approx(bounds[0].upper, abs=1e-12)


def walk(step, **options):
    system = cb.DiscreteSystem(step, states=["x"], noise=cb.Gaussian(std=0.5))
    return cb.Problem(system, **({"initial": [1.0], "safe": HALF, "horizon": math.inf} | options))


@pytest.mark.parametrize("step", [lambda x: x + 0.3, lambda x: 1.1 * x + 0.2])
def test_walks_that_drift_away_are_bounded_from_both_sides(step):
    found, drift = bound_drifting(walk(step), seconds=2.0)
    rng, x = np.random.default_rng(1), np.full(60_000, 1.0)
    out = np.zeros(len(x), dtype=bool)
    for _ in range(100):
        x = step(x) + 0.5 * rng.standard_normal(len(x))
        out |= x < 0
    error = 4 * math.sqrt(out.mean() / len(x))
    assert found.lower - error < out.mean() < found.upper + error
    assert found.upper < 1.05 * found.lower
    assert math.exp(drift.log) > found.upper


def test_a_walk_without_drift_has_no_bound_below_1():
    with pytest.raises(InfeasibleError, match="no drift leads away"):
        bound_by_drift(walk(lambda x: 1.0 * x))
    with pytest.raises(InfeasibleError, match="on one side only"):
        bound_by_drift(walk(lambda x: x + 0.3, safe=[cb.Inside(cb.Box([0.0], [9.0]))]))


@pytest.mark.parametrize("system", [drifting(lambda x: 0 * x + 0.5).system, cb.DiscreteSystem(
    lambda x: x + 0.5, states=["x"], noise=cb.Gaussian(std=1.0))])  # fmt: skip
def test_a_half_line_to_keep_out_of_is_a_limit(system):
    kept, left = ([one] for one in (cb.Outside(cb.HalfSpace([1.0], 0.0)), HALF[0]))
    bound = bound_lasting if system.time == "continuous" else bound_by_drift
    asked = drifting(lambda x: 0 * x + 0.5, safe=kept, delta=0.5).replace(system=system)
    found, same = bound(asked), bound(asked.replace(safe=left))
    assert vars_of(found) == vars_of(same)
    verdict = cb.verify_safety(asked, method="values")
    data = json.loads(proved_certificate(asked, verdict))
    assert check_data(data).log10_proved == pytest.approx(-math.log10(math.e), rel=1e-6)
    data["problem"]["constraints"][0]["region"]["bound"] = (0.1).hex()
    assert not check_data(data).valid


def vars_of(found):
    return [getattr(found, name) for name in ("upper", "lower", "rate", "limit", "log") if hasattr(found, name)]


def test_an_obstacle_that_begins_where_the_target_does_is_not_forgotten():
    asked = drifting(lambda x: 0 * x + 0.5, reach=cb.Reach(cb.HalfSpace([-1.0], -3.0)), delta=0.5)
    verdict = cb.verify_safety(asked, method="values")
    data = json.loads(proved_certificate(asked, verdict))
    assert check_data(data).valid
    region = {"kind": "halfspace", "normal": [(-1.0).hex()], "bound": (-3.0).hex()}
    data["problem"]["constraints"].append({"kind": "outside", "region": region, "during": None, "label": "x < 3"})
    assert not check_data(data).valid
    with pytest.raises(InfeasibleError, match="no obstacles"):
        bound_lasting(asked.replace(safe=[*HALF, cb.Outside(cb.HalfSpace([-1.0], -4.0))]))
