"""Bounds for every state of the line, not for the initial set alone."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial

import numpy as np

from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.problem.problem import Problem
from certbound.values.charts import Chart, Charts
from certbound.values.continuous.held_faces import check_noise
from certbound.values.continuous.hypotheses import Model, chart_above, chart_below
from certbound.values.continuous.line import ladder
from certbound.values.continuous.line.initial_law import Start, start_of
from certbound.values.continuous.line.linked import spans
from certbound.values.continuous.line.reach import cuts_of

_UNSEALED = -700.0
_MOST_RATIO = 4.0


def chart_line(problem: Problem, model: Model, levels: list[float], times: int, lower: bool) -> Charts:
    """Charts at ``times`` times, sharp at the ``levels`` (natural logarithms, rising).

    Raises
    ------
    InfeasibleError
        Limits that move, come or go, or are missing, or noise that vanishes.
    """
    inner, outer, start = _rooms(problem, model)
    rough = ladder.sketches(inner)
    least = max(levels[0], float(rough[0].values.min()))
    levels = sorted({max(level, least) for level in levels})
    fineness, tolerance, lead = ladder.LADDER[2]
    share = lead / max(rough[0].growth, 1.0)
    above: list[Chart] = []
    for level in (_UNSEALED, levels[0]):  # a shorter line gives smaller bounds on it, the longer one more room
        links = ladder.surfaces_above(
            inner, start, [dataclasses.replace(rough[0], level=level)], (share, fineness, tolerance, lead)
        )
        if links is not None and spans(links, upper=True):
            surface = links[0].surface
            chart = partial(chart_above, surface, inner.models[0], levels, held=[links[0].held])
            found = _at_times(model, surface.times, times, -1, chart)
            same = len(above) == len(found) and all(a.time == b.time for a, b in zip(above, found))
            above = [a.joined(b) for a, b in zip(above, found)] if same else found
    below: list[Chart] = []
    rough = [dataclasses.replace(rough[0], level=levels[0])]
    lower = lower and (len(model.branches) == 1 or not any(outer.phases[0].held))
    links = ladder.surfaces_below(outer, start, rough, (share, fineness, 0.5 * tolerance, lead)) if lower else None
    if links is not None and spans(links, upper=False):
        surface = links[0].surface
        chart = partial(chart_below, surface, outer.models[0], levels, cut=[_cut(outer)])
        below = _at_times(model, surface.times, times, 1, chart)
    return Charts(upper=tuple(above), lower=tuple(below))


def chart_slabs(problem: Problem, model: Model, step: float, last: float) -> Charts:
    """Charts at many times up to ``last``, of one surface above and one below: between two log P moves about a step.

    Where the model does not depend on time, the chart at t is that of P(leaving by the horizon minus t): of all states
    at the first time, later on the cells that meet the starts.

    Raises
    ------
    InfeasibleError
        As `chart_line`; also where the model depends on time.
    """
    if not model.autonomous:
        raise InfeasibleError("exit times at all horizons at once need a model that does not depend on time.")
    inner, outer, start = _rooms(problem, model)
    sketch, horizon = ladder.sketches(inner)[0], float(problem.horizon)
    ratio, growth = horizon / max(horizon - last, horizon / _MOST_RATIO), max(sketch.growth, 1.0)
    low = sketch.level - growth * (ratio - 1)  # log P at the shortest time: it falls about like -1/s
    levels, rough = [low, min(sketch.level, -0.1)], [dataclasses.replace(sketch, level=low)]
    fineness, tolerance, lead = ladder.LADDER[2]
    share = lead / growth
    near = (horizon * step / (growth * ratio), start.low, start.high)
    above = ladder.surfaces_above(inner, start, rough, (share, fineness, tolerance, lead))
    below = None
    if len(model.branches) == 1 or not any(outer.phases[0].held):
        below = ladder.surfaces_below(outer, start, rough, (share, fineness, 0.5 * tolerance, lead))
    upper: list[Chart] = []
    lower: list[Chart] = []
    if above is not None and spans(above, upper=True):
        surface = above[0].surface
        slabs = np.flatnonzero(surface.times[:-1] <= last).tolist()
        upper = chart_above(surface, inner.models[0], levels, slabs, near, [above[0].held])
    if below is not None and spans(below, upper=False):
        surface = below[0].surface
        slabs = np.flatnonzero(surface.times[:-1] <= last).tolist()
        lower = chart_below(surface, outer.models[0], levels, slabs, near, [_cut(outer)])
    return Charts(upper=tuple(upper), lower=tuple(lower))


def _rooms(problem: Problem, model: Model) -> tuple[ladder.Room, ladder.Room, Start]:
    """The room for upper bounds, that for lower ones, and the start; refused where limits change."""
    start = start_of(problem)
    held = ladder.held_in(problem, model, start)
    cuts = cuts_of(problem, model, start, held)
    inner, outer = (ladder.room_of(problem, model, cuts, start, held, inner=side) for side in (True, False))
    if not (ladder.is_plain(inner) and ladder.is_plain(outer)) or start.random:
        raise InfeasibleError(
            "maps of value functions serve limits that stand still over the whole horizon, and a set of starts."
        )
    phase = outer.phases[0]
    check_noise(outer.models[0], (phase.start, phase.end), [(phase.low, phase.high)], [phase.held])
    return inner, outer, start


def _cut(room: ladder.Room) -> tuple[bool, bool]:
    """The sides on which the line is only cut: a path that leaves there has not failed."""
    phase = room.phases[0]
    return not (phase.closed[0] or phase.held[0]), not (phase.closed[1] or phase.held[1])


def _at_times(
    model: Model, ends: Array, count: int, side: int, chart: Callable[[list[int]], list[Chart]]
) -> list[Chart]:
    """Charts at ``count`` times from 0 on: at equal ones, or at ends of slabs where the model depends on time.

    Where it does not (the limits stand still, `chart_line`), the probability falls with t: what holds at the end of a
    slab before t (``side`` -1: an upper bound) or after it (1: a lower one) holds at t.
    """
    wanted = float(ends[-1]) * np.arange(count) / count
    if not model.autonomous:
        return chart(sorted({int(np.argmin(np.abs(ends[:-1] - time))) for time in wanted}))
    slabs = np.searchsorted(ends, wanted) if side > 0 else np.searchsorted(ends, wanted, side="right") - 1
    found = chart([min(int(slab), len(ends) - 2) for slab in slabs])
    kept = [(one, float(time)) for one, time in zip(found, wanted) if side < 0 or one.time >= time]
    return [dataclasses.replace(one, time=time) for one, time in kept]
