"""Nominal curves and their proved defects."""

from __future__ import annotations

import time

import numpy as np
import pytest

from certbound.errors import EngineError
from certbound.problem.noise import Gaussian
from certbound.problem.problem import Problem
from certbound.problem.sets.constraints import Inside
from certbound.problem.sets.regions import Box, HalfSpace
from certbound.problem.systems import ContinuousSystem, DiscreteSystem, linear_system
from certbound.reach.nominal.flow import Flow
from certbound.reach.nominal.integration import bound_defect, bound_disturbance_slope, nominal_curve, time_grid


def continuous(f, n, horizon=2.0, point=None, **options) -> Flow:
    system = ContinuousSystem(f, states=n, **{k: v for k, v in options.items() if k in ("disturbance", "inputs")})
    rest = {k: v for k, v in options.items() if k in ("plan", "safe")}
    return Flow(
        Problem(system, initial=point if point is not None else np.zeros(n), horizon=horizon, **({"safe": []} | rest))
    )


def sampled_defect(flow: Flow, curve, count=9) -> np.ndarray:
    """|p' - f(p)| on a grid of every piece."""
    result = np.zeros((curve.cells, curve.pieces, curve.dimension))
    rows = flow.plan_rows(curve.starts)
    for fraction in np.linspace(0, 1, count):
        t = curve.starts + fraction * (curve.ends - curve.starts)
        s = (t - curve.middles)[:, None]
        powers = [curve.coefficients[..., j, :] * s**j for j in range(curve.coefficients.shape[2])]
        slopes = [curve.coefficients[..., j, :] * j * s ** (j - 1) for j in range(1, curve.coefficients.shape[2])]
        error = sum(slopes) - flow.value(t, sum(powers), rows)
        result = np.maximum(result, np.abs(error))
    return result


def test_the_curve_follows_the_known_solution():
    flow = continuous(lambda x: [x[1], -x[0]], 2, horizon=6.0, point=[1.0, 0.0])
    curve = nominal_curve(flow, [1.0, 0.0])
    t = np.linspace(0, 6, 101)
    exact = np.stack([np.cos(t), -np.sin(t)], axis=-1)
    assert np.max(np.abs(curve.value(t)[0] - exact)) < 1e-8


@pytest.mark.parametrize(
    ("f", "n", "point"),
    [
        (lambda x: [x[1], -np.sin(x[0]) - 0.1 * x[1]], 2, [1.0, 0.0]),
        (lambda t, x: [np.tanh(x[1]) + np.cos(3 * t), np.exp(-(x[0] ** 2)) - x[1]], 2, [0.3, -0.5]),
        (lambda x: [-x[0] / (1 + x[1] ** 2), np.sqrt(2 + x[0]), np.arctan2(x[0], 3 + x[1])], 3, [1.0, 0.0, 0.2]),
    ],
)
def test_the_defect_bounds_what_sampling_finds_and_is_small(f, n, point):
    flow = continuous(f, n, point=point)
    curve = nominal_curve(flow, point)
    bound = bound_defect(flow, curve)
    assert np.all(bound.mag >= sampled_defect(flow, curve) - 1e-13)
    assert np.max(bound.mag) < 1e-6


def test_the_defect_falls_with_the_fifth_power_of_the_piece():
    flow = continuous(lambda x: [x[1], -np.sin(x[0])], 2, point=[1.0, 0.0])
    sizes = []
    for pieces in (16, 32):
        curve = nominal_curve(flow, [1.0, 0.0], times=np.linspace(0, 2, pieces + 1))
        sizes.append(np.max(bound_defect(flow, curve).mag))
    assert sizes[0] / sizes[1] > 2**3.5


def test_a_wrong_curve_has_a_large_defect():
    flow = continuous(lambda x: [x[1], -x[0]], 2, point=[1.0, 0.0])
    other = continuous(lambda x: [x[1], -1.1 * x[0]], 2, point=[1.0, 0.0])
    curve = nominal_curve(other, [1.0, 0.0])
    assert np.max(bound_defect(flow, curve).mag) > 0.05


def test_the_defect_sees_what_happens_between_nodes_at_a_kink():
    flow = continuous(lambda x: [1.0, np.abs(x[0])], 2, point=[-1.0, 0.0])
    curve = nominal_curve(flow, [-1.0, 0.0])
    assert np.all(bound_defect(flow, curve).mag >= sampled_defect(flow, curve, 41) - 1e-13)
    assert np.max(bound_defect(flow, curve).mag) < 0.1


def test_pieces_where_the_closed_loop_jumps_are_refused():
    flow = continuous(lambda x: [1.0, np.where(x[0] > 0, 1.0, -1.0)], 2, point=[-1.0, 0.0])
    curve = nominal_curve(flow, [-1.0, 0.0], times=np.linspace(0, 2, 21))
    unbounded = np.isinf(bound_defect(flow, curve).mag).any(axis=(0, 2))
    assert unbounded[9:11].any()
    assert not unbounded[:8].any()
    assert not unbounded[12:].any()


def test_an_array_plan_switches_at_nodes_and_the_defect_stays_small():
    system = linear_system(
        [[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], time="continuous", diffusion=np.eye(2), inputs=Box([-2], [2])
    )
    problem = Problem(system, initial=[0, 0], safe=[], horizon=3.0, plan=[[1.0], [-2.0], [0.5]])
    flow = Flow(problem)
    curve = nominal_curve(flow, [0.0, 0.0])
    assert {0.0, 1.0, 2.0} <= set(curve.starts.tolist())
    assert np.max(bound_defect(flow, curve).mag) < 1e-12
    assert curve.value(3.0)[0, 1] == pytest.approx(-0.5)


def test_window_ends_are_nodes():
    flow = continuous(lambda x: [1.0], 1, safe=[Inside(HalfSpace([1.0], 9.0), during=(0.3, 1.7))])
    grid = time_grid(flow, 10)
    assert {0.0, 0.3, 1.7, 2.0} <= set(grid.tolist())
    assert np.all(np.diff(grid) > 0)


def test_discrete_time_accounts_for_rounding():
    system = DiscreteSystem(lambda x: [0.1 * x[0] + np.sin(x[1]), x[0] / 3], states=2, noise=Gaussian(std=0.1))
    flow = Flow(Problem(system, initial=[1.0, 2.0], safe=[], horizon=20))
    curve = nominal_curve(flow, [1.0, 2.0])
    defect = bound_defect(flow, curve)
    assert defect.shape == (1, 20, 2)
    assert np.all(defect.lo <= 0)
    assert np.all(defect.hi >= 0)
    assert 0 < np.max(defect.mag) < 1e-13


def test_disturbance_slope_encloses_the_difference():
    flow = continuous(
        lambda x, d: [x[1] * np.cos(d[0]), -x[0] + d[1] ** 2],
        2,
        point=[1.0, 0.5],
        disturbance=Box([-0.4, -0.2], [0.6, 0.3]),
    )
    curve = nominal_curve(flow, [1.0, 0.5])
    slope = bound_disturbance_slope(flow, curve)
    assert slope.shape == (1, curve.pieces, 2, 2)
    rng = np.random.default_rng(0)
    d0 = flow.centre_disturbance
    for _ in range(20):
        d = rng.uniform([-0.4, -0.2], [0.6, 0.3])
        k = int(rng.integers(curve.pieces))
        t = rng.uniform(curve.starts[k], curve.ends[k])
        p = curve.value(t)[0]
        rows = np.zeros((0,))
        difference = flow.value(t, p, rows, d) - flow.value(t, p, rows, d0)
        image = (slope[0, k] @ (d - d0)[:, None])[:, 0]
        assert np.all(image.lo - 1e-12 <= difference)
        assert np.all(difference <= image.hi + 1e-12)


def test_twelve_states_and_several_cells_at_once():
    n = 12
    chain = -np.eye(n) + 0.5 * np.eye(n, k=1)
    flow = continuous(lambda x: chain @ np.tanh(x), n, point=np.zeros(n))
    points = np.random.default_rng(1).normal(size=(3, n))
    curve = nominal_curve(flow, points)
    assert curve.coefficients.shape[0] == 3
    assert np.max(bound_defect(flow, curve).mag) < 1e-6
    assert np.max(curve.jumps().mag) < 1e-12


def test_a_horizon_beyond_a_blow_up_is_refused():
    flow = continuous(lambda x: [x[0] ** 2], 1, point=[1.0], horizon=2.0)
    with pytest.raises(EngineError, match=r"the noise-free trajectory is lost.*; shorten the horizon"):
        nominal_curve(flow, [1.0])


def test_a_discrete_trajectory_that_overflows_is_refused():
    system = DiscreteSystem(lambda x: [x[0] ** 3], states=1, noise=Gaussian(std=0.1))
    flow = Flow(Problem(system, initial=[10.0], safe=[], horizon=20))
    with pytest.raises(EngineError, match="lost"):
        nominal_curve(flow, [10.0])


def test_inputs_without_a_plan_are_refused():
    system = linear_system([[0.0]], [[1.0]], time="continuous", diffusion=1.0)
    with pytest.raises(ValueError, match="give `plan=`"):
        Flow(Problem(system, initial=[0.0], safe=[], horizon=1.0))


def test_a_solver_that_chatters_at_a_jump_is_given_up_soon() -> None:
    system = ContinuousSystem(lambda x: [-0.5 * np.sign(x[0]) - x[0]], states=1)
    problem = Problem(system, initial=[0.2], safe=[], horizon=1.0)
    started = time.process_time()
    with pytest.raises(EngineError, match=r"cannot be followed beyond t = 0\.336"):
        nominal_curve(problem, [0.2])
    assert time.process_time() - started < 5.0
    oscillator = ContinuousSystem(lambda x: [100.0 * x[1], -100.0 * x[0]], states=2)  # 16 periods are followed
    curve = nominal_curve(Problem(oscillator, initial=[1.0, 0.0], safe=[], horizon=1.0), [1.0, 0.0])
    assert curve.value(1.0)[0] == pytest.approx([np.cos(100.0), -np.sin(100.0)], abs=1e-8)


def test_a_trajectory_is_followed_once_however_often_its_grid_is_refined(monkeypatch):
    flow = continuous(lambda x: [x[1], 8 * (1 - x[0] ** 2) * x[1] - x[0]], 2, horizon=8.0, point=np.array([2.0, 0.1]))
    evaluated, value = [], Flow.value

    def counted(self, t, state, row):
        evaluated.append(np.ndim(t) == 0)
        return value(self, t, state, row)

    monkeypatch.setattr(Flow, "value", counted)
    curve = nominal_curve(flow, [[2.0, 0.1]])
    refined = sum(evaluated)
    assert curve.pieces > 1.5 * len(time_grid(flow, 128))
    evaluated.clear()
    grid = np.append(curve.starts, curve.ends[-1])
    fresh = nominal_curve(flow, [[2.0, 0.1]], times=grid)
    assert refined < 1.5 * sum(evaluated)
    np.testing.assert_array_equal(curve.coefficients, fresh.coefficients)
