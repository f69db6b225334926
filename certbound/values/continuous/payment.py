"""From bounds of the residual to bounds of the probability: the last step of Theorem K8-CT.

Upper bound. On every patch that is not wholly at V >= 0

    R <= lam_k + eps_k exp(-V) + m(V) Q2,

m a step function of the level. With q piecewise linear in the level, q = 0 below the lowest step, 0 <= q < 1 and
q' >= (1 - q)(m - q) (proved by `repay`), theta(V) = V + int_V^0 q and L = sum lam_k h_k,

    P (1 - w) + w <= exp(L + theta(v0)) + exp(Q) sum_k eps_k h_k exp(L_k),      w = exp(inf V(T, .)) or less.

Lower bound. On every patch, with V <= 0 throughout, R >= -lam_k - eps_k exp(-V) - m(V) Q2. With p' >= (1 + p)(m - p),
p = 0 below the lowest step, theta(V) = V - int_V^0 p, M = 1 + max p and W = exp(sup V(T, .)) or more,

    P (1 - W) + W >= exp(theta(v0) - M L) - M sum_k eps_k h_k.

lam, eps and m are searched; whatever they are, lam is at last recomputed from the inequality itself (`_rates`).
Proofs: docs/values.md.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from certbound.arrays import Array, Index
from certbound.rigor.intervals import Interval, exp, log

BIN = 0.125
_UP = 1 + 1e-13
_DOWN = 1 - 1e-13
_CUTS = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
_CAPS = (0.01, 0.03, 0.1, 0.3, 1.0)
_BASES = (0.0, 0.003, 0.01, 0.03)
_SHARES = (0.0, *np.geomspace(3e-4, 0.9, 12))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Patched:
    """Patches at which the inequality costs something, and the slabs' lengths.

    ``excess`` is R's upper bound (upper side) or minus its lower bound (lower side); ``low``, ``high`` bound V and
    ``energy`` Q2 from below; ``slab`` is the number of the slab. Every slab pays at least ``spare`` as lam and as
    eps (in units of exp(start)): all other patches rely on it.
    """

    excess: Array
    low: Array
    high: Array
    energy: Array
    slab: Index
    steps: Array
    spare: float


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Levels:
    """m on bins of width `BIN` that end at level 0, lowest first, and q (upper side) or p (lower) at their ends.

    Several step functions over the same bins may stand in the rows of ``m`` and ``q``; ``level`` is one number then.
    """

    m: Array
    q: Array
    edges: Array

    def above(self, level: Array | float) -> Interval:
        """int of q from each ``level`` to 0 (q is piecewise linear, and 0 below the lowest edge)."""
        level = np.asarray(level, dtype=float)
        if not self.m.shape[-1]:
            return Interval.point(np.zeros(level.shape))
        left, right = self.edges[:-1], self.edges[1:]
        start = np.clip(level[..., None], left, right)
        share = (Interval.point(right) - Interval.point(start)) * Interval.point(1 / BIN)
        end = Interval.point(self.q[..., 1:])
        begin = end - share * (end - Interval.point(self.q[..., :-1]))
        found = ((begin + end) * share * Interval.point(BIN / 2)).sum(axis=-1)
        return Interval(np.where(level >= 0, 0.0, found.lo), np.where(level >= 0, 0.0, found.hi))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Terms:
    """What was paid, slab by slab: with it a bound at any place and from any slab on follows from V there.

    ``lam`` and ``eps`` (in units of exp(``start``)) hold on every slab; ``end`` is a lower bound of V(T, .) on the
    upper side, an upper one on the lower side. Where ``whole``, V stands for the logarithm of a mean of e^V: then all
    of q (or p) is paid, its integral over every level. Several searched at once stand in rows, as in `Levels`.
    """

    levels: Levels
    lam: Array
    eps: Array
    steps: Array
    start: float
    end: float
    whole: bool = False

    def growth(self, values: Array) -> Interval:
        """theta(V) - V (upper side) or V - theta(V) (lower side)."""
        return self.levels.above(np.full(values.shape, -np.inf) if self.whole else values)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Payment:
    """A bound of the probability as a natural logarithm, and what it was paid with.

    ``terms`` holds what each slab paid; None where nothing was proved. V was lifted by ``lift`` over the faces.
    """

    log: float
    terms: Terms | None = None
    lift: float = 0.0


def repay(m: Array, *, upper: bool) -> Array | None:
    """q (or p) at the ends of the bins; None where q would reach 1.

    Proves: the linear interpolant has q' >= (1 - q)(m - q) (upper) or p' >= (1 + p)(m - p) (lower) on each bin. Both
    right-hand sides are quadratics: the first is convex, the second concave with its top at (m - 1) / 2.
    """
    values = [0.0]
    for rate in m.tolist():
        q = values[-1]
        guess = q + BIN * _slope(q, q, rate, upper)
        for _ in range(40):
            slope = _slope(min(q, guess), max(q, guess), rate, upper)
            if guess >= (q + BIN * slope * (_UP if slope > 0 else _DOWN)) + 1e-15:
                break
            guess = max(q + BIN * slope, guess) + 1e-3 * BIN * abs(slope) + 4e-15
        else:
            return None
        guess = max(guess, 0.0)  # a larger end makes the slope larger and the interval of q smaller
        values.append(guess)
        if upper and guess >= 0.95:
            return None
    return np.array(values)


def _slope(low: float, high: float, m: float, upper: bool) -> float:
    """An upper bound of (1 - q)(m - q), or (1 + p)(m - p), on [low, high]."""
    if upper:
        most = max((1 - low) * (m - low), (1 - high) * (m - high))
    else:
        most = max((1 + low) * (m - low), (1 + high) * (m - high))
        if low < (m - 1) / 2 < high:
            most = max(most, (1 + m) ** 2 / 4)
    return most + 1e-14 * (1 + abs(most))


def pay_upper(patched: Patched, start: float, floor: float, *, whole: bool = False) -> Payment:
    """The smallest upper bound of log P that the search finds.

    Parameters
    ----------
    patched : Patched
        Every patch with V < 0 somewhere and R > 0 somewhere.
    start : float
        Upper bound of V(0, .) over the starts.
    floor : float
        Lower bound of V(T, .) over the safe set; -inf will do.
    whole : bool
        Whether ``start`` is the logarithm of a mean of e^V(0, .): then all of q is paid, int q over every level.
    """
    if start >= 0:
        return Payment(log=0.0)
    values, terms = _settled(patched, start, floor, whole, upper=True)
    k = int(np.argmin(values))
    return Payment(log=float(values[k]), terms=terms[k]) if values[k] < 0 else Payment(log=0.0)


def pay_lower(patched: Patched, start: float, ceiling: float, *, whole: bool = False) -> Payment | None:
    """The largest lower bound of log P that the search finds; None where none is positive.

    Parameters
    ----------
    patched : Patched
        Every patch with R < 0 somewhere; V <= 0 on all patches.
    start : float
        Lower bound of V(0, .) at one start.
    ceiling : float
        Upper bound of V(T, .) over the safe set.
    whole : bool
        As for `pay_upper`, with p.
    """
    values, terms = _settled(patched, start, ceiling, whole, upper=False)
    k = int(np.argmax(values))
    return Payment(log=float(values[k]), terms=terms[k]) if values[k] > -np.inf else None


def _settled(patched: Patched, start: float, end: float, whole: bool, *, upper: bool) -> tuple[Array, list[Terms]]:
    """A bound of log P from every step function that is proposed, and what it was paid with."""
    patched = _by_slab(patched)
    places, found, values = _Places.of(patched, start), list[Terms](), [np.empty(0)]
    for several in _proposals(patched, places, upper=upper):
        paid = [_rates(patched, places, levels) for levels in several]
        terms = [
            Terms(levels=levels, lam=lam, eps=eps, steps=patched.steps, start=start, end=end, whole=whole)
            for levels, (lam, eps) in zip(several, paid)
        ]
        bound = bound_above if upper else bound_below
        values.append(np.atleast_1d(bound(_rows(terms), np.array(start))))
        found += terms
    return np.concatenate(values), found


def _by_slab(patched: Patched) -> Patched:
    """The patches in the order of their slabs."""
    if np.all(np.diff(patched.slab) >= 0):
        return patched
    order = np.argsort(patched.slab, kind="stable")
    return replace(
        patched, excess=patched.excess[order], low=patched.low[order], high=patched.high[order],
        energy=patched.energy[order], slab=patched.slab[order],
    )  # fmt: skip


def _rows(terms: list[Terms]) -> Terms:
    """Terms over the same bins as the rows of one."""
    if len(terms) == 1:
        return terms[0]
    m, q = np.stack([one.levels.m for one in terms]), np.stack([one.levels.q for one in terms])
    lam, eps = np.stack([one.lam for one in terms]), np.stack([one.eps for one in terms])
    return replace(terms[0], levels=Levels(m=m, q=q, edges=terms[0].levels.edges), lam=lam, eps=eps)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Places:
    """Where patches lie that are sorted by slab, whatever step function is tried.

    ``first`` and ``last`` are the bins that V may visit, counted from level 0 (-1 is the highest one); ``reach`` is a
    lower bound of exp(start - V); ``begins`` says where the patches of the slabs ``filled`` begin.
    """

    first: Index
    last: Index
    reach: Array
    begins: Index
    filled: Index

    @staticmethod
    def of(patched: Patched, start: float) -> _Places:
        first = np.floor(np.maximum(patched.low, -1e6) / BIN).astype(int)
        last = np.minimum(np.floor(np.clip(patched.high, -1e6, 0.0) / BIN).astype(int), -1)
        with np.errstate(over="ignore"):
            reach = np.exp(np.minimum(start - patched.high, 700.0)) * _DOWN
        filled, begins = np.unique(patched.slab, return_index=True)
        return _Places(first=first, last=last, reach=reach, begins=begins, filled=filled)

    def tops(self, numbers: Array, slabs: int) -> Array:
        """The largest positive number of the patches of every slab, 0 where there is none."""
        top = np.zeros(slabs)
        if len(self.filled):
            top[self.filled] = np.maximum(np.maximum.reduceat(numbers, self.begins), 0.0)
        return top


def _proposals(patched: Patched, places: _Places, *, upper: bool) -> Iterator[list[Levels]]:
    """Step functions m: above a cut, what the patches there need beyond a base rate, those aside that need too much.

    Those with the same cut come together, those that are 0 everywhere apart.
    """
    horizon = float(patched.steps.sum())
    for cut in _CUTS:
        count = round(cut / BIN)
        here = np.flatnonzero((places.last + count >= 0) & (places.first <= places.last))
        pair = np.maximum(places.first[here] + count, 0) * count + places.last[here] + count
        here, pair = here[np.argsort(pair, kind="stable")], np.sort(pair)
        met, begins = np.unique(pair, return_index=True)
        flat, risen, seen = list[Levels](), list[Levels](), set[bytes]()
        needs = [(patched.excess[here] - base / horizon) / np.maximum(patched.energy[here], 1e-200) for base in _BASES]
        for cap, need in itertools.product(_CAPS, needs) if count else [(_CAPS[0], needs[0])]:
            table = np.zeros((count, count))
            if len(met):
                least = np.where((need > 0) & (need <= cap), need, 0.0)
                table.flat[met] = np.maximum.reduceat(least, begins)
            # the most of all patches whose bins begin at or before one bin and end at or after it
            table = np.maximum.accumulate(np.maximum.accumulate(table, axis=0)[:, ::-1], axis=1)[:, ::-1]
            m = table.diagonal().copy()
            if m.tobytes() in seen:
                continue
            seen.add(m.tobytes())
            q = repay(m, upper=upper)
            if q is not None:
                (risen if m.any() else flat).append(Levels(m=m, q=q, edges=-BIN * np.arange(count, -1, -1.0)))
        yield from (several for several in (flat, risen) if several)


def _credit(patched: Patched, places: _Places, levels: Levels) -> Array:
    """A lower bound of m(V) Q2 over each patch."""
    count = len(levels.m)
    credit = np.zeros(len(patched.excess))
    if not count:
        return credit
    here = np.flatnonzero((places.first >= -count) & (places.first <= places.last))
    row = np.arange(count)
    least = np.minimum.accumulate(np.where(row >= row[:, None], levels.m, np.inf), axis=1)  # of m, from bin to bin
    credit[here] = least[places.first[here] + count, places.last[here] + count] * patched.energy[here] * _DOWN
    return credit


def _rates(patched: Patched, places: _Places, levels: Levels) -> tuple[Array, Array]:
    """lam and eps (in units of exp(start)) of each slab: the cheaper mixtures, and lam from the inequality itself."""
    slabs, reach = len(patched.steps), places.reach
    excess = (patched.excess - _credit(patched, places, levels)) * 1.0
    excess = excess + 1e-15 * np.abs(patched.excess)
    top = places.tops(excess, slabs)
    ratio, peak = excess / np.maximum(reach, 1e-200), top[patched.slab] / np.maximum(reach, 1e-200)
    extra = np.stack([places.tops(ratio - share * peak, slabs) for share in _SHARES])
    cost = np.concatenate([top[None], np.multiply.outer(_SHARES, top) + extra])
    cheapest = np.argmin(np.where(np.isnan(cost), np.inf, cost), axis=0)
    eps = np.concatenate([np.zeros((1, slabs)), extra])[cheapest, np.arange(slabs)]
    lam = places.tops((excess - eps[patched.slab] * reach * _DOWN) * _UP, slabs)
    return lam + patched.spare, eps + patched.spare


def bound_above(terms: Terms, values: Array, first: int = 0) -> Array:
    """Upper bounds of log P(failing from the start of slab ``first`` on) from where V is at most ``values`` then."""
    steps = Interval(*_around(terms.steps[first:]))
    paid = Interval.point(terms.lam[..., first:]) * steps
    later = np.cumsum(paid.hi[..., ::-1], axis=-1)[..., ::-1]  # over a slab and all later ones
    later = later * (1 + 1e-15 * (len(terms.steps) + 4))
    fine = (later[..., 0] < 50) & np.isfinite(terms.eps).all(axis=-1)
    if not fine.any():
        return np.zeros(np.broadcast_shapes(values.shape, fine.shape))
    later, eps = np.where(fine[..., None], later, 0.0), np.where(fine[..., None], terms.eps[..., first:], 0.0)
    growth, most = terms.growth(values), terms.levels.above(-np.inf)
    rest = (Interval.point(eps) * steps * exp(Interval.point(later))).sum(axis=-1)
    # in units of exp(start): total = exp(L + theta(v) - start) + exp(Q) sum eps h exp(L_k)
    here = exp(Interval.point(later[..., 0]) + (Interval.point(values) - Interval.point(terms.start)) + growth)
    total = (here + exp(most) * rest).hi
    level = Interval.point(terms.start) + log(Interval.point(total))
    found = level.hi
    if terms.end > -np.inf:  # (exp(level) - w) / (1 - w), w = exp(floor)
        kept = (Interval.point(1.0) - exp(Interval.point(terms.end) - level)).hi
        less = level + log(Interval.point(np.maximum(kept, 1e-300)))
        less = less - log(Interval.point(1.0) - exp(Interval.point(terms.end)))
        found = np.where(kept > 0, less.hi, found)
    return np.asarray(np.where(fine & (values < 0) & (level.hi < 0), np.minimum(found, 0.0), 0.0))


def bound_below(terms: Terms, values: Array, first: int = 0) -> Array:
    """Lower bounds of log P(failing from the start of slab ``first`` on) from where V is at least ``values`` then."""
    steps = Interval(*_around(terms.steps[first:]))
    paid = (Interval.point(terms.lam[..., first:]) * steps).sum(axis=-1)
    fine = (paid.hi < 50) & np.isfinite(terms.eps).all(axis=-1)
    if not fine.any():
        return np.full(np.broadcast_shapes(values.shape, fine.shape), -np.inf)
    top = terms.levels.q.max(axis=-1)
    most = Interval.point(1.0 + top) if top.any() else Interval.point(1.0)
    eps = np.where(fine[..., None], terms.eps[..., first:], 0.0)
    away = Interval.point(values) - Interval.point(terms.start)
    rest = most * (Interval.point(eps) * steps).sum(axis=-1)
    # in units of exp(start); then less W = exp(ceiling)
    left = exp(away - (terms.growth(values) + most * paid)) - rest
    least = (left - exp(Interval.point(terms.end) - Interval.point(terms.start))).lo
    kept = log(Interval.point(1.0) - exp(Interval.point(terms.end)))
    found = Interval.point(terms.start) + log(Interval.point(np.maximum(least, 1e-300))) - kept
    return np.asarray(np.where(fine & (least > 0), found.lo, -np.inf))


def _around(steps: Array) -> tuple[Array, Array]:
    return steps * (1 - 1e-15), steps * (1 + 1e-15)
