"""Constants that are drawn once, before the start, and then stay: a mass of a batch, a wind that holds all day."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from typing import Any

import numpy as np
from flint import arb, fmpq

from certbound.arrays import Array
from certbound.checks import number
from certbound.problem.noise import Law
from certbound.rigor.balls import lower, precision, upper

_FAR = (2, 4, 6, 8, 10, 14, 20, 30, 40)


@dataclass(frozen=True, eq=False, kw_only=True)
class Random:
    """A constant mean + w, where w is drawn once from a law of one entry.

    Parameters
    ----------
    law : Gaussian, Uniform, Triangular, Rademacher, Discrete, Histogram or Laplace
        The law of w, with mean 0.
    mean : float
        What is added to it.

    Raises
    ------
    TypeError, ValueError
        If the law is none whose probabilities are known, or has more than one entry.

    Examples
    --------
    >>> from certbound.problem.noise import Uniform
    >>> friction = Random(law=Uniform(halfwidth=0.1), mean=0.4)
    >>> low, high = friction.probability(0.4, 0.45)
    >>> 0.2499 < low < high < 0.2501
    True
    """

    law: Law
    mean: float = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.law, Law) or self.law.name not in (*_DENSE, *_ATOMS):
            raise TypeError(f"`law` must be one of {', '.join((*_DENSE, *_ATOMS))}, got {self.law!r}.")
        object.__setattr__(self, "law", self.law.resolve(1))
        if not np.all(np.asarray(getattr(self.law, self.law.level)) > 0):
            raise ValueError(f"`law` must have a positive {self.law.level}, got 0; make it a parameter.")
        object.__setattr__(self, "mean", number("mean", self.mean))

    @property
    def atoms(self) -> list[tuple[float, Fraction]] | None:
        """The values, which rise, and their probabilities; None of a law with a density."""
        find = _ATOMS.get(self.law.name)
        return None if find is None else [(self.mean + float(value), p) for value, p in find(self.law)]

    def weight(self, low: float, high: float) -> arb:
        """P(low <= constant <= high) as a ball."""
        atoms, shift = self.atoms, Fraction(self.mean)
        with precision():
            if atoms is not None:
                return _ball(sum((p for value, p in atoms if low <= value <= high), Fraction(0)))
            below = _DENSE[self.law.name]
            return below(self.law, Fraction(high) - shift) - below(self.law, Fraction(low) - shift)

    def probability(self, low: float, high: float) -> tuple[float, float]:
        """A lower and an upper bound of P(low <= constant <= high)."""
        with precision():
            value = self.weight(low, high)
            return max(lower(value), 0.0), min(max(upper(value), 0.0), 1.0)

    def outside(self, low: float, high: float) -> float:
        """An upper bound of the probability that the constant lies below ``low`` or above ``high``."""
        atoms, shift = self.atoms, Fraction(self.mean)
        with precision():
            if atoms is not None:
                found = _ball(sum((p for value, p in atoms if not low <= value <= high), Fraction(0)))
            else:
                below = _DENSE[self.law.name]
                found = below(self.law, Fraction(low) - shift) + 1 - below(self.law, Fraction(high) - shift)
            return min(max(upper(found), 0.0), 1.0)

    def hull(self, low: float, high: float) -> tuple[float, float]:
        """The ends of what can be drawn between two ends; the ends themselves where that is nothing."""
        atoms = self.atoms
        bound = self.law.bound
        if atoms is not None:
            inside = [value for value, _ in atoms if low <= value <= high]
            return (inside[0], inside[-1]) if inside else (low, high)
        if bound is None:
            return low, high
        ends = Fraction(self.mean) - Fraction(float(bound[0])), Fraction(self.mean) + Fraction(float(bound[0]))
        return max(low, _below(ends[0])), min(high, _above(ends[1]))

    def ends(self, tail: float) -> tuple[float, float]:
        """Ends outside of which the constant lies with at most the probability ``tail``: 0 for bounded laws."""
        if self.law.bound is not None:
            return self.hull(-math.inf, math.inf)
        scale = float(self.law.factor[0, 0])
        for far in _FAR:
            low, high = self.mean - far * scale, self.mean + far * scale
            if not (math.isfinite(low) and math.isfinite(high)):
                raise ValueError(f"`random` must hold constants of a moderate size, got {self.describe()}.")
            if self.outside(low, high) <= tail:
                break
        return low, high

    def sample(self, rng: np.random.Generator, size: int) -> Array:
        """Independent draws, shape (size,)."""
        atoms = self.atoms
        if atoms is not None:
            weights = np.array([float(weight) for _, weight in atoms])
            return rng.choice([value for value, _ in atoms], size, p=weights / weights.sum())
        return np.asarray(self.mean + self.law.sample(rng, size)[:, 0])

    def describe(self) -> str:
        """The law in words, such as ``0.4 + gaussian (std 0.02)``."""
        level = self.data()[self.law.level]
        return f"{self.mean:g} + {self.law.name} ({self.law.level} {level:g})"

    def data(self) -> dict[str, Any]:
        """Its table in a problem file."""
        found = self.law.data()
        level = found[self.law.level]
        plain = level[0][0] if np.ndim(level) == 2 else level[0]
        return found | {self.law.level: plain} | ({"mean": self.mean} if self.mean else {})


def _ball(value: Fraction) -> arb:
    return arb(fmpq(value.numerator, value.denominator))


def _below(value: Fraction) -> float:
    nearest = float(value)
    return nearest if Fraction(nearest) <= value else math.nextafter(nearest, -math.inf)


def _above(value: Fraction) -> float:
    nearest = float(value)
    return nearest if Fraction(nearest) >= value else math.nextafter(nearest, math.inf)


# ---- distribution functions --------------------------------------------------------------------------------------


def _level(law: Law) -> Fraction:
    return Fraction(float(np.ravel(getattr(law, law.level))[0]))


def _gaussian(law: Law, x: Fraction) -> arb:
    level = _ball(_level(law))
    std = level if law.level == "std" else level.sqrt()
    return (1 + (_ball(x) / (std * arb(2).sqrt())).erf()) / 2


def _uniform(law: Law, x: Fraction) -> arb:
    width = _level(law)
    return _ball(min(max((x + width) / (2 * width), Fraction(0)), Fraction(1)))


def _triangular(law: Law, x: Fraction) -> arb:
    width = _level(law)
    place = min(max(x / width, Fraction(-1)), Fraction(1))
    return _ball((1 + place) ** 2 / 2 if place < 0 else 1 - (1 - place) ** 2 / 2)


def _laplace(law: Law, x: Fraction) -> arb:
    width = _level(law)
    tail = (-_ball(abs(x) / width)).exp() / 2
    return tail if x < 0 else 1 - tail


def _histogram(law: Any, x: Fraction) -> arb:
    scale, edges = _level(law), [Fraction(edge) for edge in law.edges.tolist()]
    weights = [Fraction(weight) for weight in law.probabilities.tolist()]
    mean = sum((w * (a + b) / 2 for w, (a, b) in zip(weights, pairwise(edges))), Fraction(0))
    place, found = x / scale + mean, Fraction(0)
    for weight, (a, b) in zip(weights, pairwise(edges)):
        found += weight * min(max((place - a) / (b - a), Fraction(0)), Fraction(1))
    return _ball(found / sum(weights))


_DENSE: dict[str, Callable[[Any, Fraction], arb]] = {
    "gaussian": _gaussian, "uniform": _uniform, "triangular": _triangular, "laplace": _laplace,
    "histogram": _histogram,
}  # fmt: skip
"""P(w <= x) by the law's name."""

Atoms = list[tuple[float, Fraction]]


def _signs(law: Law) -> Atoms:
    scale = float(_level(law))
    return [(-scale, Fraction(1, 2)), (scale, Fraction(1, 2))]


def _values(law: Any) -> Atoms:
    weights = [Fraction(weight) for weight in law.probabilities.tolist()]
    values = (float(_level(law)) * law.values).tolist()
    return [(value, weight / sum(weights)) for value, weight in zip(values, weights)]


_ATOMS: dict[str, Callable[[Any], Atoms]] = {"rademacher": _signs, "discrete": _values}
"""Values, as floats are multiplied, and their probabilities, by the law's name."""
