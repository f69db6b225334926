"""Bounds where failing is rare: what is lost is paid as a share of U, and only the rest by an amount.

e^V solves the linear equation but for e^V R, and so does W = e^V - k for every number k. With k a little below e^-e,
W is about e (U + c), c small.

*Below.* R >= -lam W - eps where V is above what it is where paths end without having failed is the theorem's hypothesis
for log W / (1 - k) in place of V (V <= 0 on faces; e^V R >= R e^h where R < 0 and V <= h): on a patch the least R and
the least W decide. In the layers at faces, where a proposal is worst, W is large.

*Above.* k is below e^V all over the box, so that W > 0, and log W / (1 - k) >= 0 exactly where V >= 0. Where V < 0
and R > 0, e^V R <= R, so that R <= lam W + eps is the hypothesis of the upper theorem for it, with m = 0.

e is so small that Q2, of order e^2, is next to nothing: it is bounded by the sizes of its terms from above, and by 0
from below, and the rest of R, which is linear, is a polynomial of lower degree.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from certbound.arrays import Array, Index
from certbound.rigor.intervals import Interval, exp, log
from certbound.values.continuous.hypotheses import (
    Model,
    Need,
    Proof,
    examine,
    extreme_over,
    raised_above,
    sunk,
    top_of,
    up,
)  # fmt: skip
from certbound.values.continuous.payment import Levels, Terms, bound_above, bound_below
from certbound.values.continuous.residual import value_range
from certbound.values.continuous.surface import Surface

Starts = Sequence[tuple[float, float]]

_SHIFT = 1e-3  # c, in units of U at the starts
_PARTS = np.array([0.0, *np.geomspace(1e-6, 1.0, 25)])  # eps, in units of the largest -R of a slab
_UP = 1 + 1e-12
_NONE = Levels(m=np.empty(0), q=np.zeros(1), edges=np.zeros(1))


def seen_above(surface: Surface, model: Model, starts: Starts, negligible: float, near: Array) -> Proof:
    """What the inequality says of V, raised over its faces, but for Q2 (`residual`); ``near`` is that of `examine`."""
    surface = raised_above(surface)
    start = up(extreme_over(surface, starts, upper=True))
    need = Need(spare=negligible / float(surface.times[-1]), start=start, top=0.0)
    return examine(surface, model, need, upper=True, near=near, straight=True)


def seen_below(
    surface: Surface, model: Model, starts: Starts, negligible: float, near: Array, points: Array | None,
    cut: Sequence[tuple[bool, bool]],
) -> Proof:
    """The same of V lowered until V <= 0 everywhere."""
    surface = sunk(surface)
    start, end = -up(-extreme_over(surface, starts, upper=False, points=points)), surface.highest_end(cut)
    need = Need(spare=negligible / float(surface.times[-1]), start=start, top=np.inf, bottom=end)
    return examine(surface, model, need, upper=False, near=near, straight=True)


def relative_below(proof: Proof, highest: float | None = None) -> float | None:
    """A lower bound of log P from what `seen_below` saw of V; None where there is none.

    `Need.bottom` bounds V where paths end without having failed; nothing is asked where V is less. ``highest`` bounds
    V wherever paths may go, on the whole surface if it is not given.
    """
    assert proof.seen is not None
    surface, need = proof.seen
    highest = max(0.0, top_of(surface) if highest is None else highest)
    if not highest < 1:
        return None
    more = math.exp(highest) * _UP  # than e^V anywhere
    excess, least = np.maximum(-proof.ranges.residual_low, 0.0) * more, need.bottom
    terms = _terms(proof, excess, least, least, more, upper=False)
    found = -math.inf if terms is None else float(bound_below(terms, np.array(terms.start)))
    return found if found > -math.inf else None


def relative_above(proof: Proof) -> float | None:
    """An upper bound of log P from what `seen_above` saw of V; None where there is none.

    k is below e^V everywhere, so that W > 0; R bounds e^V R where V < 0.
    """
    assert proof.seen is not None
    surface, _ = proof.seen
    least = min(float(value_range(surface.patches(*chunk))[0].min()) for chunk in surface.chunks())
    excess, end = np.maximum(proof.ranges.residual_high, 0.0), float(surface.range_at(-1)[0].min())
    terms = _terms(proof, excess, least, end, 1.0, upper=True)
    found = 0.0 if terms is None else float(bound_above(terms, np.array(terms.start)))
    return found if found < 0 else None


def _terms(proof: Proof, excess: Array, least: float, end: float, more: float, *, upper: bool) -> Terms | None:
    """What is paid for log W / (1 - k), k a little below e^``least``: V is above that wherever something is asked.

    ``end`` is V where paths end without having failed; where nothing was looked at, e^V R is within what `Need` grants
    where V is ``least``, times ``more``.
    """
    assert proof.seen is not None
    surface, need = proof.seen
    if not least < need.start < 0 or not np.isfinite(excess).all():
        return None
    less = float(exp(Interval.point(least)).lo) - _SHIFT * (math.exp(need.start) - math.exp(least))

    def grown(values: Array | float) -> Interval:
        """W of V."""
        return exp(Interval.point(np.asarray(values, dtype=float))) - Interval.point(less)

    whole, begun, ended = log(Interval.point(1.0) - Interval.point(less)), grown(need.start), grown(end)
    if not min(grown(least).lo, ended.lo) > 0:
        return None
    lam, eps = _rates(excess, grown(np.maximum(proof.ranges.low, least)).lo, proof.slab, surface.slabs, float(begun.lo))
    spare = need.spare * (1 + math.exp(need.start - least)) * more * _UP
    start, stop = log(begun) - whole, log(ended) - whole
    return Terms(
        levels=_NONE, lam=lam, eps=(eps + spare) / float(begun.lo) * _UP, steps=surface.steps,
        start=float(start.hi if upper else start.lo), end=float(stop.lo if upper else stop.hi),
    )  # fmt: skip


def _rates(excess: Array, low: Array, slab: Index, slabs: int, begun: float) -> tuple[Array, Array]:
    """lam and eps of each slab with -R <= lam W + eps, W >= ``low``, on its patches, the cheapest at W = ``begun``."""
    lam, eps = np.zeros(slabs), np.zeros(slabs)
    for k in np.unique(slab):
        here = slab == k
        parts = _PARTS * float(excess[here].max())
        most = np.maximum((excess[here] - parts[:, None]) / low[here], 0.0).max(axis=1) * _UP
        best = int(np.argmin(most * begun + parts))
        lam[k], eps[k] = most[best], parts[best]
    return lam, eps
