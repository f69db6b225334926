"""phi = h(f) on a grid: values at nodes, second derivatives over cells, and the functions made of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.problem.model.evaluation import compile_numpy
from certbound.values.discrete.fields import Tables
from certbound.values.discrete.functions import ValueFunction
from certbound.values.discrete.induction import back_above, back_below, zones_of
from certbound.values.discrete.scans import cell_ranges, in_space, second_differences, window_extremes
from certbound.values.discrete.shocks import shocks_of
from certbound.values.discrete.steps import Dynamics
from certbound.values.discrete.transitions import Transition
from certbound.values.grids import Grid, over_corners
from tests.values.discrete.helpers import mean_after_noise, random_function

STEPS: dict[str, Callable[..., Any]] = {
    "affine": lambda x: [0.8 * x[0] + 0.3 * x[1], -0.4 * x[0] + 0.7 * x[1]],
    "bent": lambda x: [x[0] - 0.4 * x[0] ** 2 + 0.2 * np.sin(3 * x[1]), 0.5 * x[1] * x[0] + 0.1],
    "kinked": lambda x: [0.7 * abs(x[0]) + 0.1 * x[1], np.maximum(x[1], 0.3 * x[0])],
    "jumping": lambda x: [np.where(x[0] > 0.1, x[0], -x[0] + 0.05), 0.5 * x[1]],
    "far": lambda x: [6 * x[0] + 1.0, 4 * x[1]],
}


def setting(name: str, *, cells: int = 7, fixed: float = 0.3) -> tuple[cb.Problem, Transition, ValueFunction]:
    system = cb.DiscreteSystem(STEPS[name], states=2, noise=cb.Gaussian(std=[0.2, 0.3]))
    problem = cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 0.9]))], horizon=1)
    grid = Grid(axes=(np.linspace(-1, 1, cells + 1), np.linspace(-1, 0.9, cells)))
    step = Dynamics(problem).step(0, grid)
    tables = Tables(grid, shocks_of(system.noise, system.noise_matrix), *step.hull())
    return problem, Transition(step, tables), random_function(np.random.default_rng(1), grid, fixed=fixed)


def phi(problem: cb.Problem, value: ValueFunction, points: np.ndarray) -> np.ndarray:
    image = compile_numpy(problem.closed_loop)(0.0, *points.T)
    return mean_after_noise(value, image, np.diag([0.04, 0.09]))


@pytest.mark.parametrize("name", STEPS)
def test_values_at_nodes_are_within_their_errors(name: str) -> None:
    problem, transition, value = setting(name)
    ((found, error),) = transition.at_nodes(transition.tables.field(value))
    exact = phi(problem, value, transition.step.grid.nodes()).reshape(found.shape)
    assert np.all(np.abs(found - exact) <= error + 1e-9)
    assert error.max() < 5e-5


@pytest.mark.parametrize("name", ["affine", "bent", "far"])
@pytest.mark.parametrize("axis", [0, 1])
def test_second_derivatives_lie_within_their_bounds(name: str, axis: int) -> None:
    problem, transition, value = setting(name)
    field = transition.tables.field(value)
    ((least,),) = transition.bends(field, range(axis, axis + 1), above=True)
    ((most,),) = transition.bends(field, range(axis, axis + 1), above=False)
    cells = transition.step.grid.cells()
    rng = np.random.default_rng(2)
    points = cells.lo + rng.uniform(0.05, 0.95, cells.lo.shape) * (cells.hi - cells.lo)
    away = 1e-3 * np.eye(2)[axis]
    exact = (
        phi(problem, value, points + away) - 2 * phi(problem, value, points) + phi(problem, value, points - away)
    ) / 1e-6
    assert np.all(least <= exact + 1e-3)
    assert np.all(exact <= most + 1e-3)
    assert name == "far" or np.median(most - least) < 12


@pytest.mark.parametrize("name", STEPS)
@pytest.mark.parametrize("seed", [0, 1])
def test_one_step_back_lies_above_and_below_phi_everywhere(name: str, seed: int) -> None:
    problem, transition, value = setting(name)
    zones = zones_of(transition.step.grid, problem.constraints, None, 0)
    above, below = back_above(transition, value, zones), back_below(transition, value, zones)
    points = np.random.default_rng(seed).uniform([-1, -1], [1, 0.9], (300, 2))
    exact = phi(problem, value, points)
    assert np.all(above.values(points) >= exact - 1e-9)
    assert np.all(below.values(points) <= exact + 1e-9)


@pytest.mark.parametrize("kind", ["turning", "peaked", "jumping"])
def test_all_disturbances_lie_below_and_the_worst_above(kind: str) -> None:
    moves = {
        "turning": lambda x, d: [x[0] + 0.6 * np.sin(3 * d[0]) * x[1] + 0.3, x[1] * np.cos(2 * d[0])],
        "peaked": lambda x, d: [0.9 - 4 * (d[0] - 0.13) ** 2 + 0.3 * x[0], 0.4 * x[1] + d[0] * x[0] ** 2],
        "jumping": lambda x, d: [np.where(x[0] > 0.1 + 0.9 * d[0], 0.9 * x[0], -0.4) + 0.2 * d[0], 0.5 * x[1]],
    }
    system = cb.DiscreteSystem(
        moves[kind], states=2, noise=cb.Gaussian(std=[0.2, 0.3]), disturbance=cb.Box([-1.0], [1.0])
    )
    problem = cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 0.9]))], horizon=1)
    grid = Grid(axes=(np.linspace(-1, 1, 6), np.linspace(-1, 0.9, 6)))
    step = Dynamics(problem, parts=4).step(0, grid)
    transition = Transition(step, Tables(grid, shocks_of(system.noise, system.noise_matrix), *step.hull()))
    zero = np.zeros(grid.node_shape)
    value = ValueFunction(
        grid=grid, nodal=zero, bend=np.zeros((2, *grid.shape)), fixed=None, level=np.zeros(grid.shape)
    )
    zones = zones_of(grid, problem.constraints, None, 0)
    points = np.concatenate([grid.nodes(), np.random.default_rng(0).uniform([-1, -1], [1, 0.9], (150, 2))])
    image = compile_numpy(problem.closed_loop)
    covariance = np.diag([0.04, 0.09])
    each = [mean_after_noise(value, image(0.0, *points.T, d), covariance) for d in np.linspace(-1, 1, 41)]
    worst = np.max(each, axis=0)
    above, below = back_above(transition, value, zones), back_below(transition, value, zones)
    if above.fixed is not None:
        assert above.fixed.mean() < 0.7 or (kind == "jumping" and above.level[above.fixed].mean() < 0.7)
    assert np.all(above.values(points) >= worst - 1e-9)
    assert np.all(below.values(points) <= worst + 1e-3)
    field = transition.tables.field(value)
    for function, is_above in ((above, True), (below, False)):
        free = np.ones(grid.shape, dtype=bool) if function.fixed is None else ~function.fixed
        for box in transition.bends(field, range(2), above=is_above):
            gap = np.stack([part.reshape(grid.shape) for part in box]) - function.bend
            assert np.all((gap if is_above else -gap)[:, free] >= -1e-12)


def test_correlated_noise_and_images_far_outside_are_bounded_too() -> None:
    covariance = np.array([[0.04, 0.05], [0.05, 0.09]])
    system = cb.DiscreteSystem(
        lambda x: [3.0 + x[0], 2.0 * x[1] - 4.0], states=2, noise=cb.Gaussian(covariance=covariance)
    )
    problem = cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 0.9]))], horizon=1)
    grid = Grid(axes=(np.linspace(-1, 1, 6), np.linspace(-1, 0.9, 5)))
    step = Dynamics(problem).step(0, grid)
    transition = Transition(step, Tables(grid, shocks_of(system.noise, system.noise_matrix), *step.hull()))
    value = random_function(np.random.default_rng(1), grid)
    zones = zones_of(grid, problem.constraints, None, 0)
    points = np.random.default_rng(0).uniform([-1, -1], [1, 0.9], (100, 2))
    exact = mean_after_noise(value, compile_numpy(problem.closed_loop)(0.0, *points.T), covariance)
    assert np.all(back_above(transition, value, zones).values(points) >= exact - 1e-9)
    assert np.all(back_below(transition, value, zones).values(points) <= exact + 1e-9)


def test_finer_cells_bring_both_sides_together() -> None:
    gaps = []
    for cells in (6, 12, 24):
        problem, transition, _ = setting("bent", cells=cells)
        grid = transition.step.grid
        value = ValueFunction(
            grid=grid, nodal=np.zeros(grid.node_shape), bend=np.zeros((2, *grid.shape)), fixed=None,
            level=np.zeros(grid.shape),
        )  # fmt: skip
        zones = zones_of(grid, problem.constraints, None, 0)
        points = np.random.default_rng(0).uniform(-0.9, 0.9, (500, 2))
        gaps.append(
            np.max(
                back_above(transition, value, zones).values(points)
                - back_below(transition, value, zones).values(points)
            )
        )
    assert gaps[1] < gaps[0] / 3
    assert gaps[2] < gaps[1] / 3


@pytest.mark.parametrize("shape", [(9,), (5, 8), (4, 5, 6)])
def test_compiled_scans_agree_with_numpy_and_keep_what_is_no_number(shape: tuple[int, ...]) -> None:
    table = np.random.default_rng(0).normal(size=shape)
    bent = np.zeros(shape)
    for axis in range(len(shape)):
        g, out = np.moveaxis(table, axis, 0), np.moveaxis(bent, axis, 0)
        out[1:-1] += np.abs(g[2:] + g[:-2] - 2 * g[1:-1])
    assert np.array_equal(second_differences(in_space(table)).reshape(shape), bent)
    close = np.abs(table[(slice(1, None),) * len(shape)])
    wide = over_corners(np.maximum, bent) / 8 + 0.3 * close + 0.1
    for hole in (False, True):
        if hole:
            table[(2,) * len(shape)] = np.nan
        low, high = cell_ranges(table, close, 0.3, 0.1)
        known = np.isfinite(over_corners(np.minimum, table))
        assert hole != known.all()
        assert low[known] == pytest.approx((over_corners(np.minimum, table) - wide)[known], rel=1e-8) or hole
        assert high[known] == pytest.approx((over_corners(np.maximum, table) + wide)[known], rel=1e-8) or hole
        assert np.isnan(low[~known]).all()
        assert np.isnan(high[~known]).all()
        size = (2,) * len(shape)
        places = np.stack(np.unravel_index(np.arange(table.size), shape), axis=-1)
        start = np.flatnonzero(np.all(places + 2 <= shape, axis=1))
        found = np.empty(len(start))
        window_extremes(in_space(table), start, (1,) * (3 - len(size)) + size, True, found)
        assert np.array_equal(found, over_corners(np.maximum, table).ravel(), equal_nan=True)
