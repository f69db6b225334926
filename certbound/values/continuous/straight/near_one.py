"""Both bounds by proposals of U itself, corrected by their own residual, and proved by `hypotheses`.

Carried residual: what a sample of the residual asks for, times a factor, is the source of the next proposal (`Source`).
The equation is linear, so that U grows by no more than the expected payment along paths, and the residual that is left
shrinks by its factor from one pass to the next. The last one is bounded on every patch; the theorem pays for the rest.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from certbound.arrays import Array
from certbound.problem.problem import Problem
from certbound.values.continuous.held_faces import check_noise
from certbound.values.continuous.hypotheses import (
    NEGLIGIBLE,
    Model,
    covers,
    extreme_over,
    proved_lower,
    proved_upper,
    raised_above,
    sampled_residual,
)  # fmt: skip
from certbound.values.continuous.payment import Payment
from certbound.values.continuous.plane import Found, Plane, Source, held_plane, plane_of, rough_level, two_states
from certbound.values.continuous.residual import value_range
from certbound.values.continuous.room import Room, points_of, starts_of
from certbound.values.continuous.straight.ramps import SMALL, Ramps, ramp_of
from certbound.values.continuous.straight.relative import relative_below
from certbound.values.continuous.surface import Surface
from certbound.watch import OutOfTime

Proposed = tuple[Surface, Payment]
Other = Callable[[float, float], Found]

_RARE = math.log(1e-3)  # below that logarithms serve better and need the time; lower bounds come after them
_RAREST = math.log(1e-6)  # below that there are none of those
_FEWEST, _MOST = 14, 60  # cells along each state
_COARSE = 0.55  # of the cells that may be afforded, for a first grid
_COST = 0.01  # about the seconds of both sides, over cells^2
_SHARE = 0.58  # of what may be spent, for the finer grid
_MARGIN = {True: 0.45, False: 0.35}  # of a cell, times the correlation of noises: lower bounds need more
_FACTORS = (1.12, 4.0, 4.0, 4.0, 4.0)
_AGAIN = (3.0, 3.0)  # the same for bounds of it
_GENTLY = (1.12, 1.12, 1.12), (2.0, 2.0)  # both where failing is rare
_BELOW = 0.43  # of what may be spent, for a lower bound then
_FINE = 30  # cells along each state, without which nothing comes of it
_LONG = 0.04  # a ramp's share of the horizon then: fronts that start with it are as wide as cells
_ENOUGH_RARE = 0.5
_SPARED = 0.03  # of U, which need not be carried then
_VAIN = 0.1  # of the cost, of a proposal that is not proved
_LEFT = 0.01  # of the answer: a residual that need not be carried any more
_WORSE = 1.5  # times the least one of those before: sources do not help any more
_MUCH = 10.0  # times U at the starts: where a proof would pay more, another pass does not make it good
_CLOSE = 0.05  # of log P between both bounds: no finer grid
_LIKELY = 0.15  # of log P: as near to a rough guess nothing is wrong
_ENOUGH = 0.25  # and nothing else is tried


def bound_plane(problem: Problem, model: Model, room: Room, deadline: float, wanted: float) -> Found:
    """As `two_states`: the best of both ways, this one first where it applies and failing is not too rare."""
    inner = plane_of(problem, model, room.inner_low, room.inner_high, starts_of(problem))
    outer = replace(inner, low=_pair(room.outer_low), high=_pair(room.outer_high))
    other = partial(two_states, problem, model, room)
    if held_plane(inner, model)[0] is not inner:
        return other(deadline, wanted)
    check_noise(model, (0.0, inner.horizon), list(zip(room.inner_low, room.inner_high)))
    if wanted < math.inf:
        check_noise(model, (0.0, inner.horizon), list(zip(room.outer_low, room.outer_high)))
    return bound_between(problem, model, inner, outer, deadline, wanted, other)


def bound_between(
    problem: Problem, model: Model, inner: Plane, outer: Plane | None, deadline: float, wanted: float, other: Other
) -> Found:
    """Bounds on an inner box (upper) and an outer one (lower, if any), by ``other`` (deadline, wanted) where due."""
    granted = round(deadline - time.perf_counter(), 1)
    served = inner.autonomous and len(model.branches) == 1 and granted >= _COST * _FEWEST**2
    level = rough_level(inner)
    if not served or not _RARE < level < 0:
        logs = other(time.perf_counter() + granted, wanted)
        if not served or not _RAREST < level <= _RARE or outer is None or logs[0] <= wanted or wanted == math.inf:
            return logs
        return _with_rare(problem, model, outer, granted, level, logs)
    upper, lower, spent, done = 0.0, -math.inf, 0.0, list[str]()
    above, below = list[Proposed](), list[Proposed]()
    most = min(math.sqrt(_SHARE * granted / _COST), _MOST)
    for cells in sorted({max(round(share * most), _FEWEST) for share in (_COARSE, 1.0)}):
        cost = _COST * cells**2
        try:
            found = _bounded(inner, model, cells, level, None, below=False)
            done.append(f"{cells}^2")
            if found is not None and found[1].log < upper:
                above.append(found)
                upper = found[1].log
            spent += cost / 2 if found is not None else _VAIN * cost
            if upper <= wanted < math.inf:
                break
            if outer is not None and wanted < math.inf:
                found = _bounded(outer, model, cells, level, points_of(problem), below=True)
                spent += cost / 2 if found is not None else _VAIN * cost
                if found is not None and found[1].log > lower:
                    below.append(found)
                    lower = found[1].log
        except OutOfTime:
            if upper == 0:
                raise
            break
        if upper - lower < _CLOSE or -math.inf < wanted < lower:
            break
    words = f"value function in two states, cells: {', '.join(done)}"
    least = None if lower == -math.inf else lower
    if upper <= wanted < math.inf or -math.inf < wanted < lower or upper - lower < _ENOUGH:
        return upper, least, words, (above, below)
    try:
        log = other(time.perf_counter() + granted - spent, wanted)
    except OutOfTime:
        return upper, least, words, (above, below)
    least = max((one for one in (least, log[1]) if one is not None), default=None)
    above += [one for one in log[3][0] if one[1].log < upper]
    below += [one for one in log[3][1] if one[1].log > lower]
    return min(upper, log[0]), least, f"{words} and {log[2].rpartition('cells: ')[2]}", (above, below)


def _with_rare(
    problem: Problem, model: Model, outer: Plane, granted: float, level: float, found: Found
) -> Found:
    """The lower bound that may be had where failing is rare, beside what is ``found``."""
    upper, lower, words, proposed = found
    if lower is not None and upper - lower < _ENOUGH:
        return found
    cells, shares = round(math.sqrt(_BELOW * granted / _COST)), list[float]()
    if cells < _FINE:
        return found
    with contextlib.suppress(OutOfTime):
        _bounded(outer, model, cells, level, points_of(problem), below=True, shares=shares)
    best = max(shares, default=-math.inf)
    if best <= (-math.inf if lower is None else lower):
        return found
    return upper, best, f"{words}, {cells}^2 below", proposed


def _pair(ends: tuple[float, ...]) -> tuple[float, float]:
    return ends[0], ends[1]


def _bounded(
    plane: Plane, model: Model, cells: int, level: float, points: Array | None, *, below: bool,
    shares: list[float] | None = None,
) -> Proposed | None:
    """The best bound of a few proposals: corrected by samples of the residual, then by its bounds.

    ``shares`` gets the bounds of log P by `relative_below` (lower ones only), which no certificate states.
    """
    rare = shares is not None
    starts, kinds = plane.starts, list[tuple[float, float, Ramps, Surface, Source | None]]()
    for eased in (False, True):
        solver = Ramps(
            plane, cells, (_LONG if rare else ramp_of(cells)) * plane.horizon, _MARGIN[below], eased=eased, below=below, finely=rare
        )
        if eased and solver.plain:  # the same again
            break
        surface, source, value, promised = _corrected(solver, model, points, below, rare)
        if surface is not None and 0 < value < 1 and abs(promised - value) < _MUCH * value:
            kinds.append((promised, value, solver, surface, source))
            if promised > 0 and abs(math.log(promised) - level) < (_ENOUGH_RARE if rare else _LIKELY):
                break
    if not kinds:
        return None
    _, value, solver, surface, source = (max if below else min)(kinds, key=lambda one: one[0])
    small = solver.small
    best: Proposed | None = None
    for factor in (*(_GENTLY[1] if rare else _AGAIN), None):
        spare = NEGLIGIBLE * small * value
        payment: Payment | None
        near = small * _SPARED / plane.horizon * _least(surface, small) if rare else None
        if below:
            payment, proof = proved_lower(surface, model, starts, points, spare, plane.cut, near, rare)
            needed = -proof.ranges.residual_low
        else:
            payment, proof = proved_upper(surface, model, starts, (), spare)
            needed = np.where(proof.ranges.low < 0, proof.ranges.residual_high, 0.0)
        if shares is not None and (share := relative_below(proof)) is not None:
            shares.append(share)
        if payment is not None and (best is None or (payment.log - best[1].log) * (1 if below else -1) > 0):
            best = surface if below else raised_above(surface), payment
        if factor is None or not np.isfinite(needed).all():
            break
        table = np.zeros((surface.slabs, surface.cells[0] * surface.cells[1]))
        table[proof.slab, proof.cell] = np.maximum(needed, 0.0) / small
        table = table.reshape(surface.slabs, *surface.cells)
        if rare:
            table = np.maximum(table - _SPARED / plane.horizon * _least(surface, small), 0.0)
        if table.max(axis=(1, 2)) @ surface.steps < _LEFT * value:
            break
        source = _more(source, surface, factor * table)
        surface = solver.surface(source, below=below)
    return best


def _corrected(
    solver: Ramps, model: Model, points: Array | None, below: bool, rare: bool = False
) -> tuple[Surface | None, Source | None, float, float]:
    """The proposal that promises most, its source, U at the starts and about the bound."""
    plane, source, small = solver.plane, None, solver.small
    best: tuple[Surface | None, Source | None, float, float] = None, None, 0.0, math.inf
    sign, least = -1 if below else 1, math.inf
    for factor in (*(_GENTLY[0] if rare else _FACTORS), None):
        surface = solver.surface(source, below=below)
        if not covers(surface, plane.horizon, plane.low, plane.high, within=not below):
            break
        value = 1 + extreme_over(surface, plane.starts, upper=not below, points=points) / small
        excess, level = sampled_residual(surface, model, upper=not below, along=6)
        asked = level > -small if below else level < 0  # where 0 < U < 1
        needed = np.where(asked, np.maximum(excess, 0.0), 0.0) / small
        paid = float(needed.max(axis=(1, 2)) @ surface.steps)
        if rare:  # as a share of U and what it is at the starts
            share = needed / (_least(surface, small) + value)
            paid = min(paid, 2 * value * float(share.max(axis=(1, 2)) @ surface.steps))
            needed = np.maximum(needed - _SPARED / plane.horizon * _least(surface, small), 0.0)
        if not math.isfinite(paid) or value <= 0:
            break
        if best[0] is None or sign * (value - best[3]) + paid < 0:
            best = surface, source, value, value + sign * paid
        if factor is None or paid < 2 * _LEFT * value or paid > _WORSE * least:
            break
        least = min(least, paid)
        source = _more(source, surface, factor * needed)
    return best


def _more(source: Source | None, surface: Surface, needed: Array) -> Source:
    more = Source.above(surface, needed)
    return more if source is None else source.plus(more)


def _least(surface: Surface, small: float) -> Array:
    """The least U of each patch, 0 where it is less."""
    low = [value_range(surface.patches(*chunk))[0] for chunk in surface.chunks()]
    return np.maximum(1 + np.concatenate(low) / small, 0.0).reshape(surface.slabs, *surface.cells)
