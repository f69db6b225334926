"""The door: an upper bound of the probability of leaving, for noise in one of three coordinates."""

from __future__ import annotations

import math
import time

import numpy as np

from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.problem.model import compile_numpy, jacobian
from certbound.problem.problem import Problem
from certbound.rigor.intervals import Interval
from certbound.values.continuous import ExitBounds
from certbound.values.semilagrangian.carried.carried_grid import Fineness, axes_of, layout_of
from certbound.values.semilagrangian.carried.carried_problem import STATES, Voyage, voyage_of
from certbound.values.semilagrangian.carried.carried_step import Layout, back, terminal
from certbound.values.semilagrangian.flows import flow
from certbound.watch import OutOfTime, poll

_TALLEST = 100.0
_PLANS = ((0.1, 16, 0.6), (0.07, 28, 0.5), (0.05, 40, 0.5), (0.05, 60, 0.5), (0.05, 80, 0.45), (0.04, 110, 0.4))
"""Lengths of the steps, relative to the time in which f turns; cells between faces; cells along q."""
_RATE = 350_000
"""Nodes times steps that are done in a second."""
_LONGEST = 600.0
"""Seconds beyond which the coarsest grid is left out where less was asked for."""
_OMEGA = 4.2  # for answers not far below 1; others ask for more
_LEAST, _MOST = 8, 2000


def bound_carried_exits(problem: Problem, *, seconds: float = 20.0) -> ExitBounds:
    """Bound P(X_t leaves the safe set for some t <= T) from above, for noise in one of three coordinates.

    Parameters
    ----------
    problem : Problem
        Three states in continuous time, constant noise in one of them, no time in the model.
    seconds : float
        About what may be spent, as a number of nodes and steps: bounds do not depend on the clock. The coarsest grid
        is finished in any case.

    Raises
    ------
    InfeasibleError
        The problem is of another kind.
    """
    begin = time.process_time()
    voyage = voyage_of(problem)
    best, done, omega = 1.0, [], _OMEGA
    for fineness in _affordable(voyage, _RATE * round(seconds, 1), omega):
        try:
            found = bound_by_kicks(voyage, fineness)
        except OutOfTime:
            if not best < 1:
                raise
            break
        best = min(best, found)
        done.append(f"{fineness.count} steps")
    words = f"value function along the flow, {', '.join(done)}"
    upper = min(0.0, math.log10(best) * (1 - 1e-15) + 1e-15)
    return ExitBounds(upper=upper, lower=None, words=words, seconds=time.process_time() - begin)


def _affordable(voyage: Voyage, work: float, omega: float) -> list[Fineness]:
    """The finest of the plans whose nodes times steps are at most ``work``; or else the coarsest, if it ever ends."""
    turn, chosen = _turn(voyage), None
    for share, cells, cell in _PLANS:
        count = min(max(_LEAST, math.ceil(voyage.horizon / (share * turn))), _MOST)
        plan = Fineness(count=count, cells=cells, edge=1.0, cell=cell, omega=omega)
        axes = axes_of(voyage, plan, voyage.horizon / count)
        asked = math.prod(len(axis) for axis in axes) * count
        if chosen is None and asked > max(work, _RATE * _LONGEST):
            raise InfeasibleError(
                f"the coarsest grid asks for {asked / _RATE:.2g} s, as the noise of a step is small against the safe "
                "set; value functions prove nothing here."
            )
        if chosen is not None and asked > work:
            break
        chosen = plan
    return [chosen] if chosen is not None else []


def _turn(voyage: Voyage) -> float:
    """The time in which the flow turns by a radian, or in which the noise turns how it carries, about."""
    grid = np.meshgrid(*(np.linspace(*ends, 9) for ends in voyage.ends))
    points = [part.ravel() for part in grid]
    first = jacobian(voyage.tape, tuple(range(1, STATES + 1)))
    with np.errstate(all="ignore"):
        slopes = np.broadcast_to(compile_numpy(first)(0.0, *points), (len(points[0]), STATES, STATES))
        second = compile_numpy(jacobian(jacobian(voyage.tape, (STATES,)), (STATES,)))(0.0, *points)
    second = np.broadcast_to(second, (len(points[0]), STATES, 1))[..., 0]
    fine = np.isfinite(slopes).all(axis=(1, 2)) & np.isfinite(second).all(axis=1)
    if not fine.any():
        raise InfeasibleError("the model is undefined all over the safe set; value functions prove nothing here.")
    slopes, second = slopes[fine], second[fine]
    rates = float(np.median(np.abs(np.linalg.eigvals(slopes)).max(axis=1)))
    bent = float(np.sqrt((second**2).mean() / max((slopes[..., -1] ** 2).mean(), 1e-300)))
    return 1 / max(rates, (voyage.noise * bent) ** 2, 1 / voyage.horizon)


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
    from scipy.interpolate import RegularGridInterpolator

    parts = [np.linspace(low, high, 4 if high > low else 2) for low, high in voyage.starts]
    low = [part.ravel() for part in np.meshgrid(*(part[:-1] for part in parts), indexing="ij")]
    high = [part.ravel() for part in np.meshgrid(*(part[1:] for part in parts), indexing="ij")]
    start = [Interval(np.nextafter(a, -np.inf), np.nextafter(b, np.inf)) for a, b in zip(low, high)]
    found = flow(voyage.tape, start, half * (1 + 1e-15), 6)
    if not found.known.all():
        return 1.0
    look, best = RegularGridInterpolator(layout.axes, value), 0.0
    for k in range(len(low[0])):
        places = []
        for axis, end in zip(layout.axes, found.end):
            a, b = float(end.lo[k]) - 1e-14, float(end.hi[k]) + 1e-14
            if a < axis[0] or b > axis[-1]:
                return 1.0
            places.append(np.concatenate([[a], axis[(axis > a) & (axis < b)], [b]]))
        points = np.stack([part.ravel() for part in np.meshgrid(*places, indexing="ij")], axis=1)
        best = max(best, float(look(points).max()))
    return best * (1 + 1e-12) + 1e-300
