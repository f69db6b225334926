"""Uniform noise, against brute force and simulation."""

from __future__ import annotations

import numpy as np
import pytest

import certbound as cb
from certbound.problem.model.evaluation import compile_numpy
from certbound.values.discrete.failures import bound_failure
from certbound.values.discrete.functions import ValueFunction
from certbound.values.discrete.induction import back_above, back_below, zones_of
from certbound.values.discrete.shocks import Inapplicable, shocks_of
from certbound.values.discrete.steps import Dynamics
from certbound.values.discrete.uniform_noise import UniformTables, UniformTransition
from certbound.values.grids import Grid
from tests.values.discrete.helpers import mean_over_boxes, random_function
from tests.values.discrete.test_failures import limits
from tests.values.discrete.test_transitions import STEPS

HALF = np.array([0.4, 0.3])


def setting(name: str, seed: int) -> tuple[cb.Problem, UniformTransition, ValueFunction]:
    system = cb.DiscreteSystem(STEPS[name], states=2, noise=cb.Uniform(halfwidth=HALF))
    problem = cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 0.9]))], horizon=1)
    grid = Grid(axes=(np.linspace(-1, 1, 8), np.linspace(-1, 0.9, 7)))
    step = Dynamics(problem).step(0, grid)
    tables = UniformTables(grid, shocks_of(system.noise, system.noise_matrix), *step.hull(), fineness=15.0)
    return problem, UniformTransition(step, tables), random_function(np.random.default_rng(seed), grid, fixed=0.3)


@pytest.mark.parametrize("name", STEPS)
def test_the_table_and_the_slopes_enclose_the_mean(name: str) -> None:
    _, transition, value = setting(name, 1)
    field = transition.tables.field(value)
    mesh = field.mesh
    rng = np.random.default_rng(2)
    index = np.stack([rng.integers(0, count - 1, 40) for count in mesh.count], axis=1)
    points = mesh.start + mesh.step * index
    exact = mean_over_boxes(value, points, HALF)
    assert np.all(np.abs(field.table[tuple(index.T)] - exact) <= field.error + 1e-12)
    inner = points + mesh.step * rng.uniform(0.1, 0.9, points.shape)
    for i, (low, high) in enumerate(field.slopes):
        away = 1e-6 * np.eye(2)[i]
        slope = (mean_over_boxes(value, inner + away, HALF) - mean_over_boxes(value, inner - away, HALF)) / 2e-6
        assert np.all(low[tuple(index.T)] <= slope + 1e-6)
        assert np.all(slope <= high[tuple(index.T)] + 1e-6)


@pytest.mark.parametrize("name", STEPS)
@pytest.mark.parametrize("seed", [0, 1])
def test_one_step_back_lies_above_and_below_phi_everywhere(name: str, seed: int) -> None:
    problem, transition, value = setting(name, seed)
    zones = zones_of(transition.step.grid, problem.constraints, None, 0)
    points = np.random.default_rng(seed).uniform([-1, -1], [1, 0.9], (300, 2))
    exact = mean_over_boxes(value, compile_numpy(problem.closed_loop)(0.0, *points.T), HALF)
    assert np.all(back_above(transition, value, zones).values(points) >= exact - 1e-9)
    assert np.all(back_below(transition, value, zones).values(points) <= exact + 1e-9)


def test_one_step_is_an_overlap_of_intervals() -> None:
    system = cb.DiscreteSystem(lambda x: x, states=1, noise=cb.Uniform(halfwidth=0.5))
    problem = cb.Problem(system, initial=[0.7], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=1)
    found = bound_failure(problem, ratio=1.001)
    assert found.lower <= 0.2 <= found.upper <= 0.2 * 1.01
    assert found.lower >= 0.2 / 1.01


@pytest.mark.parametrize("dimension", [1, 2])
def test_several_steps_agree_with_simulation(dimension: int) -> None:
    system = cb.DiscreteSystem(lambda x: x - 0.3 * x**2, states=dimension, noise=cb.Uniform(halfwidth=0.35))
    safe = [cb.Inside(cb.Box([-1.0] * dimension, [1.0] * dimension))]
    problem = cb.Problem(system, initial=[0.1] * dimension, safe=safe, horizon=4)
    found = bound_failure(problem, ratio=1.1)
    low, high = limits(problem, 100_000, 0)
    assert low <= found.upper <= 1.2 * found.lower
    assert found.lower <= high


def test_uniform_noise_that_is_mixed_is_refused() -> None:
    with pytest.raises(Inapplicable, match="an entry of its own"):
        shocks_of(cb.Uniform(halfwidth=0.1).resolve(2), np.array([[1.0, 0.5], [0.0, 1.0]]))


def test_a_kernel_that_would_fill_the_memory_is_refused() -> None:
    system = cb.DiscreteSystem(lambda x: 0.9 * x, states=1, noise=cb.Uniform(halfwidth=1e-4))
    problem = cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-0.4], [0.4]))], horizon=3)
    with pytest.raises(Inapplicable, match="very many halfwidths of the uniform noise wide"):
        bound_failure(problem)
