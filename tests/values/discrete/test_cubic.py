"""Second derivatives at the nodes: integrals, one step from both sides, what it rests on, and when it is taken."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
from flint import arb, arb_series

import certbound as cb
from certbound.problem.model.evaluation import compile_numpy
from certbound.values.discrete.cubic import CubicTransition, cubic_transition
from certbound.values.discrete.cubic.cell_scans import Stencils, lacking
from certbound.values.discrete.cubic.cubic_step import finer
from certbound.values.discrete.cubic.majorants import majorants
from certbound.values.discrete.dominance import KAPPA
from certbound.values.discrete.failures import Work, bound_failure
from certbound.values.discrete.fields import Tables
from certbound.values.discrete.functions import ValueFunction
from certbound.values.discrete.shocks import shocks_of
from certbound.values.discrete.steps import Dynamics
from certbound.values.grids import Grid
from experiments.values_discrete import PROBLEMS
from tests.values.discrete.helpers import mean_after_noise

STEPS: dict[str, Any] = {
    "line": (lambda x: 0.8 * x[0] - 0.3 * x[0] ** 2, [0.3], 12),
    "affine": (lambda x: [0.8 * x[0] + 0.3 * x[1], -0.4 * x[0] + 0.7 * x[1]], [0.3, 0.4], 9),
    "bent": (lambda x: [x[0] + 0.1 * x[1], x[1] - 0.4 * np.sin(x[0]) * x[1]], [0.3, 0.4], 9),
    "space": (lambda x: [0.6 * x[0] + 0.2 * x[1] * x[2], 0.7 * x[1], 0.5 * x[2] - 0.1 * x[0]], [0.9, 1.0, 0.8], 4),
}


def setting(name: str, seed: int = 1) -> tuple[cb.Problem, CubicTransition, ValueFunction]:
    step, std, cells = STEPS[name]
    n = len(std)
    system = cb.DiscreteSystem(step, states=n, noise=cb.Gaussian(std=std))
    problem = cb.Problem(system, initial=[0] * n, safe=[cb.Inside(cb.Box([-1] * n, [1] * n))], horizon=1)
    rng = np.random.default_rng(seed)
    axes = [np.cumsum(rng.uniform(0.8, 1.2, cells + k)) for k in range(n)]
    grid = Grid(axes=tuple(2 * (axis - axis[0]) / (axis[-1] - axis[0]) - 1 for axis in axes))
    transition = cubic_transition(Dynamics(problem), 0, grid, shocks_of(system.noise, system.noise_matrix))
    assert transition is not None
    return problem, transition, random_curved(rng, grid)


def random_curved(rng: np.random.Generator, grid: Grid) -> ValueFunction:
    bend = np.stack([rng.uniform(-1, 1, grid.node_shape) / grid.widths(i).min() ** 2 for i in range(grid.dimension)])
    return ValueFunction(
        grid=grid, nodal=rng.uniform(size=grid.node_shape), bend=bend, fixed=None, level=np.zeros(grid.shape)
    )


@pytest.mark.parametrize("name", STEPS)
def test_means_of_curved_functions_are_those_by_brute_force(name: str) -> None:
    _, transition, value = setting(name)
    tables, std = transition.tables, STEPS[name][1]
    rng = np.random.default_rng(3)
    index = [rng.integers(0, count, 12) for count in tables.mesh.count]
    points = np.stack([tables.mesh.points(i)[index[i]] for i in range(len(std))], axis=1)
    exact = mean_after_noise(value, points, np.diag(np.square(std)))
    assert np.abs(tables.means(value)[tuple(index)] - exact).max() < 1e-9


@pytest.mark.parametrize("name", STEPS)
def test_one_step_lies_on_its_side_of_the_mean_everywhere_and_near_it(name: str) -> None:
    problem, transition, value = setting(name)
    std = STEPS[name][1]
    rng = np.random.default_rng(4)
    points = rng.uniform(-1, 1, (300 if len(std) < 3 else 60, len(std)))
    points[:20] = np.round(points[:20])  # corners, where one-sided differences count
    phi = mean_after_noise(value, compile_numpy(problem.closed_loop)(0.0, *points.T), np.diag(np.square(std)))
    above, below = (transition.back(value, above=side) for side in (True, False))
    high, low = above.values(points), below.values(points)
    assert np.all(low <= phi + 1e-9)
    assert np.all(phi <= high + 1e-9)
    assert np.mean(high - low) < {"line": 0.01, "affine": 0.2, "bent": 0.8, "space": 1.5}[name]  # of jagged functions


@pytest.mark.parametrize("name", STEPS)
def test_second_derivatives_between_nodes_lie_on_their_side(name: str) -> None:
    problem, transition, value = setting(name, 2)
    std, grid = STEPS[name][1], transition.step.grid
    n, h = len(std), 2e-3
    points = np.random.default_rng(5).uniform(-0.99, 0.99, (60 if n < 3 else 3, n))
    step = compile_numpy(problem.closed_loop)

    def phi(x: np.ndarray) -> np.ndarray:
        return mean_after_noise(value, step(0.0, *x.T), np.diag(np.square(std)))

    above, below = (transition.back(value, above=side) for side in (True, False))
    for i in range(n):
        move = h * np.eye(n)[i]
        second = (phi(points + move) - 2 * phi(points) + phi(points - move)) / h**2
        flat = [ValueFunction(grid=grid, nodal=side.bend[i], bend=np.zeros((n, *grid.shape)), fixed=None,
                              level=np.zeros(grid.shape)) for side in (above, below)]  # fmt: skip
        assert np.all(flat[0].values(points) <= second + 1e-3)
        assert np.all(second <= flat[1].values(points) + 1e-3)


def test_constant_bends_of_a_curved_function_lie_on_their_side() -> None:
    _, _, value = setting("bent")
    points = np.random.default_rng(6).uniform(-1, 1, (500, 2))
    exact = value.values(points)
    assert np.all(value.flat(above=False).values(points) <= exact + 1e-12)
    assert np.all(exact <= value.flat(above=True).values(points) + 1e-12)
    low, high = value.range()
    place = tuple(np.searchsorted(axis, points[:, k]) - 1 for k, axis in enumerate(value.grid.axes))
    assert np.all((low[place] <= exact) & (exact <= high[place]))
    assert np.all(np.abs(exact) <= value.size()[place])


def test_fifth_and_sixth_derivatives_are_at_most_what_is_said() -> None:
    std = 0.2
    system = cb.DiscreteSystem(lambda x: 0.9 * x[0] - 0.3 * x[0] ** 2 + 0.2 * x[0] ** 3, states=1,
                               noise=cb.Gaussian(std=std))  # fmt: skip
    problem = cb.Problem(system, initial=[0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=1)
    grid, dynamics = Grid(axes=(np.linspace(-1, 1, 21),)), Dynamics(problem)
    transition = cubic_transition(dynamics, 0, grid, shocks_of(system.noise, system.noise_matrix))
    assert transition is not None
    sizes = majorants(dynamics, 0, grid, transition.tables)
    assert sizes is not None
    nothing = ValueFunction(grid=grid, nodal=np.zeros(21), bend=np.zeros((1, 20)), fixed=None, level=np.zeros(20))
    dominant = transition.tables.field(nothing).dominant
    heavy = transition.windows[0].extreme(np.maximum(dominant[:-1], dominant[1:]), largest=True) * transition.convexity
    ratios = {5: [0.0], 6: [0.0]}
    for k, x in itertools.product(range(20), (0.0, 0.5, 1.0)):  # 1 is lost outside [-1, 1], 0 inside
        x = grid.axes[0][k] + 0.1 * x
        t = arb_series([x, 1], prec=7)
        m = 0.9 * t - 0.3 * t * t + 0.2 * t * t * t
        scale = 1 / (std * arb(2).sqrt())
        phi = (((1 - m) * scale).erfc() + ((1 + m) * scale).erfc()) / 2
        for order in ratios:
            found = abs(float(phi[order])) * math.factorial(order) * 0.1**order
            assert found <= sizes.near[order][k] * heavy[k] + sizes.beyond[order][k]
            ratios[order].append(found / (sizes.near[order][k] * heavy[k]))
    assert min(max(ratios[order]) for order in ratios) > 0.1  # and not far from it


def test_between_finer_nodes_fourth_derivatives_exceed_their_differences_by_no_more_than_is_paid() -> None:
    std, system = 0.2, cb.DiscreteSystem(lambda x: 1.0 * x[0], states=1, noise=cb.Gaussian(std=0.2))
    problem = cb.Problem(system, initial=[0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=1)
    axis = np.linspace(-1, 1, 15) + 0.02 * np.sin(np.arange(15) * np.pi / 7)
    axis[[0, -1]] = -1, 1
    grid = Grid(axes=(axis,))
    transition = cubic_transition(Dynamics(problem), 0, grid, shocks_of(system.noise, system.noise_matrix))
    assert transition is not None
    nothing = ValueFunction(grid=grid, nodal=np.zeros(15), bend=np.zeros((1, 14)), fixed=None, level=np.zeros(14))
    paid = transition._higher(transition.tables.field(nothing)) / np.diff(axis) ** 2

    def derivative(x: float, order: int) -> float:
        t, scale = arb_series([x, 1], prec=7), 1 / (std * arb(2).sqrt())
        return float(((((1 - t) * scale).erfc() + ((1 + t) * scale).erfc()) / 2)[order]) * math.factorial(order)

    fine, parts = transition.fine.axes[0], transition.parts
    second = np.array([derivative(x, 2) for x in fine])
    left, right = np.diff(fine)[:-1], np.diff(fine)[1:]
    turn = np.pad(2 * (np.diff(second)[1:] / right - np.diff(second)[:-1] / left) / (left + right), 1, mode="edge")
    missing = []
    for k in range(14):
        delta = np.diff(axis)[k] / parts
        most = max(derivative(x, 4) for x in np.linspace(axis[k], axis[k + 1], 41))
        missing.append(delta**2 / 8 * (max(most, 0.0) - max(turn[parts * k : parts * k + parts + 1].max(), 0.0)))
        assert missing[-1] <= paid[k]
    assert max(missing) > 0  # which is more than nothing


def test_dominating_means_between_the_nodes_of_a_mesh_are_paid_for() -> None:
    _, transition, _ = setting("line")
    spread, step = KAPPA * 0.3, float(transition.tables.mesh.step[0])
    rng = np.random.default_rng(9)
    places, masses = rng.uniform(-1, 1, 5), rng.uniform(size=(300, 5)) ** 20  # some of them nearly single ones

    def mean(m: np.ndarray) -> np.ndarray:
        return masses @ np.exp(-0.5 * ((m - places[:, None]) / spread) ** 2)

    ends = np.linspace(-1, 1, 41)
    inner = mean((ends[:, None] + step * np.linspace(0, 1, 9)).ravel()).reshape(300, 41, 9)
    corner = np.maximum(inner[..., 0], inner[..., -1])
    assert np.all(inner.max(axis=-1) <= corner * transition.convexity)
    assert np.max(inner.max(axis=-1) / corner) > 1 + 0.5 * (transition.convexity - 1)


def test_values_at_nodes_are_apart_by_their_errors() -> None:
    _, transition, value = setting("bent")
    ((at, error),) = transition.at_nodes(transition.tables.field(value))
    above, below = (transition.back(value, above=side) for side in (True, False))
    assert np.all(error > 0)
    assert np.all(above.nodal >= at + error)
    assert np.all(below.nodal <= at - error)


@pytest.mark.parametrize("n", [1, 2, 3])
def test_what_cells_lack_is_found_by_looking_at_all_finer_nodes(n: int) -> None:
    rng, parts = np.random.default_rng(n), 2
    grid = Grid(axes=tuple(np.cumsum(rng.uniform(0.5, 1, 4 + k)) for k in range(n)))
    fine = finer(grid, parts)
    low = rng.normal(size=fine.node_shape)
    high = low + rng.uniform(size=low.shape)
    found = lacking(low, high, fine.axes, parts)
    for cell in itertools.product(*(range(size) for size in grid.shape)):
        block = tuple(slice(parts * c, parts * c + parts + 1) for c in cell)
        worst, turns = 0.0, np.zeros(n)
        for node in itertools.product(*(range(part.start, part.stop) for part in block)):
            line = 0.0
            for corner in itertools.product((0, 1), repeat=n):
                shares = [(p - parts * c) / parts for p, c in zip(node, cell)]
                weight = math.prod(s if bit else 1 - s for s, bit in zip(shares, corner))
                line += weight * low[tuple(parts * (c + bit) for c, bit in zip(cell, corner))]
            worst = max(worst, line - low[node])
            for j in range(n):
                k = min(max(node[j], 1), fine.node_shape[j] - 2)
                a, b, c = (tuple(k + d if i == j else p for i, p in enumerate(node)) for d in (-1, 0, 1))
                x = fine.axes[j][k - 1 : k + 2]
                turn = 2 * ((high[c] - low[b]) / (x[2] - x[1]) - (low[b] - high[a]) / (x[1] - x[0])) / (x[2] - x[0])
                turns[j] = max(turns[j], turn * max(x[2] - x[1], x[1] - x[0]) ** 2 / 8)
        assert found[cell] == pytest.approx(worst + turns.sum(), rel=1e-6)


def test_tables_are_read_off_as_written() -> None:
    rng = np.random.default_rng(8)
    tables = [rng.normal(size=(8, 9)) for _ in range(2)]
    base = [rng.integers(0, 2, 5), rng.integers(0, 3, 5)]
    weights = [[rng.normal(size=5) for _ in range(6)] for _ in range(2)]
    found = Stencils(base, weights).read_off(tables)
    for a, c in itertools.product(range(2), range(5)):
        block = tables[a][base[0][c] : base[0][c] + 6, base[1][c] : base[1][c] + 6]
        first, second = (np.array([w[c] for w in weights[i]]) for i in range(2))
        assert found[a, c] == pytest.approx(first @ block @ second)


def test_a_pendulum_is_bounded_closely_on_few_cells() -> None:
    problem = PROBLEMS["pendulum, std .15"]()
    found = bound_failure(problem, ratio=1.05)
    assert found.upper <= 1.05 * found.lower
    assert math.prod(found.cells) < 6000
    assert found.lower <= 0.0690 <= found.upper  # [0.0684, 0.0697] on 62 x 150 cells with constant bends


@pytest.mark.parametrize("name", ["kink", "obstacle", "clock", "smooth", "random"])
def test_only_what_is_smooth_and_everywhere_safe_takes_curved_functions(name: str) -> None:
    slope = (lambda x: abs(x[0])) if name == "kink" else (lambda x: 0.9 * x[0])
    if name == "clock":
        slope = lambda t, x: 0.9 * x[0] + 0.1 * np.sin(t)  # noqa: E731
    system = cb.DiscreteSystem(slope, states=1, noise=cb.Gaussian(std=0.3))
    safe = [cb.Inside(cb.Box([-1], [1]))] + ([cb.Outside(cb.Box([0.5], [0.6]))] if name == "obstacle" else [])
    initial = cb.GaussianStart([0.0], [[0.01]]) if name == "random" else [0.0]
    work = Work(cb.Problem(system, initial=initial, safe=safe, horizon=4), None, 1)
    layout = work.layout(0.33)
    assert layout is not None
    upper, lower = work.bounds(layout, 0.33)
    assert work.cubic == (name in ("smooth", "random"))
    assert 0 < lower <= upper < 1.05 * lower or not work.cubic
    chart = work.charts(0.33, [0])
    assert np.all(chart.lower[0].log10 <= chart.upper[0].log10)


def test_tables_without_cubics_refuse_curved_functions() -> None:
    _, transition, value = setting("affine")
    tables = Tables(value.grid, transition.tables.shocks, *transition.step.hull())
    with pytest.raises(KeyError):
        tables.field(value)


def test_images_far_off_the_grid_are_left_to_constant_bends_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def counted(*given: Any) -> CubicTransition | None:
        asked.append(1)
        return cubic_transition(*given)

    monkeypatch.setattr("certbound.values.discrete.failures.cubic_transition", counted)
    system = cb.DiscreteSystem(lambda x: 1 - 3 * x[0] ** 2, states=1, noise=cb.Gaussian(std=0.05))
    problem = cb.Problem(system, initial=[0.4], safe=[cb.Inside(cb.Box([-1], [1.2]))], horizon=3)
    found = bound_failure(problem, ratio=1.01)
    assert 0 < found.lower <= found.upper < 1
    assert len(found.tried) > 1
    assert len(asked) == 1
