"""Laws of one entry of the noise at level 1 as pieces: intervals that hold it, each with the probability that they do.

What lies in none of them has the rest of the probability. Distribution functions are evaluated in balls.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

from flint import arb

Piece = tuple[arb, arb, arb]
"""Low and high end, probability."""
Cut = Callable[[int, Sequence[Sequence[float]]], list[Piece]]
"""From about how many pieces are wanted, and the law's tables."""


def _normal(z: arb) -> arb:
    return (-z / arb(2).sqrt()).erfc() / 2


def _uniform(z: arb) -> arb:
    return (1 + z) / 2


def _triangular(z: arb) -> arb:
    return (1 + z) ** 2 / 2 if z <= 0 else 1 - (1 - z) ** 2 / 2


def _laplace(z: arb) -> arb:
    return z.exp() / 2 if z <= 0 else 1 - (-z).exp() / 2


_BELOW = {"normal": _normal, "uniform": _uniform, "triangular": _triangular, "laplace": _laplace}


def cut_by(name: str, low: float, high: float) -> Cut:
    """Intervals between two ends, equal ones; closer in the middle where the density has a kink and long tails."""

    def cut(count: int, tables: Sequence[Sequence[float]]) -> list[Piece]:
        shares = [arb(2 * k - count) / count for k in range(count + 1)]
        if name == "laplace":
            shares = [share * abs(share) for share in shares]
        edges = [arb(float((high * share).mid())) for share in shares]
        below = [_BELOW[name](edge) for edge in edges]
        return [(a, b, q - p) for (a, b), (p, q) in zip(itertools.pairwise(edges), itertools.pairwise(below))]

    return cut


def atoms(values: Sequence[float], weights: Sequence[float]) -> list[Piece]:
    """A few values, less their mean."""
    return [(value, value, share) for value, share in zip(_centred(values, values, weights), _shared(weights))]


def bins(count: int, edges: Sequence[float], weights: Sequence[float]) -> list[Piece]:
    """Bins of a constant density, less their mean, cut into equal parts."""
    parts = max(1, count // len(weights))
    middles = [(arb(a) + arb(b)) / 2 for a, b in itertools.pairwise(edges)]
    found = []
    for (a, b), share in zip(itertools.pairwise(_centred(edges, middles, weights)), _shared(weights)):
        ends = [a + (b - a) * k / parts for k in range(parts + 1)]
        found += [(low, high, share / parts) for low, high in itertools.pairwise(ends)]
    return found


def _shared(weights: Sequence[float]) -> list[arb]:
    """Probabilities, in proportion to weights whose sum is 1 but for rounding."""
    total = sum(map(arb, weights), arb(0))
    return [arb(weight).union(weight / total) for weight in weights]


def _centred(places: Sequence[float], middles: Sequence[float | arb], weights: Sequence[float]) -> list[arb]:
    """Places less the mean: as they stand, or moved by all of it, since either may be meant."""
    mean = sum((arb(m) * arb(w) for m, w in zip(middles, weights)), arb(0))
    return [arb(place).union(arb(place) - mean) for place in places]
