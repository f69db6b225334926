"""Obstacles and safe sets of any shape: edges that cut cells."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import solve_banded

import certbound as cb
from certbound.arrays import Array
from certbound.values.kolmogorov import bound_failing
from certbound.values.kolmogorov.box_setting import stages_of
from certbound.values.kolmogorov.door import largest_at_start, refined, side_of, starts_in
from certbound.values.kolmogorov.failed_cells import Shapes
from certbound.values.kolmogorov.splines import Axis, Sampling, controls_on_some

SHAPES = {
    "disc": [cb.Inside(cb.Ball([0, 0], 1.0))],
    "obstacle": [cb.Outside(cb.Ball([0.6, 0.6], 0.3))],
    "box": [cb.Outside(cb.Box([0.3, 0.4], [0.9, 2.0]))],
    "slanted": [cb.Inside(cb.HalfSpace([1, 1], 0.7))],
    "two": [cb.Outside(cb.Ball([0.6, 0.6], 0.3)), cb.Inside(cb.Ellipsoid([0, 0], [[2.0, 0.5], [0.5, 1.0]]))],
}


def disc(noise: float = 0.5) -> cb.Problem:
    """Paths are drawn to the middle of a disc."""
    system = cb.ContinuousSystem(lambda x, y: [-x, -y], states=["x", "y"], diffusion=noise * np.eye(2))
    return cb.Problem(system, initial=[0.2, 0], safe=SHAPES["disc"], horizon=1.0)


def truth(noise: float = 0.5, steps: int = 2000) -> float:
    """What leaves the disc, by the radius alone: u_t + (s^2/2) (u_rr + u_r / r) - r u_r = 0."""
    r = (np.arange(1200) + 0.5) / 1200
    gap, h = r[1] - r[0], 1.0 / steps
    up, down = ((noise**2 / 2 / gap**2 + sign * (noise**2 / 2 / r - r) / (2 * gap)) for sign in (1, -1))
    down[0] = 0.0
    diagonal, last = up + down, up[-1]
    diagonal[-1] += last  # the ghost beyond the edge is -u: survival is 0 there
    up[-1] = 0.0
    a = np.ones(len(r))
    for k in range(steps):
        share = 1.0 if k < 8 else 0.5
        right = a + (1 - share) * h * (up * np.roll(a, -1) + down * np.roll(a, 1) - diagonal * a)
        rows = np.array([np.roll(-share * h * up, 1), 1 + share * h * diagonal, np.roll(-share * h * down, -1)])
        a = solve_banded((1, 1), rows, right)
    return float(1 - np.interp(0.2, r, a))


def grid(count: int = 23) -> tuple[Axis, Axis]:
    lines = (np.linspace(-1.3, 1.25, count), np.linspace(-1.2, 1.3, count + 2) ** 3 / 1.4)
    return tuple(Axis(line, Sampling(5)) for line in lines)  # type: ignore[return-value]


def parts_at(shapes: Shapes, axes: tuple[Axis, Axis], points: Array) -> tuple[Array, Array]:
    """Whether points lie in a part of a cut cell that the edge meets, and whether in a failed cell."""
    cells = np.stack([np.searchsorted(axis.nodes, row, side="right") - 1 for axis, row in zip(axes, points.T)])
    number = {(int(i), int(j)): k for k, (i, j) in enumerate(zip(*shapes.cut))}
    cuts = np.array([0.0, 0.03, 0.25, 0.5, 0.75, 0.97, 1.0])
    met = np.zeros(len(points), dtype=bool)
    for k, (point, cell) in enumerate(zip(points, cells.T)):
        own = number.get((int(cell[0]), int(cell[1])))
        if own is not None:
            shares = [(y - a.nodes[c]) / (a.nodes[c + 1] - a.nodes[c]) for y, a, c in zip(point, axes, cell)]
            met[k] = shapes.met[own][tuple(int(np.searchsorted(cuts, s, side="right") - 1) for s in shares)]
    return met, shapes.failed[tuple(cells)]


@pytest.mark.parametrize("name", SHAPES)
def test_edges_lie_in_parts_that_are_met_and_no_safe_point_in_a_failed_cell(name: str) -> None:
    axes, constraints, rng = grid(), SHAPES[name], np.random.default_rng(0)
    shapes = Shapes.of(constraints, axes)
    low, high = (np.array([axis.nodes[end] for axis in axes]) + 1e-6 * (1 - 2 * (end != 0)) for end in (0, -1))
    inner = low + (high - low) * rng.random((4000, 2))
    outer = low + (high - low) * rng.random((4000, 2))
    holds = lambda x: np.logical_and.reduce([one.satisfied(x) for one in constraints])  # noqa: E731
    _, failed = parts_at(shapes, axes, inner)
    assert not np.any(failed & holds(inner))
    pairs = holds(inner) & ~holds(outer)
    inner, outer = inner[pairs], outer[pairs]
    for _ in range(60):
        middle = (inner + outer) / 2
        safe = holds(middle)[:, None]
        inner, outer = np.where(safe, middle, inner), np.where(safe, outer, middle)
    assert len(inner) > 50
    assert parts_at(shapes, axes, inner)[0].all()


def test_a_disc_is_left_as_often_as_the_bounds_say() -> None:
    exact = truth()
    found = list(bound_failing(disc(), seconds=10.0))[-1]
    assert 0.9 * exact < found.estimate < 1.2 * exact
    assert exact < found.upper < 1.8 * exact
    assert 0 <= found.lower < exact


@pytest.mark.parametrize("above", [True, False])
def test_what_lacks_on_edges_is_noticed_and_paid(above: bool) -> None:
    side = side_of(stages_of(disc()), 0.05, 24, above)
    side.propose()
    wrong = [np.zeros_like(one) if above else -2 * np.ones_like(one) for one in side.values]
    side.values, side.rates = wrong, [np.zeros_like(one) for one in side.rates]
    assert side.lacking() >= 1.0
    before = side.shortfall_on_edges().max()
    assert before == pytest.approx(1.0)
    late = side.shortfall_at_end()  # asked of all that has not failed
    assert late[side.shapes.cut][side.shapes.kept.any(axis=(1, 2))] == pytest.approx(0.0 if above else 2.0, abs=1e-9)
    assert np.all(late[side.shapes.failed] == 0)
    for _ in range(3):
        side.correct(side.residuals())
    assert side.shortfall_on_edges().max() < 0.3 * before


def test_a_wrong_solution_costs_width_and_never_truth() -> None:
    exact, rng = truth(), np.random.default_rng(3)
    for above in (True, False):
        side, starts = side_of(stages_of(disc()), 0.05, 30, above), starts_in(disc())
        side.propose()
        noise = [0.02 * rng.normal(size=one.shape) for one in side.values]
        side.values = [one + off - (0.03 if above else 0.0) for one, off in zip(side.values, noise)]
        bound, _, _ = refined(side, starts)
        assert bound >= (exact if above else -exact)


def test_a_start_in_a_cell_that_the_edge_cuts_is_bounded_by_nothing() -> None:
    asked = disc().replace(initial=[0.999, 0.0])
    for above in (True, False):
        side = side_of(stages_of(asked), 0.05, 24, above)
        side.propose()
        assert largest_at_start(side, starts_in(asked))[1] == (1.0 if above else pytest.approx(0.0, abs=1e-9))


@pytest.mark.parametrize("above", [True, False])
def test_a_target_that_an_obstacle_cuts_is_met_on_all_of_its_faces(above: bool) -> None:
    system = cb.ContinuousSystem(lambda x, y: [1.0 + 0 * x, -y], states=["x", "y"], diffusion=0.25 * np.eye(2))
    room = [cb.Inside(cb.Box([-1, -1.2], [3, 1.2])), cb.Outside(cb.Ball([2.1, 0.4], 0.3))]
    reach = cb.Reach(cb.HalfSpace([-1, 0], -2))
    asked = cb.Problem(system, initial=[0, 0], safe=room, reach=reach, horizon=4.0)
    side = side_of(stages_of(asked), 0.06, 24, above)
    x = side.axes[0].nodes
    ahead = x[:-1] >= 2 - 1e-6
    assert np.array_equal(side.arrived, np.broadcast_to(ahead[:, None], side.arrived.shape))
    side.propose()
    side.values = [one - 0.5 for one in side.values]  # below 0 on the faces by which paths arrive
    faces = [missing.max() for face, missing in zip(side.faces, side.shortfalls()) if face.place is not None]
    assert max(faces) > 0.3


def test_coefficients_on_a_part_of_a_cell_are_those_of_the_same_function() -> None:
    axes, rng = grid(), np.random.default_rng(5)
    coefficients = rng.normal(size=(1, *(axis.cells + 5 for axis in axes)))
    cells, part = (np.array([4, 9]), np.array([7, 0])), [(0.25, 0.5), (0.97, 1.0)]
    found, off = controls_on_some(axes, coefficients, cells, part)
    for corner in [(0, 0), (-1, 0), (0, -1), (-1, -1)]:
        shares = [one[end] for one, end in zip(part, corner)]
        for cell in (0, 1):
            value = coefficients[0]
            for axis, place, share in zip(axes, cells, shares):
                a, b = axis.nodes[place[cell]], axis.nodes[place[cell] + 1]
                value = axis.at_points(np.array([a + share * (b - a)]), 0).along(value, 0)[0]
            assert found.reshape(2, 6, 6)[cell][corner] == pytest.approx(float(value), abs=1e-11 + float(off[0, cell]))


def test_an_obstacle_beside_the_way_is_met_as_often_as_paths_say() -> None:
    system = cb.ContinuousSystem(lambda x, y: [1.0 + 0 * x, -y], states=["x", "y"], diffusion=0.3 * np.eye(2))
    room = [cb.Inside(cb.Box([-1, -1], [4, 1.5])), cb.Outside(cb.Box([1, 0.3], [1.6, 2]))]
    asked = cb.Problem(system, initial=[0, 0], safe=room, horizon=2.0)
    found = list(bound_failing(asked, seconds=8.0))[-1]
    assert 0.1 < found.lower < 0.2455  # 40,000 Euler paths of 4,000 steps, which miss some exits: .2442 +- .0064
    assert 0.24 < found.upper < 0.5
