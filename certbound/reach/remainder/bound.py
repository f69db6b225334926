"""What the linear response leaves over: rigorous bounds of the remainder beta of Thm K7.

On a piece with nominal curve p and slope Jhat(t) = J_m + (t - t_m) K,

    beta = f(t, p + s, d) - p' - Jhat s - E (d - d0),

over s in a polytope. The polytope is cut into boxes of the coordinates that enter the dynamics nonlinearly; on each
box beta is expanded to second order (`certbound.reach.remainder.expansion`), and boxes that reach beyond what is asked
for are cut further. Coordinates that no second derivative couples are handled side by side; where many are coupled,
every output has boxes of its own, cut in the coordinates that it depends on.

Symbols: H second derivatives of f, J first ones; Thm K7 and "Bounding beta" of docs/theory.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from certbound.arrays import Array, Index
from certbound.constants.enclosures import enclose
from certbound.problem.model import adds_plainly, selected
from certbound.reach.remainder.derivatives import Derivatives
from certbound.reach.remainder.expansion import Expansion, Parts
from certbound.reach.remainder.frame import Frame
from certbound.reach.remainder.nominal_defect import NominalDefect
from certbound.reach.remainder.polytope import Boxes, Polytope, grid
from certbound.reach.remainder.samples import fitted_slopes, sampled_range
from certbound.rigor.intervals import Interval
from certbound.watch import poll

Target = tuple[Array, Array]

_GRID = {1: 16, 2: 6, 3: 4}
_MANY = 4  # coupled coordinates from which on outputs that depend on fewer are bounded by themselves
_MOST = 300  # boxes per piece that one round may cut
_CROWD = 1000  # boxes of one piece, beyond which cutting them is no way to what is hoped for
_CLOSE = 0.02  # of the range that is hoped for: how close bounds come to one that is larger
_STALLED = 0.995  # cutting a box must make it exceed less
_EFFORT = ((0, np.inf), (8, 0.5), (12, 0.2), (20, 0.08))  # rounds of bisection, tolerated excess over the range


@dataclass(frozen=True, eq=False)
class _Asked:
    """Over what a bound is asked for, in how many rounds, how closely, what is hoped for, on which pieces, of what."""

    inner: Target
    polytope: Polytope
    rounds: int
    tolerance: float
    target: Target | None
    only: Index | None
    outputs: list[int] | None = None  # all when omitted

    def excess(
        self, lo: Array, hi: Array, inner_lo: Array, inner_hi: Array, items: Index, nominal: NominalDefect | None
    ) -> Array:
        """By how much bounds over boxes exceed what is hoped for, or their own range: in its units, (Q, n).

        Where no cutting keeps what is hoped for, because the middle of a box exceeds it, what is there counts instead.
        """
        low, high = (inner_lo, inner_hi) if self.target is None else self.target
        width = np.maximum(high - low, 1e-300)
        if self.target is not None:
            if nominal is not None:
                inner_lo, inner_hi = inner_lo + nominal.defect.lo, inner_hi + nominal.defect.hi
            low, high = np.minimum(low, inner_lo - _CLOSE * width), np.maximum(high, inner_hi + _CLOSE * width)
        found = np.maximum(hi - high[items], low[items] - lo) / width[items]
        found = found - self.tolerance if self.target is None else found
        if self.outputs is not None:
            found[:, np.setdiff1d(np.arange(found.shape[1]), self.outputs)] = -np.inf
        return np.where(np.isfinite(found) | (found < 0), found, np.inf)


@dataclass(frozen=True, eq=False)
class Remainder(Derivatives):
    """Bounds of beta over pieces of time; ``recent`` keeps the expansions of the last frame."""

    recent: list[tuple[Frame, Expansion]] = field(init=False, default_factory=list)

    def bound(
        self, frame: Frame, low: Array, high: Array, rows: Array, effort: int = 2, target: Target | None = None,
        only: Index | None = None,
    ) -> tuple[Array, Array]:
        """Enclosure of beta over every piece of ``frame``.

        Parameters
        ----------
        low, high : ndarray, shape (M, D)
            Bounds of s along the active coordinates (first) and along ``rows``.
        rows : ndarray, shape (M, D - active, active)
            Further directions, over the active coordinates.
        effort : int
            0 (one grid of boxes) to 3 (the boxes that matter are cut in many rounds).
        target : (ndarray, ndarray), shape (M, n), optional
            Bounds hoped for: boxes are cut no further than it takes to prove them.
        only : ndarray of int, optional
            The pieces asked for; what is returned for the others means nothing.

        Returns
        -------
        lower, upper : ndarray, shape (M, n)
            Infinite where the dynamics is not defined on the whole polytope.
        """
        count = len(self.active)
        expansion = self._expansion(frame)
        extra = self._disturbance(frame, low[:, :count], high[:, :count]) if self.gain is not None else None
        jumped = self._jumped(frame, low[:, :count], high[:, :count])
        if jumped is not None:
            extra = jumped if extra is None else extra + jumped
        if target is not None and extra is not None:
            target = target[0] - extra.lo, target[1] - extra.hi
        inner = low[:, :count], high[:, :count]
        asked = _Asked(inner, Polytope(low[:, count:], high[:, count:], rows), *_EFFORT[effort], target, only)
        if self.apart:
            lower, upper = self._one_by_one(expansion, asked)
        else:
            lower, upper = self._together(expansion, asked)
        if extra is not None:
            total = Interval(lower, upper) + extra
            lower, upper = total.lo, total.hi
        return lower, upper

    def sampled(self, frame: Frame, low: Array, high: Array, rows: Array) -> tuple[Array, Array]:
        """Range of beta over sample points, which proves nothing; see `sampled_range`."""
        return sampled_range(self, frame, low, high, rows)

    def fitted(self, frame: Frame, low: Array, high: Array, rows: Array) -> Array:
        """What to add to the slopes so that they fit beta: see `fitted_slopes`."""
        return fitted_slopes(self, frame, low, high, rows)

    def defect(self, frame: Frame) -> Array:
        """What no cutting of boxes takes off a bound of beta, on either side: its motion over the piece, (M, n)."""
        base = self._at_nominal(frame)
        return np.nan_to_num((base.hi - base.lo) / 2, nan=0.0, posinf=0.0)

    def _at_nominal(self, frame: Frame) -> Interval:
        """beta without any deviation, (M, n)."""
        origin, expansion = np.zeros((len(frame), len(self.active))), self._expansion(frame)
        boxes = Boxes(np.arange(len(frame)), origin, origin)
        return Interval(*expansion.plain_range(expansion.parts(boxes), boxes))

    def _expansion(self, frame: Frame) -> Expansion:
        """The expansions over ``frame``; those of the last frame are kept."""
        if not self.recent or self.recent[0][0] is not frame:
            self.recent[:] = [(frame, Expansion(self, frame))]
        return self.recent[0][1]

    def _disturbance(self, frame: Frame, low: Array, high: Array) -> Interval:
        """(D_d f - E)(d - d0) over the whole polytope's box."""
        n, q = frame.spread.shape[1], len(frame.disturbance_middle)
        assert self.gain is not None
        if adds_plainly(self.value, self.gain, q):
            point = [Interval.point(np.zeros(1))] * len(self.value.inputs)
            gain = enclose(selected(self.gain, list(range(n * q)), None), point).reshape(1, n, q)
        else:
            state = self._whole_box(frame, low, high)
            widths = (frame.disturbance_low, frame.disturbance_high)
            slots = self.slots(frame.span, state, frame.inputs, frame.disturbance_middle, widths)
            gain = enclose(self.gain, slots, undefined="infinite").broadcast_to((len(frame), n, q))
        reach = Interval(frame.disturbance_low, frame.disturbance_high) - frame.disturbance_middle
        return ((gain - frame.input_gain) * reach[None, None, :]).sum(axis=-1)

    def _whole_box(self, frame: Frame, low: Array, high: Array) -> Interval:
        """The box of the states over a piece and the polytope, (M, n)."""
        shift, size = np.zeros(frame.spread.shape), frame.spread.copy()
        shift[:, self.active] = (low + high) / 2
        size[:, self.active] += (high - low) / 2 * (1 + 1e-12) + 1e-15 * (np.abs(low) + np.abs(high)) + 1e-300
        size = size * (1 + 1e-15)
        return frame.middle + shift + Interval(-size, size)

    def _jumped(self, frame: Frame, low: Array, high: Array) -> Interval | None:
        """What rows that change beside the end of a piece add to beta there, spread over the whole piece; (M, n).

        For the part tau of a piece beta lies within D of what the piece's own row gives, and its integral over the
        piece within tau D: so much more of beta on all of it, tau D / h, has the same bounds, since the response is
        bounded by integrals of |beta| (`Supports.remainder`). States that are not active add nothing to D.
        """
        own = frame.beside
        if own is None:
            return None
        touched, n = np.flatnonzero((own.lo < own.hi).any(axis=1)), frame.spread.shape[1]
        size = np.zeros((len(frame), n))
        if len(touched):
            part, some = frame.taken(touched), self._whole_box(frame, low, high)[touched]
            widths = (frame.disturbance_low, frame.disturbance_high)
            slots = self.slots(part.span, some, part.inputs, part.disturbance_middle, widths)
            for place in range(part.inputs.shape[1]):
                slots[1 + n + place] = own[touched][:, place]
            values = enclose(self.value, slots, undefined="infinite").broadcast_to((len(touched), n))
            with np.errstate(invalid="ignore"):
                width = np.nextafter(values.hi - values.lo, np.inf) * frame.part
            size[touched] = np.where(np.isfinite(width), np.nextafter(width, np.inf), np.inf)
        return Interval(-size, size)

    def _together(self, expansion: Expansion, asked: _Asked) -> tuple[Array, Array]:
        """Bounds of all outputs over the boxes of each group."""
        if len(self.blocks) == 1:
            return self._group(expansion, self.blocks[0], asked)
        total = base = self._at_nominal(expansion.frame)
        for group in self.blocks:
            total = total + (Interval(*self._group(expansion, group, replace(asked, target=None))) - base)
        return total.lo, total.hi

    @cached_property
    def apart(self) -> dict[tuple[int, ...], list[int]]:
        """Outputs by the places in ``active`` of what they depend on nonlinearly, where that is less than all of many.

        Or where sums have kinks, whose boxes are culled by rows. Empty where one search over all coordinates does as
        well, and where an output meets several blocks.
        """
        blocks = [set(block) for group in self.blocks for block in group]
        many = (len(blocks) == 1 and len(blocks[0]) >= _MANY) or (len(blocks) > 1 and self.kinks_of_sums)
        if not many or self.planar or self.jumping:
            return {}
        place = {int(state): a for a, state in enumerate(self.active)}
        own: dict[int, set[int]] = {}
        for (i, j), states in zip(self.entries, self.sources, strict=True):
            own.setdefault(i, set()).update(place[state] for state in (j, *states))
        found: dict[tuple[int, ...], list[int]] = {}
        for i, places in own.items():
            found.setdefault(tuple(sorted(places)), []).append(i)
        within = all(any(block.issuperset(places) for block in blocks) for places in found)
        return found if within and any(len(places) < sum(map(len, blocks)) for places in found) else {}

    def _one_by_one(self, expansion: Expansion, asked: _Asked) -> tuple[Array, Array]:
        """Bounds of every output over boxes that are cut in its own coordinates alone, and whole in all others."""
        whole = Boxes(*_whole(asked))
        lower, upper = np.zeros((2, *expansion.frame.spread.shape))
        lower[whole.items], upper[whole.items] = expansion.plain_range(expansion.parts(whole), whole)
        for own, outputs in self.apart.items():
            found = self._group(expansion, [list(own)], replace(asked, outputs=outputs))
            for kept, part in zip((lower, upper), found):
                kept[:, outputs] = part[:, outputs]
        if np.isfinite(lower).all() and np.isfinite(upper).all():
            return lower, upper
        # boxes that are whole in other coordinates may reach where something else is undefined
        joint = self._together(expansion, asked)
        return np.fmax(lower, joint[0]), np.fmin(upper, joint[1])

    @np.errstate(over="ignore", invalid="ignore")  # boxes next to all floats: what overflows bounds nothing
    def _group(self, expansion: Expansion, group: list[list[int]], asked: _Asked) -> tuple[Array, Array]:
        """Bounds over the boxes of one group of blocks, displaced together."""
        m, n = expansion.frame.spread.shape
        size, alone = len(group[0]), len(group) == 1
        boxes = self._first_boxes(group, asked)
        lower, upper = np.full((m, n), np.inf), np.full((m, n), -np.inf)
        inner_lo, inner_hi = lower.copy(), upper.copy()
        # boxes of one of several blocks are 0 in all others, of which constraints say nothing then
        curbed = alone and asked.polytope.rows.shape[1] > 0 and (asked.outputs is not None or len(self.blocks) == 1)
        before = np.full(len(boxes), np.inf)  # by how much the box that a box was cut from exceeded
        for step in range(asked.rounds + 1):
            poll()
            inside = np.ones(len(boxes), dtype=bool)
            if curbed:
                keep, inside = asked.polytope.cull(boxes)
                boxes, inside, before = boxes[keep], inside[keep], before[keep]
            if not len(boxes):
                break
            items, parts = boxes.items, expansion.parts(boxes)
            if curbed:
                lo, hi = expansion.polytope_range(parts, boxes, asked.polytope, asked.outputs)
            else:
                lo, hi = expansion.plain_range(parts, boxes)
            np.fmax.at(inner_hi, items[inside], parts.middle[inside])
            np.fmin.at(inner_lo, items[inside], parts.middle[inside])
            if step == asked.rounds or not alone or size > 6:
                excess = np.full((len(items), n), -np.inf)
            else:
                excess = asked.excess(lo, hi, inner_lo, inner_hi, items, expansion.nominal)
            largest = excess.max(axis=1)
            # planes may need cuts on both sides to come closer, and what lies beyond kinks is culled late
            moving = np.isinf(before) | expansion.model.planar | expansion.model.kinked
            worst = (largest > 0) & ((largest < _STALLED * before) | moving)
            if alone:
                worst &= (np.bincount(items[worst], minlength=m) <= _CROWD)[items]
            if worst.sum() > _MOST * m:
                worst &= largest > np.partition(largest, -_MOST * m)[-_MOST * m]
            done = ~worst
            np.minimum.at(lower, items[done], lo[done])
            np.maximum.at(upper, items[done], hi[done])
            if not worst.any():
                break
            whole = np.maximum(asked.inner[1] - asked.inner[0], 1e-300)[items]
            boxes = boxes[worst].halved(_costliest(expansion, parts, boxes.radius, boxes.radius / whole, excess)[worst])
            before = np.tile(largest[worst], 2)
        # a polytope without any box left is empty: nothing can leave it, and 0 stands for the empty set
        empty = lower > upper
        return np.where(empty, 0.0, lower), np.where(empty, 0.0, upper)

    def _first_boxes(self, group: list[list[int]], asked: _Asked) -> Boxes:
        """A grid over the blocks of a group on every piece that is asked for."""
        (m, count), size = asked.inner[0].shape, len(group[0])
        divisions = _GRID.get(size, 2 if size <= 8 else 1)
        items = np.repeat(np.arange(m), divisions**size)
        centre, radius = (np.zeros((m, divisions**size, count)) for _ in range(2))
        if asked.outputs is not None:  # of some outputs alone: the coordinates that they do not see are whole
            _, middle, half = _whole(replace(asked, only=None))
            centre[:], radius[:] = middle[:, None], half[:, None]
        for block in group:
            centre[..., block], radius[..., block] = grid(*asked.inner, block, divisions)
        boxes = Boxes(items, centre.reshape(-1, count), radius.reshape(-1, count))
        return boxes if asked.only is None else boxes[np.isin(items, asked.only)]


def _whole(asked: _Asked) -> tuple[Index, Array, Array]:
    """One box a piece that is asked for: pieces, centres and radii."""
    (m, count), block = asked.inner[0].shape, list(range(asked.inner[0].shape[1]))
    centre, radius = (a.reshape(m, count) for a in grid(*asked.inner, block, 1))
    items = np.arange(m) if asked.only is None else np.unique(asked.only)
    return items, centre[items], radius[items]


def _costliest(expansion: Expansion, parts: Parts, radius: Array, share: Array, excess: Array) -> Index:
    """The coordinate of every box whose width costs most in the output that exceeds most.

    What planes leave is owed to no coordinate in particular: it counts for each by its ``share`` of the whole.
    """
    worst = np.argmax(excess, axis=1)
    number = np.arange(len(radius))
    cost = np.where(np.isfinite(parts.spend[number, worst]), parts.spend[number, worst], 0.0)
    if expansion.model.planar:
        gap = (parts.upper - parts.lower)[number, worst]
        cost += np.where(np.isfinite(gap), gap, 0.0)[:, None] * share / np.maximum(share.sum(axis=1), 1e-300)[:, None]
    for entry, (i, a) in enumerate(expansion.entries):
        linear = (0.25 * np.abs(parts.gradient[:, entry]) + parts.blur[:, entry]) * radius[:, a]
        cost[:, a] += np.where((worst == i) & np.isfinite(linear), linear, 0.0)
    usable = radius > 0
    return np.asarray(np.argmax(np.where(usable, np.where(parts.bad[:, None], radius, cost), -1.0), axis=1))
