"""The contraction tube (Thm K5)."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from certbound.errors import EnclosureError
from certbound.problem.noise import Gaussian
from certbound.problem.problem import Problem
from certbound.problem.sets.constraints import GaussianStart
from certbound.problem.sets.regions import Ball, Box, Ellipsoid
from certbound.problem.systems import ContinuousSystem, DiscreteSystem, linear_system
from certbound.reach.contraction.uniform import contraction_tube, growth, values_on_pieces
from certbound.reach.nominal.cells import initial_cells
from certbound.reach.nominal.curve import Curve
from certbound.reach.sets.reach_tube import ReachTube
from certbound.rigor.norms import Norm
from certbound.tubes.constants import Constants


def scalar(rate, horizon=2.0, initial=None, d=None) -> Problem:
    if d is None:
        system = ContinuousSystem(lambda x: [rate * x[0]], states=1, diffusion=0.1)
    else:
        system = ContinuousSystem(
            lambda x, d: [rate * x[0] + d[0]], states=1, diffusion=0.1, disturbance=Box([-d], [d])
        )
    return Problem(system, initial=Box([0.9], [1.1]) if initial is None else initial, safe=[], horizon=horizon)


def trajectory(problem, start, signal, times):
    """Noise-free states under a disturbance signal t -> d."""
    tape_value = __import__("certbound.reach.nominal.flow", fromlist=["Flow"]).Flow(problem).value
    solution = solve_ivp(
        lambda t, x: tape_value(t, x, np.zeros(0), signal(t)),
        (0, times[-1]),
        start,
        t_eval=times,
        rtol=1e-9,
        atol=1e-10,
        max_step=0.02,
    )
    return solution.y.T


@pytest.mark.parametrize("rate", [-3.0, -0.5, 0.0, 1e-17, 0.7])
def test_scalar_closed_form(rate):
    tube = contraction_tube(scalar(rate), Constants(rate=rate, sigma=0.1, dimension=1))
    ends = 0.1 * np.exp(rate * np.stack([tube.curve.starts, tube.curve.ends]))
    assert tube.end == 2.0
    assert np.all(tube.radius[0] >= ends.max(axis=0))
    assert np.all(tube.radius[0] <= ends.max(axis=0) + 1e-7)


@pytest.mark.parametrize("rate", [-2.0, 0.0, 0.7])
def test_disturbance_enters_by_its_integral(rate):
    tube = contraction_tube(scalar(rate, initial=[1.0], d=0.3), Constants(rate=rate, sigma=0.1, dimension=1))
    t = tube.curve.ends
    exact = 0.3 * (t if rate == 0 else np.expm1(rate * t) / rate)
    assert np.all(tube.radius[0] >= exact)
    assert np.all(tube.radius[0] <= exact * (1 + 1e-6) + 1e-7)


def test_discrete_closed_form_and_time_varying_gain():
    system = DiscreteSystem(lambda t, x: [0.5 * x[0] + 0.25 * t], states=1, noise=Gaussian(std=0.1))
    problem = Problem(system, initial=Box([0.9], [1.1]), safe=[], horizon=6)
    constants = Constants(gain=[0.5, 2.0, 0.5], sigma=0.1, dimension=1, times=[0, 2, 3, 6])
    radius = contraction_tube(problem, constants).radius[0]
    assert radius.shape == (7,)
    assert radius == pytest.approx(0.1 * np.cumprod([1, 0.5, 0.5, 2.0, 0.5, 0.5, 0.5]), rel=1e-12)
    assert np.all(radius >= 0.1 * np.cumprod([1, 0.5, 0.5, 2.0, 0.5, 0.5, 0.5]) * (1 - 1e-16))


def test_trajectories_stay_inside_for_corners_random_starts_and_hostile_disturbances():
    system = ContinuousSystem(
        lambda t, x, d: [x[1], -x[0] - x[1] + 0.3 * np.sin(x[0]) + d[0] * np.cos(t)],
        states=2,
        diffusion=np.eye(2),
        disturbance=Box([-0.2], [0.3]),
    )
    problem = Problem(system, initial=Box([0.9, -0.1], [1.1, 0.1]), safe=[], horizon=3.0)
    metric = np.array([[1.5, 0.5], [0.5, 1.0]])
    # a rate that holds for every slope of sin in [-1, 1] in this metric (checked on a grid with slack)
    root = np.linalg.cholesky(metric).T
    worst = -np.inf
    for slope in np.linspace(-0.3, 0.3, 31):
        seen = root @ np.array([[0, 1], [-1 + slope, -1]]) @ np.linalg.inv(root)
        worst = max(worst, np.linalg.eigvalsh((seen + seen.T) / 2)[-1])
    tube = contraction_tube(problem, Constants(rate=worst + 1e-6, sigma=1.0, dimension=2, metric=metric))
    rng = np.random.default_rng(4)
    times = np.linspace(0, 3, 31)
    starts = [
        *np.stack(np.meshgrid([0.9, 1.1], [-0.1, 0.1]), -1).reshape(-1, 2),
        *rng.uniform([0.9, -0.1], [1.1, 0.1], (6, 2)),
    ]
    signals = [
        lambda t: np.array([0.3]),
        lambda t: np.array([-0.2]),
        lambda t: np.array([0.3 if np.cos(t) > 0 else -0.2]),
    ]
    for start in starts:
        for signal in signals:
            for t, x in zip(times, trajectory(problem, start, signal, times)):
                assert tube.contains(t, x, tolerance=1e-7)


def test_cells_cover_the_start_and_never_widen_the_tube():
    problem = scalar(0.5)
    constants = Constants(rate=0.5, sigma=0.1, dimension=1)
    one, four = contraction_tube(problem, constants), contraction_tube(problem, constants, cells=4)
    assert four.curve.cells == 4
    assert four.contains(0.0, [0.9])
    assert four.contains(0.0, [1.1])
    assert np.all(four.hull.lo >= one.hull.lo - 1e-7)
    assert np.all(four.hull.hi <= one.hull.hi + 1e-7)
    assert float(four.radius.max()) < 0.3 * float(one.radius.max())


@pytest.mark.parametrize("n", [2, 12])
def test_round_initial_sets_are_covered(n):
    rng = np.random.default_rng(n)
    raw = rng.normal(size=(n, n))
    metric = raw @ raw.T + np.eye(n)
    shape = np.diag(rng.uniform(0.5, 2.0, n))
    system = linear_system(-np.eye(n), time="continuous", diffusion=np.eye(n))
    norm = Norm(n, metric)
    for region in (Ball(np.ones(n), 0.5), Ellipsoid(np.ones(n), shape)):
        problem = Problem(system, initial=region, safe=[], horizon=1.0)
        cells = initial_cells(problem)
        from certbound.rigor.intervals import Interval

        bound = cells.radii(norm, Interval.point(np.ones((1, n))))[0]
        points = region.sample(rng, 4000) - 1.0
        sampled = np.sqrt(np.einsum("bi,ij,bj->b", points, metric, points)).max()
        half = 0.25 * np.eye(n) if isinstance(region, Ball) else shape
        exact = np.sqrt(np.max(np.linalg.eigvals(half @ metric).real))
        assert sampled <= bound
        assert exact * (1 - 1e-9) <= bound <= exact * (1 + 1e-6)


def test_a_random_start_is_represented_by_its_mean():
    system = ContinuousSystem(lambda x: [-x[0]], states=1, diffusion=0.1)
    problem = Problem(system, initial=GaussianStart([2.0], [[0.01]]), safe=[], horizon=1.0)
    cells = initial_cells(problem)
    assert cells.centres.tolist() == [[2.0]]
    assert cells.boxes.width.max() == 0


def test_a_larger_rate_start_or_horizon_never_gives_a_smaller_tube():
    base = contraction_tube(scalar(0.2), Constants(rate=0.2, sigma=0.1, dimension=1))
    wider = contraction_tube(scalar(0.2, initial=Box([0.8], [1.2])), Constants(rate=0.2, sigma=0.1, dimension=1))
    faster = contraction_tube(scalar(0.2), Constants(rate=0.4, sigma=0.1, dimension=1))
    assert np.all(wider.radius >= base.radius)
    assert np.all(faster.radius >= base.radius)


def test_user_stated_constants_are_named_as_an_assumption():
    assert contraction_tube(scalar(0.2), Constants(rate=0.2, sigma=0.1, dimension=1)).assumption


def test_the_tube_ends_where_the_closed_loop_is_undefined():
    system = ContinuousSystem(lambda t, x: [np.where(t * t < 1.0, 1.0, -1.0)], states=1, diffusion=0.1)
    problem = Problem(system, initial=[0.0], safe=[], horizon=2.0)
    tube = contraction_tube(problem, Constants(rate=0.0, sigma=0.1, dimension=1))
    assert tube.end <= 1.0
    assert tube.end > 0.9
    broken = ContinuousSystem(lambda x: [np.where(x[0] > 0, 1.0, 2.0)], states=1, diffusion=0.1)
    with pytest.raises(EnclosureError, match="first piece"):
        contraction_tube(
            Problem(broken, initial=[0.0], safe=[], horizon=2.0), Constants(rate=0.0, sigma=0.1, dimension=1)
        )


def test_refusals():
    with pytest.raises(ValueError, match="`constants` must state a rate"):
        contraction_tube(scalar(0.2), Constants(gain=0.5, sigma=0.1, dimension=1))
    with pytest.raises(ValueError, match="`cells` must be a positive integer"):
        initial_cells(scalar(0.2), 0)
    wide = linear_system(-np.eye(12), time="continuous", diffusion=np.eye(12))
    with pytest.raises(ValueError, match="at most 4096 cells"):
        initial_cells(Problem(wide, initial=Box(-np.ones(12), np.ones(12)), safe=[], horizon=1.0), 3)
    with pytest.raises(ValueError, match="`times` must reach the horizon"):
        contraction_tube(scalar(0.2), Constants(rate=[0.1, 0.2], sigma=0.1, dimension=1, times=[0, 0.5, 1.0]))


def test_growth_factors_bound_the_exact_ones_tightly():
    import flint

    rates = np.array([-50.0, -3.0, -0.4, -1e-9, 0.0, 1e-17, 1e-3, 0.49, 0.51, 4.0, 30.0])
    lengths = np.full(len(rates), 0.7)
    curve = Curve(
        continuous=True,
        starts=np.cumsum(lengths) - 0.7,
        ends=np.cumsum(lengths),
        coefficients=np.zeros((1, len(rates), 1, 1)),
    )
    factor, integral = growth(rates, curve)
    for k, c in enumerate(rates):
        h = flint.arb(float(curve.ends[k])) - flint.arb(float(curve.starts[k]))
        x = flint.arb(float(c)) * h
        exact = x.exp()
        area = h if c == 0 else (exact - 1) / flint.arb(float(c))
        assert float(exact.lower()) <= factor[k] <= float(exact) * (1 + 1e-13)
        if abs(c) > 1e-8 or c == 0:
            assert float(area.lower()) <= integral[k] <= float(area) * (1 + 1e-12)


def test_infinite_rates_give_infinite_growth():
    curve = Curve(continuous=True, starts=[0.0], ends=[1.0], coefficients=np.zeros((1, 1, 1, 1)))
    factor, integral = growth(np.array([np.inf]), curve)
    assert np.isinf(factor[0])
    assert np.isinf(integral[0])


def test_piecewise_values_take_the_largest_on_each_piece():
    curve = Curve(continuous=True, starts=[0, 0.5, 1.0], ends=[0.5, 1.0, 2.0], coefficients=np.zeros((1, 3, 1, 1)))
    assert values_on_pieces([1.0, 5.0, 2.0], np.array([0, 0.5, 0.8, 2.0]), curve).tolist() == [1.0, 5.0, 2.0]
    assert values_on_pieces(3.0, None, curve).tolist() == [3.0, 3.0, 3.0]


def test_the_tube_is_a_reach_tube_without_noise():
    tube = contraction_tube(scalar(0.2), Constants(rate=0.2, sigma=0.1, dimension=1))
    assert isinstance(tube, ReachTube)
    assert not tube.noise
    assert tube.log10_delta == -np.inf
