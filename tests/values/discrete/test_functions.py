"""Functions on a grid: bounds on parts of cells hold and are sharper than those on whole cells."""

from __future__ import annotations

import numpy as np
import pytest

from certbound.values.discrete.functions import ValueFunction
from certbound.values.grids import Grid


@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.parametrize("parts", [1, 2, 4])
def test_bounds_on_parts_of_cells_hold_everywhere_and_lie_within_those_of_the_cells(n: int, parts: int) -> None:
    rng = np.random.default_rng(n)
    grid = Grid(axes=tuple(np.cumsum(rng.uniform(0.1, 0.5, 4 + k)) - 1 for k in range(n)))
    fixed = rng.uniform(size=grid.shape) < 0.3
    function = ValueFunction(
        grid=grid, nodal=rng.normal(size=grid.node_shape), fixed=fixed, level=rng.uniform(size=grid.shape),
        bend=np.where(fixed, 0.0, 20 * rng.normal(size=(n, *grid.shape))),
    )  # fmt: skip
    axes, low, high = function.ranges_within(parts)
    assert [len(axis) - 1 for axis in axes] == [parts * size for size in grid.shape]
    points = rng.uniform([axis[0] for axis in grid.axes], [axis[-1] for axis in grid.axes], size=(5000, n))
    values = function.values(points)
    place = tuple(np.searchsorted(axis, points[:, k]) - 1 for k, axis in enumerate(axes))
    assert np.all(low[place] <= values)
    assert np.all(values <= high[place])
    least, most = (np.kron(end, np.ones([parts] * n)) for end in function.range())
    assert np.all(least <= low)
    assert np.all(high <= most)
    assert parts == 1 or np.mean(high - low) < 0.6 * np.mean(most - least)
