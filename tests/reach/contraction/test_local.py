"""Local constants along the reach tube (Thms K4, K5)."""

from __future__ import annotations

import numpy as np
import pytest

from certbound.errors import EnclosureError
from certbound.problem.library import MODELS
from certbound.problem.model.evaluation import compile_numpy
from certbound.problem.noise import Gaussian
from certbound.problem.problem import Problem
from certbound.problem.sets.regions import Box
from certbound.problem.systems import ContinuousSystem, DiscreteSystem
from certbound.reach.contraction.local import local_contraction_tube
from certbound.reach.contraction.slopes import LocalSlopes
from certbound.reach.nominal.flow import Flow
from certbound.reach.nominal.integration import nominal_curve
from certbound.rigor.norms import Norm


def cubic(half=0.05, horizon=2.0, d=0.0) -> Problem:
    system = ContinuousSystem(
        lambda x, d: [x[1], -x[0] - x[1] - x[0] ** 3 + d[0]], states=2, diffusion=np.eye(2), disturbance=Box([-d], [d])
    )
    start = np.array([0.6, 0.0])
    return Problem(system, initial=Box(start - half, start + half), safe=[], horizon=horizon)


def simulate(problem: Problem, starts: np.ndarray, d: np.ndarray, tube, steps_per_piece: int = 4):
    """Float trajectories by fine Runge-Kutta steps between the tube's nodes: yields (t, states)."""
    flow = Flow(problem)
    x = starts.copy()
    rows = np.zeros((len(x), 0))
    for start, end in zip(tube.curve.starts, tube.curve.ends):
        h = (end - start) / steps_per_piece
        for k in range(steps_per_piece):
            t = start + k * h
            f = lambda s, y: flow.value(np.full(len(y), s), y, rows, d)  # noqa: E731
            k1 = f(t, x)
            k2 = f(t + h / 2, x + h / 2 * k1)
            k3 = f(t + h / 2, x + h / 2 * k2)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + f(t + h, x + h * k3))
        yield float(end), x


@pytest.mark.parametrize("problem", [cubic(), cubic(0.02, 3.0, 0.05)])
def test_noise_free_trajectories_stay_inside(problem):
    tube = local_contraction_tube(problem)
    assert tube.end == problem.horizon
    rng = np.random.default_rng(0)
    corners = np.stack(np.meshgrid(*zip(problem.initial.low, problem.initial.high)), -1).reshape(-1, 2)
    starts = np.concatenate([corners, problem.initial.sample(rng, 200)])
    box = problem.system.disturbance
    d = np.concatenate([np.full((100, 1), box.high[0]), np.full((len(starts) - 100, 1), box.low[0])])
    metric = np.eye(2)
    for k, (t, x) in enumerate(simulate(problem, starts, d, tube)):
        y = x - tube.curve.value(t)[0]
        lengths = np.sqrt(np.einsum("bi,ij,bj->b", y, metric, y))
        last = min(k + 1, tube.curve.pieces - 1)
        assert lengths.max() <= max(tube.radius[0, k], tube.radius[0, last]) + 1e-9


def test_local_rates_are_close_to_what_sampling_finds_and_above_it():
    problem = MODELS["unicycle"]()
    flow = Flow(problem)
    centre = (problem.initial.low + problem.initial.high) / 2
    curve = nominal_curve(flow, centre)
    radius = 0.1
    bound = LocalSlopes(flow, Norm(3)).bound(curve, np.full((1, curve.pieces), radius))[0]
    rng = np.random.default_rng(1)
    for k in (0, curve.pieces // 2, curve.pieces - 1):
        unit = rng.normal(size=(4000, 3))
        x = curve.coefficients[0, k, 0] + radius * unit / np.linalg.norm(unit, axis=1, keepdims=True)
        jacobians = compile_numpy(flow.state_jacobian)(curve.middles[k], *x.T, rng.uniform(-0.1, 0.1, 4000))
        sampled = np.linalg.eigvalsh((jacobians + jacobians.swapaxes(1, 2)) / 2)[:, -1].max()
        assert sampled <= bound[k] <= sampled + 0.08


def test_rates_grow_with_the_ball():
    flow = Flow(cubic())
    curve = nominal_curve(flow, [0.6, 0.0])
    slopes = LocalSlopes(flow, Norm(2))
    small, large = (slopes.bound(curve, np.full((1, curve.pieces), r)) for r in (0.05, 0.5))
    assert np.all(small <= large + 1e-9)
    assert np.all(np.isinf(slopes.bound(curve, np.full((1, curve.pieces), np.inf))))


def test_a_jump_in_the_middle_of_a_ball_leaves_it_unbounded_and_the_others_as_they_were():
    system = DiscreteSystem(lambda x: [np.arctan2(x[0], x[1]), 0.5 * x[1] + 1], states=2, noise=Gaussian(std=0.1))
    flow = Flow(Problem(system, initial=Box([0.0, 0.0], [0.0, 0.0]), safe=[], horizon=3))
    curve = nominal_curve(flow, [0.0, 0.0])
    bounds = LocalSlopes(flow, Norm(2)).bound(curve, np.full((1, curve.pieces), 0.01))[0]
    assert bounds[0] == np.inf
    assert np.all(bounds[1:] < 2.0)


def test_a_point_keeps_to_its_trajectory():
    tube = local_contraction_tube(cubic(0.0))
    assert tube.end == 2.0
    assert float(tube.radius.max()) < 1e-6


def test_cells_shrink_the_tube():
    one, four = (local_contraction_tube(cubic(0.1, 1.0), cells=k) for k in (1, 2))
    assert four.curve.cells == 4
    assert float(four.radius.max()) < 0.6 * float(one.radius.max())


def test_the_metric_is_used():
    metric = np.array([[2.0, 0.5], [0.5, 1.0]])
    tube = local_contraction_tube(cubic(horizon=0.5), metric=metric)
    assert tube.norm.matrix is not None
    plain = local_contraction_tube(cubic(horizon=0.5))
    assert not np.allclose(tube.radius[0, -1], plain.radius[0, -1])


def test_the_tube_stops_before_a_singularity_and_says_where():
    system = ContinuousSystem(lambda x: [-1.0 / x[0]], states=1, diffusion=0.1)
    problem = Problem(system, initial=Box([0.9], [1.1]), safe=[], horizon=0.45)
    tube = local_contraction_tube(problem)
    assert 0.1 < tube.end < 0.405  # the trajectory from 0.9 ends at 0.405
    inside = local_contraction_tube(problem.replace(horizon=0.1))
    assert inside.end == 0.1


def test_discrete_time_marches_step_by_step():
    system = DiscreteSystem(lambda x: [0.9 * x[0] + 0.1 * np.sin(x[1]), 0.8 * x[1]], states=2, noise=Gaussian(std=0.1))
    problem = Problem(system, initial=Box([0.9, 0.9], [1.1, 1.1]), safe=[], horizon=15)
    tube = local_contraction_tube(problem)
    assert tube.curve.pieces == 16
    rng = np.random.default_rng(2)
    x = problem.initial.sample(rng, 500)
    for t in range(16):
        y = x - tube.curve.value(t)[0]
        assert np.linalg.norm(y, axis=1).max() <= tube.radius[0, t]
        x = np.stack([0.9 * x[:, 0] + 0.1 * np.sin(x[:, 1]), 0.8 * x[:, 1]], -1)


def test_a_closed_loop_that_jumps_at_the_start_is_refused():
    system = ContinuousSystem(lambda x: [np.where(x[0] > 0, 1.0, -1.0)], states=1, diffusion=0.1)
    problem = Problem(system, initial=Box([-0.1], [0.1]), safe=[], horizon=1.0)
    with pytest.raises(EnclosureError, match="first piece"):
        local_contraction_tube(problem)


def test_twelve_states():
    n = 12
    coupling = -np.eye(n) + 0.4 * np.eye(n, k=1)
    system = ContinuousSystem(lambda x: coupling @ np.tanh(x), states=n, diffusion=np.eye(n))
    problem = Problem(system, initial=Box(0.3 * np.ones(n), 0.32 * np.ones(n)), safe=[], horizon=0.5)
    tube = local_contraction_tube(problem)
    assert tube.end == 0.5
    assert float(tube.radius[0, -1]) < float(tube.radius[0, 0])


def test_slopes_that_overflow_choose_what_is_halved_without_a_warning() -> None:
    system = ContinuousSystem(lambda x: [-(x[0] ** 9), -x[1] * np.exp(3 * x[0])], states=2, diffusion=0.1 * np.eye(2))
    problem = Problem(system, initial=Box([0.5, 0.0], [2.0, 2.0]), safe=[], horizon=2.0)
    with pytest.raises(EnclosureError, match="on its first piece"):
        local_contraction_tube(problem)
