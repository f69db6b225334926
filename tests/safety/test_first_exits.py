"""Curves of exit times: closed forms in continuous time, NumPy's own chain in discrete time, means, refusals."""

import json

import numpy as np
import pytest
from scipy.stats import norm

import certbound as cb
from certbound.cli.app import run
from certbound.errors import InfeasibleError
from certbound.problem.files import save
from certbound.safety import first_exits
from certbound.values.continuous import bound_mean_time, bound_rate
from certbound.values.continuous.hypotheses import chart_below
from certbound.values.continuous.line import ladder, maps
from certbound.watch import OutOfTime, current_watch


def brownian(horizon=2.0, drift=0.0, start=0.0):
    system = cb.ContinuousSystem(lambda x: 0 * x + drift, states=["x"], diffusion=[[1.0]])
    safe = [cb.Inside(cb.Box([-1.0], [1.0]))]
    return cb.Problem(system, initial=[start], safe=safe, horizon=horizon, name="brownian")


def survival(s, drift, start):
    """P(a Brownian motion with drift has not left (-1, 1) by s), by its eigenfunctions."""
    k = np.arange(1, 400)[:, None]
    rate, y = (k * np.pi / 2) ** 2 / 2 + drift**2 / 2, start + 1
    ends = k * np.pi / 2 * (np.exp(-drift) - (-1.0) ** k * np.exp(drift)) / (drift**2 + (k * np.pi / 2) ** 2)
    return np.sum(np.exp(-drift * start) * np.sin(k * np.pi * y / 2) * np.exp(-rate * s) * ends, axis=0)


@pytest.fixture(scope="module")
def found():
    """From the one horizon alone, without those for short times."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(first_exits, "_SHORTEST", 1)
        patch.setattr(first_exits, "_STEP", 0.04)
        patch.setattr(ladder, "LADDER", ladder.LADDER[:1] * 3)
        return cb.bound_exit_times(brownian())


@pytest.mark.parametrize("near", [False, True])
def test_a_limit_on_one_side_is_enough(monkeypatch, near):
    """A share that falls below 80 from 100: the first passage of its logarithm, in closed form (reflection).

    Where the line is cut near by, leaving there is a failure for upper bounds alone.
    """
    asked = []
    monkeypatch.setattr(maps, "chart_below", lambda *args: asked.append(args) or chart_below(*args))
    if near:
        monkeypatch.setattr(maps, "cuts_of", lambda *_: (80.0, 112.0))
    monkeypatch.setattr(first_exits, "_SHORTEST", 1)
    monkeypatch.setattr(first_exits, "_STEP", 0.04)
    monkeypatch.setattr(ladder, "LADDER", ladder.LADDER[:1] * 3)
    system = cb.ContinuousSystem(lambda x: 0.05 * x, states=["S"], diffusion=lambda x: [[0.2 * x[0]]])
    problem = cb.Problem(system, initial=[100], safe=[cb.Inside(cb.HalfSpace([-1], -80))], horizon=1.0)
    found = cb.bound_exit_times(problem)
    times = found.times[found.times > 0.4]
    rate, away = 0.05 - 0.2**2 / 2, np.log(100 / 80)
    above, below = ((sign * away - rate * times) / (0.2 * np.sqrt(times)) for sign in (-1, 1))
    truth = norm.cdf(above) + np.exp(-2 * rate * away / 0.2**2) * norm.cdf(-below)
    lower, upper = (np.array([found.at(float(s))[k] for s in times]) for k in (0, 1))
    assert len(times) > 10
    assert np.all((lower < truth) & (truth < upper))
    assert np.all((0.9 * truth < lower) & (upper < 1.1 * truth)) or near
    assert found.mean_lower > 1  # it is infinite; by the curves alone it is less than the horizon
    assert [args[-1] for args in asked] == [[(False, True)]]
    assert found.mean_upper is None  # some never do


def test_leaving_through_a_cut_is_no_failure_whatever_is_proposed(monkeypatch):
    """A proposal that counts both faces proves nothing of leaving through the lower one by itself."""
    asked = []
    monkeypatch.setattr(maps, "chart_below", lambda *args: asked.append(args) or chart_below(*args))
    monkeypatch.setattr(first_exits, "_SHORTEST", 1)
    monkeypatch.setattr(first_exits, "_STEP", 0.04)
    monkeypatch.setattr(ladder, "LADDER", ((1.5, 1e-3, 0.03),) * 3)
    cb.bound_exit_times(brownian(1.0))
    assert asked[0][-1] == [(False, False)]
    plain, cut = (chart_below(*asked[0][:-1], [(False, side)])[0] for side in (False, True))
    middle = np.array([[0.0]])
    assert plain.at(middle, up=False)[0] > np.log10(0.9 * (1 - survival(1.0, 0.0, 0.0)))
    assert cut.at(middle, up=False)[0] < np.log10(0.5 * (1 - survival(1.0, 0.0, 0.0)))


@pytest.mark.slow
def test_short_times_are_bounded_closely_too():
    found = cb.bound_exit_times(brownian(8.0))
    truth = 1 - survival(np.maximum(found.times, 1e-3), 0.0, 0.0)
    assert np.max(found.upper - truth) < 0.015
    assert np.max(truth - found.lower) < 0.015
    assert 0.96 < found.mean_lower < 1 < found.mean_upper < 1.05


def test_the_curves_hold_the_closed_form_closely(found):
    times = found.times[found.times > 0.02]
    truth = 1 - survival(times, 0.0, 0.0)
    lower, upper = (np.array([found.at(float(s))[k] for s in times]) for k in (0, 1))
    assert np.all(lower <= truth + 1e-12)
    assert np.all(truth <= upper + 1e-12)
    late = times > 1.0
    assert np.max(upper[late] / truth[late]) < 1.03
    assert np.min(lower[late] / truth[late]) > 0.97


@pytest.mark.parametrize(
    ("drift", "mean"),
    [(lambda x: [0 * x[0]], 1.0), (lambda x: [-x[0]], 1.44524563), (lambda x: [0 * x[0] + 0.5], 2 * np.tanh(0.5))],
)
def test_means_are_within_a_fraction_of_a_per_cent_of_the_closed_form(drift, mean):
    """Of Ornstein-Uhlenbeck: the double integral of exp(y^2 - z^2) over 0 < z < y < 1, twice."""
    system = cb.ContinuousSystem(drift, states=["x"], diffusion=1.0)
    problem = cb.Problem(system, initial=[0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=6)
    low, high = bound_mean_time(problem)
    assert low <= mean <= high
    assert high / low < 1.004
    wide = bound_mean_time(problem.replace(initial=cb.Box([-0.2], [0.3])))
    assert wide[0] < low
    assert wide[1] > high


def scale_mean(drift, noise, low, start, far):
    """2 int_low^start s(y) int_y^far m(z) dz dy with s' / s = -2 f / a and m = 1 / (a s): above a limit at ``low``."""
    x = np.linspace(low, far, 400_001)
    step = x[1] - x[0]
    rate = 2 * drift(x) / noise**2
    power = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2 * step)])
    speed = np.exp(power - power.max()) / noise**2
    tail = np.concatenate([np.cumsum(((speed[1:] + speed[:-1]) / 2 * step)[::-1])[::-1], [0.0]])
    inner = tail * np.exp(power.max() - power)
    inside = x <= start
    return 2 * np.sum((inner[inside][1:] + inner[inside][:-1]) / 2) * step


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(
    ("drift", "noise", "low", "start"),
    [
        (lambda x: 0.2 - abs(1 - x) * x, 0.15, 0.7236, 1.1708),  # a box model of the ocean, with a kink at 1
        (lambda x: 0.3 - x, 0.25, -0.2, 0.3),
        (lambda x: x - x**3, 0.3, 0.0, 1.0),
    ],
)
def test_means_need_a_limit_on_one_side_only_and_no_smooth_model(sign, drift, noise, low, start):
    """The mean was [42, none] of the first, whose horizon is short beside it and whose polynomial misses the kink."""
    mean = scale_mean(drift, noise, low, start, 2.5)
    mirrored = cb.ContinuousSystem(lambda x: [sign * drift(sign * x[0])], states=["x"], diffusion=[[noise]])
    safe = [cb.Inside(cb.HalfSpace([-sign], -low))]
    found = bound_mean_time(cb.Problem(mirrored, initial=[sign * start], safe=safe, horizon=5))
    assert found[0] <= mean * (1 + 1e-5)
    assert mean * (1 - 1e-5) <= found[1]
    assert found[1] <= 1.002 * found[0]


def test_of_a_drift_that_does_not_lead_back_the_mean_has_a_lower_bound_alone():
    """Brownian motion above -1 leaves, but not in the mean; with a drift to the limit it takes 1/drift."""
    safe = [cb.Inside(cb.HalfSpace([-1], 1))]
    low, high = bound_mean_time(brownian().replace(safe=safe))
    assert high is None
    assert low > 100
    low, high = bound_mean_time(brownian(drift=-0.5).replace(safe=safe))
    assert 0.998 * 2 < low <= 2 <= high < 1.002 * 2


def test_a_drift_that_jumps_has_a_mean_too():
    """x' = -.5 sign(x) + noise in (-1, 1) from 0: E tau = int_0^1 2 e^y int_0^y e^-z dz dy = 2 (e - 2)."""
    system = cb.ContinuousSystem(lambda x: [np.where(x[0] < 0, 0.5, -0.5)], states=["x"], diffusion=[[1.0]])
    safe = [cb.Inside(cb.Box([-1], [1]))]
    low, high = bound_mean_time(cb.Problem(system, initial=[0], safe=safe, horizon=1))
    assert low <= 2 * (np.e - 2) <= high
    assert high / low < 1.002


def test_rates_hold_the_closed_form_for_every_horizon_from_both_sides():
    """Brownian motion leaves (-1, 1) at the rate pi^2/8 (with drift b: + b^2/2); survival from its series."""
    for drift in (0.0, 0.5):
        problem = brownian(1.0, drift)
        found = bound_rate(problem)
        exact = np.pi**2 / 8 + drift**2 / 2
        assert found.rate[0] <= exact <= found.rate[1]
        assert found.rate[1] < 1.002 * exact
        assert found.rate[0] > 0.96 * exact
        for time in (0.3, 1.0, 4.0, 12.0):
            low, high = found.before(time)
            truth = 1 - float(survival(np.array([time]), drift, 0.0)[0])
            assert low <= truth + 1e-12
            assert truth <= high + 1e-12
        assert found.before(np.inf) == (1.0, 1.0)


def test_an_infinite_horizon_in_continuous_time_is_unsafe_with_the_rate():
    verdict = cb.verify_safety(brownian(1.0).replace(horizon=np.inf), method="values")
    assert verdict.status == "UNSAFE"
    assert verdict.log10_lower > -1e-9
    assert "every path leaves in the end" in verdict.reason
    plane = cb.ContinuousSystem(lambda x: -x, states=2, diffusion=lambda t, x: [[x[0], 0.0], [0.0, x[1]]])
    safe = [cb.Inside(cb.Box([-1, -1], [1, 1]))]  # noise that vanishes at 0 may never lead out
    refused = cb.verify_safety(cb.Problem(plane, initial=[0.5, 0.5], safe=safe, horizon=np.inf), method="values")
    assert refused.status == "UNKNOWN"
    assert "a single state is served" in refused.reason


def test_means_hold_for_every_disturbance_and_no_clock():
    push, safe = cb.Box([-0.1], [0.1]), [cb.Inside(cb.Box([-1], [1]))]
    system = cb.ContinuousSystem(lambda x, d: [-x[0] + d[0]], states=["x"], disturbance=push, diffusion=1.0)
    low, high = bound_mean_time(cb.Problem(system, initial=[0], safe=safe, horizon=6))
    assert low < 1.40 < 1.4453 < high
    clock = cb.ContinuousSystem(lambda t, x: [-x[0] * (1 + t)], states=["x"], diffusion=1.0)
    assert bound_mean_time(cb.Problem(clock, initial=[0], safe=safe, horizon=6)) is None
    ring = [*safe, cb.Outside(cb.Ball([0.5], 0.1))]
    still = cb.ContinuousSystem(lambda x: [-x[0]], states=["x"], diffusion=1.0)
    assert bound_mean_time(cb.Problem(still, initial=[0], safe=ring, horizon=6)) is None


def test_the_curves_rise_and_are_read_between_their_times(found):
    assert np.all(np.diff(found.lower) >= 0)
    assert np.all(np.diff(found.upper) >= 0)
    low, high = found.at(1.2345)
    assert low < 1 - survival(np.array([1.2345]), 0.0, 0.0)[0] < high
    assert found.at(0.0)[0] == 0.0
    with pytest.raises(ValueError, match=r"`s` must lie in \[0, 2\], got 3"):
        found.at(3.0)


def test_the_mean_is_bounded_from_both_sides(found):
    assert found.mean_lower < 1 < found.mean_upper
    assert "mean exit time" in found.summary()
    # P(left within 2) is .89 at least from anywhere: what is still to come is little
    assert found.mean_upper < 1.2


@pytest.mark.slow
@pytest.mark.parametrize(("drift", "start"), [(0.5, 0.0), (-1.0, 0.3)])
def test_drift_and_another_start(drift, start):
    found = cb.bound_exit_times(brownian(8.0, drift, start), times=[0.2, 0.5, 1.0, 2.0, 4.0])
    truth = 1 - survival(found.times, drift, start)
    assert np.all((found.lower <= truth) & (truth <= found.upper))
    assert np.max(found.upper / truth) < 1.05
    y, m = start + 1, drift
    mean = (2 * (1 - np.exp(-2 * m * y)) / (1 - np.exp(-4 * m)) - y) / m
    assert 0.95 * mean < found.mean_lower < mean < found.mean_upper < 1.06 * mean


def test_discrete_time_holds_a_chain_of_its_own():
    system = cb.DiscreteSystem(lambda x: 0.9 * x, states=["x"], noise=cb.Gaussian(std=0.4))
    problem = cb.Problem(system, initial=[0.2], safe=[cb.Inside(cb.Box([-1.0], [1.0]))], horizon=120)
    found = cb.bound_exit_times(problem)
    paths, mean = 100_000, 0.0
    rng, x = np.random.default_rng(0), np.full(paths, 0.2)  # of those still inside
    for k in range(1, 2000):
        mean += len(x) / paths
        x = 0.9 * x + 0.4 * rng.standard_normal(len(x))
        x = x[np.abs(x) <= 1]
        if k in (1, 5, 20, 80):
            low, high = found.at(k)
            assert low - 0.005 < 1 - len(x) / paths < high + 0.005
            assert high - low < 1e-3
    assert 0.95 * mean < found.mean_lower < mean * 1.01
    assert 0.99 * mean < found.mean_upper < 1.1 * mean


def test_every_start_of_a_set_counts():
    system = cb.DiscreteSystem(lambda x: 0.9 * x, states=["x"], noise=cb.Gaussian(std=0.3))
    safe = [cb.Inside(cb.Box([-1.0], [1.0]))]
    whole = cb.bound_exit_times(cb.Problem(system, initial=cb.Box([0.1], [0.6]), safe=safe, horizon=60))
    ends = [cb.bound_exit_times(cb.Problem(system, initial=[x], safe=safe, horizon=60)) for x in (0.1, 0.6)]
    assert np.all(whole.upper >= ends[1].lower)
    assert np.all(whole.lower <= ends[1].upper)
    assert whole.lower[20] > ends[0].upper[20]  # the worst start
    assert whole.mean_lower < ends[1].mean_upper  # the shortest mean
    assert whole.mean_upper > ends[0].mean_lower  # the longest


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"safe": [cb.Inside(cb.Box([-1.0], [1.0]), during=(0, 1))]}, "limits that always hold"),
        ({"safe": []}, "need a limit by which paths may leave"),
        ({"initial": cb.GaussianStart([0.0], [[0.01]])}, "need one set of starts"),
        ({"initial": [cb.Box([0.0], [0.1]), cb.Box([0.2], [0.3])]}, "need one set of starts"),
        ({"reach": cb.Box([0.5], [0.6])}, "the problem has a target"),
        ({"system": cb.ContinuousSystem(lambda t, x: 0 * x + t, states=["x"], diffusion=[[1.0]])}, "depend on time"),
    ],
)
def test_what_is_not_served_says_so(changes, message):
    with pytest.raises(InfeasibleError, match=message):
        cb.bound_exit_times(brownian().replace(**changes))


def test_inputs_without_a_plan_are_refused_as_such():
    system = cb.ContinuousSystem(lambda x, u: u - x, states=1, inputs=cb.Box([-1], [1]), diffusion=[[0.3]])
    with pytest.raises(ValueError, match="and no plan"):
        cb.bound_exit_times(cb.Problem(system, initial=[0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=1))


def test_two_states_are_refused():
    system = cb.ContinuousSystem(lambda x: -x, states=2, diffusion=np.eye(2))
    safe = [cb.Inside(cb.Box([-1, -1], [1, 1]))]
    with pytest.raises(InfeasibleError, match="in one state, the problem has 2"):
        cb.bound_exit_times(cb.Problem(system, initial=[0, 0], safe=safe, horizon=1))


def test_the_command_prints_the_curves(tmp_path, capsys):
    system = cb.DiscreteSystem(lambda x: 0.9 * x, states=["x"], noise=cb.Gaussian(std=0.4))
    problem = cb.Problem(system, initial=[0.2], safe=[cb.Inside(cb.Box([-1.0], [1.0]))], horizon=30, name="walk")
    save(problem, tmp_path / "walk.toml")
    assert run(["exit-times", str(tmp_path / "walk.toml"), "--json", "--plot", str(tmp_path / "walk.png")]) == 0
    result = json.loads(capsys.readouterr().out)
    keys = ["times", "lower", "upper", "mean_lower", "mean_upper", "density", "by_limit", "seconds"]
    assert list(result) == keys
    assert result["upper"][-1] > result["lower"][-1] > 0.5
    assert (tmp_path / "walk.png").stat().st_size > 5000
    assert run(["exit-times", str(tmp_path / "walk.toml")]) == 0
    assert "mean exit time" in capsys.readouterr().out


def test_what_was_proved_in_time_stands_for_all_times(monkeypatch):
    charts, asked = first_exits.chart_slabs_of, []

    def in_time(problem, **options):
        asked.append(problem.horizon)
        if len(asked) > 1:
            raise OutOfTime
        return charts(problem, **options)

    monkeypatch.setattr(first_exits, "_STEP", 0.05)
    monkeypatch.setattr(first_exits, "chart_slabs_of", in_time)
    curves = cb.bound_exit_times(brownian())
    truth = float(1 - survival(2.0, 0.0, 0.0)[0])
    assert curves.lower[-1] <= truth <= curves.upper[-1] < 1.1 * truth
    assert curves.upper[0] > 0  # of longer times
    assert len(asked) == 2


def test_a_mean_that_was_proved_in_time_stands_without_curves(monkeypatch):
    def late(*_, **__):
        raise OutOfTime

    monkeypatch.setattr(first_exits, "chart_slabs_of", late)
    found = cb.bound_exit_times(brownian())
    assert found.mean_lower == pytest.approx(1, abs=1e-3)
    assert found.mean_upper == pytest.approx(1, abs=1e-3)
    assert found.at(2.0) == (0.0, 1.0)


def test_the_command_has_a_limit_of_its_own(found, monkeypatch, capsys):
    limits = []

    def asked(problem, by_limit):
        limits.append(current_watch().limit)
        return found

    monkeypatch.setattr(first_exits, "bound_exit_times", asked)
    for words in ((), ("--time-limit", "7")):
        assert run(["exit-times", "ou", "--set", "radius=1", "--json", *words]) == 0
    assert all(most - 5 < limit <= most for limit, most in zip(limits, (60, 7), strict=True))  # since the command began


def test_a_command_whose_time_is_over_before_anything_is_proved_says_so(monkeypatch, capsys):
    def late(problem, by_limit):
        raise OutOfTime

    monkeypatch.setattr(first_exits, "bound_exit_times", late)
    assert run(["exit-times", "ou", "--json"]) == 3
    said = capsys.readouterr()
    assert "--time-limit" in json.loads(said.out)["error"] + json.loads(said.out)["try"]
    assert "Traceback" not in said.err


def test_a_command_without_methods_does_not_speak_of_them(capsys):
    assert run(["exit-times", "unicycle"]) == 3
    said = capsys.readouterr().err
    assert "certbound sweep --over horizon" in said
    assert "--method" not in said
