"""Laws given by tables (values with probabilities, histograms), and the Laplace law, which has no variance proxy."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, NoReturn

import numpy as np

from certbound.arrays import Array
from certbound.checks import frozen, vector
from certbound.errors import InfeasibleError
from certbound.problem.noise import Law

_SUM = Fraction(1, 10**12)
"""How far probabilities may miss 1 in sum, and a mean 0 in units of the largest value: by rounding, no more."""
_MOST = 200
"""Entries of a table: a kernel of simulations has a line for each, and compiles in 4 s (of 1000 entries in 70 s)."""


class _Table(Law):
    """w_i = scale_i (z_i - E z_i) with independent z_i of one law that a table gives.

    The mean has to be 0 but for rounding, which is taken off. Proxy: a quarter of the squared range (Hoeffding).
    """

    probabilities: Any
    scale: Any

    def __post_init__(self) -> None:
        Law.__post_init__(self)
        for name in self.tables:
            object.__setattr__(self, name, frozen(vector(name, getattr(self, name))))
        places, weights = (getattr(self, name) for name in self.tables)
        where, kind = self.tables[0], type(self).__name__
        extra = len(self._middles) - len(weights)
        if len(weights) > _MOST:
            cure = "join neighbouring bins" if len(self._middles) < len(places) else "round values to fewer"
            raise ValueError(
                f"`probabilities` of {kind} must have at most {_MOST} entries, since every draw of a simulation and "
                f"every mean of a value function goes through all of them, got {len(weights)}; {cure}."
            )
        if extra or not len(weights):
            raise ValueError(
                f"`probabilities` of {kind} must have entries, one for each of `{where}`"
                f"{'' if len(self._middles) == len(places) else ' but one'}, got {len(weights)} for {len(places)}."
            )
        if np.any(weights < 0):
            raise ValueError(f"`probabilities` must not be negative, got {weights.tolist()}.")
        if abs(sum(map(Fraction, weights.tolist()), Fraction(-1))) > _SUM:
            raise ValueError(f"`probabilities` must sum to 1 within 1e-12, got {float(weights.sum())!r}; scale them.")
        if any(b <= a for a, b in itertools.pairwise(places.tolist())):
            raise ValueError(f"`{where}` must rise, got {places.tolist()}; sort them.")
        mean = sum((w * m for w, m in zip(map(Fraction, weights.tolist()), self._middles)), Fraction(0))
        if abs(mean) > _SUM * max(Fraction(float(np.abs(places).max())), Fraction(1, 10**300)):
            raise ValueError(
                f"`{where}` must have mean 0 under their probabilities, got {float(mean):.6g}; subtract it from them, "
                "and add it (times the noise matrix) to the dynamics."
            )

    @property
    def _middles(self) -> list[Fraction]:
        """Where the mass of each probability has its mean."""
        raise NotImplementedError

    @property
    def _places(self) -> Array:
        """Values or edges, which rise."""
        found: Array = getattr(self, self.tables[0])
        return found

    @property
    def proxy(self) -> Array:
        span = Fraction(float(self._places[-1])) - Fraction(float(self._places[0]))
        return frozen(np.diag([_above(Fraction(float(s)) ** 2 * span**2 / 4) for s in self.scale]))

    @property
    def bound(self) -> Array:
        largest = Fraction(float(np.abs(self._places).max())) * (1 + _SUM)
        return frozen([_above(Fraction(float(s)) * largest) for s in self.scale])

    @property
    def factor(self) -> Array:
        return np.diag(self.scale)

    def _ends(self) -> Array:
        """Cumulated probabilities on the scale (-1, 1) of the variate, from -1 on."""
        return np.asarray(2.0 * np.concatenate([[0.0], np.cumsum(self.probabilities)]) - 1.0)


def _above(value: Fraction) -> float:
    nearest = float(value)
    return nearest if Fraction(nearest) >= value else float(np.nextafter(nearest, np.inf))


@dataclass(frozen=True, eq=False, kw_only=True)
class Discrete(_Table):
    """Independent entries that take a few values each: packet loss, jumps between modes.

    Parameters
    ----------
    values : array_like, shape (K,)
        Rising, with mean 0 under the probabilities (within 1e-12, which is taken off).
    probabilities : array_like, shape (K,)
        Not negative, with sum 1 within 1e-12.
    scale : float or array_like, shape (m,)
        Factor of each entry, not negative.

    Examples
    --------
    >>> lost = Discrete(values=[-0.9, 0.1], probabilities=[0.1, 0.9])
    >>> lost.resolve(1).proxy
    array([[0.25]])
    """

    values: Any
    probabilities: Any
    scale: Any = 1.0

    name = "discrete"
    levels = ("scale",)
    tables = ("values", "probabilities")
    variate = "uniform"

    @property
    def _middles(self) -> list[Fraction]:
        return [Fraction(value) for value in self.values.tolist()]

    def unit(self, v: Array) -> Array:
        ends, found = self._ends()[1:-1], 0.0 * v + self.values[0]
        for end, step in zip(ends, np.diff(self.values)):
            found = found + np.where(v > end, step, 0.0)
        return np.asarray(found)


@dataclass(frozen=True, eq=False, kw_only=True)
class Histogram(_Table):
    """Independent entries with a density that is constant between edges: any bounded law, as a table.

    Parameters
    ----------
    edges : array_like, shape (K + 1,)
        Rising; the law has mean 0 (within 1e-12 of its largest edge, which is taken off).
    probabilities : array_like, shape (K,)
        Of each bin: not negative, with sum 1 within 1e-12.
    scale : float or array_like, shape (m,)
        Factor of each entry, not negative.

    Examples
    --------
    >>> Histogram(edges=[-2, -1, 1, 2], probabilities=[0.25, 0.5, 0.25]).resolve(1).proxy
    array([[4.]])
    """

    edges: Any
    probabilities: Any
    scale: Any = 1.0

    name = "histogram"
    levels = ("scale",)
    tables = ("edges", "probabilities")
    variate = "uniform"

    @property
    def _middles(self) -> list[Fraction]:
        edges = [Fraction(edge) for edge in self.edges.tolist()]
        return [(a + b) / 2 for a, b in itertools.pairwise(edges)]

    def unit(self, v: Array) -> Array:
        found = 0.0 * v + self.edges[0]
        for (a, b), width in zip(itertools.pairwise(self._ends().tolist()), np.diff(self.edges)):
            if b > a:
                found = found + width * np.minimum(np.maximum((v - a) / (b - a), 0.0), 1.0)
        return np.asarray(found)


@dataclass(frozen=True, eq=False, kw_only=True)
class Laplace(Law):
    """Independent entries with the density exp(-|w|/b_i)/(2 b_i).

    Its tails are those of an exponential, so that it has no variance proxy: it is simulated, and no engine that needs a
    proxy applies.

    Parameters
    ----------
    scale : float or array_like, shape (m,)
        b, not negative; the standard deviation is 1.414 b.
    """

    scale: Any

    name = "laplace"
    levels = ("scale",)
    variate = "uniform"

    @property
    def dimension(self) -> int:
        return len(self.scale)

    @property
    def proxy(self) -> NoReturn:
        raise InfeasibleError(
            "Laplace noise has no variance proxy, as its tails are exponential: value functions of one or two states "
            "alone bound it; cut it off (cb.Histogram), or state what you know of it by cb.SubGaussian."
        )

    @property
    def factor(self) -> Array:
        return np.diag(self.scale)

    def unit(self, v: Array) -> Array:
        return np.asarray(-np.sign(v) * np.log(1.0 - np.abs(v)))
