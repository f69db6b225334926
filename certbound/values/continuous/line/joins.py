"""One surface at the end of its phase against the next one at its start: enclosures of V on small intervals.

Upper bounds need min(V_next, 0) <= V wherever a path may pass the gate, and 0 <= V wherever it may not; lower bounds
V <= V_next where it may pass. Both are read on pieces of the cells of V, with enclosed ends.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from certbound.arrays import Array, Index, Mask
from certbound.rigor.intervals import Interval, stack
from certbound.values.continuous.line.phases import Gate, Phase
from certbound.values.continuous.surface import Surface
from certbound.values.polynomials import HERMITE

_PARTS = 12


class Profile:
    """V at one end of a slab as a polynomial on each cell, with enclosed coefficients about the cell's left end."""

    def __init__(self, surface: Surface, index: int) -> None:
        self.nodes = surface.axes[0]
        data = surface.values[index]
        h = Interval.point(self.nodes[1:]) - Interval.point(self.nodes[:-1])
        terms = [Interval.point(data[:-1, 0]), Interval.point(data[:-1, 1]) * h, Interval.point(data[:-1, 2]) * h * h]
        terms += [Interval.point(data[1:, 0]), Interval.point(data[1:, 1]) * h, Interval.point(data[1:, 2]) * h * h]
        # Bernstein coefficients by the rows of HERMITE, whose entries (fifths and twentieths) are off by a unit
        self.coefficients = []
        for row in HERMITE:
            total = Interval.point(np.zeros(len(h)))
            for entry, term in zip(row, terms):
                if entry:
                    total = total + Interval(entry - 1e-15 * abs(entry), entry + 1e-15 * abs(entry)) * term
            self.coefficients.append(total)
        self.widths = h

    def over(self, y: Interval) -> tuple[Interval, Interval]:
        """Enclosures of V and V' over intervals on the grid, shape (P,); all reals for those that stick out of it."""
        first = np.clip(np.searchsorted(self.nodes, y.lo, side="right") - 1, 0, len(self.nodes) - 2)
        last = np.clip(np.searchsorted(self.nodes, y.hi, side="left") - 1, 0, len(self.nodes) - 2)
        value, slope = self._on_cell(first, y)
        for hop in range(1, int((last - first).max(initial=0)) + 1):
            more = self._on_cell(np.minimum(first + hop, last), y)
            value, slope = value.hull(more[0]), slope.hull(more[1])
        out = (y.lo < self.nodes[0]) | (y.hi > self.nodes[-1])
        return _blurred(value, out), _blurred(slope, out)

    def _on_cell(self, cell: Index, y: Interval) -> tuple[Interval, Interval]:
        """V and V' over the part of an interval that lies on a cell."""
        low, high = np.clip(y.lo, self.nodes[cell], self.nodes[cell + 1]), np.clip(
            y.hi, self.nodes[cell], self.nodes[cell + 1]
        )
        width = self.widths[cell]
        left = Interval.point(self.nodes[cell])
        ends = [(Interval.point(end) - left) / width for end in (low, high)]
        b = [part[cell] for part in self.coefficients]
        slopes = [(b[k + 1] - b[k]) * 5.0 / width for k in range(5)]
        return _range(_blossoms(b, *ends)), _range(_blossoms(slopes, *ends))


def _blossoms(coefficients: Sequence[Interval], first: Interval, second: Interval) -> list[Interval]:
    """The polar form at k times ``second`` after ``first``, for every k: de Casteljau's algorithm."""
    level, found = stack(coefficients), list[Interval]()
    rests = Interval.point(1.0) - first, Interval.point(1.0) - second
    for left in range(len(coefficients) - 1, -1, -1):
        inner = level
        for _ in range(left):
            inner = rests[1] * inner[:-1] + second * inner[1:]
        found.append(inner[0])
        level = rests[0] * level[:-1] + first * level[1:]
    return found


def _range(parts: Sequence[Interval]) -> Interval:
    return Interval(np.min([part.lo for part in parts], axis=0), np.max([part.hi for part in parts], axis=0))


def _blurred(x: Interval, out: Mask) -> Interval:
    return Interval(np.where(out, -np.inf, x.lo), np.where(out, np.inf, x.hi))


def _pieces(surface: Surface, phase: Phase, gate: Gate) -> Interval:
    """Parts of the cells, cut again near the ends of the gate."""
    nodes = surface.axes[0]
    share = np.arange(_PARTS) / _PARTS
    cuts = (nodes[:-1, None] + np.diff(nodes)[:, None] * share).ravel()
    ends = [end for end in (gate.low, gate.high) if math.isfinite(end)]
    marks = [float(phase.local(Interval.point(end), gate.time).mid) for end in ends]
    cuts = np.unique(np.concatenate([cuts, nodes, [m for m in marks if nodes[0] < m < nodes[-1]]]))
    return Interval(cuts[:-1], cuts[1:])


def missing_upper(here: Surface, phase: Phase, gate: Gate, after: tuple[Surface, Phase] | None) -> float:
    """What has to be added to V at the end of a phase so that it joins the next one from above; None: nothing comes."""
    y = _pieces(here, phase, gate)
    value, slope = Profile(here, -1).over(y)
    x = phase.place(y, gate.time)
    surely_in = (x.lo >= gate.low) & (x.hi <= gate.high)
    surely_out = (x.hi < gate.low) | (x.lo > gate.high)
    need = np.where(surely_in & (after is None), -np.inf, -value.lo)
    if after is not None:
        gap = _gap(here, phase, gate, *after, y, slope)
        need = np.where(surely_out, -value.lo, np.where(surely_in, np.minimum(gap.hi, -value.lo), -value.lo))
    return float(max(need.max(), 0.0))


def missing_lower(here: Surface, phase: Phase, gate: Gate, after: Surface, next_phase: Phase) -> float:
    """What has to be taken from V at the end of a phase so that it joins the next one from below."""
    y = _pieces(here, phase, gate)
    x = phase.place(y, gate.time)
    out = (x.hi < gate.low) | (x.lo > gate.high)
    ends = [phase.local(Interval.point(np.clip(end, -1e300, 1e300)), gate.time) for end in (gate.low, gate.high)]
    low, high = np.maximum(y.lo, ends[0].lo), np.minimum(y.hi, ends[1].hi)  # only what may pass is compared
    y = Interval(np.minimum(low, y.hi), np.maximum(high, np.minimum(low, y.hi)))
    slope = Profile(here, -1).over(y)[1]
    gap = _gap(here, phase, gate, after, next_phase, y, slope)
    return float(max(np.where(out, -np.inf, -gap.lo).max(), 0.0))


def highest_inside(here: Surface, phase: Phase, gate: Gate) -> float:
    """An upper bound of V at the end of a phase over all places where a path may pass the gate."""
    y = _pieces(here, phase, gate)
    x = phase.place(y, gate.time)
    out = (x.hi < gate.low) | (x.lo > gate.high)
    return float(np.where(out, -np.inf, Profile(here, -1).over(y)[0].hi).max())


def _gap(
    here: Surface, phase: Phase, gate: Gate, after: Surface, next_phase: Phase, y: Interval, slope: Interval
) -> Interval:
    """V_next - V over pieces of V's cells: at the middle, and from there by the slopes."""
    middle = Interval.point(y.mid)
    away = y - middle
    mine, theirs = Profile(here, -1), Profile(after, 0)

    def beyond(part: Interval) -> Interval:
        return next_phase.local(phase.place(part, gate.time), gate.time)

    image = beyond(y)
    rate = _rate(phase, next_phase, gate.time)
    direct = theirs.over(image)
    # an image that sticks out by rounding alone is cut back: there V_next is not asked for
    at = theirs.over(_within(beyond(middle), theirs.nodes))[0] - mine.over(middle)[0]
    steep = theirs.over(_within(image, theirs.nodes))[1]
    rounding = 2 * _edge(theirs.nodes) * steep.mag  # what cutting back may have moved
    found = at + (steep * rate - slope) * away + Interval(-rounding, rounding)
    out = ~np.isfinite(direct[0].lo) & ~_nearly(image, theirs.nodes)
    return Interval(np.where(out, -np.inf, found.lo), np.where(out, np.inf, found.hi))


def _rate(phase: Phase, next_phase: Phase, t: float) -> Interval:
    """dy' / dy between the coordinates of two phases."""
    zero, one = phase.place(Interval.point(0.0), t), phase.place(Interval.point(1.0), t)
    if phase.width is None and next_phase.width is None:
        return Interval.point(1.0)
    return next_phase.local(one, t) - next_phase.local(zero, t)


def _within(y: Interval, nodes: Array) -> Interval:
    return Interval(np.clip(y.lo, nodes[0], nodes[-1]), np.clip(y.hi, nodes[0], nodes[-1]))


def _nearly(y: Interval, nodes: Array) -> Mask:
    slack = _edge(nodes)
    return np.asarray((y.lo >= nodes[0] - slack) & (y.hi <= nodes[-1] + slack))


def _edge(nodes: Array) -> float:
    """How far an image may stick out by rounding alone."""
    return 1e-13 * float(nodes[-1] - nodes[0] + np.abs(nodes).max())
