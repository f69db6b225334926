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
from certbound.values.continuous.hypotheses import Model, Need, Proof, examine, extreme_over, raised_above, sunk, up
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


def relative_below(proof: Proof) -> float | None:
    """A lower bound of log P from what `seen_below` saw of V; None where there is none.

    `Need.bottom` bounds V where paths end without having failed; nothing is asked where V is less.
    """
    assert proof.seen is not None
    surface, need = proof.seen
    excess, least = np.maximum(-proof.ranges.residual_low, 0.0), need.bottom
    highest = max(0.0, *(float(value_range(surface.patches(*chunk))[1].max()) for chunk in surface.chunks()))
    if not least < need.start < 0 or not np.isfinite(excess).all() or not highest < 1:
        return None
    more = math.exp(highest) * _UP  # than e^V anywhere
    excess = excess * more
    less = float(exp(Interval.point(least)).lo) - _SHIFT * (math.exp(need.start) - math.exp(least))

    def grown(values: Array | float) -> Interval:
        """W of V."""
        return exp(Interval.point(np.asarray(values, dtype=float))) - Interval.point(less)

    whole, begun, ended = log(Interval.point(1.0) - Interval.point(less)), grown(need.start), grown(least)
    if ended.lo <= 0:
        return None
    lam, eps = _rates(excess, grown(np.maximum(proof.ranges.low, least)).lo, proof.slab, surface.slabs, float(begun.lo))
    spare = need.spare * (1 + math.exp(need.start - least)) * more  # -R is at most that where nothing was looked at
    terms = Terms(
        levels=_NONE, lam=lam, eps=(eps + spare) / float(begun.lo) * _UP, steps=surface.steps,
        start=float((log(begun) - whole).lo), end=float((log(ended) - whole).hi),
    )  # fmt: skip
    found = float(bound_below(terms, np.array(terms.start)))
    return found if found > -math.inf else None


def relative_above(proof: Proof) -> float | None:
    """An upper bound of log P from what `seen_above` saw of V; None where there is none.

    k is below e^V everywhere, so that W > 0.
    """
    assert proof.seen is not None
    surface, need = proof.seen
    excess = np.maximum(proof.ranges.residual_high, 0.0)  # of e^V too where V < 0
    least = min(float(value_range(surface.patches(*chunk))[0].min()) for chunk in surface.chunks())
    if not least <= need.start < 0 or not np.isfinite(excess).all():
        return None
    less = float(exp(Interval.point(least)).lo) - _SHIFT * (math.exp(need.start) - math.exp(least))

    def grown(values: Array | float) -> Interval:
        return exp(Interval.point(np.asarray(values, dtype=float))) - Interval.point(less)

    whole, begun, ended = log(Interval.point(1.0) - Interval.point(less)), grown(need.start), grown(least)
    if ended.lo <= 0:
        return None
    lam, eps = _rates(excess, grown(np.maximum(proof.ranges.low, least)).lo, proof.slab, surface.slabs, float(begun.lo))
    spare = need.spare * (1 + math.exp(need.start - least)) * _UP  # e^V R is at most that where nothing was looked at
    ended = grown(float(surface.range_at(-1)[0].min()))
    terms = Terms(
        levels=_NONE, lam=lam, eps=(eps + spare) / float(begun.lo) * _UP, steps=surface.steps,
        start=float((log(begun) - whole).hi), end=float((log(ended) - whole).lo),
    )  # fmt: skip
    found = float(bound_above(terms, np.array(terms.start)))
    return found if found < 0 else None


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
