"""The noise of one step as boxes that cover its law, each with bounds of its probability."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from flint import arb

from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.problem.noise import LAWS, Law
from certbound.rigor.balls import lower, precision, upper
from certbound.rigor.intervals import Interval

_MOST_ENTRIES = 2
_REACH = 8.3  # standard deviations; beyond it nothing is known, at 1e-16
_LAPLACE = 37.0
_MEAN = 2e-12  # of a table's largest value: what its mean may be off
_UNIT = 2.0**-52


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Pieces:
    """Boxes, shape (K, m), that hold w with probability at least ``least`` and at most ``most`` each.

    What lies in none of them has at most the probability ``rest``.
    """

    boxes: Interval
    least: Array
    most: Array
    rest: float


def pieces_of(law: Law, count: int) -> Pieces:
    """The law cut into boxes, about so many along every entry.

    Raises
    ------
    InfeasibleError
        For more than two entries, entries that are not independent, and laws that are not known by name.
    """
    level = np.asarray(getattr(law, law.level))
    sizes = np.diag(level) if level.ndim == 2 else level
    m = len(sizes)
    if m > _MOST_ENTRIES:
        raise InfeasibleError(f"value functions on chains take noise of one or two entries, not {m}.")
    cut = _CUTS.get(law.name)
    if cut is None or type(law) is not LAWS[law.name]:
        raise InfeasibleError(f"value functions on chains do not know the law {type(law).__name__}.")
    with precision(64):
        axes = [cut(law, i, count) if size else _NOTHING for i, size in enumerate(sizes)]
    low = np.array(list(itertools.product(*(axis[0] for axis in axes))))
    high = np.array(list(itertools.product(*(axis[1] for axis in axes))))
    least = np.array([np.prod(row) for row in itertools.product(*(axis[2] for axis in axes))])
    most = np.array([np.prod(row) for row in itertools.product(*(axis[3] for axis in axes))])
    rest = sum(max(0.0, 1 - float(np.sum(axis[2]))) + 1e-15 for axis in axes)
    return Pieces(
        boxes=Interval(low, high), least=least * (1 - 4 * _UNIT), most=most * (1 + 4 * _UNIT), rest=rest * (1 + 1e-12)
    )


Axis = tuple[Array, Array, Array, Array]
"""Low and high ends, and probabilities, rounded down and up."""


_NOTHING: Axis = np.zeros(1), np.zeros(1), np.ones(1), np.ones(1)
"""Of an entry that is always 0."""


def _cut(edges: Array, below: Callable[[float], Any]) -> Axis:
    """Intervals between edges, whose probabilities come from the law's distribution function in ball arithmetic."""
    level = [below(float(edge)) for edge in edges]
    parts = [b - a for a, b in itertools.pairwise(level)]
    least = np.array([max(lower(part), 0.0) for part in parts])
    return edges[:-1], edges[1:], least, np.array([max(upper(part), 0.0) for part in parts])


def _scaled(axis: Axis, size: Interval) -> Axis:
    """The pieces of size * w, ends rounded outward."""
    ends = Interval(axis[0], axis[1]) * size
    return ends.lo, ends.hi, axis[2], axis[3]


def _gaussian(law: Law, i: int, count: int) -> Axis:
    covariance = law.enclosed_covariance()
    if any(covariance[i, j].mag > 0 for j in range(len(covariance)) if j != i):
        raise InfeasibleError("value functions on chains need noise with independent entries.")
    edges = np.linspace(-_REACH, _REACH, count + 1)
    root = arb(2).sqrt()
    axis = _cut(edges, lambda z: (-arb(z) / root).erfc() / 2)
    variance = covariance[i, i]
    low, high = np.sqrt(np.maximum([float(variance.lo), float(variance.hi)], 0.0))
    return _scaled(axis, Interval(low * (1 - _UNIT), high * (1 + _UNIT)))


def _uniform(law: Law, i: int, count: int) -> Axis:
    return _scaled(_cut(np.linspace(-1, 1, count + 1), lambda z: (1 + arb(z)) / 2), _size(law, i))


def _triangular(law: Law, i: int, count: int) -> Axis:
    def below(z: float) -> Any:
        return (1 + arb(z)) ** 2 / 2 if z <= 0 else 1 - (1 - arb(z)) ** 2 / 2

    return _scaled(_cut(np.linspace(-1, 1, count + 1), below), _size(law, i))


def _laplace(law: Law, i: int, count: int) -> Axis:
    half = _LAPLACE * np.linspace(0, 1, count // 2 + 1) ** 2
    edges = np.concatenate([-half[:0:-1], half])

    def below(z: float) -> Any:
        return arb(z).exp() / 2 if z <= 0 else 1 - (-arb(z)).exp() / 2

    return _scaled(_cut(edges, below), _size(law, i))


def _rademacher(law: Law, i: int, count: int) -> Axis:
    values = np.array([-1.0, 1.0])
    return _scaled((values, values, np.full(2, 0.5), np.full(2, 0.5)), _size(law, i))


def _discrete(law: Any, i: int, count: int) -> Axis:
    values, weights = np.asarray(law.values), np.asarray(law.probabilities)
    off = _MEAN * float(np.abs(values).max())
    return _scaled((values - off, values + off, weights * (1 - 1e-12), weights * (1 + 1e-12)), _size(law, i))


def _histogram(law: Any, i: int, count: int) -> Axis:
    edges, weights = np.asarray(law.edges), np.asarray(law.probabilities)
    parts = max(1, count // len(weights))
    cuts = [np.linspace(a, b, parts + 1) for a, b in itertools.pairwise(edges)]
    off = (_MEAN + 4 * _UNIT) * float(np.abs(edges).max())
    low, high = np.concatenate([cut[:-1] for cut in cuts]) - off, np.concatenate([cut[1:] for cut in cuts]) + off
    share = np.repeat(weights / parts, parts)
    return _scaled((low, high, share * (1 - 1e-12), share * (1 + 1e-12)), _size(law, i))


def _size(law: Any, i: int) -> Interval:
    return Interval.point(float(getattr(law, law.level)[i]))


_CUTS: dict[str, Callable[[Any, int, int], Axis]] = {
    "gaussian": _gaussian,
    "uniform": _uniform,
    "triangular": _triangular,
    "laplace": _laplace,
    "rademacher": _rademacher,
    "discrete": _discrete,
    "histogram": _histogram,
}
