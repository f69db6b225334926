"""The compiled loops say of a residual's interpolants what arrays over all lattice points say, or a little less."""

from __future__ import annotations

import numpy as np
import pytest

from certbound.problem.model import trace
from certbound.rigor.intervals import Interval
from certbound.values.kolmogorov.cell_fields import Fields
from certbound.values.kolmogorov.residual import Generator, Images
from certbound.values.kolmogorov.splines import Sampling, most_of_interpolants, over_cells
from tests.values.kolmogorov.test_inequality import axis

DRIFTS = {
    2: lambda t, x: [x[1] * x[0] - x[0], 0.3 + 0 * x[0]],
    3: lambda t, x: [x[1] - x[0], x[0] * x[2], -0.7 * x[2]],
}
NOISES = {
    2: lambda t, x: [0.2, 0.1 * x[0], 0.1 * x[0], x[1] * x[1]],
    3: lambda t, x: [0.2, 0, 0.1, 0, 0, 0, 0.1, 0, 0.3 + x[0] * x[0]],
}


RISING, FALLING = (8, 9, 11), (11, 9, 8)  # cells of the axes; the loops take the axes in the first order


def parts(n: int, degree: int, counts: tuple[int, ...]) -> tuple[Generator, np.ndarray, np.ndarray]:
    """A generator with constant, mixed and varying coefficients on cells of all sizes, and random splines."""
    rng = np.random.default_rng(10 * n + degree)
    axes = tuple(axis(rng, cells, degree) for cells in counts[:n])
    rows = []
    for model in (DRIFTS[n], NOISES[n]):
        tape = trace(model, {"t": ["t"], "x": ["x", "y", "z"][:n]})
        rows.append(Fields(tape, n).on(axes, Interval(0.0, 1.0)))
    shape = (3, *(one.cells + 5 for one in axes))
    return Generator.of(axes, (rows[0], rows[1])), rng.normal(size=shape), rng.normal(size=shape)


def on_lattice(generator: Generator, values: np.ndarray, rates: np.ndarray) -> np.ndarray:
    _, images = generator.on_lattice(values)
    return np.asarray(generator.at_lattice(rates) + np.add.reduce(images))


@pytest.mark.parametrize("degree", [2, 3, 4, 5])
@pytest.mark.parametrize("n", [2, 3])
@pytest.mark.parametrize("counts", [RISING, FALLING])
def test_loops_find_the_largest_lattice_value_of_every_cell(n: int, degree: int, counts: tuple[int, ...]) -> None:
    generator, values, rates = parts(n, degree, counts)
    most = over_cells(generator.axes, on_lattice(generator, values, rates))
    found = generator.images.most(values, rates, proved=False)
    np.testing.assert_allclose(found, most, rtol=1e-11, atol=1e-11 * np.abs(most).max())


@pytest.mark.parametrize("degree", [2, 3, 4, 5])
@pytest.mark.parametrize("n", [2, 3])
@pytest.mark.parametrize("counts", [RISING, FALLING])
def test_loops_bound_interpolants_as_arrays_do(n: int, degree: int, counts: tuple[int, ...]) -> None:
    generator, values, rates = parts(n, degree, counts)
    lattice = on_lattice(generator, values, rates)
    arrays = most_of_interpolants(generator.axes, lattice)
    found = generator.images.most(values, rates, proved=True)
    off = 1e-11 * np.abs(lattice).max()
    if counts is RISING:
        assert np.all(found <= arrays + off)
    assert np.median((arrays - found) / np.abs(arrays)) < 0.2
    # the interpolants themselves, on a finer lattice of each cell
    fine = lattice
    nodes = Sampling(degree).nodes
    share = np.linspace(0, 1, 7)
    rows = np.array([[np.prod([(s - b) / (a - b) for b in nodes if b != a]) for a in nodes] for s in share])
    for k in range(n):
        moved = np.moveaxis(fine, k + 1, 0)
        cells = (len(moved) - 1) // degree
        blocks = [np.tensordot(rows, moved[c * degree : (c + 1) * degree + 1], axes=(1, 0)) for c in range(cells)]
        fine = np.moveaxis(np.concatenate(blocks), 0, k + 1)
    for k in range(n):
        moved = np.moveaxis(fine, k + 1, 0)
        fine = np.moveaxis(moved.reshape(-1, 7, *moved.shape[1:]).max(axis=1), 0, k + 1)
    assert np.all(found >= fine - off)


def test_two_constant_coefficients_of_one_derivative_are_added() -> None:
    rng = np.random.default_rng(0)
    axes = (axis(rng, 8, 2), axis(rng, 9, 2))
    ones = np.ones((17, 19))
    values = rng.normal(size=(2, 13, 14))
    twice = Images.of(axes, [((2, 0), 0.5 * ones), ((2, 0), 1.5 * ones)]).most(values, values, proved=True)
    once = Images.of(axes, [((2, 0), 2.0 * ones)]).most(values, values, proved=True)
    np.testing.assert_allclose(twice, once, rtol=1e-12)
