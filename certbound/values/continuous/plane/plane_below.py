"""Two states, the lower bound: V rises from a small share of P at T, and is drawn to 0 in a margin around the box.

As in `two_sides`, what a proof of a first proposal would have to pay is handed to the next one, here as something
that V loses. The proof is that of `hypotheses`, on the part of the surface that lies in the box.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.values.continuous.hypotheses import Model, covers, extreme_over, prove_lower, sampled_residual
from certbound.values.continuous.payment import Payment
from certbound.values.continuous.plane.plane_grids import Pair, Plan, Plane, Source, slab_times
from certbound.values.continuous.plane.plane_proposal import propose_plane
from certbound.values.continuous.surface import Surface

_SHARE = 0.005  # of P: what V starts from, which is subtracted at last
_LEAD = 100.0  # over cells^2: the share of the horizon within which V rises on the faces, so that cells can follow
_FACTOR = 1.12
_PASSES = 2
_GRANTED = 0.01  # eps that the proof may pay, in units of the bound, summed over the horizon
_VARIED = 1.0
_CAP = 50.0
_HOPELESS = (60.0, 5.0)  # so far below the floor a first proposal, or a later one, is the last


def plan_below(plane: Plane, level: float, patches: float) -> Plan:
    """The finest grid with about so many patches, for that log P."""
    for cells in itertools.count(16):
        lead = min(_LEAD / cells**2, 0.4) * plane.horizon
        plan = Plan(cells=cells, growth=min(6 / cells, 0.3), lead=lead, floor=level + math.log(_SHARE), below=True)
        if cells**2 * len(slab_times(plane.horizon, plan)) > patches:
            break
    return plan


def bound_plane_below(
    plane: Plane, model: Model, plan: Plan, starts: list[Pair], points: Array | None
) -> tuple[Surface, Payment] | None:
    """The most promising of a few proposals, and what it pays for its lower bound of log P; None where that is none.

    The starts fill their box, or ``points`` lie among them.
    """
    source: Source | None = None
    best: SketchBelow | None = None
    for number in range(_PASSES + 1):
        surface = propose_plane(plane, plan, source)
        if surface is None or not covers(surface, plane.horizon, plane.low, plane.high, within=False):
            break
        sketch = SketchBelow.of(surface, model, starts, points)
        if best is None or sketch.estimate() > best.estimate():
            best = sketch
        if best.estimate() < plan.floor - _HOPELESS[min(number, 1)]:
            break
        more = Source.above(surface, _FACTOR * np.minimum(sketch.excess, _CAP))
        source = more if source is None else source.plus(more)
    if best is None or best.estimate() < plan.floor:  # what is subtracted at last would leave nothing
        return None
    payment = prove_lower(best.surface, model, starts, points, plane.cut)
    return None if payment is None else (best.surface, payment)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SketchBelow:
    """A proposal with samples of what its proof would pay for: -R, but for what eps pays."""

    surface: Surface
    start: float
    excess: Array

    @classmethod
    def of(
        cls, surface: Surface, model: Model, starts: list[Pair], points: Array | None = None, *,
        level: float | None = None,
    ) -> SketchBelow:
        start = extreme_over(surface, starts, upper=False, points=points) if level is None else level
        deficit, high = sampled_residual(surface, model, upper=False)
        paid = _GRANTED / float(surface.times[-1]) * np.exp(np.minimum(start - high - _VARIED, 50.0))
        return cls(surface=surface, start=start, excess=np.maximum(deficit - paid, 0.0))

    def estimate(self) -> float:
        """About what the proof will find."""
        return self.start - float(self.excess.max(axis=(1, 2)) @ self.surface.steps)
