"""The proof: bounds of the probability that a path leaves the box of a surface, from both sides.

Nothing here trusts the surface. What Theorem K8-CT asks for, and where it is shown:

- V twice continuously differentiable in x, C^1 in t on slabs, continuous in t: by construction (`surface`);
- V >= 0 on every face (upper), V <= 0 everywhere (lower): `prove_upper`, `prove_lower` shift V by what it misses;
- R <= lam + eps e^-V + m(V) Q2 where V < 0 (upper), R >= -lam - eps e^-V - m(V) Q2 everywhere (lower): `examine`
  bounds R, V, Q2 on every patch (or finds that a negligible lam and eps pay), `payment` pays for the worst;
- the supremum over d: the branches of the model cover D (upper), the best single branch of a patch (lower);
- q and theta: `payment.repay`, `payment.Levels.above`;
- V(0, .) over the starts, V(T, .) over the box: `extreme_over`, `Surface.range_at`;
- the box lies in the safe set (upper) or contains it (lower), and the slabs fill [0, T]: `covers`.
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from certbound.arrays import Array, Index, Mask
from certbound.rigor.intervals import Interval
from certbound.values.charts import Chart, from_natural
from certbound.values.continuous.coefficients import Cells, Interpolant, Reader
from certbound.values.continuous.payment import Patched, Payment, bound_above, bound_below, pay_lower, pay_upper
from certbound.values.continuous.residual import (
    Ranges,
    bound_ranges,
    coarse_size,
    sample_in_plane,
    value_range,
)  # fmt: skip
from certbound.values.continuous.surface import Surface
from certbound.values.polynomials import nodes_of

Found = TypeVar("Found")
Near = tuple[float, float, float] | None
Sides = tuple[bool, bool]

LIFTS = (0.0, 0.003, 0.01, 0.02, 0.035, 0.06, 0.1, 0.16, 0.25)
_NEAR = 40.0  # in units of what is granted without being looked at
NEGLIGIBLE = 5e-4
"""lam and eps (in units of the bound), summed over the horizon, that are granted without being looked at."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Model:
    """Drift f(t, x, d) and a(t, x) on a box, and the branches that cover D.

    ``branches`` are boxes of d whose union (or, where f is affine in d, the hull of whose union) is D.
    """

    drift: Reader
    square: Reader
    branches: tuple[tuple[Interval, ...], ...]

    @property
    def autonomous(self) -> bool:
        """True when neither depends on t."""
        return self.drift.autonomous and self.square.autonomous

    def counts(self, straight: bool = False) -> tuple[int, ...]:
        """Samples in time and in each state with which R, or R - Q2 in two, is a polynomial known exactly."""
        n = self.drift.axes - 1
        f, a = self.drift.degrees, self.square.degrees
        if straight:
            return (4 + max(f[0], a[0]), *(6 + max(pair) for pair in zip(f[1:], a[1:])))
        own = 4 if n == 1 else 5  # degree of V_x in its own variable; that of V_y in x is V's
        space = [max(5, f[1 + i] + own, a[1 + i] + 2 * own) + 1 for i in range(n)]
        return (max(3 + f[0], 6 + a[0]) + 1, *space)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Proof:
    """What the residual inequality says about one surface: ranges of the patches that were looked at.

    ``slab`` and ``cell`` say which (in the order of `Surface.patches`), ``seen`` what was looked at, and what for.
    """

    ranges: Ranges
    slab: Index
    cell: Index
    seen: tuple[Surface, Need] | None = None


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Need:
    """Which patches need no close look: V >= ``top`` or V <= ``bottom``, or |R| <= ``spare`` (1 + exp(start - V))."""

    spare: float
    start: float
    top: float
    bottom: float = -np.inf

    def free(self, high: Array) -> Array:
        """The excess that is paid for in any case where V <= ``high``."""
        return self.spare * (1 + np.exp(np.minimum(self.start - high, 700.0)) * (1 - 1e-13)) * (1 - 1e-13)


def examine(
    surface: Surface, model: Model, need: Need, *, upper: bool, near: Array | None = None, alive: Mask | None = None,
    straight: bool = False,
) -> Proof:
    """Enclose R (closely on one side), V and Q2 on every patch of a surface that needs it.

    ``near``, shape (slabs, *cells), says how far from samples of R its bound may lie where that is nothing to lose.
    Where ``alive``, shape ``cells``, is false nothing is looked at: every path there has come to its end.
    """
    counts = model.counts(straight)
    fixed = interpolants(surface, model, 0, 1, counts) if model.autonomous else None
    per = int(np.prod(surface.cells))
    share = _NEAR * (0.5 + 0.5 * surface.times[-1] / (surface.slabs * surface.steps))
    loose = np.zeros(surface.slabs * per) if near is None else near.reshape(-1)
    over = np.zeros(per, dtype=bool) if alive is None else ~alive.ravel()

    def look(ends: tuple[int, int]) -> tuple[Index, Ranges] | None:
        patches = surface.patches(*ends)
        place = np.arange(len(patches.size)) % (per if fixed else len(patches.size))
        drifts, squares = fixed or interpolants(surface, model, *ends, counts)
        low, high = value_range(patches)
        size = np.inf if straight else coarse_size(patches, drifts, squares, place)  # takes as long as to look
        due = ~(low >= need.top) & ~(high <= need.bottom) & ~(size <= need.free(high))  # no number is looked at, too
        kept = np.flatnonzero(due & ~np.tile(over, ends[1] - ends[0]))
        if not len(kept):
            return None
        close = np.maximum(share[ends[0] + kept // per] * need.free(high[kept]), loose[ends[0] * per + kept])
        ranges = bound_ranges(
            patches.take(kept), drifts, squares, place[kept], counts, wanted=need.spare, near=close, upper=upper,
            straight=straight,
        )  # fmt: skip
        return ends[0] * per + kept, ranges

    found = [one for one in side_by_side(look, list(surface.chunks())) if one is not None]
    patch, ranges = np.concatenate([np.empty(0, dtype=np.intp), *(one[0] for one in found)]), [one[1] for one in found]
    return Proof(ranges=joined(ranges), slab=patch // per, cell=patch % per, seen=(surface, need))


def joined(ranges: Sequence[Ranges]) -> Ranges:
    """All of them, one after the other."""
    return Ranges(**{
        name: np.concatenate([np.empty(0), *(getattr(one, name) for one in ranges)])
        for name in Ranges.__dataclass_fields__
    })


def side_by_side(look: Callable[[tuple[int, int]], Found], chunks: list[tuple[int, int]]) -> list[Found]:
    """Chunk by chunk on all cores, in order: the compiled kernel runs without the interpreter's lock."""
    with ThreadPoolExecutor(min(len(chunks), os.cpu_count() or 1)) as pool:
        return list(pool.map(look, chunks))


def sampled_residual(
    surface: Surface, model: Model, *, upper: bool = True, along: int = 5
) -> tuple[Array, Array]:
    """The largest R among a few samples of each patch in two states, and V's least value there: no bounds.

    For lower bounds the largest -R of the best branch, and V's largest value. Both have shape (slabs, *cells); a
    sketch of what `examine` finds, at a tenth of its cost with five samples ``along`` each state.
    """
    excess, low, high = sampled(surface, model, upper=upper, along=along)
    return excess, low if upper else high


def sampled(surface: Surface, model: Model, *, upper: bool = True, along: int = 5) -> tuple[Array, Array, Array]:
    """The same, with V's least and largest values."""
    counts = (4, along, along)
    fixed = interpolants(surface, model, 0, 1, counts) if model.autonomous else None
    per = int(np.prod(surface.cells))

    def look(ends: tuple[int, int]) -> tuple[Array, Array, Array]:
        patches = surface.patches(*ends)
        place = np.arange(len(patches.size)) % (per if fixed else len(patches.size))
        drifts, squares = fixed or interpolants(surface, model, *ends, counts)
        return sample_in_plane(patches, drifts, squares, place, counts, upper=upper), *value_range(patches)

    found = side_by_side(look, list(surface.chunks()))
    excess, low, high = (np.concatenate(parts).reshape(surface.slabs, *surface.cells) for parts in zip(*found))
    return excess, low, high


def interpolants(
    surface: Surface, model: Model, first: int, last: int, counts: Sequence[int]
) -> tuple[list[Interpolant], Interpolant]:
    cells = _cells(surface, first, last)
    points = [nodes_of(count) for count in counts]
    if model.autonomous:
        points = [(0.5,), *points[1:]]
    drifts = [model.drift.interpolate(cells, branch, points) for branch in model.branches]
    return drifts, model.square.interpolate(cells, (), points)


def _cells(surface: Surface, first: int, last: int) -> Cells:
    ends = [(surface.times[first:last], surface.times[first + 1 : last + 1])]
    ends += [(axis[:-1], axis[1:]) for axis in surface.axes]
    low, high = (np.meshgrid(*(pair[side] for pair in ends), indexing="ij") for side in (0, 1))
    return Cells(low=tuple(array.ravel() for array in low), high=tuple(array.ravel() for array in high))


def covers(surface: Surface, horizon: float, low: Sequence[float], high: Sequence[float], *, within: bool) -> bool:
    """Whether a surface spans [0, horizon] and its box lies within another one (or contains it)."""
    if surface.times[0] != 0 or surface.times[-1] != horizon:
        return False
    own = [(float(axis[0]), float(axis[-1])) for axis in surface.axes]
    if within:
        return all(a <= left and right <= b for (left, right), a, b in zip(own, low, high))
    return all(left <= a and b <= right for (left, right), a, b in zip(own, low, high))


def prove_upper(
    surface: Surface, model: Model, starts: Sequence[tuple[float, float]], held: Sequence[Sides] = ()
) -> Payment:
    """An upper bound of log P(leaving the box of the surface by its last time), whatever the surface is."""
    return proved_upper(surface, model, starts, held)[0]


def proved_upper(
    surface: Surface, model: Model, starts: Sequence[tuple[float, float]], held: Sequence[Sides] = (),
    negligible: float = NEGLIGIBLE,
) -> tuple[Payment, Proof]:
    """The same with what was seen; ``negligible`` stands for `NEGLIGIBLE`."""
    surface = raised_above(surface, held)
    start = up(extreme_over(surface, starts, upper=True))
    need = Need(spare=negligible / float(surface.times[-1]), start=start, top=0.0)
    proof = examine(surface, model, need, upper=True)
    payment, lift = cheapest(proof, need, surface, start)
    return replace(payment, lift=lift), proof


def cheapest(
    proof: Proof, need: Need, surface: Surface, start: float, floor: float | None = None
) -> tuple[Payment, float]:
    """The payment that bounds log P best where V(0, .) = ``start``, and by how much V was lifted for it.

    ``floor`` bounds V from below where paths end without having failed; at the last time if nothing is said.
    """
    floor = float(surface.range_at(-1)[0].min()) if floor is None else floor
    best: tuple[Payment, float] | None = None
    for lift in LIFTS:  # V + lift has the same residual, and nothing is due where it is positive
        if best is not None and start + lift >= best[0].log:
            break
        patched = patched_of(proof, proof.ranges.residual_high, need, surface.steps, lift)
        payment = pay_upper(patched, up(start + lift), floor + lift - 1e-15 * (1 + abs(floor)))
        best = (payment, lift) if best is None or payment.log < best[0].log else best
    assert best is not None
    return best


def raised_above(surface: Surface, held: Sequence[Sides] = ()) -> Surface:
    """The surface, raised by what it misses of V >= 0 on its faces, but for those that no path crosses (``held``)."""
    sides = [(axis, side) for axis in range(len(surface.axes)) for side in (0, 1) if not (held and held[axis][side])]
    lift = max(0.0, -min((surface.face_range(*side)[0] for side in sides), default=0.0))
    surface = surface.raised(up(lift)) if lift else surface
    if any(surface.face_range(*side)[0] < 0 for side in sides):
        surface = surface.raised(1e-12 * (1 + lift))
    return surface


def top_of(surface: Surface) -> float:
    """An upper bound of V over all of the surface."""
    return max(float(value_range(surface.patches(*chunk))[1].max()) for chunk in surface.chunks())


def chart_above(
    surface: Surface, model: Model, levels: Sequence[float], slabs: Sequence[int], near: Near = None,
    held: Sequence[Sides] = (),
) -> list[Chart]:
    """Upper bounds of P(leaving the box from a cell on), at the start of each of the ``slabs``, or ``near`` the starts.

    One payment is made for each of the ``levels`` (of log P), where it is sharp; every cell takes the best.
    """
    surface = raised_above(surface, held)
    need = Need(spare=NEGLIGIBLE / float(surface.times[-1]), start=min(levels), top=0.0)
    proof = examine(surface, model, need, upper=True)
    paid = [cheapest(proof, need, surface, level) for level in levels]
    charts = []
    for time, k, axes, values in surface.readings(slabs, near, up=True):
        raised = [(one.terms, values + lift + 1e-15 * (np.abs(values) + lift)) for one, lift in paid]
        rows = [bound_above(terms, above, k) for terms, above in raised if terms is not None]
        best = np.minimum.reduce([np.zeros(values.shape), *rows])
        charts.append(Chart(time=time, axes=axes, log10=from_natural(best, up=True)))
    return charts


def prove_lower(
    surface: Surface, model: Model, starts: Sequence[tuple[float, float]], points: Array | None = None,
    cut: Sequence[Sides] = (),
) -> Payment | None:
    """A lower bound of log P(leaving the box of the surface by its last time) from the best start, whatever it is.

    Leaving by a face that is no limit (``cut``) does not count; nothing is asked where V <= what is taken off there.
    """
    if extreme_over(surface, starts, upper=False, points=points) == -math.inf:
        return None
    return proved_lower(surface, model, starts, points, cut=cut)[0]


def proved_lower(
    surface: Surface, model: Model, starts: Sequence[tuple[float, float]], points: Array | None = None,
    negligible: float = NEGLIGIBLE, cut: Sequence[Sides] = (),
) -> tuple[Payment | None, Proof]:
    """The same with what was seen, if a start is in the grid."""
    surface = sunk(surface)
    start, end = -up(-extreme_over(surface, starts, upper=False, points=points)), surface.highest_end(cut)
    need = Need(spare=negligible / float(surface.times[-1]), start=start, top=np.inf, bottom=end)
    proof = examine(surface, model, need, upper=False)
    return _earned(proof, need, surface, start, end), proof


def sunk(surface: Surface) -> Surface:
    """The surface, lowered until V <= 0 everywhere."""
    return surface.raised(-highest - 1e-12 * (1 + highest)) if (highest := top_of(surface)) > 0 else surface


def _earned(proof: Proof, need: Need, surface: Surface, start: float, end: float) -> Payment | None:
    """``end`` bounds V from above where paths end without having failed."""
    if np.any(proof.ranges.high > 0):
        return None
    return pay_lower(patched_of(proof, -proof.ranges.residual_low, need, surface.steps), start, end)


def chart_below(
    surface: Surface, model: Model, levels: Sequence[float], slabs: Sequence[int], near: Near = None,
    cut: Sequence[Sides] = (),
) -> list[Chart]:
    """Lower bounds of P(leaving the box from a cell on), as `chart_above`, but not through a mere ``cut``."""
    surface = sunk(surface)
    need = Need(spare=NEGLIGIBLE / float(surface.times[-1]), start=min(levels), top=np.inf)
    proof = examine(surface, model, need, upper=False)
    found = [_earned(proof, need, surface, level, surface.highest_end(cut)) for level in levels]
    paid = [payment.terms for payment in found if payment is not None and payment.terms is not None]
    charts = []
    for time, k, axes, values in surface.readings(slabs, near, up=False):
        best = np.maximum.reduce([np.full(values.shape, -np.inf), *(bound_below(terms, values, k) for terms in paid)])
        charts.append(Chart(time=time, axes=axes, log10=from_natural(best, up=False)))
    return charts


def up(value: float) -> float:
    return value + 1e-15 * (1 + abs(value))


def patched_of(proof: Proof, excess: Array, need: Need, steps: Array, lift: float = 0.0) -> Patched:
    """The patches that cost more than what every slab pays in any case, for V + lift."""
    ranges, slack = proof.ranges, 1e-14 if lift else 0.0
    low, high = ranges.low + lift - slack * (1 + np.abs(ranges.low)), ranges.high + lift
    high = high + slack * (1 + np.abs(ranges.high))
    due = ~(low >= need.top) & ~(excess <= need.free(ranges.high))
    return Patched(
        excess=excess[due], low=low[due], high=high[due], energy=ranges.energy[due],
        slab=proof.slab[due], steps=steps, spare=need.spare,
    )  # fmt: skip


def chained(parts: Sequence[Patched], surfaces: Sequence[Surface], need: Need) -> Patched:
    """The patches of surfaces that follow each other, their slabs numbered through."""
    before = np.cumsum([0, *(surface.slabs for surface in surfaces)])[:-1]
    together = {
        name: np.concatenate([getattr(part, name) for part in parts]) for name in ("excess", "low", "high", "energy")
    }
    slab = np.concatenate([part.slab + count for part, count in zip(parts, before)])
    return Patched(**together, slab=slab, steps=np.concatenate([one.steps for one in surfaces]), spare=need.spare)


def extreme_over(
    surface: Surface, starts: Sequence[tuple[float, float]], *, upper: bool, points: Array | None = None
) -> float:
    """The supremum of V(0, .) over the starts (upper), or V at the best of the nodes among them, rounded safely.

    Starts are covered by the cells, or by those of a line of the grid, that they touch; at a node V is one of the
    data. Starts that stick out of the grid give infinity. Only ``points``, if any, count from below.
    """
    if any(low < axis[0] or high > axis[-1] for axis, (low, high) in zip(surface.axes, starts)):
        return math.inf if upper else -math.inf
    if points is not None and not upper:
        return float(surface.floor_at(0, points).max(initial=-math.inf))
    exact = [np.flatnonzero((axis >= low) & (axis <= high)) for axis, (low, high) in zip(surface.axes, starts)]
    index = np.ix_(*itertools.chain.from_iterable((nodes, [0]) for nodes in exact))
    at_nodes = float(surface.values[0][index].max()) if all(map(len, exact)) else -math.inf
    touched = [_touched(axis, *ends) for axis, ends in zip(surface.axes, starts)]
    if not upper:
        return max(at_nodes, float(surface.range_at(0)[0][np.ix_(*touched)].max()))
    line = [(axis, int(nodes[0])) for axis, (nodes, (a, b)) in enumerate(zip(exact, starts)) if a == b and len(nodes)]
    if len(line) in (0, len(starts)):
        return at_nodes if line else float(surface.range_at(0)[1][np.ix_(*touched)].max())
    touched.pop(line[0][0])
    return float(surface.across(*line[0], begin=True)[1][0][np.ix_(*touched)].max())


def _touched(axis: Array, low: float, high: float) -> Index:
    if low == high:
        return np.flatnonzero((axis[:-1] <= low) & (axis[1:] >= high))
    return np.flatnonzero((axis[:-1] < high) & (axis[1:] > low))
