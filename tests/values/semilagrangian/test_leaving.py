"""Bounds for noise in one of two coordinates, against simulation."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.special import ndtr

import certbound as cb
from certbound.problem.model import compile_numpy
from certbound.rigor.intervals import Interval
from certbound.safety.engines import values
from certbound.values.semilagrangian import bound_exits_by_steps, groundwork, leaving, mirrors
from certbound.values.semilagrangian.backward import back
from certbound.values.semilagrangian.confines import Wall
from certbound.values.semilagrangian.groundwork import layouts_of, nodes_of
from certbound.values.semilagrangian.leaving import bounds_by_steps
from certbound.values.semilagrangian.local_steps import Clock, Plan
from certbound.values.semilagrangian.mirrors import Mirror
from certbound.values.semilagrangian.noisy_axis import setting_of
from certbound.watch import OutOfTime, Watch

COARSE = Plan(count=20, fine=1.0, wide=0.012, cell=0.4, spare=1e-12)


def bound_by_steps(setting, plan: Plan) -> float:
    """The upper bound alone."""
    return bounds_by_steps(setting, plan, below=False)[0]


def both_bounds(setting, plan: Plan) -> tuple[float, float]:
    """Upper and lower bound, where one layout serves all steps."""
    return bounds_by_steps(setting, plan, layouts=[next(layouts_of(setting, plan))] * plan.count)


def mechanical(force, s: float, low, high, horizon: float, start) -> cb.Problem:
    system = cb.ContinuousSystem(lambda x: [x[1], force(x)], states=2, diffusion=[[0.0], [s]])
    return cb.Problem(system, initial=list(start), safe=[cb.Inside(cb.Box(low, high))], horizon=horizon)


def simulated(problem: cb.Problem, paths: int, rng: np.random.Generator) -> tuple[float, float]:
    """Share of the paths that leave, seen at 400 times only, and its standard error."""
    setting = setting_of(problem)
    drift, parts = compile_numpy(setting.tape), 400
    d = setting.horizon / parts
    p, q = (np.full(paths, ends[0]) for ends in setting.starts)
    inside = np.ones(paths, dtype=bool)
    for k in range(parts):
        f = drift(k * d, p, q)
        noise = setting.noise * math.sqrt(d) * rng.standard_normal(paths)
        p, q = p + d * (f[..., 0] + noise / 2), q + d * f[..., 1] + noise
        for x, ends in zip((p, q), setting.faces):
            inside &= (x >= ends[0]) & (x <= ends[1])
    share = 1 - inside.mean()
    return share, math.sqrt(share * (1 - share) / paths)


@pytest.mark.parametrize(
    ("force", "s", "low", "high", "start", "most"),
    [
        pytest.param(  # a mass on a spring in wind
            lambda x: -2 * x[0] - x[1], 0.8, [-0.8, -3], [0.8, 3], (0.1, 0.0), 2.0, marks=pytest.mark.slow
        ),
        pytest.param(
            lambda x: x[0] - x[0] ** 3 - 0.5 * x[1], 0.5, [0.3, -2], [1.7, 2], (1.0, 0.1), 2.0, marks=pytest.mark.slow
        ),
        (lambda x: -0.7 * x[1], 0.7, [-1, -1], [1, 1], (0.0, 0.2), 3.0),  # the face of q is reached as well
    ],
)
def test_the_bound_is_above_what_simulation_counts_and_near_it(force, s, low, high, start, most) -> None:
    problem = mechanical(force, s, low, high, 1.5, start)
    setting = setting_of(problem)
    bound, below = both_bounds(setting, replace(COARSE, count=15, wide=0.02))
    share, error = simulated(problem, 8000, np.random.default_rng(1))
    assert bound >= share - 4 * error
    assert bound <= most * (share + 4 * error)
    assert share / most <= below <= 1.05 * share + 4 * error  # exits between the times seen are missed


def wiener_exit(s: float, horizon: float) -> float:
    """P(|s W| reaches 1 by the horizon)."""
    rates = [(2 * k + 1) * math.pi / 2 for k in range(40)]
    parts = (math.exp(-(r**2) * s**2 * horizon / 2) * (-1) ** k / r for k, r in enumerate(rates))
    return 1 - 2 * sum(parts)


def test_at_a_face_of_the_noise_hardly_anything_is_lost_on_either_side() -> None:
    setting = setting_of(mechanical(lambda x: 0.0 * x[0], 0.8, [-2, -1], [2, 1], 0.5, (0.0, 0.0)))
    plan = Plan(count=8, fine=2.0, wide=0.02, cell=0.4, spare=1e-15)
    exact, (upper, lower) = wiener_exit(0.8, 0.5), both_bounds(setting, plan)
    assert exact < upper < 1.12 * exact
    assert exact > lower > 0.85 * exact


def pulled(safe: list[cb.Inside], s: float = 0.8) -> cb.Problem:
    system = cb.ContinuousSystem(lambda x: [x[1], -x[0] - 0.5 * x[1]], states=2, diffusion=[[0.0], [s]])
    return cb.Problem(system, initial=[0.1, 0.0], safe=safe, horizon=1.2)


@pytest.mark.parametrize(
    ("safe", "most"),
    [
        ([cb.Inside(cb.HalfSpace([0, 1], 0.9))], 1.6),  # nothing bounds the other side, nor the position
        pytest.param([cb.Inside(cb.HalfSpace([1, 1], 0.9))], 3.5, marks=pytest.mark.slow),
        pytest.param([cb.Inside(cb.Ball([0, 0], 1.0))], 3.5, marks=pytest.mark.slow),
        pytest.param([cb.Outside(cb.Box([0.2, 0.1], [0.7, 0.9]))], 3.5, marks=pytest.mark.slow),
    ],
)
def test_limits_of_other_shapes_are_bounded_from_both_sides(safe, most) -> None:
    problem = pulled(safe)
    setting = setting_of(problem)
    plan = Plan(count=24, fine=1.0, wide=0.01, cell=0.4, spare=1e-15)
    upper, lower = both_bounds(setting, plan)
    rng, d = np.random.default_rng(2), 1.2 / 600
    x, failed = np.tile([0.1, 0.0], (8000, 1)), np.zeros(8000, dtype=bool)
    for _ in range(600):
        kick = 0.8 * math.sqrt(d) * rng.standard_normal(8000)
        x = x + d * np.stack([x[:, 1], -x[:, 0] - 0.5 * x[:, 1]], axis=1) + np.stack([0 * kick, kick], axis=1)
        failed |= ~safe[0].satisfied(x)
    share = failed.mean()
    error = math.sqrt(share * (1 - share) / 8000)
    assert share - 4 * error <= upper <= most * share
    assert share / most <= lower <= 1.06 * share + 4 * error


def test_a_wall_knows_what_is_safe_near_it() -> None:
    walls = setting_of(pulled([cb.Inside(cb.Ellipsoid([0, 0], [[1.0, 0.0], [0.0, 4.0]]))])).walls
    box = Interval(np.array([0.0, 0.95, 2.0]), np.array([0.1, 1.05, 2.1]))
    sizes = walls[0].sizes(box, Interval.point(np.zeros(3)))
    assert walls[0].safe(sizes, np.zeros((1, 1))).tolist() == [True, False, False]
    assert walls[0].broken(sizes).tolist() == [False, False, True]
    still = Interval.point(np.zeros(3))
    outward = walls[0].margins((box, still), (Interval.point(np.ones(3)), still), 0.1, 0.5)
    inward = walls[0].margins((box, still), (-Interval.point(np.ones(3)), still), 0.1, 0.5)
    assert outward.max() < 1e-8  # a drift outward only helps
    assert inward[0, 1] == pytest.approx(1 - (1 - 0.21) ** 2, rel=1e-6)  # at most 1.05 / 1 inward, twice over


def test_past_the_middle_of_a_tilted_chord_the_drift_counts_too() -> None:
    obstacle = Wall(region=cb.Ellipsoid([0, 0], [[0.02, 0.18], [0.18, 2.0]]), outside=True, order=(0, 1))
    tube = Interval.point(np.zeros(1)), Interval.point(np.zeros(1))
    rates = Interval.point(np.ones(1)), Interval.point(np.zeros(1))
    found = obstacle._beyond_the_middle(rates, np.array([0.1]), 0.1, 0.6)
    across = 0.02 / (0.02 * 2.0 - 0.18**2)  # of the inverse; the middle moves by 9 along q for 1 along p
    assert found == pytest.approx(across * (0.6 + 9 * 0.1) ** 2, rel=1e-6)
    strip = Wall(region=cb.Ball([0.5], 0.1, coordinates=[1]), outside=True, order=(0, 1))
    assert np.isfinite(strip.margins(tube, (Interval.point(np.ones(1)),) * 2, 0.1, 0.5)).all()


def test_starts_in_a_ball_are_narrower_than_its_box() -> None:
    setting = setting_of(pulled([cb.Inside(cb.HalfSpace([0, 1], 3.0))]).replace(initial=cb.Ball([1.0, 0.0], 0.5)))
    assert setting.starts_between(0.4, 0.5) == pytest.approx((0.7, 1.3), abs=1e-6)
    assert setting.starts_between(-0.1, 0.5) == pytest.approx((0.5, 1.5), abs=1e-4)
    points = setting.some_starts()
    assert np.hypot(points[:, 0] - 1, points[:, 1]).max() <= 0.5


def test_starts_of_a_thin_ellipse_surely_lie_in_it_and_between_its_ends() -> None:
    rng = np.random.default_rng(0)
    for thin in 1e-9 * rng.uniform(1, 3, 10):
        shape = np.array([[0.04, 0.04 * (1 - thin)], [0.04 * (1 - thin), 0.04]])
        start = cb.Ellipsoid([0, 0], shape)
        setting = setting_of(pulled([cb.Inside(cb.HalfSpace([0, 1], 3.0))]).replace(initial=start))
        a, b, c = (Fraction(float(shape[k])) for k in ((0, 0), (0, 1), (1, 1)))
        for p, q in setting.some_starts():
            x, y = Fraction(float(p)), Fraction(float(q))
            assert c * x * x - 2 * b * x * y + a * y * y <= a * c - b * b
            low, high = setting.starts_between(float(q), float(q))
            assert low <= p <= high
        ends = np.sqrt(float(a - b * b / c))  # of the chord at q = 0, exactly but for one rounding
        assert setting.starts_between(0.0, 0.0)[1] >= ends


def test_states_may_come_in_either_order() -> None:
    problem = mechanical(lambda x: -2 * x[0] - x[1], 0.8, [-0.8, -3], [0.8, 3], 0.25, (0.5, 0.4))
    system = cb.ContinuousSystem(lambda x: [-2 * x[1] - x[0], x[0]], states=2, diffusion=[[0.8], [0.0]])
    turned = cb.Problem(system, initial=[0.4, 0.5], safe=[cb.Inside(cb.Box([-3, -0.8], [3, 0.8]))], horizon=0.25)
    plan = Plan(count=4, fine=1.0, wide=0.02, cell=0.5, spare=1e-7)
    bound = bound_by_steps(setting_of(problem), plan)
    assert bound == bound_by_steps(setting_of(turned), plan)
    assert bound > 1e-4  # ten times what is paid for rare events


def test_a_start_that_runs_into_a_face_is_sure_to_fail_and_a_longer_horizon_never_safer() -> None:
    force = (lambda x: -2 * x[0] - x[1], 0.8, [-0.8, -3], [0.8, 3])
    at_once, short, long = (replace(COARSE, count=count) for count in (1, 6, 8))
    doomed = setting_of(mechanical(*force, 0.0625, (0.79, 2.0)))
    assert bound_by_steps(doomed, at_once) == pytest.approx(1.0, rel=1e-3)
    safer, riskier = (setting_of(mechanical(*force, horizon, (0.5, 0.4))) for horizon in (0.375, 0.5))
    assert 0.0035 < bound_by_steps(safer, short) < bound_by_steps(riskier, long) < 0.1  # .0037 by simulation


def exit_at_the_end() -> float:
    """P(|p| > .8 at time .8), from .1 at rest: a lower bound of the probability of leaving until then."""
    a = np.array([[0.0, 1.0], [-2.0, -1.0]])
    times = np.linspace(0, 0.8, 401)
    loads = np.array([expm(a * t)[0, 1] for t in times])
    spread = 0.8 * math.sqrt(np.trapezoid(loads**2, times))
    mean = 0.1 * expm(a * 0.8)[0, 0]
    return float(ndtr((mean - 0.8) / spread) + ndtr((-mean - 0.8) / spread))


def test_the_engine_answers_mechanical_problems(monkeypatch) -> None:
    monkeypatch.setattr(values, "_SECONDS", 0.3)
    problem = mechanical(lambda x: -2 * x[0] - x[1], 0.8, [-0.8, -3], [0.8, 3], 0.8, (0.1, 0.0))
    answer = values.values_engine(problem)
    assert answer.applicable
    assert "along the flow" in answer.reason
    exact = exit_at_the_end()
    assert math.log10(exact) < answer.log10_delta < math.log10(60 * exact)
    assert answer.log10_lower is None or answer.log10_lower < answer.log10_delta


def test_bad_arguments_are_named() -> None:
    problem = mechanical(lambda x: -2 * x[0] - x[1], 0.8, [-0.8, -3], [0.8, 3], 0.6, (0.1, 0.0))
    with pytest.raises(ValueError, match="`seconds` must be positive"):
        bound_exits_by_steps(problem, seconds=0)
    disturbed = cb.ContinuousSystem(
        lambda x, d: [x[1], d[0] - x[0]], states=2, diffusion=[[0.0], [0.3]], disturbance=cb.Box([-0.1], [0.1])
    )
    with pytest.raises(cb.InfeasibleError, match="neither disturbances nor plans"):
        bound_exits_by_steps(problem.replace(system=disturbed))
    windowed = problem.replace(safe=[cb.Inside(cb.Box([-0.8, -3], [0.8, 3]), during=(0.1, 0.6))])
    with pytest.raises(cb.InfeasibleError, match="neither moving sets nor windows"):
        bound_exits_by_steps(windowed)


def test_more_work_buys_finer_plans_and_the_clock_is_not_asked() -> None:
    setting = setting_of(mechanical(lambda x: -2 * x[0] - x[1], 0.8, [-0.8, -3], [0.8, 3], 0.5, (0.1, 0.0)))
    turn, scout = leaving._turn(setting), leaving.scout_of(setting)
    assert leaving._affordable(setting, turn, 1.0, scout) == [leaving._PLANS[0]]
    (some,), (more,) = (leaving._affordable(setting, turn, work, scout) for work in (1.7e6, 2.5e6))
    assert 0 < nodes_of(setting, leaving._plan(setting, turn, *some, 1e-9), scout) < 1.7e6 / 2
    assert all(finer <= coarser for finer, coarser in zip((more[0], *more[1]), (some[0], *some[1])))
    assert more != some


def test_a_force_that_changes_with_time_acts_when_it_does() -> None:
    plan, found = replace(COARSE, count=6, wide=0.03, fine=1.5), []
    for push in (2.5, -2.5):  # the same in reversed order
        problem = pushed(lambda t, push=push: push * np.sin(4 * np.pi * t), 0.5)
        upper, lower = bounds_by_steps(setting_of(problem), plan)
        share, error = simulated(problem, 10_000, np.random.default_rng(1))
        assert lower < share + 4 * error
        assert share - 4 * error < upper
        assert share < 2.5 * lower
        assert upper < 3 * share
        found.append((lower, upper))
    assert found[1][1] < found[0][0]


def test_steps_that_are_prepared_at_once_have_images_of_their_own(monkeypatch) -> None:
    monkeypatch.setattr(groundwork, "_ALIKE", 10.0)
    setting = setting_of(pushed(lambda t: 2.5 * np.sin(4 * np.pi * t), 0.5))
    layouts = list(layouts_of(setting, replace(COARSE, count=4, fine=2.0, wide=0.05)))
    assert len({id(layout.bands) for layout in layouts}) == 1
    drift = compile_numpy(setting.tape)
    for k, layout in zip((3, 2, 1, 0), layouts):
        frame, h, shear = layout.frame, layout.clock.step, layout.clock.shear
        assert layout.clock.begin.lo == 0
        assert layout.clock.begin.hi >= 3 * h
        i, j = len(frame.y) // 2, len(frame.q) // 2
        start = frame.y[i] + shear * frame.q[j], frame.q[j]
        p, q = solve_ivp(lambda t, x: drift(t, *x), (k * h, (k + 1) * h), start, rtol=1e-10, atol=1e-12).y[:, -1]
        assert np.all(np.abs(frame.image[:, i, j] - [p - shear * q, q]) <= frame.radius[:, i, j] + 1e-9)
        assert frame.radius[:, i, j].max() < 1e-3


def test_a_model_that_names_the_time_but_is_at_rest_has_the_bounds_of_one_that_does_not() -> None:
    plan = replace(COARSE, count=3, wide=0.03)
    still, clocked = (setting_of(pushed(push, 0.5)) for push in (lambda t: 0 * t, lambda t: np.minimum(t + 2, 1) - 1))
    assert clocked.timed
    assert not still.timed
    assert bounds_by_steps(clocked, plan) == pytest.approx(bounds_by_steps(still, plan), rel=1e-6)


def pushed(push, horizon: float) -> cb.Problem:
    """A velocity with friction, noise and a force that depends on time."""
    system = cb.ContinuousSystem(lambda x, t: [x[1], push(t) - 0.7 * x[1]], states=2, diffusion=[[0.0], [0.7]])
    return cb.Problem(system, initial=[0.0, 0.3], safe=[cb.Inside(cb.Box([-1, -1.5], [1, 1.5]))], horizon=horizon)


def test_the_steps_end_when_the_time_is_over() -> None:
    setting = setting_of(mechanical(lambda x: -2 * x[0] - x[1], 0.8, [-0.8, -3], [0.8, 3], 0.5, (0.1, 0.0)))
    ticks = itertools.count()
    with pytest.raises(OutOfTime), Watch(limit=3.0, clock=lambda: next(ticks)).running():
        bound_by_steps(setting, COARSE)


def test_a_drift_that_runs_away_beyond_a_face_is_no_fault_of_the_problem() -> None:
    """A neuron at rest, for which what may lie beyond its lower face grows without end."""
    system = cb.ContinuousSystem(
        lambda x: [0.08 * (x[1] + 0.7 - 0.8 * x[0]), x[1] - x[1] ** 3 / 3 - x[0]], states=2, diffusion=[[0.0], [0.1]]
    )
    box = cb.Box([-0.7, -3.0], [0.0, 0.5])
    setting = setting_of(cb.Problem(system, initial=[-0.5, -1.1], safe=[cb.Inside(box)], horizon=1))
    clock = Clock(step=0.15, count=10, shear=0.05, omega=6.0)
    face = mirrors._face(setting, clock, np.linspace(-0.7, 0.0, 5), (0, -3.0), 6.0)
    assert np.all(face.most == np.inf)


def test_beyond_a_face_nobody_counts_less_than_once() -> None:
    mirror = Mirror(
        inside=np.array([2, 1, 0]), beyond=np.array([2, 3, 4]), depths=np.array([0.0, 0.1, 0.2]),
        places=np.array([2, 3, 4]), rate=np.zeros(1), factor=np.ones(1), blind=np.zeros(1, bool),
        window=(np.zeros(1, int), np.ones(1, int)),
    )  # fmt: skip
    found = mirror.above(np.array([[0.5, 0.9, 1.2, 0.0, 0.0]]), np.zeros((1, 4)), np.full(4, 0.1))
    assert np.allclose(found, [[1.0, 1.1, 1.5]], atol=1e-9)
    assert np.all(found >= 1)


@pytest.mark.parametrize("pull", [-0.8, 0.0, 0.9])
@pytest.mark.parametrize("drift", [0.3, 1.4, 1.7, 3.0])
def test_whoever_met_a_face_counts_once_in_the_mean_where_the_inside_is_not_looked_at(drift, pull) -> None:
    s, h, depths = 1.0, 1.0, np.linspace(0, 8, 161)
    found = mirrors._paid((drift, pull), s, h, depths, (6.0, 0.15), blind=True)
    assert found is not None or math.prod(mirrors._leading((drift, pull), s, h)) > 3.8
    margin, level = mirrors._levelled([(math.inf, 0.0), (drift, pull)], s, h)
    fine = (np.arange(40000) + 0.5) / 5000
    for left in np.linspace(0.01, h, 12):
        mean, spread = after(drift, pull, s, left)
        density = np.exp(-((fine - mean) ** 2) / (2 * spread**2)) / math.sqrt(2 * math.pi) / spread / 5000
        assert (density * level).sum() + (ndtr(-mean / spread) if margin else 0.0) >= 1 - 1e-6
        if found is not None:
            counted = 1 + np.exp(np.minimum(found[0] * np.interp(fine, depths, depths), math.log(mirrors._MOST / 10)))
            total = (density * counted).sum()
            assert total * found[1] >= 1 - 1e-6
            assert pull != 0 or total <= 1.1


def after(drift: float, pull: float, s: float, left: float) -> tuple[float, float]:
    """Mean and standard deviation of the depth so long after a path has met 0, for the inward drift drift + pull d."""
    mean = -drift * (left if pull == 0 else -math.expm1(-pull * left) / pull)
    return mean, s * math.sqrt(left if pull == 0 else -math.expm1(-2 * pull * left) / (2 * pull))


@pytest.mark.parametrize("pull", [-0.3, 0.0, 0.9])
@pytest.mark.parametrize("drift", [-0.4, 0.1, 0.8])
def test_whoever_met_a_face_counts_once_from_either_side_whatever_the_rest_of_the_step(drift, pull) -> None:
    s, h, depths = 1.0, 1.0, np.linspace(0, 14, 1401)
    rate, factor = mirrors._paid((drift, pull), s, h, depths, (6.0, 0.15))
    face = mirrors._Face(
        most=np.array([drift]), least=np.array([drift]), pulls=(np.array([pull]),) * 2, window=np.zeros(1)
    )
    under, share = mirrors._granted(face, 0, 4.25, s, h, depths)
    assert (rate > 0) == (under > 0) == (drift > 0)
    inside = 0.6 * np.exp(-depths)
    for left in np.linspace(0.01, h, 9):
        mean, spread = after(drift, pull, s, left)
        weight = np.where(depths > 0, 0.01, 0.005) / math.sqrt(2 * math.pi) / spread
        near, back = (weight * np.exp(-((sign * depths - mean) ** 2) / (2 * spread**2)) for sign in (1, -1))
        above = (near * (1 + np.exp(rate * depths) * (1 - inside)) * factor + back * inside).sum()
        below = (near * (1 + np.exp(under * depths) * (1 - inside)) / share + back * inside).sum()
        assert below - 1e-4 <= 1 <= above + 1e-4
        if pull == 0 and drift > 0:
            assert above < 1.01 < below + 0.02


def scouted_problem() -> cb.Problem:
    return mechanical(lambda x: x[0] - x[0] ** 3 - 0.5 * x[1], 0.4, [0, -2], [2, 2], 1.5, (0.5, -0.1))


def test_scouts_say_where_a_grid_must_be_fine() -> None:
    setting = setting_of(scouted_problem())
    scout = leaving.scout_of(setting)
    assert scout is not None
    assert 0.5 * setting.horizon < scout.visits.sum() <= setting.horizon * (1 + 1e-9)  # paths that fail end early
    assert (scout.visits * scout.p).sum() < scout.visits.sum()  # they go to the left, where leaving is easy
    plan = replace(COARSE, count=15, loss=0.01, cell=0.3)
    assert nodes_of(setting, plan, scout) < 0.6 * nodes_of(setting, plan)
    calm = setting_of(mechanical(lambda x: -x[0] - x[1], 1e-3, [-5, -5], [5, 5], 0.5, (0.0, 0.0)))
    assert leaving.scout_of(calm) is None


@pytest.mark.slow
def test_on_a_scouted_grid_the_bounds_hold() -> None:
    rng, problem = np.random.default_rng(8), scouted_problem()
    setting = setting_of(problem)
    plan = replace(COARSE, count=15, loss=0.01, cell=0.3)
    seeing = next(layouts_of(setting, plan, leaving.scout_of(setting)))
    share, error = simulated(problem, 3_000, rng)
    upper, lower = bounds_by_steps(setting, plan, layouts=[seeing] * plan.count)
    assert lower - 4 * error < share < upper + 4 * error
    assert lower < upper < 2.5 * lower


def test_who_bows_out_within_a_step_is_counted() -> None:
    rng = np.random.default_rng(9)
    problem = mechanical(lambda x: 2.0 + 0 * x[0], 0.5, [0, -2], [2, 2], 0.1, (1.0, 0.0))  # pushed back inside
    setting, h = setting_of(problem), 0.1
    layout = next(layouts_of(setting, replace(COARSE, count=1)))
    value = back(layout.frame, layout.bands, layout.above, leaving.terminal(layout, layout.above))
    bow = 0.5 * h**1.5
    for p, q in ((0.4 * bow, 0.0), (0.8 * bow, 0.0), (1.5 * bow, -0.1), (0.6 * bow, 0.1), (5 * bow, -0.6)):
        paths, parts = 4000, 200
        x, v, least = np.full(paths, p), np.full(paths, q), np.full(paths, p)
        for _ in range(parts):
            kick = setting.noise * math.sqrt(h / parts) * rng.standard_normal(paths)
            x, v = x + h / parts * (v + kick / 2), v + 2.0 * h / parts + kick
            least = np.minimum(least, x)
        seen = (least < 0).mean()
        y = p - layout.clock.shear * q
        i, j = np.searchsorted(layout.frame.y, y) - 1, np.searchsorted(layout.frame.q, q, side="right") - 1
        most = value.nodal[i : i + 2, j : j + 2].max() + np.abs(value.bend[i : i + 2, j]).max() / 8 * 0.1**2
        assert most >= seen - 4 * math.sqrt(seen * (1 - seen) / paths)


def test_cells_beside_a_face_pay_for_paths_that_leave_and_come_back_within_a_step() -> None:
    """dp = v dt, dv = s dW: from a cell's end towards the face, at speeds that lead back or along it."""
    s, plan, rng = 0.8, replace(COARSE, count=4, cell=0.8), np.random.default_rng(7)
    setting = setting_of(mechanical(lambda x: 0.0 * x[0], s, [-1, -3], [1, 3], 1.0, (0.0, 0.0)))
    layout = next(layouts_of(setting, plan))
    h, paid = layout.clock.step, layout.above.paid
    short = 0.3 * s * h**1.5  # who ends nearer to the face than that is counted as having left
    y, q, shear = layout.frame.y, layout.frame.q, layout.clock.shear
    away = 1 - (y[1:, None] + shear * q[None, 1:])
    count, steps, seen = 5000, 100, 0.0
    for row, column in np.argwhere(layout.frame.live & (away >= short) & (away < 1.5 * short) & (np.abs(q[1:]) < 1)):
        for speed in np.linspace(q[column], q[column + 1], 4)[1:]:
            noise = np.cumsum(s * math.sqrt(h / steps) * rng.standard_normal((count, steps)), axis=1)
            p = y[row + 1] + shear * speed + np.cumsum(speed + noise, axis=1) * (h / steps)
            found = ((p.max(axis=1) > 1) & (p[:, -1] < 1 - short)).mean()
            assert found <= paid[row, column]
            seen = max(seen, found)
    assert seen > 5e-4


def test_whoever_met_a_face_counts_once_in_the_mean_on_whichever_line_it_ends() -> None:
    drifts, depths, fine = [0.9, 1.5, 2.2, 3.5], np.linspace(0, 8, 161), (np.arange(40000) + 0.5) / 5000
    rates, factors = np.full((2, 4), np.nan), np.ones((2, 4))
    for k in (0, 1):
        rates[k, k], factors[k, k] = mirrors._paid((drifts[k], 0.0), 1.0, 1.0, depths, (6.0, 0.15), blind=k == 1)
    always = [mirrors._levelled([(math.inf, 0.0), (drift, 0.0)], 1.0, 1.0)[1] for drift in drifts[2:]]
    levels = np.array([0, 0, *always])[:, None]
    around = np.array([0, 0, 1, 2]), np.array([2, 3, 4, 4])  # paths come to a line and the next ones
    levels = mirrors._alike(np.arange(4), rates, factors, levels, around)
    found = levels + 0 * fine
    for rate, factor, most in zip(rates, factors, (mirrors._MOST, mirrors._MOST / 10)):
        asks = factor[:, None] * (1 + np.exp(np.minimum(rate[:, None] * fine, np.log(most))))
        found = np.maximum(found, np.where(np.isnan(asks), 0, asks))
    for first in range(3):  # such a path has the lesser drift, whatever its line is
        density = np.exp(-((fine + drifts[first]) ** 2) / 2) / math.sqrt(2 * math.pi) / 5000
        assert (density * np.minimum(found[first], found[first + 1])).sum() > 1 - 1e-6


def test_where_paths_run_off_beyond_a_limit_the_other_state_is_looked_at_within_it() -> None:
    system = cb.ContinuousSystem(lambda x: [x[1], x[0] ** 3 - x[0]], states=2, diffusion=[[0.0], [0.5]])
    safe = [cb.Inside(cb.Box([-0.9], [0.9], coordinates=[0]))]
    faces = setting_of(cb.Problem(system, initial=[0, 0], safe=safe, horizon=20)).faces
    assert faces[0] == (-0.9, 0.9)
    assert max(np.abs(faces[1])) < 5
