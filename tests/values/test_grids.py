"""Grids."""

from __future__ import annotations

import numpy as np
import pytest

from certbound.values.grids import Grid, around_nodes, corners, graded_axis, over_corners


def test_cells_and_nodes_have_the_order_of_tensors() -> None:
    grid = Grid(axes=(np.array([0.0, 1.0, 3.0]), np.array([0.0, 0.5])))
    assert grid.shape == (2, 1)
    assert grid.nodes().reshape(3, 2, 2)[2, 1].tolist() == [3.0, 0.5]
    assert grid.cells().hi.reshape(2, 1, 2)[1, 0].tolist() == [3.0, 0.5]
    assert grid.widths(0).ravel() == pytest.approx([1.0, 2.0])


def test_corners_and_cells_around_nodes() -> None:
    nodal = np.arange(12.0).reshape(3, 4)
    assert [view[1, 2] for view in corners(nodal)] == [6.0, 7.0, 10.0, 11.0]
    assert over_corners(np.maximum, nodal)[1, 2] == 11.0
    assert over_corners(np.minimum, nodal)[1, 2] == 6.0
    cells = np.arange(6.0).reshape(2, 3)
    assert around_nodes(cells, largest=True)[1, 1] == 4.0
    assert around_nodes(cells, largest=False)[1, 1] == 0.0


def test_a_graded_axis_follows_the_widths_and_keeps_marks_and_ends() -> None:
    places, widths = np.array([0.0, 1.0, 2.0]), np.array([0.1, 0.01, 0.1])
    axis = graded_axis(0.0, 2.0, places, widths, marks=[0.777, 5.0])
    assert axis[0] == 0.0
    assert axis[-1] == 2.0
    assert 0.777 in axis
    wanted = np.interp((axis[:-1] + axis[1:]) / 2, places, widths)
    assert np.all(np.diff(axis) <= 1.3 * wanted)
    assert np.all(np.diff(axis) > 0)
