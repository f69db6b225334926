"""Upper bounds in a region with curved walls by proposals of U itself, where failing is not too rare.

The way of `straight`, with what the region meets of each cell in place of all cells, and the logarithm of U paid for:
what is lost is lost near walls, where U is large.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from certbound.arrays import Array, Index
from certbound.problem.sets import Region as Set
from certbound.values.continuous.curved.boundaries import Walls
from certbound.values.continuous.curved.cuts import Cuts
from certbound.values.continuous.curved.proof import (
    Lot,
    examine_within,
    highest_over,
    look_over,
    raised_over_walls,
)  # fmt: skip
from certbound.values.continuous.curved.walled_ramps import WalledRamps
from certbound.values.continuous.hypotheses import LIFTS, NEGLIGIBLE, Model, Need, Proof, cheapest, covers, up
from certbound.values.continuous.payment import Payment
from certbound.values.continuous.plane import Plane, Source
from certbound.values.continuous.residual import Ranges, sample_in_plane, value_range
from certbound.values.continuous.straight import SMALL
from certbound.values.continuous.surface import Surface

_SAMPLES = (4, 6, 6)
_FACTORS = (0.6, 0.9, 1.12, 1.12, 1.12)  # of what a proof would pay, for one source after the other
_SAMPLED = 3  # of which samples tell, and its bounds after that
_HOPELESS = 3.0  # of log P: where samples say that a proof would lose more, none is tried
_TOP = -0.003  # of log U: where it is above, the proof may lift it over 0 instead
_SHIFTS = (2e-3, 0.03, 0.1, 0.3, 1.0, 3.0)  # of P, added to U where its logarithm is looked at, in turn
_ROUNDED = 1e-15  # more than 1 + V / e is off by
_GRANTED = 0.005  # of the answer, which the proof may pay in any case


def bound_near_walls(plane: Plane, walls: Walls, model: Model, initial: Set, cells: int) -> float:
    """The upper bound of log P on a grid with so many cells along each state, 0 where nothing is proved."""
    solver, upper = WalledRamps(plane, walls, cells), 0.0
    source: Source | None = None
    for number, factor in enumerate(_FACTORS):
        try:
            surface = solver.surface(source, below=False)
        except (RuntimeError, ValueError):  # a singular system, or a proposal that is not finite
            break
        if not covers(surface, plane.horizon, plane.low, plane.high, within=True):
            break
        sketch = _Sketch.of(surface, walls, model, initial)
        if not 0 < sketch.value < 1:
            break
        needed, gap = sketch.excess, sketch.estimate() - math.log(sketch.value)
        if number >= _SAMPLED and gap < _HOPELESS:
            log, needed = sketch.proved(walls, model)
            upper = min(upper, log)
        more = Source.above(surface, factor * np.where(np.log(sketch.low) < _TOP, needed, 0.0))
        source = more if source is None else source.plus(more)
    return upper


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Sketch:
    """A proposal, V >= 0 on the walls, with samples of U's residual and U's least values, patch by patch.

    ``value`` is an upper bound of U over the starts, ``floor`` a lower one of V in the region.
    """

    surface: Surface
    cuts: Cuts
    value: float
    floor: float
    excess: Array
    low: Array
    paid: float

    @classmethod
    def of(cls, surface: Surface, walls: Walls, model: Model, initial: Set) -> _Sketch:
        cuts = Cuts.of(surface.axes, walls)
        surface = raised_over_walls(surface, cuts)
        value = 1 + highest_over(surface, walls, initial) / SMALL

        def look(lot: Lot) -> tuple[Array, Array, Index, Index]:
            found = sample_in_plane(lot.patches, lot.drifts, lot.squares, lot.place, _SAMPLES, upper=True)
            return found, value_range(lot.patches)[0], lot.slab, lot.cell

        shape = (surface.slabs, int(np.prod(surface.cells)))
        excess, low, floor = np.zeros(shape), np.ones(shape), 0.0
        for highest, least, slab, cell in look_over(surface, cuts, model, _SAMPLES, look):
            floor = min(floor, float(least.min(initial=0.0)))
            np.maximum.at(excess, (slab, cell), highest / SMALL)
            np.minimum.at(low, (slab, cell), 1 + least / SMALL)
        paid = _GRANTED * value / float(surface.times[-1])
        whole = (surface.slabs, *surface.cells)
        return cls(
            surface=surface, cuts=cuts, value=value, floor=floor, paid=paid,
            excess=np.maximum(excess - paid, 0.0).reshape(whole),
            low=np.maximum(low, _GRANTED * max(value, 0.0) + 1e-300).reshape(whole),
        )  # fmt: skip

    def estimate(self) -> float:
        """About what the proof will find."""
        rates = self.excess / self.low
        costs = [
            lift + float(np.where(np.log(self.low) < -lift, rates, 0.0).max(axis=(1, 2)) @ self.surface.steps)
            for lift in LIFTS
        ]
        return math.log(self.value) + min(costs) if self.value > 0 else math.inf

    def proved(self, walls: Walls, model: Model) -> tuple[float, Array]:
        """What the theorem says of log P, whatever the surface is, and what the residual's bounds ask for."""
        start = up(SMALL * (self.value - 1))
        need = Need(spare=NEGLIGIBLE * SMALL * self.value / float(self.surface.times[-1]), start=start, top=0.0)
        proof = examine_within(self.surface, self.cuts, model, need)
        table = np.zeros((self.surface.slabs, int(np.prod(self.surface.cells))))
        np.maximum.at(table, (proof.slab, proof.cell), proof.ranges.residual_high / SMALL)
        payment = relative_payment(proof, self.surface, start, self.floor, need.spare)
        return payment.log, np.maximum(table.reshape(self.excess.shape) - self.paid, 0.0)


def relative_payment(proof: Proof, surface: Surface, start: float, floor: float, spare: float) -> Payment:
    """The theorem's upper bound with log((U + c) / (1 + c)) in place of V, from what was seen of V = e (U - 1).

    (U + c)_t + L (U + c) is at most R / e, since Q2 >= 0: so R of the logarithm is at most R / (e (U + c)), which is
    less where U is large, and where the logarithm is above 0, as on walls, nothing is asked. The best of some c is
    taken: with large ones U is paid for in absolute terms. ``start`` bounds V over the starts from above,
    ``floor`` everywhere from below; where nothing was looked at, R is at most ``spare`` (1 + exp(start - V)), which is
    less than 2.1 ``spare``.
    """
    value, least = 1 + start / SMALL + _ROUNDED, 1 + floor / SMALL - _ROUNDED
    if not (0 < value < 1 and least > -10):
        return Payment(log=0.0)
    paid = [_paid_with(proof, surface, (value, least, max(0.0, -least) + c * value), spare) for c in _SHIFTS]
    return min(paid, key=lambda one: one.log)


def _paid_with(proof: Proof, surface: Surface, ends: tuple[float, float, float], spare: float) -> Payment:
    """The same with one c, from U at the starts, the least U, and c."""
    value, least, shift = ends
    walls = math.log1p(shift) * (1 - 1e-15)  # at most log (1 + c)
    low = (1 + proof.ranges.low / SMALL - _ROUNDED + shift) * (1 - 1e-12)
    high = (1 + proof.ranges.high / SMALL + _ROUNDED + shift) * (1 + 1e-12)
    low = np.maximum(low, (least + shift) * (1 - 1e-12))
    begun = math.log((value + shift) * (1 + 1e-12)) - walls + 1e-14
    excess = np.maximum(proof.ranges.residual_high / SMALL / low * (1 + 1e-12), 0.0)
    none = np.zeros(len(low))
    ranges = Ranges(
        residual_low=none, residual_high=excess, low=np.log(low) - walls - 1e-14, high=np.log(high) - walls + 1e-14,
        energy=none,
    )  # fmt: skip
    need = Need(spare=2.1 * spare / SMALL / (value + shift), start=begun, top=0.0)
    end = math.log((least + shift) * (1 - 1e-12)) - walls - 1e-14
    payment, lift = cheapest(replace(proof, ranges=ranges), need, surface, begun, end)
    return replace(payment, lift=lift)
