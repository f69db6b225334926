"""Shares of the carried error by place, axes that follow them, and sources that pay for it."""

from __future__ import annotations

import numpy as np
import pytest

import certbound as cb
from certbound.values.kolmogorov.box_setting import stages_of
from certbound.values.kolmogorov.carry import Side
from certbound.values.kolmogorov.door import adapted, side_of, starts_in
from certbound.values.kolmogorov.equation.solve import Equation, SplitEquation
from certbound.values.kolmogorov.equation.sources import Breadth, at_knots, at_nodes
from certbound.values.kolmogorov.error_shares import better_shapes, shares


def near_one_limit() -> cb.Problem:
    """Noise leads paths through one limit only: all the rest is smooth."""
    system = cb.ContinuousSystem(lambda x, y: [-x, x - y], states=["x", "y"], diffusion=[[0.4, 0.0], [0.0, 0.4]])
    return cb.Problem(system, initial=[0.5, 0.0], safe=[cb.Inside(cb.Box([-3, -3], [1, 3]))], horizon=2.0)


def proposed(above: bool) -> Side:
    side = side_of([stages_of(near_one_limit())[0]], 0.08, 12, above)
    side.propose()
    return side


@pytest.mark.parametrize("above", [True, False])
def test_shares_add_up_to_what_is_carried_to_the_start(above: bool) -> None:
    side, starts = proposed(above), starts_in(near_one_limit())
    parts = side.rough_parts()
    residuals = [np.add.reduce(one) for one in parts]
    total = sum(float(one.sum()) for one in shares(side, parts, starts.places))
    equation = side.carrier.equation
    e = np.zeros(equation.shape)
    for residual, step in zip(residuals, side.steps):
        e = equation.solve(step, e + step * at_nodes(residual, side.carrier.pad, Breadth.MEAN) * equation.live)
    place = tuple(int(np.abs(line - y).argmin()) for line, y in zip(side.carrier.nodes, [0.5, 0.0]))
    assert total == pytest.approx(float(e[place]), rel=0.25)


def test_as_many_cells_leave_less_error_where_axes_follow_the_shares() -> None:
    side, starts = proposed(above=False), starts_in(near_one_limit())
    before = sum(float(one.sum()) for one in shares(side, side.rough_parts(), starts.places))
    better, _ = adapted(side, starts, 2)
    after = sum(float(one.sum()) for one in shares(better, better.rough_parts(), starts.places))
    assert better.work < 1.2 * side.work
    assert after < 0.5 * before


def test_cells_change_by_no_more_than_shares_tell() -> None:
    side, starts = proposed(above=True), starts_in(near_one_limit())
    for axis, shape in zip(side.axes, better_shapes(side, side.rough_parts(), starts.places)):
        change = shape(shape.places) / axis.widths
        assert change.max() < 4
        assert np.abs(np.diff(shape.sizes) / np.diff(shape.places)).max() < 0.3 * 3


@pytest.mark.parametrize(("stiffness", "more"), [(8.0, True), (0.0, False)])
def test_steps_are_more_where_they_lead_paths_across_many_cells(stiffness: float, more: bool) -> None:
    """A spring with friction, whose paths cross 16 cells within a step, and friction without the spring."""
    moving = stiffness > 0
    system = cb.ContinuousSystem(
        lambda x, v: [v if moving else 0.0, -stiffness * x - 0.4 * np.tanh(5 * v)], states=["x", "v"],
        diffusion=[[0.0 if moving else 0.2, 0.0], [0.0, 0.42]],
    )  # fmt: skip
    problem = cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -1.6], [1, 1.6]))], horizon=6.0)
    side, starts = side_of(stages_of(problem), 0.05, 16, True), starts_in(problem)
    side.propose()
    better, _ = adapted(side, starts, 2)
    assert (len(better.steps) > 1.2 * len(side.steps)) == more
    assert better.work < 1.2 * side.work


def _random_equation(kind: type[Equation] | type[SplitEquation], n: int) -> Equation | SplitEquation:
    rng = np.random.default_rng(0)
    nodes = [np.sort(rng.uniform(-1, 1, 9 + k)) for k in range(n)]
    shape = tuple(map(len, nodes))
    flow, noise = rng.normal(size=(n, *shape)), rng.uniform(0.1, 1, size=(n, *shape))
    spread = np.zeros((n, n, *shape))
    for k in range(n):
        spread[k, k] = noise[k]
    dead = np.zeros(shape, dtype=bool)
    dead[0] = True
    return kind(nodes, flow, spread, dead, rng.uniform(0, 1, shape))


def test_the_adjoint_is_the_transpose() -> None:
    equation, rng = _random_equation(Equation, 2), np.random.default_rng(1)
    x, y = rng.normal(size=(2, *equation.shape))
    assert np.vdot(equation.adjoint(0.01, x), y) == pytest.approx(np.vdot(x, equation.solve(0.01, y)), rel=1e-9)


@pytest.mark.parametrize("share", [1e-3, 0.1, 1.0])
def test_systems_without_a_matrix_are_solved_where_a_step_leads_over_many_cells(share: float) -> None:
    nodes = [np.cumsum(np.append(0.0, np.linspace(0.02, 0.08, 24))) for _ in range(3)]
    x, y, z = np.meshgrid(*nodes, indexing="ij")
    flow, spread = np.array([4 * (y - x), 5 - y, x * y - 10 * z]), np.zeros((3, 3, *x.shape))
    for k in range(3):
        spread[k, k] = 0.1
    dead = np.zeros(x.shape, dtype=bool)
    for face in np.array([0, -1]):
        dead[face], dead[:, face], dead[:, :, face] = True, True, True
    equation = SplitEquation(nodes, flow, spread, dead, np.zeros(x.shape))
    right = np.sin(3 * x) * np.cos(2 * y) * z * ~dead
    found = equation.solve(share, right)
    left = found - share * equation.speed(found) - right
    assert np.linalg.norm(left) <= 0.02 * np.linalg.norm(right)


def test_the_adjoint_without_a_matrix_moves_paths_by_the_flow_and_loses_none() -> None:
    nodes = [np.linspace(-1, 1, 41)] * 3
    shape = (41, 41, 41)
    flow = np.broadcast_to(np.array([1.0, -2.0, 0.5]).reshape(3, 1, 1, 1), (3, *shape))
    spread = np.zeros((3, 3, *shape))
    spread[0, 0] = 0.01
    equation = SplitEquation(nodes, flow, spread, np.zeros(shape, dtype=bool), np.zeros(shape))
    there = np.zeros(shape)
    there[20, 20, 20] = 1.0
    later = equation.adjoint(0.05, there)
    assert later.min() >= 0.0
    assert later.sum() == pytest.approx(1.0, rel=1e-5)
    places = np.array(np.meshgrid(*nodes, indexing="ij"))
    assert (later * places).sum(axis=(1, 2, 3)) == pytest.approx([0.05, -0.1, 0.025], rel=1e-3)


@pytest.mark.parametrize("pads", [((0, 0), (0, 0)), ((9, 5), (0, 3))])
def test_sources_are_above_what_is_asked_for_or_as_much_in_the_mean(pads: tuple[tuple[int, int], ...]) -> None:
    rng = np.random.default_rng(1)
    cells = rng.exponential(size=(12, 10)) ** 3
    cells[[0, -1]] = cells[:, [0, -1]] = 0.0
    (before, behind), (left, right) = pads
    above = at_nodes(cells, pads, Breadth.ABOVE)
    assert above.shape == (12 + before + behind + 1, 10 + left + right + 1)
    corners = np.minimum(np.minimum(above[1:, 1:], above[:-1, 1:]), np.minimum(above[1:, :-1], above[:-1, :-1]))
    inner = corners[before : before + 12, left : left + 10]
    assert np.all(inner >= cells * (1 - 1e-12))
    mean = at_nodes(cells, pads, Breadth.MEAN)
    assert mean.sum() == pytest.approx(cells.sum(), rel=0.02)
    largest = at_nodes(cells, pads, Breadth.LARGEST)
    assert mean.sum() < largest.sum() < above.sum()


def test_sources_are_continuous_in_time() -> None:
    slabs, steps = [np.array([1.0]), np.array([4.0]), np.array([2.0])], np.array([1.0, 1.0, 2.0])
    assert [float(one[0]) for one in at_knots(slabs, steps, Breadth.ABOVE)] == [1, 4, 4, 2]
    assert [float(one[0]) for one in at_knots(slabs, steps, Breadth.MEAN)] == [1, 2.5, (4 + 2 * 2) / 3, 2]


def test_axes_that_are_improved_again_and_again_do_not_swing() -> None:
    """Lorenz' model: along one axis layers, along another ones that coarse cells resolve less than all shares say."""
    system = cb.ContinuousSystem(
        lambda x, y, z: [4 * (y - x), x * (0.8 - z) - y, x * y - 1.5 * z], states=["x", "y", "z"],
        diffusion=0.43 * np.eye(3),
    )  # fmt: skip
    safe = [cb.Inside(cb.Box([-1.3] * 3, [1.3] * 3))]
    problem = cb.Problem(system, initial=[0.1, 0.1, 0.1], safe=safe, horizon=3.33)
    side, counts = side_of(stages_of(problem), 0.2, 8, True), []
    side.propose()
    for _ in range(3):
        *shapes, longest = better_shapes(side, side.rough_parts(), np.array([[0.1, 0.1, 0.1]]))
        side = side.on(shapes, longest)
        side.propose()
        counts.append([axis.cells for axis in side.axes])
    changes = np.abs(np.diff(np.log(counts), axis=0))
    assert changes.max() < np.log(1.25)  # by a factor of 1.3 up and down where the axes follow their shares at once
