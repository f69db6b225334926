"""Noise that the state multiplies: means from every node, second derivatives over cells, and both bounds."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

import certbound as cb
from certbound.values.discrete import bound_failure
from certbound.values.discrete.dominance import KAPPA, dominance
from certbound.values.discrete.failures import Work
from certbound.values.discrete.induction import back_above, back_below, final
from certbound.values.discrete.kernels import axis_kernel
from certbound.values.discrete.scaled import ScaledTransition, dynamics_of
from certbound.values.discrete.shocks import Inapplicable
from certbound.values.grids import Grid
from tests.values.discrete.helpers import mean_after_noise, random_function

LOW, HIGH = np.array([0.5, 0.5]), np.array([1.9, 1.8])


def growth(noise_matrix, *, law=None, horizon=4, **more):
    """A predator and its prey, strongly driven."""
    system = cb.DiscreteSystem(
        lambda x: [x[0] + 0.2 * x[0] * (1 - x[1]), x[1] + 0.2 * x[1] * (x[0] - 1)], states=["x", "y"],
        noise=law or cb.Gaussian(std=[1.0, 1.0]), noise_matrix=noise_matrix,
    )  # fmt: skip
    return cb.Problem(
        system, initial=[1.0, 1.1], safe=[cb.Inside(cb.Box(LOW, HIGH))], horizon=horizon, delta=0.1, **more
    )


def multiplied(t, x):
    return [[0.12 * x[0], 0], [0, 0.1 * x[1] + 0.02 * x[0]]]


def moments(x):
    """Means and standard deviations of one step, (P, 2) each."""
    mean = [x[:, 0] * (1.2 - 0.2 * x[:, 1]), x[:, 1] * (0.8 + 0.2 * x[:, 0])]
    return np.stack(mean, axis=1), np.stack([0.12 * x[:, 0], 0.1 * x[:, 1] + 0.02 * x[:, 0]], axis=1)


@pytest.mark.parametrize("order", [0, 2, 5, 8])
def test_the_constant_dominates_derivatives_of_other_widths(order: int) -> None:
    y, tau = np.linspace(-9, 9, 2401)[:, None], 1.05
    worst = 0.0
    for width in (1 / tau, 1.0, tau):
        z = (y - np.linspace(-0.3, 0.3, 13)) / width
        hermite = np.polynomial.hermite_e.hermeval(z, [0] * order + [1])
        ratio = np.abs(hermite) * norm.pdf(z) / width ** (order + 1) / (norm.pdf(y / KAPPA) / KAPPA)
        worst = max(worst, ratio.max())
    assert worst <= dominance(order, 0.3, stretch=tau) <= 3 * worst
    with pytest.raises(ValueError, match="stretch"):
        dominance(0, stretch=1.2)


def test_rows_with_deviations_of_their_own_are_those_of_one_kernel_each() -> None:
    nodes, points, sizes = np.linspace(0, 1, 9), np.array([0.4, -0.1, 0.9]), np.array([0.1, 0.3, 0.2])
    together = axis_kernel(points, nodes, sizes, 1e-15, orders=5)
    values = np.cos(np.arange(8.0))
    for k in range(3):
        alone = axis_kernel(points[k : k + 1], nodes, float(sizes[k]), 1e-15)
        for name in ("left", "bubble"):
            for one, other in zip(alone.apply(name, values, 0), together.apply(name, values, 0, 5)):
                assert other[k] == pytest.approx(one[0], rel=1e-9, abs=1e-11)
        assert together.outside[:3, k] == pytest.approx(alone.outside[:, 0], rel=1e-9, abs=1e-12)
    fine = np.linspace(0, 1, 400_001)
    z = (fine[:, None] - points) / sizes
    for order in (3, 4):
        hermite = np.polynomial.hermite_e.hermeval(z, [0] * order + [1])
        exact = np.trapezoid(hermite * norm.pdf(z) / sizes ** (order + 1), fine, axis=0)
        assert together.apply("whole", np.ones(8), 0, 5)[order] == pytest.approx(exact, rel=1e-6, abs=1e-6)
        assert together.outside[order] == pytest.approx(-exact, rel=1e-6, abs=1e-6)


def test_values_and_second_derivatives_hold_over_every_cell() -> None:
    problem, rng = growth(multiplied), np.random.default_rng(0)
    grid = Grid(axes=(np.linspace(0.8, 1.9, 26), np.linspace(0.8, 1.8, 26)))
    value = random_function(rng, grid, fixed=0.2)
    value = type(value)(grid=grid, nodal=value.nodal, bend=0.1 * value.bend, fixed=value.fixed, level=value.level)
    step = ScaledTransition(dynamics_of(problem, 1), 0, grid, grid, np.zeros(grid.shape, dtype=bool))
    field = step.tables.field(value)
    ((at, error),) = step.at_nodes(field)
    (least,), (most,) = step.bends(field, range(2), above=True), step.bends(field, range(2), above=False)
    for _ in range(3):
        k = rng.integers(0, grid.shape)
        place = np.array([axis[i] for axis, i in zip(grid.axes, k)])
        side = np.array([axis[i + 1] - axis[i] for axis, i in zip(grid.axes, k)])

        def phi(x):
            mean, size = moments(x)
            return np.array([mean_after_noise(value, m[None], np.diag(s**2))[0] for m, s in zip(mean, size)])

        assert abs(phi(place[None])[0] - at[tuple(k)]) <= error[tuple(k)] + 1e-6
        inner = place + side * rng.uniform(0.1, 0.9, 2)
        for i in range(2):
            shift = 0.05 * side[i] * np.eye(2)[i]
            second = (phi((inner + shift)[None]) - 2 * phi(inner[None]) + phi((inner - shift)[None]))[0] / shift[i] ** 2
            cell = int(np.ravel_multi_index(tuple(k), grid.shape))
            slack = 1e-3 * (1 + abs(second))
            assert least[i][cell] - slack <= second <= most[i][cell] + slack


def test_one_step_lies_on_its_side_of_the_closed_form() -> None:
    problem = growth(multiplied, horizon=1)
    work = Work(problem, None, 1)
    grid = work.layout(0.2)[1]
    zones, step = work.zones(grid, 0), work.transition(0, grid, grid, 0.2)
    points = np.random.default_rng(1).uniform(LOW, HIGH, (4000, 2))
    mean, size = moments(points)
    exact = 1 - np.prod(norm.cdf((HIGH - mean) / size) - norm.cdf((LOW - mean) / size), axis=1)
    above = back_above(step, final(grid, zones, above=True), zones).values(points)
    below = back_below(step, final(grid, zones, above=False), zones).values(points)
    assert np.all(below <= exact + 1e-12)
    assert np.all(exact <= above + 1e-12)
    assert np.max(above - below) < 0.03


def test_both_bounds_lie_around_a_simulation() -> None:
    found = bound_failure(growth(multiplied, horizon=3), seconds=0.3)
    rng, x, left = np.random.default_rng(0), np.tile([1.0, 1.1], (200_000, 1)), np.zeros(200_000, dtype=bool)
    for _ in range(3):
        mean, size = moments(x)
        x = mean + size * rng.standard_normal(x.shape)
        left |= np.any((x < LOW) | (x > HIGH), axis=1)
    share = left.mean()
    error = 4 * np.sqrt(share / len(x))
    assert found.lower - error <= share <= found.upper + error
    assert found.upper <= 1.6 * found.lower


def test_a_constant_matrix_says_the_same_written_as_a_function() -> None:
    fixed = bound_failure(growth([[0.15, 0], [0, 0.12]]), seconds=1.0)
    moving = bound_failure(growth(lambda t: [[0.15 + 0 * t, 0], [0, 0.12]]), seconds=1.0)
    assert max(fixed.lower, moving.lower) <= min(fixed.upper, moving.upper)
    assert moving.upper <= 1.3 * fixed.upper


def test_what_is_served_otherwise_is_refused() -> None:
    for matrix, law in (
        (lambda x: [[0.1 * x[0], 0], [0.1, 0.1 * x[1]]], None),
        (multiplied, cb.Gaussian(covariance=[[1, 0.5], [0.5, 1]])),
    ):
        with pytest.raises(Inapplicable, match="move one state each"):
            dynamics_of(growth(matrix, law=law), 1)
    with pytest.raises(Inapplicable, match="two states, with Gaussian noise"):
        dynamics_of(growth(multiplied, law=cb.Laplace(scale=[0.1, 0.1])), 1)
    with pytest.raises(Inapplicable, match="nowhere in the safe set much less"):
        bound_failure(growth(lambda x: [[0.1 * (x[0] - 1), 0], [0, 0.1]]), seconds=1.0)
