"""Upper bounds of log P(leaving a box) where that is far below e^-20: bounds of the residual feed the next proposal.

V falls by several units over a cell there, and samples of R tell little of its bounds: what these pay, patch by patch,
is the next source. Along faces, and in corners where a face that the drift leads to meets one that it leads away from,
R > 0 remains where V is all but 0, and `two_sides` lifts V over 0 there, by the same all over the plane. Here sources
go on working until V = `_OVER`: then V is positive in a strip inside of the box as well, in which nothing is due, as
if the box ended there. Hardly a path that leaves gets to such corners, so that little is lost. All this is proposal;
the proof is `hypotheses.proved_upper`, which asks for V >= 0 on the faces and for R only where V < 0.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable

import numpy as np

from certbound.arrays import Array
from certbound.values.continuous.hypotheses import Model, Proof, covers, extreme_over, proved_upper, raised_above
from certbound.values.continuous.payment import Payment
from certbound.values.continuous.plane import (
    RATE,
    Found,
    Plan,
    Plane,
    Sketch,
    Solver,
    Source,
    integrated,
    plan_above,
)  # fmt: skip
from certbound.values.continuous.surface import Surface
from certbound.watch import OutOfTime

RAREST = -20.0  # of log P

Proposed = tuple[Surface, Payment]
Other = Callable[[float, float], Found]

_OVER = 0.3  # V up to which sources work
_TOP = -0.003  # where V is above on all of a patch no source is asked for: corners would swing, and a lift does it
_GRANT = 1.7  # times the patches that seconds stand for elsewhere: one side is looked for, on one grid
_PASSES = 4  # that are proved
_FACTOR = 1.12
_CAP = 50.0
_GRANTED = 0.003  # eps that the proof may pay, in units of the bound, summed over the horizon
_HOPELESS = 6.0  # what a corrected proposal may lose (log P)
_FAR = 6.0  # of log P above a rough guess: another way may do better
_LITTLE = 0.1  # of log P: where a pass gains less, the next one is not worth its time
_CLOSE = 0.06  # of log P above what the proposal says: another pass would not help


def bound_rare(plane: Plane, model: Model, seconds: float, level: float, wanted: float, other: Other) -> Found:
    """An upper bound on one grid, or by ``other`` (deadline, wanted) where that is far above the ``level``.

    That is about log P. The seconds are turned into a number of patches, as in `two_states`.
    """
    plan, proposed = plan_above(plane, level, _GRANT * RATE * max(1.0, seconds)), list[Proposed]()
    try:
        _correct(plane, model, plan, proposed)
    except OutOfTime:
        if not proposed:
            raise
    upper = min((payment.log for _, payment in proposed), default=0.0)
    found: Found = upper, None, f"value function in two states, cells: {plan.cells}^2", (proposed, [])
    if upper < level + _FAR:
        return found
    with contextlib.suppress(*([OutOfTime] if proposed else [])):
        rest = other(time.perf_counter() + seconds, wanted)
        found = rest if rest[0] <= upper else found
    return found


def _correct(plane: Plane, model: Model, plan: Plan, proposed: list[Proposed]) -> None:
    """Each bound that is better than those before joins the ``proposed`` ones."""
    source: Source | None = None
    for number in range(_PASSES + 1):
        surface = integrated(Spilling(plane, plan, source))
        if surface is None or not covers(surface, plane.horizon, plane.low, plane.high, within=True):
            return
        if number < 2:
            sketch = Sketch.of(surface, model, plane.starts)
            if number and sketch.estimate() > sketch.start + _HOPELESS:
                return
        if number == 0:
            due = sketch.needed(_TOP)
        else:
            payment, proof = proved_upper(surface, model, plane.starts)
            start = extreme_over(surface, plane.starts, upper=True)
            gained = min((one.log for _, one in proposed), default=math.inf) - payment.log
            proposed += [(raised_above(surface), payment)] if gained > 0 and payment.log < 0 else []
            if gained < _LITTLE or payment.log < start + _CLOSE:
                return
            due = _due(proof, surface, start)
        more = Source.above(surface, _FACTOR * due)
        source = more if source is None else source.plus(more)


def _due(proof: Proof, surface: Surface, start: float) -> Array:
    """What a proof pays for on each patch, but for what eps does where V is far below ``start``."""
    ranges = proof.ranges
    paid = _GRANTED / float(surface.times[-1]) * np.exp(np.minimum(start - ranges.high, _CAP))
    due = np.where(ranges.low < _TOP, np.clip(ranges.residual_high - paid, 0.0, _CAP), 0.0)
    table = np.zeros((surface.slabs, int(np.prod(surface.cells))))
    table[proof.slab, proof.cell] = due
    return table.reshape(surface.slabs, *surface.cells)


class Spilling(Solver):
    """V with a source that lifts it above 0 where it has to, up to `_OVER`."""

    def _fed(self, tau: float, value: Array) -> Array:
        return np.asarray(self._source(tau) * np.clip(1 - value / _OVER, 0.0, 1.0))

    def _falls(self, tau: float, value: Array) -> Array:
        return np.where((value > 0) & (value < _OVER), self._source(tau) / _OVER, 0.0)
