"""Transition matrices, Gramians and drifts of a constant slope over halves of halves of the horizon.

F(h) = exp(A h), Q(h) = int_0^h F(s) M F(s)^T ds and w(h) = int_0^h F(s) v ds for h = T/2^l. At the finest level that is
needed, or where |A| h <= 1/4 in the norm of row sums, Q and w are their Taylor series with what follows them:

- the k-th derivative of F M F^T at 0 is M_k, M_0 = M, M_(k+1) = A M_k + M_k A^T, no entry of which exceeds
  (2 |A|)^k max|M|, so that what follows K terms is at most 2 h max|M| (2 |A| h)^K/(K + 1)! entry by entry;
- that of F v is A^k v, so that what follows is at most 2 h max|v| (|A| h)^K/(K + 1)!.

Longer steps follow by F(2h) = F(h)^2, Q(2h) = Q(h) + F(h) Q(h) F(h)^T and w(2h) = w(h) + F(h) w(h).
"""

from __future__ import annotations

from collections.abc import Mapping

from flint import arb, arb_mat, ctx

from certbound.checker.balls import row_sums
from certbound.checker.report import Budget, Unproved

MOST_LEVELS = 160
"""Halvings of the horizon, at most."""
_MILD = 0.25
_GUARD = 16
"""Bits by which a series is more exact than the balls."""


class Transitions:
    """F, w and the Q of each source for the levels 0 (the horizon) to ``finest``; each a list by the level.

    ``sources`` are matrices M by name, each (n, n), ``drift`` is v, (n, 1), or None where it is 0.
    """

    def __init__(
        self, slope: arb_mat, sources: Mapping[str, arb_mat], drift: arb_mat | None, horizon: float, finest: int,
        budget: Budget,
    ) -> None:  # fmt: skip
        self.horizon = arb(horizon)
        self.finest = max(finest, _mild_level(slope, self.horizon))
        n, count = slope.nrows(), self.finest + 1
        budget.hold((len(sources) + 2) * n * n * count)
        terms = _terms(ctx.prec)
        budget.products(n, n, n * ((len(sources) + 1) * 2 * terms + count * (1 + 2 * len(sources))))
        h = self.step(self.finest)
        self.transitions = [(slope * h).exp()]
        self.gramians = {name: [_series(slope, source, h, terms)] for name, source in sources.items()}
        self.drifts = [] if drift is None else [_vector_series(slope, drift, h, terms)]
        for _ in range(self.finest):
            forward = self.transitions[-1]
            back = forward.transpose()
            for found in self.gramians.values():
                found.append(found[-1] + forward * found[-1] * back)
            if self.drifts:
                self.drifts.append(self.drifts[-1] + forward * self.drifts[-1])
            self.transitions.append(forward * forward)
        for found in (self.transitions, self.drifts, *self.gramians.values()):
            found.reverse()

    def step(self, level: int) -> arb:
        """The length T/2^level."""
        return self.horizon * arb(2) ** (-level)


def _mild_level(slope: arb_mat, horizon: arb) -> int:
    """The least level at which a step is short against the slope."""
    turn, level = row_sums(slope) * horizon, 0
    while not turn <= _MILD:
        turn, level = turn / 2, level + 1
        if level > MOST_LEVELS:
            raise Unproved(f"the slopes are too large for {MOST_LEVELS} halvings of the horizon")
    return level


def _terms(bits: int) -> int:
    """K with (1/2)^K/(K + 1)! below the accuracy of the balls."""
    size, count = 1, 1
    while size.bit_length() <= bits + _GUARD:
        count += 1
        size *= 2 * count
    return count


def _largest(a: arb_mat) -> arb:
    largest = arb(0)
    for x in a.entries():
        largest = arb.max(largest, x.abs_upper())
    return largest


def _rest(size: arb, factor: arb, terms: int, h: arb) -> arb:
    """The ball about 0 of radius 2 h size factor^K/(K + 1)!."""
    bound = (2 * h * size * factor**terms / arb(terms + 1).gamma() / (terms + 1)).upper()
    return (-bound).union(bound)


def _shifted(a: arb_mat, by: arb) -> arb_mat:
    return arb_mat(a.nrows(), a.ncols(), [x + by for x in a.entries()])


def _series(slope: arb_mat, source: arb_mat, h: arb, terms: int) -> arb_mat:
    """Q(h) for a step h with 2 |A| h <= 1/2."""
    back = slope.transpose()
    term = source * h
    total = term
    for k in range(1, terms):
        term = (slope * term + term * back) * (h / (k + 1))
        total = total + term
    return _shifted(total, _rest(_largest(source), 2 * row_sums(slope) * h, terms, h))


def _vector_series(slope: arb_mat, vector: arb_mat, h: arb, terms: int) -> arb_mat:
    """w(h) for a step h with |A| h <= 1/4."""
    term = vector * h
    total = term
    for k in range(1, terms):
        term = slope * term * (h / (k + 1))
        total = total + term
    return _shifted(total, _rest(_largest(vector), row_sums(slope) * h, terms, h))
