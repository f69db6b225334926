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

from certbound.arrays import Array, Index
from certbound.rigor.intervals import Interval
from certbound.values.continuous.coefficients import Cells, Interpolant, Reader
from certbound.values.continuous.payment import Patched, Payment, pay_lower, pay_upper
from certbound.values.continuous.polynomials import nodes_of
from certbound.values.continuous.residual import (
    Ranges,
    bound_ranges,
    coarse_size,
    sample_in_plane,
    value_range,
)  # fmt: skip
from certbound.values.continuous.surface import Surface

Found = TypeVar("Found")

_LIFTS = (0.0, 0.003, 0.02, 0.1)
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

    def counts(self) -> tuple[int, ...]:
        """Samples in time and in each state with which the residual is a polynomial known exactly."""
        n = self.drift.axes - 1
        f, a = self.drift.degrees, self.square.degrees
        own = 4 if n == 1 else 5  # degree of V_x in its own variable; that of V_y in x is 5
        squared = 8 if n == 1 else 10
        space = [max(5, f[1 + i] + own, a[1 + i] + squared) + 1 for i in range(n)]
        return (max(3 + f[0], 6 + a[0]) + 1, *space)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Proof:
    """What the residual inequality says about one surface: ranges of the patches that were looked at.

    ``slab`` and ``cell`` say which these are; the cells of a slab are numbered in the order of `Surface.patches`.
    """

    ranges: Ranges
    slab: Index
    cell: Index

    def spread(self, values: Array, surface: Surface, rest: float) -> Array:
        """One value a patch, shape (slabs, *cells), ``rest`` where nothing was looked at."""
        table = np.full((surface.slabs, int(np.prod(surface.cells))), rest)
        table[self.slab, self.cell] = values
        return table.reshape(surface.slabs, *surface.cells)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Need:
    """Which patches need no close look: V >= ``top`` throughout, or |R| paid for by ``spare`` (1 + exp(start - V))."""

    spare: float
    start: float
    top: float

    def free(self, high: Array) -> Array:
        """The excess that is paid for in any case where V <= ``high``."""
        return self.spare * (1 + np.exp(np.minimum(self.start - high, 700.0)) * (1 - 1e-13)) * (1 - 1e-13)


def examine(surface: Surface, model: Model, need: Need) -> Proof:
    """Enclose R, V and Q2 on every patch of a surface that needs it."""
    counts = model.counts()
    fixed = interpolants(surface, model, 0, 1, counts) if model.autonomous else None
    per = int(np.prod(surface.cells))

    def look(ends: tuple[int, int]) -> tuple[Index, Ranges] | None:
        patches = surface.patches(*ends)
        place = np.arange(len(patches.size)) % (per if fixed else len(patches.size))
        drifts, squares = fixed or interpolants(surface, model, *ends, counts)
        low, high = value_range(patches)
        size = coarse_size(patches, drifts, squares, place)
        kept = np.flatnonzero(~(low >= need.top) & ~(size <= need.free(high)))  # what is no number is looked at
        if not len(kept):
            return None
        ranges = bound_ranges(patches.take(kept), drifts, squares, place[kept], counts, wanted=need.spare)
        return ends[0] * per + kept, ranges

    found = [one for one in _side_by_side(look, list(surface.chunks())) if one is not None]
    empty = np.empty(0)
    joined = {
        name: np.concatenate([empty, *(getattr(ranges, name) for _, ranges in found)])
        for name in Ranges.__dataclass_fields__
    }
    patch = np.concatenate([np.empty(0, dtype=np.intp), *(index for index, _ in found)])
    return Proof(ranges=Ranges(**joined), slab=patch // per, cell=patch % per)


def _side_by_side(look: Callable[[tuple[int, int]], Found], chunks: list[tuple[int, int]]) -> list[Found]:
    """Chunk by chunk on all cores, in order: the compiled kernel runs without the interpreter's lock."""
    with ThreadPoolExecutor(min(len(chunks), os.cpu_count() or 1)) as pool:
        return list(pool.map(look, chunks))


def sampled_residual(surface: Surface, model: Model) -> tuple[Array, Array]:
    """The largest R among a few samples of each patch in two states, and V's least value there: no bounds.

    Both have shape (slabs, *cells); a sketch of what `examine` finds, at a tenth of its cost.
    """
    counts = (4, 5, 5)
    fixed = interpolants(surface, model, 0, 1, counts) if model.autonomous else None
    per = int(np.prod(surface.cells))

    def look(ends: tuple[int, int]) -> tuple[Array, Array]:
        patches = surface.patches(*ends)
        place = np.arange(len(patches.size)) % (per if fixed else len(patches.size))
        drifts, squares = fixed or interpolants(surface, model, *ends, counts)
        return sample_in_plane(patches, drifts, squares, place, counts), value_range(patches)[0]

    found = _side_by_side(look, list(surface.chunks()))
    shape = (surface.slabs, *surface.cells)
    highest, lowest = (np.concatenate(parts).reshape(shape) for parts in zip(*found))
    return highest, lowest


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
    low = np.meshgrid(*(pair[0] for pair in ends), indexing="ij")
    high = np.meshgrid(*(pair[1] for pair in ends), indexing="ij")
    return Cells(low=tuple(array.ravel() for array in low), high=tuple(array.ravel() for array in high))


def covers(surface: Surface, horizon: float, low: Sequence[float], high: Sequence[float], *, within: bool) -> bool:
    """Whether a surface spans [0, horizon] and its box lies within another one (or contains it)."""
    if surface.times[0] != 0 or surface.times[-1] != horizon:
        return False
    own = [(float(axis[0]), float(axis[-1])) for axis in surface.axes]
    if within:
        return all(a <= left and right <= b for (left, right), a, b in zip(own, low, high))
    return all(left <= a and b <= right for (left, right), a, b in zip(own, low, high))


def prove_upper(surface: Surface, model: Model, starts: Sequence[tuple[float, float]]) -> Payment:
    """An upper bound of log P(leaving the box of the surface by its last time), whatever the surface is."""
    return examine_upper(surface, model, starts)[0]


def examine_upper(
    surface: Surface, model: Model, starts: Sequence[tuple[float, float]]
) -> tuple[Payment, Array, Array]:
    """`prove_upper`, and for every patch an upper bound of R and a lower one of V (-inf and inf where none is due)."""
    lift = max(0.0, -min(surface.face_range(axis, side)[0] for axis in range(len(surface.axes)) for side in (0, 1)))
    surface = surface.raised(_up(lift)) if lift else surface
    if any(surface.face_range(axis, side)[0] < 0 for axis in range(len(surface.axes)) for side in (0, 1)):
        surface = surface.raised(1e-12 * (1 + lift))
    start = _up(extreme_over(surface, starts, upper=True))
    need = Need(spare=NEGLIGIBLE / float(surface.times[-1]), start=start, top=0.0)
    proof = examine(surface, model, need)
    floor = float(surface.range_at(-1)[0].min())
    best: Payment | None = None
    for lift in _LIFTS:  # V + lift has the same residual, and nothing is due where it is positive
        if best is not None and start + lift >= best.log:
            break
        patched = _patched(proof, proof.ranges.residual_high, need, surface.steps, lift)
        payment = pay_upper(patched, _up(start + lift), floor + lift - 1e-15 * (1 + abs(floor)))
        payment = replace(payment, lift=lift)
        best = payment if best is None or payment.log < best.log else best
    assert best is not None
    high = proof.spread(proof.ranges.residual_high, surface, -np.inf)
    return best, high, proof.spread(proof.ranges.low, surface, np.inf)


def prove_lower(surface: Surface, model: Model, starts: Sequence[tuple[float, float]]) -> Payment | None:
    """A lower bound of log P(leaving the box of the surface by its last time) from the best start, whatever it is."""
    if extreme_over(surface, starts, upper=False) == -math.inf:
        return None
    highest = max(float(value_range(surface.patches(*chunk))[1].max()) for chunk in surface.chunks())
    if highest > 0:
        surface = surface.raised(-highest - 1e-12 * (1 + highest))
    start = -_up(-extreme_over(surface, starts, upper=False))
    need = Need(spare=NEGLIGIBLE / float(surface.times[-1]), start=start, top=np.inf)
    proof = examine(surface, model, need)
    if np.any(proof.ranges.high > 0):
        return None
    patched = _patched(proof, -proof.ranges.residual_low, need, surface.steps)
    return pay_lower(patched, start, float(surface.range_at(-1)[1].max()))


def _up(value: float) -> float:
    return value + 1e-15 * (1 + abs(value))


def _patched(proof: Proof, excess: Array, need: Need, steps: Array, lift: float = 0.0) -> Patched:
    """The patches that cost more than what every slab pays in any case, for V + lift."""
    ranges, slack = proof.ranges, 1e-14 if lift else 0.0
    low, high = ranges.low + lift - slack * (1 + np.abs(ranges.low)), ranges.high + lift
    high = high + slack * (1 + np.abs(ranges.high))
    due = ~(low >= need.top) & ~(excess <= need.free(ranges.high))
    return Patched(
        excess=excess[due], low=low[due], high=high[due], energy=ranges.energy[due],
        slab=proof.slab[due], steps=steps, spare=need.spare,
    )  # fmt: skip


def extreme_over(surface: Surface, starts: Sequence[tuple[float, float]], *, upper: bool) -> float:
    """The supremum of V(0, .) over the starts (upper), or V at the best of the nodes among them, rounded safely.

    Starts that are no union of cells are covered by the cells that they touch. Where a start is a node of the grid in
    every state, V there is one of the data. Starts that stick out of the grid give infinity.
    """
    if any(low < axis[0] or high > axis[-1] for axis, (low, high) in zip(surface.axes, starts)):
        return math.inf if upper else -math.inf
    exact = [
        np.flatnonzero((axis >= low) & (axis <= high)) for axis, (low, high) in zip(surface.axes, starts)
    ]
    index = np.ix_(*itertools.chain.from_iterable((nodes, [0]) for nodes in exact))
    at_nodes = float(surface.values[0][index].max()) if all(len(nodes) for nodes in exact) else -math.inf
    low, high = surface.range_at(0)
    touched = np.ix_(*(_touched(axis, *ends) for axis, ends in zip(surface.axes, starts)))
    if upper:
        if all(low == high for low, high in starts) and at_nodes > -math.inf:
            return at_nodes
        return float(high[touched].max())
    return max(at_nodes, float(low[touched].max()))


def _touched(axis: Array, low: float, high: float) -> Index:
    if low == high:
        return np.flatnonzero((axis[:-1] <= low) & (axis[1:] >= high))
    return np.flatnonzero((axis[:-1] < high) & (axis[1:] > low))
