"""Lower bounds where failing is rare: what is lost is paid as a share of U, and only the rest by an amount.

e^V solves the linear equation but for e^V R, and so does W = e^V - k for every number k. With k a little below e^-e,
W is about e (U + c), c small. So R >= -lam W - eps where V is above what it is where paths end without having failed
is the theorem's hypothesis for log W / (1 - k) in place of V (V <= 0 on faces; e^V R >= R e^h where R < 0 and V <= h):
on a patch the least R and the least W decide. In the layers at faces, where a proposal is worst, W is large.
"""

from __future__ import annotations

import math

import numpy as np

from certbound.arrays import Array, Index
from certbound.rigor.intervals import Interval, exp, log
from certbound.values.continuous.hypotheses import Proof
from certbound.values.continuous.payment import Levels, Terms, bound_below
from certbound.values.continuous.residual import value_range

_SHIFT = 1e-3  # c, in units of U at the starts
_PARTS = np.array([0.0, *np.geomspace(1e-6, 1.0, 25)])  # eps, in units of the largest -R of a slab
_UP = 1 + 1e-12
_NONE = Levels(m=np.empty(0), q=np.zeros(1), edges=np.zeros(1))


def relative_below(proof: Proof) -> float | None:
    """A lower bound of log P from what `proved_lower` saw of V; None where there is none.

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
