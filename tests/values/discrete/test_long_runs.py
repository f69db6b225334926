"""Long and infinite horizons from a few steps: between Nystroem's truth, and refused where steps differ."""

import math

import numpy as np
import pytest
from scipy.special import ndtr

import certbound as cb
from certbound.errors import InfeasibleError
from certbound.safety.engines import values
from certbound.values.discrete import bound_failure, bound_long_run, failures, layout, long_runs
from certbound.values.discrete.functions import ValueFunction
from certbound.values.discrete.long_runs import largest_rate, least_rate
from certbound.values.grids import Grid
from certbound.watch import OutOfTime

NODES, WEIGHTS = np.polynomial.legendre.leggauss(240)


def density(z, std):
    return np.exp(-0.5 * (z / std) ** 2) / (std * math.sqrt(2 * math.pi))


def staying(step, std, horizon, start, low=-1.0, high=1.0):
    """P(in [low, high] at all steps up to the horizon)."""
    x, w = (high + low + (high - low) * NODES) / 2, WEIGHTS * (high - low) / 2
    matrix = density(x[None, :] - step(x)[:, None], std) * w
    first = density(x - step(start), std) * w
    return float(first @ np.linalg.matrix_power(matrix, horizon - 1).sum(axis=1))


def contraction(std=0.2, gain=0.9, **options):
    system = cb.DiscreteSystem(lambda x: gain * x, states=["x"], noise=cb.Gaussian(std=std))
    given = {"initial": [0.2], "safe": [cb.Inside(cb.Box([-1], [1]))], "horizon": 10**6} | options
    return cb.Problem(system, **given)


@pytest.mark.parametrize(("std", "horizon"), [(0.2, 500), (0.12, 10**4), (0.1, 10**5)])
def test_long_horizons_enclose_the_truth(std, horizon):
    found = bound_long_run(contraction(std, horizon=horizon), seconds=0.3)
    truth = 1 - staying(lambda x: 0.9 * x, std, horizon, 0.2)
    assert found.lower <= truth <= found.upper <= 1.1 * found.lower


def test_a_thousand_million_steps_cost_what_a_hundred_thousand_cost():
    short, long = (bound_long_run(contraction(0.1, horizon=steps), seconds=0.1) for steps in (10**5, 10**9))
    assert short.before[0] == long.before[0] < 5000
    assert long.upper > short.upper


def test_no_grid_is_hardly_finer_than_the_last_one(monkeypatch):
    monkeypatch.setattr(long_runs, "shares_of", lambda *_: [0.33, 0.3, 0.2])
    found = bound_long_run(contraction(), ratio=1.00001, seconds=5)
    assert [share for share, _, _ in found.tried] == [0.33, 0.2]


def test_what_starts_see_of_a_step_is_prepared_once_a_grid(monkeypatch):
    made, plain = [], failures.Work.transition

    def counted(work, t, grid, after, share):
        made.append(share)
        return plain(work, t, grid, after, share)

    monkeypatch.setattr(failures.Work, "transition", counted)
    bound_long_run(contraction(), seconds=0.3)
    assert all(made.count(share) == 2 for share in made)  # between cells, and from the starts


def test_for_ever_noise_leaves_at_a_rate():
    found = bound_long_run(contraction(horizon=math.inf), seconds=0.3)
    rate = 1 - staying(lambda x: 0.9 * x, 0.2, 201, 0.2) / staying(lambda x: 0.9 * x, 0.2, 200, 0.2)
    steps, least, most = found.before
    assert found.rate[0] <= rate <= found.rate[1] <= 1.1 * found.rate[0]
    assert found.lower > 1 - 1e-12
    assert least <= 1 - staying(lambda x: 0.9 * x, 0.2, steps, 0.2) <= most


def test_the_disturbance_is_the_worst_one():
    system = cb.DiscreteSystem(
        lambda x, d: 0.8 * x + d, states=["x"], disturbance=cb.Box([-0.1], [0.1]), noise=cb.Gaussian(std=0.15)
    )
    wide = cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=401)
    long, steps = bound_long_run(wide, seconds=0.1), bound_failure(wide, seconds=0.03)
    assert steps.lower <= long.upper
    assert long.lower <= steps.upper
    still = 1 - staying(lambda x: 0.8 * x + 0.1, 0.15, 401, 0.0)
    assert still <= long.upper <= 2.2 * long.lower


def walk(**options):
    system = cb.DiscreteSystem(lambda x: x - 0.05, states=["x"], noise=cb.Gaussian(std=0.3))
    given = {"initial": [0.0], "safe": [cb.Inside(cb.HalfSpace([1], 1))], "horizon": math.inf}
    return cb.Problem(system, **(given | {"reach": cb.HalfSpace([1], -1)} | options))


def test_for_ever_a_target_is_met_or_missed():
    found = bound_long_run(walk(), seconds=0.6)
    x, w = NODES, WEIGHTS
    kernel = density(x[None, :] - x[:, None] + 0.05, 0.3) * w
    over = np.array([0.5 * math.erfc((1 + 0.05 - y) / (0.3 * math.sqrt(2))) for y in x])
    missed = np.linalg.solve(np.eye(len(x)) - kernel, over)
    truth = density(x + 0.05, 0.3) * w @ missed + 0.5 * math.erfc(1.05 / (0.3 * math.sqrt(2)))
    assert found.lower <= truth <= found.upper <= 1.1 * found.lower


def test_a_target_that_is_nearly_sure_is_waited_for():
    """Nothing from below, and an upper bound that falls slowly in its logarithm: it falls nevertheless."""
    system = cb.DiscreteSystem(lambda x: x - 0.5, states=["x"], noise=cb.Uniform(halfwidth=1.5))
    safe = [cb.Inside(cb.HalfSpace([1], 40))]
    missed = cb.Problem(system, initial=[3.0], safe=safe, horizon=math.inf, reach=cb.HalfSpace([1], 0))
    assert bound_long_run(missed, seconds=0.1).upper < 1e-6


def test_where_steps_are_dear_they_end_once_delta_holds(monkeypatch):
    monkeypatch.setattr(long_runs, "_DEAR", 1)
    monkeypatch.setattr(long_runs, "_BRIEF", 0.0)
    brief, whole = (bound_long_run(walk(), seconds=0.1, delta=delta, ratio=1.3) for delta in (0.9, 1e-6))
    assert brief.before[0] < whole.before[0]
    assert brief.lower <= whole.lower <= whole.upper <= brief.upper < 1.46 * brief.lower  # e^(1.25 of .3)


def test_what_was_proved_until_time_ended_is_kept(monkeypatch):
    asked = []

    def ended(phase):
        asked.append(phase)
        if len(asked) == 3:
            raise OutOfTime

    monkeypatch.setattr(long_runs, "poll", ended)
    found = bound_long_run(walk(), seconds=0.6)
    assert len(asked) == 3
    assert 0 < found.lower < found.upper < 1


def test_two_states_for_ever():
    system = cb.DiscreteSystem(
        lambda x: [0.8 * x[0] + 0.1 * x[1], 0.7 * x[1]], states=["x", "y"], noise=cb.Gaussian(std=[0.25, 0.25])
    )
    problem = cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=30)
    long = bound_long_run(problem.replace(horizon=math.inf), seconds=1)
    assert long.lower > 1 - 1e-12
    steps, least, most = long.before
    some = bound_failure(problem.replace(horizon=steps), seconds=0.3)
    assert (some.lower <= most, least <= some.upper) == (True, True)
    assert long.rate[1] <= 1.4 * long.rate[0]


def test_verdicts_of_infinite_horizons(monkeypatch):
    monkeypatch.setattr(values, "_SECONDS", 0.3)
    assert cb.verify_safety(walk(delta=0.25, initial=[-0.5]), method="values", time_limit=10).status == "SAFE"
    verdict = cb.verify_safety(contraction(horizon=math.inf), time_limit=10)
    assert verdict.status == "UNSAFE"
    assert "For every T from" in verdict.answers["values"].reason
    assert "needs a finite horizon" in verdict.answers["linear"].reason


def test_rates_belong_to_their_own_steps():
    """Of bounds that are put together, no rate is taken from one and the probability from another."""
    one, other = (bound_long_run(contraction(horizon=math.inf), seconds=s) for s in (0.01, 0.3))
    for found in (one, other):
        steps, least, most = found.before
        for horizon in (steps, 2 * steps, 10 * steps):
            truth = 1 - staying(lambda x: 0.9 * x, 0.2, horizon, 0.2)
            assert 1 - (1 - least) * (1 - found.rate[0]) ** (horizon - steps) <= truth
            assert truth <= 1 - (1 - most) * (1 - found.rate[1]) ** (horizon - steps)


def test_a_function_that_is_1_everywhere_says_nothing_of_rates():
    grid = Grid(axes=(np.linspace(-1, 1, 5),))
    one = ValueFunction(
        grid=grid, nodal=np.ones(5), bend=np.zeros((1, 4)), fixed=np.ones(4, dtype=bool), level=np.ones(4)
    )
    assert (least_rate(one, one), largest_rate(one, one)) == pytest.approx((1.0, 1.0))


def test_a_random_start_beyond_the_face_of_an_endless_target_has_arrived():
    """X_0 ~ N(2, 1), a walk with drift .05 and noise .3 from there: to 1 and beyond before it is below -1."""
    system = cb.DiscreteSystem(lambda x: x + 0.05, states=["x"], noise=cb.Gaussian(std=0.3))
    problem = cb.Problem(
        system, initial=cb.GaussianStart([2.0], [[1.0]]), safe=[cb.Inside(cb.Box([-1], [np.inf]))],
        reach=cb.Box([1.0], [np.inf]), horizon=math.inf,
    )  # fmt: skip
    matrix = density(NODES[None, :] - NODES[:, None] - 0.05, 0.3) * WEIGHTS
    failing = np.linalg.solve(np.eye(len(NODES)) - matrix, ndtr((-1 - NODES - 0.05) / 0.3))
    truth = ndtr(-3.0) + float((density(NODES - 2.0, 1.0) * WEIGHTS) @ failing)
    found = bound_long_run(problem, seconds=0.2)
    assert 0.9 * truth < found.lower <= truth <= found.upper < 1.1 * truth


def test_rates_below_count_from_a_function_that_is_negative():
    """1 - f falls from 1.5 to 1.45: a thirtieth of it, not a twentieth."""
    grid = Grid(axes=(np.linspace(-1, 1, 5),))
    one, after = (
        ValueFunction(
            grid=grid, nodal=np.full(5, value), bend=np.zeros((1, 4)), fixed=None, level=np.zeros(4)
        )
        for value in (-0.5, -0.45)
    )
    assert 0.999 * 0.05 / 1.5 < least_rate(one, after) <= 0.05 / 1.5


def test_steps_that_differ_are_not_taken_for_alike():
    system = cb.DiscreteSystem(lambda t, x: (0.9 + 0.01 * np.sin(t)) * x, states=["x"], noise=cb.Gaussian(std=0.2))
    with pytest.raises(InfeasibleError, match="a model and limits that do not change"):
        bound_long_run(contraction(horizon=math.inf).replace(system=system))
    with pytest.raises(InfeasibleError, match="limits on both sides of every state"):
        bound_long_run(contraction(horizon=math.inf, safe=[cb.Inside(cb.HalfSpace([1], 1))]))
    with pytest.raises(InfeasibleError, match="a limit wherever the target"):
        bound_long_run(walk(reach=cb.Box([-2], [-1])))
    assert bound_long_run(walk(horizon=1000)) is None
    assert bound_long_run(contraction(horizon=400)) is None


def test_an_end_is_asked_for_where_it_is_needed():
    for call in (lambda p: cb.simulate_exits(p, paths=10), cb.bound_exit_times, lambda p: bound_failure(p)):
        with pytest.raises(InfeasibleError, match="needs an end, and the horizon is infinite"):
            call(contraction(horizon=math.inf))
    with pytest.raises(ValueError, match="must have no `during` where the horizon is infinite"):
        contraction(horizon=math.inf, safe=[cb.Inside(cb.Box([-1], [1]), during=(0, 5))])
    with pytest.raises(InfeasibleError, match="at most 100000 steps"):
        bound_failure(contraction(horizon=10**9))


def cusum(step=lambda s: np.maximum(s, 0.0) - 0.5, **options):
    system = cb.DiscreteSystem(step, states=["s"], noise=cb.Gaussian(std=1.0))
    given = {"initial": [0.0], "safe": [cb.Inside(cb.Box([-np.inf], [5]))], "horizon": 500}
    return cb.Problem(system, **given | options)


def lasting(problem):
    work = failures.Work(problem, None, 4)
    return layout.lasting_box(problem, work.shocks, work.dynamics)


@pytest.mark.parametrize("horizon", [500, 3000])
def test_a_side_that_steps_hardly_pass_needs_no_limit(horizon):
    found = bound_long_run(cusum(horizon=horizon), seconds=1, ratio=1.1)
    truth = 1 - staying(lambda s: np.maximum(s, 0.0) - 0.5, 1.0, horizon, 0.0, low=-10.5, high=5.0)
    assert found.lower <= truth <= found.upper <= 1.2 * found.lower
    assert found.rate[0] == 0  # of other horizons nothing is said from below but what 500 steps say


def test_a_box_that_lasts_holds_what_steps_lead_to():
    (low,), (high,) = lasting(cusum(horizon=1))
    assert -20 < low <= -0.5 - 10
    assert high == pytest.approx(5)  # the limit
    (low,), _ = lasting(cusum(lambda s: np.where(s > 3, -40.0, 0.0), horizon=1, initial=cb.Box([-30], [0])))
    assert low <= -50  # from above the starts
    (low,), _ = lasting(cusum(lambda s: 0.9 * s, horizon=1))
    assert low <= 0.9 * low - 10
    assert lasting(cusum(lambda s: 1.1 * s, horizon=1)) is None
