"""Both bounds by proposals of U itself, corrected by their own residual, and proved by `hypotheses`.

Carried residual: what a sample of the residual asks for, times a factor, is the source of the next proposal (`Source`).
The equation is linear, so that U grows by no more than the expected payment along paths, and the residual that is left
shrinks by its factor from one pass to the next. The last one is bounded on every patch; the theorem pays for the rest.
"""

from __future__ import annotations

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
    Proof,
    covers,
    extreme_over,
    proved_lower,
    proved_upper,
    raised_above,
    sampled_residual,
)  # fmt: skip
from certbound.values.continuous.payment import Payment
from certbound.values.continuous.plane import Found, Plane, Source, held_plane, plane_of, rough_level, two_states
from certbound.values.continuous.rare import RAREST, bound_rare
from certbound.values.continuous.straight.ramps import SMALL, Ramps, ramp_of
from certbound.values.continuous.straight.relative import relative_above, relative_below, seen_above, seen_below
from certbound.values.continuous.surface import Surface
from certbound.values.room import Room, points_of, starts_of
from certbound.watch import OutOfTime

Proposed = tuple[Surface, Payment]
Other = Callable[[float, float], Found]

_RARE = math.log(1e-3)  # below that logarithms serve better and need the time; lower bounds come after them
_RAREST = math.log(1e-6)  # below that there are none of those
_FEWEST, _MOST = 14, 60  # cells along each state
_COARSE = 0.55  # of the cells that may be afforded, for a first grid
_FINER, _HOPED = 34, 30.0  # cells that are granted anyway where nothing was proved, at such a promise (P)
_COST = 0.01  # about the seconds of both sides, over cells^2
_SHARE = 0.58  # of what may be spent, for the finer grid
_MARGIN = {True: 0.45, False: 0.35}  # of a cell, times the correlation of noises: lower bounds need more
_FACTORS = (1.12, 4.0, 4.0, 4.0, 4.0)
_AGAIN = (3.0, 3.0)  # the same for bounds of it
_GENTLY = (1.12, 1.12, 1.12), (2.0, 2.0, 2.0)  # both where failing is rare
_FIRST, _ABOVE, _BELOW = 0.5, 0.44, 0.56  # of what may be spent, for logarithms; of the rest, for each bound then
_RARELY = 0.0035  # about the seconds of one of them, over cells^2
_FAR, _FARTHER = 1.0, 3.0  # of log P above a rough guess: a finer grid does better, and logarithms may
_FINE = 34  # cells along each state, without which nothing comes of it
_LONG = {True: 0.02, False: 0.012}  # a ramp's share of the horizon then: fronts start as wide as cells
_NEARLY = 0.1  # of log P: what is left to pay is no more
_SAMPLED = 0.2  # of U where failing is rare: with less to pay samples have told what they can
_SPARED = 0.03  # of U, which need not be carried then
_VAIN = 0.1  # of the cost, of a proposal that is not proved
_LEFT = 0.01  # of the answer: a residual that need not be carried any more
_WORSE = 1.5  # times the least one of those before: sources do not help any more
_MUCH = 10.0  # times U at the starts: where a proof would pay more, another pass does not make it good
_CLOSE = 0.05  # of log P between both bounds: no finer grid
_LIKELY = 0.15  # of log P: as near to a rough guess nothing is wrong
_ENOUGH = 0.25  # and nothing else is tried


def bound_plane(
    problem: Problem, model: Model, room: Room, deadline: float, wanted: float, *, above: bool = True,
    guesses: list[float] | None = None,
) -> Found:
    """As `two_states`: the best of both ways, this one first where it applies and failing is not too rare.

    ``guesses`` gets a rough one at log P where a lower bound takes a proof of its own, which is left out then.
    """
    inner = plane_of(problem, model, room.inner_low, room.inner_high, starts_of(problem))
    outer = replace(inner, low=_pair(room.outer_low), high=_pair(room.outer_high))
    other = partial(two_states, problem, model, room)
    if held_plane(inner, model)[0] is not inner:
        return other(deadline, wanted)
    check_noise(model, (0.0, inner.horizon), list(zip(room.inner_low, room.inner_high)))
    if wanted < math.inf:
        check_noise(model, (0.0, inner.horizon), list(zip(room.outer_low, room.outer_high)))
    granted, level = round(deadline - time.perf_counter(), 1), rough_level(inner)
    if above and level < RAREST:
        return bound_rare(inner, model, granted, level, wanted, other)
    return bound_between(
        problem, model, inner, outer, time.perf_counter() + granted, wanted, other, looked=above, guesses=guesses,
        level=level,
    )  # fmt: skip


def bound_between(
    problem: Problem, model: Model, inner: Plane, outer: Plane | None, deadline: float, wanted: float, other: Other,
    *, looked: bool = True, guesses: list[float] | None = None, level: float | None = None,
) -> Found:
    """Bounds on an inner box (upper) and an outer one (lower, if any), by ``other`` (deadline, wanted) where due.

    ``level`` is about log P, if that is known.
    """
    granted = round(deadline - time.perf_counter(), 1)
    served = inner.autonomous and len(model.branches) == 1 and granted >= _COST * _FEWEST**2
    level = rough_level(inner) if level is None else level
    if not served or not _RARE < level < 0:
        if served and _RAREST < level <= _RARE and granted >= _RARELY * _FINE**2:
            return _with_rare(problem, model, (inner, outer), granted, level, wanted, other, looked, guesses)
        return other(time.perf_counter() + granted, wanted)
    upper, lower, spent, done = 0.0, -math.inf, 0.0, list[str]()
    above, below, hopes = list[Proposed](), list[Proposed](), list[float]()
    most = min(math.sqrt(_SHARE * granted / _COST), _MOST)
    grids = sorted({max(round(share * most), _FEWEST) for share in (_COARSE, 1.0)})
    for number, cells in enumerate((*grids, _FINER)):
        if number == len(grids) and (upper < 0 or not most + 1 < cells <= 2 * most or min(hopes) > _HOPED):
            break
        cost = _COST * cells**2
        try:
            found = _bounded(inner, model, cells, level, None, below=False, hopes=hopes)
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
    problem: Problem, model: Model, boxes: tuple[Plane, Plane | None], granted: float, level: float, wanted: float,
    other: Other, looked: bool, guesses: list[float] | None,
) -> Found:
    """Both bounds where failing is rare: by logarithms, which certificates state, where these may do for ``wanted``.

    Then shares of U are paid, first from above if that is ``looked`` for, and logarithms serve where that fails.
    """
    inner, outer = boxes if guesses is None else (boxes[0], None)
    upper, least, words = 0.0, None, "value function in two states, cells: "
    proposed = list[Proposed](), list[Proposed]()
    room = granted / (_RARELY * _FINE**2)
    if looked and wanted >= level:
        share = _FIRST if room * (1 - _FIRST) >= 1 else 1.0
        upper, least, words, proposed = other(time.perf_counter() + share * granted, math.inf)
        if upper <= wanted or share == 1:
            return upper, least, words, proposed
        words, granted, room = f"{words}, ", (1 - share) * granted, (1 - share) * room
    shares = (_ABOVE, _BELOW) if room * _ABOVE >= 1 else (1.0, 1.0)
    cells = [round(math.sqrt(share * granted / _RARELY)) for share in shares]
    if looked and shares[0] == 1:  # with what logarithms would take
        cells[0] = round(math.sqrt((1 + _FIRST) * granted / _RARELY))
    outer = outer if shares[0] < 1 or not looked else None  # one bound or none
    try:
        if looked:
            found = rarely(inner, model, cells[0], level, None, below=False)
            upper, words = min(upper, 0.0 if found is None else found), f"{words}{cells[0]}^2"
        if upper > wanted and guesses is not None:
            guesses.append(level)
        if upper > wanted and outer is not None and wanted < math.inf:
            least = rarely(outer, model, cells[1], level, points_of(problem), below=True)
            words += f", {cells[1]}^2 below"
        done = not looked or upper <= wanted or upper < level + (_FARTHER if shares[0] == 1 else _FAR)
        if not done or (least is None and upper > wanted and outer is not None and wanted < math.inf):
            logs = other(time.perf_counter() + _FIRST * granted, wanted)
            least = max((one for one in (least, logs[1]) if one is not None), default=None)
            upper, words, proposed = min(upper, logs[0]), f"{words} and {logs[2].rpartition('cells: ')[2]}", logs[3]
    except OutOfTime:
        if upper == 0 and least is None:
            raise
    return upper, least, words, proposed


def _pair(ends: tuple[float, ...]) -> tuple[float, float]:
    return ends[0], ends[1]


def _bounded(
    plane: Plane, model: Model, cells: int, level: float, points: Array | None, *, below: bool,
    hopes: list[float] | None = None,
) -> Proposed | None:
    """The best bound of a few proposals: corrected by samples of the residual, then by its bounds.

    ``hopes`` gets what each kind of proposal promised.
    """
    starts = plane.starts
    chosen = _chosen(plane, model, cells, level, points, below=below, hopes=hopes)
    if chosen is None:
        return None
    value, solver, surface, source = chosen
    best: Proposed | None = None
    for factor in (*_AGAIN, None):
        spare = NEGLIGIBLE * SMALL * value
        payment: Payment | None
        if below:
            payment, proof = proved_lower(surface, model, starts, points, spare, plane.cut)
        else:
            payment, proof = proved_upper(surface, model, starts, (), spare)
        if payment is not None and (best is None or (payment.log - best[1].log) * (1 if below else -1) > 0):
            best = surface if below else raised_above(surface), payment
        table = _needed(proof, surface, SMALL, below=below)
        if factor is None or table is None or table.max(axis=(1, 2)) @ surface.steps < _LEFT * value:
            break
        source = _more(source, surface, factor * table)
        surface = solver.surface(source, below=below)
    return best


def rarely(
    plane: Plane, model: Model, cells: int, level: float, points: Array | None, *, below: bool
) -> float | None:
    """The best bound of log P that pays shares of U (`relative`), which no certificate states; None where none is."""
    chosen, best = _chosen(plane, model, cells, level, points, below=below, rare=True), list[float]()
    if chosen is None:
        return None
    value, solver, surface, source = chosen
    try:
        for factor in (*_GENTLY[1], None):
            spare, left = NEGLIGIBLE * solver.small * value, _SPARED / plane.horizon * _least(surface, solver.small)
            given = surface, model, plane.starts, spare, solver.small * left
            proof = seen_below(*given, points, plane.cut) if below else seen_above(*given)
            share = relative_below(proof) if below else relative_above(proof)
            best += [] if share is None else [share]
            table = _needed(proof, surface, solver.small, below=below)
            if factor is None or table is None or (best and abs(best[-1] - math.log(value)) < _NEARLY):
                break
            source = _more(source, surface, factor * np.maximum(table - left, 0.0))
            surface = solver.surface(source, below=below)
    except OutOfTime:
        if not best:
            raise
    return (max if below else min)(best, default=None)


def _chosen(
    plane: Plane, model: Model, cells: int, level: float, points: Array | None, *, below: bool, rare: bool = False,
    hopes: list[float] | None = None,
) -> tuple[float, Ramps, Surface, Source | None] | None:
    """U at the starts, the solver, the proposal and the source that promise most."""
    kinds, lead = list[tuple[float, float, Ramps, Surface, Source | None]](), _LONG[below] if rare else ramp_of(cells)
    for eased in (False, True):
        solver = Ramps(plane, cells, lead * plane.horizon, _MARGIN[below], eased=eased, below=below, finely=rare)
        if eased and solver.plain:  # the same again
            break
        surface, source, value, promised = _corrected(solver, model, points, below, rare)
        if hopes is not None:
            hopes.append(promised)
        if surface is not None and 0 < value < 1 and abs(promised - value) < _MUCH * value:
            kinds.append((promised, value, solver, surface, source))
            if rare or (promised > 0 and abs(math.log(promised) - level) < _LIKELY):
                break
    return (max if below else min)(kinds, key=lambda one: one[0])[1:] if kinds else None


def _needed(proof: Proof, surface: Surface, small: float, *, below: bool) -> Array | None:
    """What a proof found missing, of U; None where it has no bound of it."""
    ranges = proof.ranges
    needed = -ranges.residual_low if below else np.where(ranges.low < 0, ranges.residual_high, 0.0)
    if not np.isfinite(needed).all():
        return None
    table = np.zeros((surface.slabs, surface.cells[0] * surface.cells[1]))
    table[proof.slab, proof.cell] = np.maximum(needed, 0.0) / small
    return table.reshape(surface.slabs, *surface.cells)


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
            own = _least(surface, small)
            paid = min(paid, 2 * value * float((needed / (own + value)).max(axis=(1, 2)) @ surface.steps))
            needed = np.maximum(needed - _SPARED / plane.horizon * own, 0.0)
        if not math.isfinite(paid) or value <= 0:
            break
        if best[0] is None or sign * (value - best[3]) + paid < 0:
            best = surface, source, value, value + sign * paid
        if factor is None or paid < (_SAMPLED if rare else 2 * _LEFT) * value or paid > _WORSE * least:
            break
        least = min(least, paid)
        source = _more(source, surface, factor * needed)
    return best


def _more(source: Source | None, surface: Surface, needed: Array) -> Source:
    more = Source.above(surface, needed)
    return more if source is None else source.plus(more)


def _least(surface: Surface, small: float) -> Array:
    """About the least U of each patch, that at its corners; 0 where it is less."""
    low = surface.values[:, :, 0, :, 0]
    for axis in range(3):
        low = np.minimum(np.delete(low, -1, axis), np.delete(low, 0, axis))
    return np.maximum(1 + low / small, 0.0)
