"""Families of events "the Gaussian part exceeds a level along a row at some time", and the probability of any of them.

The union bound adds them. For a centred normal response at finitely many times (discrete time) the sets
{|r_k . Z_k| <= z_k for all k} are symmetric and convex, and the probability of all of them is at least the product of
their probabilities (Gaussian correlation inequality, Royen 2014): two requirements along r and -r make such a set,
with the smaller of their two levels, and so do levels of |r . Z|. What has no partner is added.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from flint import arb

from certbound.checker.balls import upper
from certbound.checker.report import Budget, Unproved

_LIKELY = 0.005
"""Below that a product saves next to nothing over a sum."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Family:
    """rows[k] . Z_k > levels[k] for some k (None: nothing is asked); ``both``: |rows[k] . Z_k| > levels[k]."""

    label: str
    rows: Sequence[Sequence[arb]]
    levels: Sequence[arb | None]
    both: bool = False


def leaving(
    families: Sequence[Family], exceedance: Callable[[Family], arb], budget: Budget, *, paid: arb | None = None,
    normal: bool = False,
) -> arb:
    """Upper bound of the probability that some event happens.

    ``exceedance`` gives P(rows[k] . Z_k > levels[k] for some k) of a family; ``paid`` is paid once, for all together.
    ``normal``: Z is a centred normal vector over finitely many times, so that symmetric events are correlated.
    """
    single = []
    for family in families:
        found = exceedance(family)
        if not found < 1:
            raise Unproved(f"nothing is left for the noise by \"{family.label}\"")
        single.append(upper(2 * found if family.both else found))
    total = upper(sum(single, arb(0) if paid is None else paid))
    if not normal or not total > _LIKELY:
        return total
    return arb.min(total, correlated(families, single, exceedance, budget))


def correlated(
    families: Sequence[Family], single: Sequence[arb], exceedance: Callable[[Family], arb], budget: Budget
) -> arb:
    """1 minus the product over the symmetric events, and the sum of the others."""
    stay, rest = arb(1), arb(0)
    open_ = list(range(len(families)))
    while open_:
        budget.spend(200 * (1 + len(open_)))
        i = open_.pop(0)
        first = families[i]
        if first.both:
            stay *= arb.max(1 - single[i], arb(0)).lower()
            continue
        j = next((j for j in open_ if not families[j].both and _opposite(first.rows, families[j].rows, budget)), None)
        if j is None:
            rest += single[i]
            continue
        open_.remove(j)
        levels = [_least(a, b) for a, b in zip(first.levels, families[j].levels)]
        pair = upper(2 * exceedance(Family(label=first.label, rows=first.rows, levels=levels)))
        if pair <= (single[i] + single[j]) * 1.001:
            stay *= arb.max(1 - pair, arb(0)).lower()
        else:
            rest += single[i] + single[j]
    return upper(1 - stay + rest)


def _opposite(first: Sequence[Sequence[arb]], second: Sequence[Sequence[arb]], budget: Budget) -> bool:
    """Whether the rows are exactly opposite, entry by entry."""
    for one, other in zip(first, second):
        budget.balls(1 + len(one))
        if any(a != -b for a, b in zip(one, other)):
            return False
    return True


def _least(a: arb | None, b: arb | None) -> arb | None:
    return b if a is None else a if b is None else arb.min(a, b)
