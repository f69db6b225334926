"""Cells of the initial set, and how far they reach from the nominal start."""

from __future__ import annotations

import numpy as np

import certbound as cb
from certbound.reach.nominal import initial_cells
from certbound.rigor.intervals import Interval
from certbound.rigor.norms import Norm


def test_an_ellipsoid_that_is_nearly_flat_reaches_as_far_as_its_box() -> None:
    flat = [[0.00036969, 0.005229284777391055], [0.005229284777391055, 0.07396882408731707]]
    system = cb.DiscreteSystem(lambda x: 0.5 * x, states=2, noise=cb.Bounded(halfwidth=0.1))
    start = cb.Ellipsoid([0.151, -0.14], flat)
    problem = cb.Problem(system, initial=start, safe=[cb.Inside(cb.Box([-9, -9], [9, 9]))], horizon=5)
    cells = initial_cells(problem)
    (radius,) = cells.radii(Norm(2, None), Interval.point(cells.centres))
    assert np.sqrt(np.trace(flat)) <= radius <= 1.01 * np.sqrt(np.trace(flat))
