"""Problems with a target: bounds against simulation, the noise-free path that misses, certificates, and bad input."""

import contextlib

import numpy as np
import pytest
from scipy.stats import norm

import certbound as cb
from certbound.checker import check_data, parse
from certbound.cli.commands.check import proved_certificate
from certbound.errors import CertificateError, InfeasibleError
from certbound.problem.goals import met_at, until
from certbound.safety.certificate import certificate_data, problem_data

WALL, TARGET = cb.Inside(cb.Box([-1.0], [1.0])), cb.Box([-0.2], [0.2])


def walk(reach=TARGET, *, start=(0.8,), drift=0.7, std=0.1, horizon=6, delta=0.05, **more):
    system = cb.DiscreteSystem(lambda x: drift * x, states=["x"], noise=cb.Gaussian(std=std))
    more |= {"safe": [WALL], "reach": reach, "horizon": horizon, "delta": delta, "name": "walk"}
    return cb.Problem(system, initial=start, **more)


def failures(problem, paths=100_000):
    """How many paths of NumPy's own fail, by what the definition says."""
    rng, count = np.random.default_rng(1), np.zeros(paths, dtype=bool)
    first, last = problem.reach.during or (0, problem.horizon)
    x = np.full(paths, problem.initial.middle[0])
    failed, done = np.zeros(paths, dtype=bool), count
    for t in range(int(problem.horizon) + 1):
        failed |= ~done & (np.abs(x) > 1)
        if first <= t <= last:
            done = done | (~failed & (np.abs(x) <= 0.2))
        x = 0.7 * x + float(problem.system.noise.std[0]) * rng.standard_normal(paths)
    return np.mean(~done)


@pytest.mark.parametrize("during", [None, (3, 5), (0, 4), (5, 5)])
def test_the_bounds_hold_what_a_simulation_of_its_own_finds(during):
    problem = walk(cb.Reach(TARGET, during), std=0.2)
    verdict = cb.verify_safety(problem, method="values")
    truth = failures(problem)
    error = 4 * np.sqrt(truth / 100_000)
    assert 10**verdict.log10_lower <= truth + error
    assert truth - error <= 10**verdict.log10_delta <= 1.05 * 10**verdict.log10_lower
    counted = cb.simulate_exits(problem, paths=100_000, rng=2, halve=False)
    assert abs(counted.probability - truth) < 2 * error
    assert sum(counted.by_constraint.values()) == counted.exits
    assert list(counted.by_constraint)[-1].startswith("not in time: reach")


def test_starts_in_the_target_have_not_failed():
    inside = cb.verify_safety(walk(start=cb.Box([-0.2], [0.1])), method="values")
    assert 10**inside.log10_delta < 1e-290
    assert cb.simulate_exits(walk(start=(0.1,)), paths=100, rng=0, halve=False).exits == 0
    later = walk(cb.Reach(TARGET, (1, 6)), start=(0.1,), std=0.3)
    assert cb.verify_safety(later, method="values").log10_lower > -3
    assert cb.simulate_exits(later, paths=10_000, rng=0, halve=False).exits > 0


def test_a_wider_target_and_a_longer_time_are_never_worse():
    bounds = [
        cb.verify_safety(walk(reach, std=0.2, horizon=horizon), method="values").log10_delta
        for reach, horizon in ((cb.Box([-0.1], [0.1]), 5), (TARGET, 5), (TARGET, 7))
    ]
    assert bounds[0] > bounds[1] > bounds[2]


def test_other_engines_meet_the_target_at_one_time_and_prove_less():
    problem = walk(std=0.05, horizon=8)
    exact = cb.verify_safety(problem, method="values")
    linear = cb.verify_safety(problem, method="linear")
    assert exact.log10_lower < linear.log10_delta < -1.5
    assert linear.log10_lower is None  # of one way of not failing no lower bound follows
    assert "one way of not failing" in linear.reason


def test_where_the_target_counts_at_one_time_the_problem_is_a_plain_one():
    problem = walk(cb.Reach(TARGET, (6, 6)), std=0.1)
    plain = met_at(problem, 6)
    assert plain.reach is None
    for method in ("values", "linear"):
        mine, theirs = (cb.verify_safety(one, method=method) for one in (problem, plain))
        assert (mine.log10_delta, mine.log10_lower) == (theirs.log10_delta, theirs.log10_lower)


def test_what_is_asked_after_the_target_does_not_count():
    late = cb.Inside(cb.Box([5.0], [6.0]), during=(6, 6))
    half = cb.Inside(cb.Box([-0.9], [0.95]), during=(0, 4))
    problem = walk(cb.Reach(TARGET, (5, 5))).replace(safe=[WALL, late, half])
    kept = until(problem, 5).safe
    assert [(c.label, c.during) for c in kept] == [("-1 <= x <= 1", None), ("-0.9 <= x <= 0.95", (0.0, 4))]
    assert cb.verify_safety(problem, method="linear").log10_delta < 0


@pytest.mark.parametrize("time", ["discrete", "continuous"])
def test_a_noise_free_path_that_misses_is_unsafe(time):
    if time == "discrete":
        problem = walk(horizon=3)
    else:
        system = cb.ContinuousSystem(lambda x: -x, states=["x"], diffusion=[[0.01]])
        problem = cb.Problem(system, initial=[0.8], safe=[WALL], reach=TARGET, horizon=1.3)
    verdict = cb.verify_safety(problem, time_limit=1)
    assert verdict.status == "UNSAFE_NOMINAL"
    assert "does not 'reach -0.2 <= x <= 0.2' by" in verdict.reason
    near = cb.verify_safety(problem.replace(reach=cb.Box([-0.2], [0.3]), delta=0.9))
    assert near.status != "UNSAFE_NOMINAL"


def test_a_path_that_breaks_a_constraint_first_misses_and_one_that_does_so_later_does_not():
    system = cb.DiscreteSystem(lambda x: x + 0.3, states=["x"], noise=cb.Gaussian(std=1e-3))
    problem = cb.Problem(system, initial=[0.0], safe=[WALL], reach=cb.Box([0.5], [0.7]), horizon=10)
    assert cb.verify_safety(problem).status == "SAFE"  # at 0.6 after two steps, and out of the wall after four
    gap = cb.Outside(cb.Box([0.2], [0.4]), during=(1, 10))
    verdict = cb.verify_safety(problem.replace(safe=[WALL, gap]))
    assert verdict.status == "UNSAFE_NOMINAL"
    assert "before it is in the target" in verdict.reason


def test_a_certificate_names_the_time_and_its_forged_twins_are_refused():
    problem = walk(std=0.03, horizon=8)
    verdict = cb.verify_safety(problem, method="linear")
    text = proved_certificate(problem, verdict)
    report = check_data(parse(text), problem_data(problem))
    assert report.valid
    assert "before it is in its target" in report.claim
    for place, forged in (("time", (4.0).hex()), ("time", (9.0).hex()), ("time", (2.5).hex())):
        data = parse(text)
        data["proof"][place] = forged
        _refused(data)
    data = parse(text)
    data["proof"], data["claim"]["method"] = data["proof"]["proof"], "linear"
    _refused(data)
    data = parse(text)
    data["problem"]["reach"]["during"] = [(0.0).hex(), (2.0).hex()]
    _refused(data)
    assert not check_data(parse(text), problem_data(problem.replace(reach=cb.Box([-0.3], [0.2])))).valid
    assert not check_data(parse(text), problem_data(problem.replace(reach=None))).valid


def _refused(data):
    with contextlib.suppress(CertificateError):
        assert not check_data(data).valid


def test_value_functions_of_targets_in_continuous_time_are_stated_in_certificates():
    system = cb.ContinuousSystem(lambda x: -x, states=["x"], diffusion=0.3)
    problem = walk(reach=TARGET, horizon=2.0).replace(system=system, delta=0.9)
    text = cb.verify_safety(problem, method="values").certificate_text(problem)
    assert check_data(parse(text)).valid


def test_targets_that_cannot_be_met_are_refused():
    with pytest.raises(ValueError, match="must meet the safe set, but the target lies wholly where '-1 <= x <= 1'"):
        walk(cb.Box([1.2], [1.5]))
    with pytest.raises(ValueError, match=r"lies wholly where 'outside -0.5 <= x <= 0.5'"):
        walk().replace(safe=[cb.Outside(cb.Box([-0.5], [0.5]))])
    with pytest.raises(ValueError, match="`reach` must have `during` within"):
        walk(cb.Reach(TARGET, (2, 9)))
    with pytest.raises(ValueError, match="a time after 0"):
        walk(cb.Reach(TARGET, (0, 0)))
    with pytest.raises(ValueError, match="whole steps"):
        walk(cb.Reach(TARGET, (0, 2.5)))
    with pytest.raises(TypeError, match="give it as `reach=`"):
        walk().replace(safe=[cb.Reach(TARGET)])
    with pytest.raises(TypeError, match=r"must be cb\.Reach or a set"):
        walk(cb.Inside(TARGET))
    with pytest.raises(ValueError, match=r"`reach` must have dimension 1"):
        walk(cb.Box([0, 0], [1, 1]))


def test_what_does_not_know_targets_says_so():
    problem = walk()
    with pytest.raises(InfeasibleError, match="the problem has a target"):
        _ = problem.constraints
    with pytest.raises(InfeasibleError, match="the problem has a target"):
        cb.bound_metrics(problem)
    with pytest.raises(InfeasibleError, match="the problem has a target"):
        cb.verify_safety(problem, method="values").safe_starts()


def test_to_arrive_by_some_time_is_to_arrive_at_any():
    system = cb.ContinuousSystem(lambda x: -x, states=1, diffusion=0.01)
    problem = cb.Problem(
        system, initial=[0.5], safe=[cb.Inside(cb.Ball([0], 2))], horizon=np.inf, reach=cb.Ball([0], 0.2),
    )  # fmt: skip
    verdict = cb.verify_safety(problem, method="linear")
    assert verdict.status == "SAFE"
    assert 2 <= verdict.answers["linear"].hit <= 64
    assert verdict.log10_lower is None
    assert verdict.certificate["proof"]["engine"] == "reach"  # met at one time
    assert cb.verify_safety(problem.replace(reach=None), method="linear").status == "UNKNOWN"


def test_a_target_on_an_orbit_is_met_at_the_first_pass():
    """After 5 of 10 steps a turn, and after no power of two."""
    c, s = np.cos(np.pi / 5), np.sin(np.pi / 5)
    system = cb.DiscreteSystem(lambda x: [c * x[0] - s * x[1], s * x[0] + c * x[1]], states=2,
                               noise=cb.Gaussian(std=0.01))  # fmt: skip
    problem = cb.Problem(system, initial=[1, 0], safe=[cb.Inside(cb.Ball([0, 0], 2))], horizon=np.inf,
                         reach=cb.Ball([-1, 0], 0.2))  # fmt: skip
    verdict = cb.verify_safety(problem, method="linear")
    assert (verdict.status, verdict.answers["linear"].hit) == ("SAFE", 5)


def test_a_target_of_one_state_is_met_at_any_time():
    system = cb.ContinuousSystem(lambda x: -1.0 + 0 * x, states=1, diffusion=0.5)
    problem = cb.Problem(
        system, initial=[1.0], safe=[cb.Inside(cb.HalfSpace([1], 2))], horizon=np.inf, reach=cb.HalfSpace([1], 0),
        delta=0.01,
    )  # fmt: skip
    truth = (np.exp(8) - 1) / (np.exp(16) - 1)  # the scale function exp(2 x / sigma^2)
    verdict = cb.verify_safety(problem, method="values")
    assert 0.9999 * truth <= 10**verdict.log10_lower <= truth <= 10**verdict.log10_delta <= 1.0001 * truth


def test_continuous_time_without_an_end_or_a_target_is_not_served():
    system = cb.ContinuousSystem(lambda x: [x[1], -x[0] - x[1]], states=2, diffusion=[[0], [0.2]])
    walls = [cb.Inside(cb.Box([-1], [1], coordinates=[0]))]  # the state that noise shakes is not bounded
    verdict = cb.verify_safety(cb.Problem(system, initial=[0, 0], safe=walls, horizon=np.inf), method="values")
    assert (verdict.status, verdict.log10_delta) == ("UNKNOWN", 0.0)
    assert "needs an end, and the horizon is infinite" in verdict.answers["values"].reason


@pytest.mark.parametrize(("delta", "status"), [(0.5, "SAFE"), (0.2, "UNSAFE_NOMINAL")])
def test_a_random_walk_may_arrive_where_no_noise_free_path_does(delta: float, status: str) -> None:
    walk = cb.DiscreteSystem(lambda x: x, states=1, noise=cb.Gaussian(std=0.5))
    safe, target = [cb.Inside(cb.Box([-6], [6]))], cb.Reach(cb.Box([2.0], [6.0]))
    problem = cb.Problem(walk, initial=[0.0], safe=safe, reach=target, horizon=100, delta=delta)
    assert cb.verify_safety(problem).status == status


def held(during) -> cb.Problem:
    system = cb.ContinuousSystem(lambda x, u: 0.5 * x + u, states=["x"], inputs=cb.Box([-9], [9]), diffusion=[[0.4]])
    return cb.Problem(
        system, initial=[1.0], safe=[cb.Inside(cb.Box([-9], [9]))],
        reach=cb.Reach(cb.Box([-0.8], [0.8]), during=during),
        horizon=2, hold=0.5, delta=0.5, plan=lambda x: -1.5 * x,
    )


def test_where_inputs_are_held_a_target_is_met_at_a_sampling_time():
    mean, variance = 1.0, 0.0
    for _ in range(4):
        factor = np.exp(0.25) - 3 * np.expm1(0.25)
        mean, variance = factor * mean, factor**2 * variance + 0.16 * np.expm1(0.5)
    truth = norm.sf((0.8 - mean) / variance**0.5) + norm.cdf((-0.8 - mean) / variance**0.5)
    at_end = cb.verify_safety(held((2, 2)))
    assert truth <= 10**at_end.log10_delta <= 1.5 * truth
    data = certificate_data(held((2, 2)), at_end)
    assert check_data(data, problem_data(held((2, 2)))).valid
    data["proof"]["time"], data["problem"]["reach"]["during"] = (1.75).hex(), None
    with pytest.raises(CertificateError, match=r"`proof.time` must be a sampling time"):
        check_data(data)
    data["problem"]["horizon"] = None
    with pytest.raises(CertificateError, match=r"`problem.hold` must be left out .* without an end"):
        check_data(data)
    between = cb.verify_safety(held((1.1, 1.4)))
    assert between.status == "UNKNOWN"
    assert "let its `during` hold a multiple of that" in between.reason
