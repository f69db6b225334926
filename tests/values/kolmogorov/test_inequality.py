"""The trusted inequality: bounds of splines, coefficients and residuals hold at random points, whatever is proposed."""

from __future__ import annotations

import numpy as np
import pytest

import certbound as cb
from certbound.errors import EnclosureError
from certbound.problem.model import trace
from certbound.rigor.intervals import Interval
from certbound.values.kolmogorov.box_setting import stages_of
from certbound.values.kolmogorov.cell_fields import Fields
from certbound.values.kolmogorov.factors import Factor
from certbound.values.kolmogorov.residual import Generator, residual_bound
from certbound.values.kolmogorov.splines import Axis, Derivatives, Sampling, most_on_cells

PARTS = (2, 3, 4, 5)


def axis(rng: np.random.Generator, cells: int, parts: int, low: float = -1.0, high: float = 1.5) -> Axis:
    inner = np.sort(rng.uniform(low, high, cells - 1))
    return Axis(np.concatenate([[low], inner, [high]]), Sampling(parts))


def value(axes: tuple[Axis, ...], coefficients: np.ndarray, points: np.ndarray, orders: tuple[int, ...]) -> np.ndarray:
    """A tensor spline's derivative at points, shape (P, n), one row after the other."""
    rows = [one.at_points(points[:, k], order).along(np.eye(one.cells + 5), 0) for k, (one, order)
            in enumerate(zip(axes, orders))]  # fmt: skip
    return np.einsum("pi,pj,ij->p", *rows, coefficients)


def cell_of(axes: tuple[Axis, ...], points: np.ndarray) -> tuple[np.ndarray, ...]:
    return tuple(
        np.clip(np.searchsorted(one.nodes, points[:, k], side="right") - 1, 0, one.cells - 1)
        for k, one in enumerate(axes)
    )


def points_in(axes: tuple[Axis, ...], rng: np.random.Generator, count: int = 4000) -> np.ndarray:
    return np.stack([rng.uniform(one.nodes[0], one.nodes[-1], count) for one in axes], axis=1)


@pytest.mark.parametrize("orders", [(0, 0), (1, 0), (0, 2), (2, 1), (3, 2), (5, 0), (4, 4)])
def test_derivatives_of_a_spline_lie_within_their_bounds_on_every_cell(orders: tuple[int, int]) -> None:
    rng = np.random.default_rng(1)
    axes = (axis(rng, 9, 2), axis(rng, 11, 4))
    c = rng.normal(size=(14, 16))
    size = Derivatives(axes, c[None]).size(orders)[0]
    points = points_in(axes, rng)
    seen = np.abs(value(axes, c, points, orders))
    bound = size[cell_of(axes, points)]
    assert np.all(seen <= bound * (1 + 1e-9))
    assert np.max(seen / bound) > 0.3


def test_bernstein_coefficients_bound_a_spline_closely_from_above() -> None:
    rng = np.random.default_rng(2)
    axes = (axis(rng, 9, 2), axis(rng, 11, 2))
    c = rng.normal(size=(14, 16))
    points = points_in(axes, rng, 20000)
    most, cells = most_on_cells(axes, c[None])[0], cell_of(axes, points)
    seen = np.full(most.shape, -np.inf)
    np.maximum.at(seen, cells, value(axes, c, points, (0, 0)))
    assert np.all(seen <= most + 1e-12)
    assert np.median((most - seen)[np.isfinite(seen)]) < 0.2


def test_nodal_values_of_a_quintic_give_it_back_also_from_nodes_beyond_the_axis() -> None:
    rng = np.random.default_rng(3)
    one = axis(rng, 12, 2)
    longer = np.concatenate([one.nodes, one.nodes[-1] + 0.1 * np.arange(1, 6)])
    quintic = np.polynomial.Polynomial([0.3, -1, 0.5, 2, -0.7, 0.2])
    for nodes in (one.nodes, longer):
        c = one.from_nodes(nodes) @ quintic(nodes)
        assert np.allclose(one.at_points(one.lattice, 1).along(c, 0), quintic.deriv()(one.lattice), atol=1e-7)


MODELS = {
    "smooth": lambda x, y: [np.sin(2 * x) * y - x, np.exp(-x) + x * y / (2 + y**2)],
    "kinks": lambda x, y: [np.abs(x - 0.1) - y, np.maximum(x, y) - np.minimum(y, 0.3)],
    "a jump": lambda x, y: [np.where(x < 0.2, 1.0, -1.0) - x, x - y],
}


def fields_of(name: str) -> Fields:
    system = cb.ContinuousSystem(MODELS[name], states=["x", "y"], diffusion=[[0.5, 0.0], [0.2, 0.4]])
    return Fields(system.dynamics, 2)


@pytest.mark.parametrize("parts", PARTS)
@pytest.mark.parametrize("name", MODELS)
def test_interpolated_coefficients_are_off_by_at_most_their_errors(name: str, parts: int) -> None:
    rng = np.random.default_rng(4)
    axes = (axis(rng, 8, parts), axis(rng, 7, parts))
    points = points_in(axes, rng)
    cells = cell_of(axes, points)
    for k, field in enumerate(fields_of(name).on(axes, Interval.point(0.0))):
        assert field is not None
        shares = [(points[:, i] - one.nodes[cells[i]]) / np.diff(one.nodes)[cells[i]] for i, one in enumerate(axes)]
        rows = [_lagrange(one.sampling.nodes, share) for one, share in zip(axes, shares)]
        places = [cells[i][:, None] * parts + np.arange(parts + 1) for i in range(2)]
        samples = field.lattice[places[0][:, :, None], places[1][:, None, :]]
        p = np.einsum("pi,pj,pij->p", *rows, samples)
        truth = np.asarray(MODELS[name](points[:, 0], points[:, 1])[k])
        assert np.all(np.abs(p - truth) <= field.error[cells] * (1 + 1e-9) + 1e-13)
        assert np.all(np.abs(p) <= field.slopes[0][0][cells] * (1 + 1e-9))


def test_errors_of_interpolants_beside_a_kink_are_near_what_they_are() -> None:
    """A controller that saturates: its range on a cell is twenty times what its interpolant misses."""
    system = cb.ContinuousSystem(
        lambda x, v: [v, np.clip(-20 * x - 6 * v, -3, 3)], states=["x", "v"], diffusion=[[0.0], [0.6]]
    )
    axes = (Axis(np.linspace(-0.5, 0.5, 21), Sampling(5)), Axis(np.linspace(-1.5, 1.5, 19), Sampling(5)))
    points = points_in(axes, np.random.default_rng(5), 40_000)
    cells = cell_of(axes, points)
    *_, field = Fields(system.dynamics, 2).on(axes, Interval.point(0.0))
    assert field is not None
    rows = [_lagrange(one.sampling.nodes, (points[:, i] - one.nodes[cells[i]]) / np.diff(one.nodes)[cells[i]])
            for i, one in enumerate(axes)]  # fmt: skip
    places = [cells[i][:, None] * 5 + np.arange(6) for i in range(2)]
    p = np.einsum("pi,pj,pij->p", *rows, field.lattice[places[0][:, :, None], places[1][:, None, :]])
    missed = np.abs(p - np.clip(-20 * points[:, 0] - 6 * points[:, 1], -3, 3))
    assert np.all(missed <= field.error[cells] + 1e-13)
    assert missed.max() > 0.02
    assert field.error.max() < 5 * missed.max()


def _lagrange(nodes: np.ndarray, places: np.ndarray) -> np.ndarray:
    rows = np.ones((len(places), len(nodes)))
    for i, node in enumerate(nodes):
        for other in np.delete(nodes, i):
            rows[:, i] *= (places - other) / (node - other)
    return rows


@pytest.mark.parametrize("parts", PARTS)
@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("kind", ["rough", "steady", "straight"])
def test_the_residual_of_a_random_function_lies_below_its_bound_everywhere(name: str, parts: int, kind: str) -> None:
    rng = np.random.default_rng(5)
    axes = (axis(rng, 7, parts), axis(rng, 8, parts))
    g = np.array([[0.5, 0.0], [0.2, 0.4]])
    a = g @ g.T
    coarse = tuple(Axis(one.nodes, Sampling(2)) for one in axes)
    generator, sketch = (
        Generator.of(grid, (fields_of(name).on(grid, Interval.point(0.0)), _constant_fields(grid, a)))
        for grid in (axes, coarse)
    )
    values, rates = rng.normal(size=(3, 12, 13)), rng.normal(size=(3, 12, 13))
    steps = np.array([0.3, 0.2])
    if kind == "steady":  # the drift's and the noise's own terms alone, where v does not change
        values, rates = np.broadcast_to(values[:1], values.shape).copy(), np.zeros_like(rates)
    if kind == "straight":  # no bulge hides what either knot asks for
        rates = np.broadcast_to(rates[:1], rates.shape).copy()
        values = values[:1] - np.array([0.0, 0.3, 0.5]).reshape(3, 1, 1) * rates
    bound = residual_bound(generator, sketch, values, rates, steps)
    points, t = points_in(axes, rng), rng.uniform(0, 1, 4000)
    cells = cell_of(axes, points)
    f = [np.broadcast_to(row, t.shape) for row in MODELS[name](points[:, 0], points[:, 1])]
    for slab, h in enumerate(steps):
        late, early = slab, slab + 1  # knots are listed from the last one backward
        basis = np.array([2 * t**3 - 3 * t**2 + 1, (t**3 - 2 * t**2 + t) * h, 3 * t**2 - 2 * t**3, (t**3 - t**2) * h])
        slope = np.array([6 * t**2 - 6 * t, (3 * t**2 - 4 * t + 1) * h, 6 * t - 6 * t**2, (3 * t**2 - 2 * t) * h]) / h
        data = (values[early], rates[early], values[late], rates[late])

        def at(orders: tuple[int, int], weights: np.ndarray, data: tuple[np.ndarray, ...] = data) -> np.ndarray:
            return sum(w * value(axes, one, points, orders) for w, one in zip(weights, data))

        r = at((0, 0), slope) + f[0] * at((1, 0), basis) + f[1] * at((0, 1), basis)
        r += a[0, 0] / 2 * at((2, 0), basis) + a[1, 1] / 2 * at((0, 2), basis) + a[0, 1] * at((1, 1), basis)
        assert np.all(r <= bound[slab][cells] + 1e-9)


def test_for_the_best_of_some_disturbances_one_and_the_same_serves_what_is_straight_and_what_bulges() -> None:
    """v = x p(t) with p = s (1 - s) - 1/16 and r = v_t + d v_x: with d = 1 what is straight is -1/16, with d = -1 what
    bulges is at most 0, but r exceeds 1/16 somewhere for either of them (|x| is at most .001)."""
    line = Axis(np.linspace(-1e-3, 1e-3, 9), Sampling(2))
    axes = (line, Axis(np.arange(9.0), Sampling(2)))
    tape = trace(lambda t, x: [1.0, 0.0], {"t": ["t"], "x": ["x", "y"]})
    along, _ = Fields(tape, 2).on(axes, Interval.point(0.0))
    generator = Generator.of(axes, ([along, None], [None] * 4))
    either = Factor(bernstein=np.array([1.0, -1.0]).reshape(2, 1, 1), error=np.zeros((2, 1)), between=np.zeros(1))
    x = np.array([line.knots[k + 1 : k + 6].mean() for k in range(line.cells + 5)])[:, None] * np.ones(13)
    values, rates = np.stack([-x / 16, -x / 16]), np.stack([-x, x])
    bound = residual_bound(generator, generator, values, rates, np.array([1.0]), [either], worst=False)
    assert np.all(bound >= 1 / 16 - 2e-3)


def _constant_fields(axes: tuple[Axis, ...], a: np.ndarray) -> list:
    tape = trace(lambda t, x: [float(entry) for entry in a.ravel()], {"t": ["t"], "x": ["x", "y"]})
    return Fields(tape, 2).on(axes, Interval.point(0.0))


def test_a_model_that_is_undefined_on_a_cell_is_refused() -> None:
    rng = np.random.default_rng(6)
    system = cb.ContinuousSystem(lambda x, y: [np.log(x) - y, -y], states=["x", "y"], diffusion=np.eye(2))
    axes = (axis(rng, 7, 2), axis(rng, 7, 2))
    with pytest.raises(EnclosureError, match="undefined"):
        Fields(system.dynamics, 2).on(axes, Interval.point(0.0))


def test_settings_that_are_not_served_are_refused_by_name() -> None:
    from certbound.errors import InfeasibleError

    stay = [cb.Inside(cb.Box([-1, -1], [1, 1]))]
    cases = {
        "discrete": cb.DiscreteSystem(lambda x, y: [x / 2, y / 2], states=["x", "y"], noise=cb.Gaussian(std=0.1)),
    }
    for words, system in cases.items():
        problem = cb.Problem(system, initial=[0, 0], safe=stay, horizon=1 if words != "discrete" else 5)
        with pytest.raises(InfeasibleError, match=words):
            stages_of(problem)[0]


def test_a_hump_that_no_line_of_the_lattice_shows_is_bounded_in_three_states() -> None:
    """A quadratic of three variables that is at most 1 at its lattice points, convex along each of their lines, and
    1.0327 at (.2, .2, .2): there -d_kk p is positive."""
    lattice = np.ones((3, 3, 3))
    lattice[1, 1] = [1, 0, -1]
    lattice[1, 2] = [1, -1, 1]
    lattice[2, 1] = [1, -1, 1]
    axes = tuple(Axis(np.arange(9.0), Sampling(2)) for _ in range(3))
    basis = _lagrange(axes[0].sampling.nodes, np.arange(9.0) - 3.0)  # it fills the cell from 3 to 4
    rows = [one.from_nodes() @ basis for one in axes]
    rate = np.einsum("ia,jb,kc,abc->ijk", *rows, lattice)
    values = np.stack([np.zeros_like(rate), -rate])
    bound = residual_bound(*[Generator(axes=axes, terms=())] * 2, values, np.stack([rate, rate]), np.array([1.0]))
    inside = np.append(np.random.default_rng(8).uniform(0, 1, (2000, 3)), [[0.2, 0.2, 0.2]], axis=0)
    weights = [_lagrange(axes[0].sampling.nodes, inside[:, k]) for k in range(3)]
    seen = np.einsum("pa,pb,pc,abc->p", *weights, lattice)
    assert seen.max() > 1.03
    assert np.all(seen <= bound[0, 3, 3, 3])


@pytest.mark.parametrize("parts", PARTS)
def test_derivatives_of_a_coefficient_are_left_out_where_they_vanish_and_nowhere_else(parts: int) -> None:
    """Of x^2 y, sin x and |x| y: the second order of a polynomial counts; none of a kink, whatever its tape says."""
    rng = np.random.default_rng(parts)
    axes = (axis(rng, 8, parts), axis(rng, 9, parts))
    smooth = trace(lambda t, x: [x[0] ** 2 * x[1], np.sin(x[0])], {"t": ["t"], "x": ["x", "y"]})
    square, wave = Fields(smooth, 2).on(axes, Interval(0.0, 1.0))
    assert [len(rows) - 1 for rows in square.slopes] == [2, 1]
    assert [len(rows) - 1 for rows in wave.slopes] == [parts, 0]
    y = np.maximum(np.abs(axes[1].nodes[1:]), np.abs(axes[1].nodes[:-1]))
    assert np.all(square.slopes[0][2] >= 2 * y * (1 - 1e-12))
    bent = trace(lambda t, x: [abs(x[0]) * x[1]], {"t": ["t"], "x": ["x", "y"]})
    (kink,) = Fields(bent, 2).on(axes, Interval(0.0, 1.0))
    assert [len(rows) - 1 for rows in kink.slopes] == [parts, parts]


def test_what_one_node_holds_reaches_no_further_than_its_neighbours() -> None:
    nodes = np.cumsum(np.random.default_rng(3).uniform(0.5, 1.5, 25))
    axis = Axis(nodes, Sampling(5))
    on_lattice = axis.on_lattice[0].along(axis.from_nodes(), 0)  # of a 1 at one node; an interpolating spline rings on
    for node, values in enumerate(on_lattice.T):
        far = np.abs(np.searchsorted(nodes, axis.lattice) - node) > 9
        assert not values[far].any()
