"""The door: an upper bound of the probability of leaving, for noise in one of three coordinates."""

from __future__ import annotations

import math
import time

import numpy as np
from scipy.interpolate import RegularGridInterpolator

from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.problem.problem import Problem
from certbound.rigor.intervals import Interval
from certbound.values.continuous import ExitBounds
from certbound.values.semilagrangian.carried.carried_grid import Fineness, layout_of
from certbound.values.semilagrangian.carried.carried_problem import Voyage, voyage_of
from certbound.values.semilagrangian.carried.carried_step import Layout, back, terminal
from certbound.values.semilagrangian.flows import flow
from certbound.watch import poll

_TALLEST = 100.0


def bound_by_kicks(voyage: Voyage, fineness: Fineness) -> float:
    """Upper bound of the probability of leaving by the horizon, from one grid; at most 1."""
    layout = layout_of(voyage, fineness)
    value, tallest = terminal(layout), 0.0
    for _ in range(fineness.count):
        poll("a value function along the flow")
        value, top = back(layout, value)
        tallest = max(tallest, top)
        if tallest > _TALLEST:
            return 1.0
    best = highest(voyage, layout, value, voyage.horizon / fineness.count / 2)
    return min(1.0, (best + fineness.rare * fineness.count * tallest) * (1 + 1e-12))


def highest(voyage: Voyage, layout: Layout, value: Array, half: float) -> float:
    """Upper bound of the function over where the starts are half a step later."""
    parts = [np.linspace(low, high, 4 if high > low else 2) for low, high in voyage.starts]
    low = [part.ravel() for part in np.meshgrid(*(part[:-1] for part in parts), indexing="ij")]
    high = [part.ravel() for part in np.meshgrid(*(part[1:] for part in parts), indexing="ij")]
    start = [Interval(np.nextafter(a, -np.inf), np.nextafter(b, np.inf)) for a, b in zip(low, high)]
    found = flow(voyage.tape, start, half * (1 + 1e-15), 6)
    if not found.known.all():
        return 1.0
    look, best = RegularGridInterpolator(layout.axes, value), 0.0
    for k in range(len(low)):
        places = []
        for axis, end in zip(layout.axes, found.end):
            a, b = float(end.lo[k]) - 1e-14, float(end.hi[k]) + 1e-14
            if a < axis[0] or b > axis[-1]:
                return 1.0
            places.append(np.concatenate([[a], axis[(axis > a) & (axis < b)], [b]]))
        points = np.stack([part.ravel() for part in np.meshgrid(*places, indexing="ij")], axis=1)
        best = max(best, float(look(points).max()))
    return best * (1 + 1e-12) + 1e-300
