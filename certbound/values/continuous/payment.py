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
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Index
from certbound.rigor.intervals import Interval, exp, log

BIN = 0.125
_UP = 1 + 1e-13
_DOWN = 1 - 1e-13
_CUTS = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
_CAPS = (0.01, 0.03, 0.1, 0.3, 1.0)
_BASES = (0.0, 0.003, 0.01, 0.03)


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
    """m on bins of width `BIN` that end at level 0, lowest first, and q (upper side) or p (lower) at their ends."""

    m: Array
    q: Array
    edges: Array

    def above(self, level: Array | float) -> Interval:
        """int of q from each ``level`` to 0 (q is piecewise linear, and 0 below the lowest edge)."""
        level = np.asarray(level, dtype=float)
        if not len(self.m):
            return Interval.point(np.zeros(level.shape))
        left, right = self.edges[:-1], self.edges[1:]
        start = np.clip(level[..., None], left, right)
        share = (Interval.point(right) - Interval.point(start)) * Interval.point(1 / BIN)
        end = Interval.point(self.q[1:])
        begin = end - share * (end - Interval.point(self.q[:-1]))
        found = ((begin + end) * share * Interval.point(BIN / 2)).sum(axis=-1)
        return Interval(np.where(level >= 0, 0.0, found.lo), np.where(level >= 0, 0.0, found.hi))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Terms:
    """What was paid, slab by slab: with it a bound at any place and from any slab on follows from V there.

    ``lam`` and ``eps`` (in units of exp(``start``)) hold on every slab; ``end`` is a lower bound of V(T, .) on the
    upper side, an upper one on the lower side. Where ``whole``, V stands for the logarithm of a mean of e^V: then all
    of q (or p) is paid, its integral over every level.
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
    for rate in m:
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
    sign = -1.0 if upper else 1.0
    ends = [(1 + sign * q) * (m - q) for q in (low, high)]
    if not upper and low < (m - 1) / 2 < high:
        ends.append((1 + m) ** 2 / 4)
    most = max(ends)
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
    best = Payment(log=0.0)
    if start >= 0:
        return best
    for levels in _proposals(patched, start, upper=True):
        best = min(best, _settle_upper(patched, levels, start, floor, whole), key=lambda payment: payment.log)
    return best


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
    best = None
    for levels in _proposals(patched, start, upper=False):
        payment = _settle_lower(patched, levels, start, ceiling, whole)
        if payment is not None and (best is None or payment.log > best.log):
            best = payment
    return best


def _proposals(patched: Patched, start: float, *, upper: bool) -> Iterator[Levels]:
    """Step functions m: above a cut, what the patches there need beyond a base rate, those aside that need too much."""
    horizon = float(patched.steps.sum())
    lowest, highest = _bins(patched)
    seen: set[bytes] = set()
    for cut, cap, base in itertools.product(_CUTS, _CAPS, _BASES):
        if cut == 0 and (cap, base) != (_CAPS[0], _BASES[0]):
            continue
        count = round(cut / BIN)
        m = np.zeros(count)
        edges = -BIN * np.arange(count, -1, -1.0)
        if count:
            first, last = lowest + count, np.minimum(highest, -1) + count
            need = (patched.excess - base / horizon) / np.maximum(patched.energy, 1e-200)
            here = np.flatnonzero((last >= 0) & (need > 0) & (need <= cap))
            need, first, last = need[here], np.maximum(first[here], 0), last[here]
            for offset in range(int(np.max(last - first, initial=-1)) + 1):
                inside = first + offset <= last
                np.maximum.at(m, (first + offset)[inside], need[inside])
        if m.tobytes() in seen:
            continue
        seen.add(m.tobytes())
        q = repay(m, upper=upper)
        if q is not None:
            yield Levels(m=m, q=q, edges=edges)


def _bins(patched: Patched) -> tuple[Index, Index]:
    """First and last bin that V of a patch may visit, counted from level 0: -1 is the highest bin."""
    first = np.floor(np.maximum(patched.low, -1e6) / BIN).astype(int)
    return first, np.floor(np.clip(patched.high, -1e6, 0.0) / BIN).astype(int)


def _credit(patched: Patched, levels: Levels) -> Array:
    """A lower bound of m(V) Q2 over each patch."""
    count = len(levels.m)
    credit = np.zeros(len(patched.excess))
    first, last = _bins(patched)
    here = np.flatnonzero(first >= -count)
    first, last = first[here] + count, np.minimum(last[here], -1) + count
    if not count or not len(here):
        return credit
    least = np.full(len(here), np.inf)
    for offset in range(int(np.max(last - first, initial=-1)) + 1):
        inside = first + offset <= last
        least[inside] = np.minimum(least[inside], levels.m[(first + offset)[inside]])
    credit[here] = np.where(np.isfinite(least), least, 0.0) * patched.energy[here] * _DOWN
    return credit


def _rates(patched: Patched, levels: Levels, start: float) -> tuple[Array, Array]:
    """lam and eps (in units of exp(start)) of each slab: the cheaper mixtures, and lam from the inequality itself."""
    slabs = len(patched.steps)
    excess = (patched.excess - _credit(patched, levels)) * 1.0
    excess = excess + 1e-15 * np.abs(patched.excess)
    with np.errstate(over="ignore"):
        reach = np.exp(np.minimum(start - patched.high, 700.0)) * _DOWN
    top = np.zeros(slabs)
    np.maximum.at(top, patched.slab, excess)
    best, eps = top.copy(), np.zeros(slabs)
    ratio, peak = excess / np.maximum(reach, 1e-200), top[patched.slab] / np.maximum(reach, 1e-200)
    for share in (0.0, *np.geomspace(3e-4, 0.9, 12)):
        extra = np.zeros(slabs)
        np.maximum.at(extra, patched.slab, ratio - share * peak)
        better = share * top + extra < best
        best, eps = np.where(better, share * top + extra, best), np.where(better, extra, eps)
    lam = np.zeros(slabs)
    np.maximum.at(lam, patched.slab, (excess - eps[patched.slab] * reach * _DOWN) * _UP)
    return lam + patched.spare, eps + patched.spare


def _settle_upper(patched: Patched, levels: Levels, start: float, floor: float, whole: bool) -> Payment:
    lam, eps = _rates(patched, levels, start)
    terms = Terms(levels=levels, lam=lam, eps=eps, steps=patched.steps, start=start, end=floor, whole=whole)
    return Payment(log=float(bound_above(terms, np.array(start))), terms=terms)


def bound_above(terms: Terms, values: Array, first: int = 0) -> Array:
    """Upper bounds of log P(failing from the start of slab ``first`` on) from where V is at most ``values`` then."""
    steps = Interval(*_around(terms.steps[first:]))
    paid = Interval.point(terms.lam[first:]) * steps
    later = np.cumsum(paid.hi[::-1])[::-1] * (1 + 1e-15 * (len(terms.lam) + 4))  # over a slab and all later ones
    if not later[0] < 50 or not np.isfinite(terms.eps).all():
        return np.zeros(values.shape)
    growth, most = terms.growth(values), terms.levels.above(-np.inf)
    rest = (Interval.point(terms.eps[first:]) * steps * exp(Interval.point(later))).sum()
    # in units of exp(start): total = exp(L + theta(v) - start) + exp(Q) sum eps h exp(L_k)
    here = exp(Interval.point(later[0]) + (Interval.point(values) - Interval.point(terms.start)) + growth)
    total = (here + exp(most) * rest).hi
    level = Interval.point(terms.start) + log(Interval.point(total))
    found = level.hi
    if terms.end > -np.inf:  # (exp(level) - w) / (1 - w), w = exp(floor)
        kept = (Interval.point(1.0) - exp(Interval.point(terms.end) - level)).hi
        less = level + log(Interval.point(np.maximum(kept, 1e-300)))
        less = less - log(Interval.point(1.0) - exp(Interval.point(terms.end)))
        found = np.where(kept > 0, less.hi, found)
    return np.asarray(np.where((values < 0) & (level.hi < 0), np.minimum(found, 0.0), 0.0))


def _settle_lower(
    patched: Patched, levels: Levels, start: float, ceiling: float, whole: bool
) -> Payment | None:
    lam, eps = _rates(patched, levels, start)
    terms = Terms(levels=levels, lam=lam, eps=eps, steps=patched.steps, start=start, end=ceiling, whole=whole)
    value = float(bound_below(terms, np.array(start)))
    return None if value == -np.inf else Payment(log=value, terms=terms)


def bound_below(terms: Terms, values: Array, first: int = 0) -> Array:
    """Lower bounds of log P(failing from the start of slab ``first`` on) from where V is at least ``values`` then."""
    steps = Interval(*_around(terms.steps[first:]))
    paid = (Interval.point(terms.lam[first:]) * steps).sum()
    if not paid.hi < 50 or not np.isfinite(terms.eps).all():
        return np.full(values.shape, -np.inf)
    levels = terms.levels
    most = Interval.point(1.0 + float(levels.q.max())) if len(levels.m) else Interval.point(1.0)
    away = Interval.point(values) - Interval.point(terms.start)
    rest = most * (Interval.point(terms.eps[first:]) * steps).sum()
    # in units of exp(start); then less W = exp(ceiling)
    left = exp(away - (terms.growth(values) + most * paid)) - rest
    least = (left - exp(Interval.point(terms.end) - Interval.point(terms.start))).lo
    kept = log(Interval.point(1.0) - exp(Interval.point(terms.end)))
    found = Interval.point(terms.start) + log(Interval.point(np.maximum(least, 1e-300))) - kept
    return np.asarray(np.where(least > 0, found.lo, -np.inf))


def _around(steps: Array) -> tuple[Array, Array]:
    return steps * (1 - 1e-15), steps * (1 + 1e-15)
