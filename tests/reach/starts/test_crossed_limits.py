"""Cells of a random start before a constraint, where numbers overflow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import certbound as cb
from certbound.reach.starts.crossed_limits import Limit
from certbound.reach.starts.drawn_paths import StartPaths
from certbound.rigor.intervals import Interval


@pytest.mark.parametrize("outside", [False, True])
@pytest.mark.parametrize("region", [cb.Ball([0.0, 0.0], 1e6), cb.Box([-1.0, -1.0], [1.0, 1.0])])
def test_unknown_paths_neither_keep_a_constraint_nor_break_it(region: cb.Ball | cb.Box, outside: bool) -> None:
    """inf - inf is no number, which compares with nothing: such a cell was counted as kept."""
    span = Interval(np.array([0.0, 1.0, 2.0]), np.array([1.0, 2.0, 3.0]))
    paths = StartPaths(
        controls=np.zeros((3, 4, 2)), gains=np.ones((3, 4, 2, 1)), rest=np.zeros((3, 4, 2, 0)), slack=np.zeros((3, 2)),
        size=np.zeros((3, 2)), span=span, reach=0.0,
    )  # fmt: skip
    limit = Limit(cb.Outside(region) if outside else cb.Inside(region), paths, 3.0)
    limit.pieces, limit.points = (
        replace(one, value=np.full(one.value.shape, np.inf), gains=np.full(one.gains.shape, -np.inf))
        for one in (limit.pieces, limit.points)
    )
    cell = np.full((1, 1), 0.5), np.full((1, 1), 0.5)
    assert np.all(limit.room(limit.pieces, *cell) < 0)
    assert len(limit.near(*cell).value) == 3
    assert not np.any(limit.breaks(limit.points, *cell) > 0)
