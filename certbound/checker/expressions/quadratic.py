"""Quadratic polynomials over boxes cut by half-spaces: whether they stay between two levels.

A function that is a polynomial v + g . x + x^T H x / 2 up to an error e stays in [low, high] where the polynomial
stays in [low + e, high - e]. Cutting the box further costs a few products here, where the function itself costs its
whole program.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from flint import arb

from certbound.checker.report import Budget

_MOST = 60
_VAIN = 0.12

Point = list[arb]


class Cut(NamedTuple):
    """low <= form . x <= high."""

    form: Sequence[arb]
    low: arb
    high: arb

    def meets(self, centre: Sequence[arb], radius: Sequence[arb]) -> bool:
        """False only where a box has no point within the cut."""
        value = reach = arb(0)
        for factor, x, size in zip(self.form, centre, radius):
            value += factor * x
            reach += abs(factor) * size
        return not (value - reach > self.high or value + reach < self.low)

    def holds(self, point: Sequence[arb]) -> bool:
        """Whether a point surely lies within the cut."""
        value = sum((factor * x for factor, x in zip(self.form, point)), arb(0))
        return bool(value >= self.low and value <= self.high)


@dataclass(frozen=True, eq=False, kw_only=True)
class Quadratic:
    """value + gradient . x + x^T hessian x / 2 for |x_a| <= radius_a, up to ``error``.

    ``smear`` guesses how much each coordinate contributes to the error; ``budget`` limits the time.
    """

    value: arb
    gradient: Point
    hessian: list[list[arb]]
    radius: Point
    error: arb
    smear: Point
    budget: Budget | None = None

    def stays(self, low: arb, high: arb, cuts: Sequence[Cut]) -> bool | None:
        """Whether the function lies in [low, high] wherever every cut has form . x in its range.

        False: it does not, at some point; None: undecided.
        """
        bottom, top = low + self.error, high - self.error
        if not bottom <= top:
            return None
        vain = bool(self.error > _VAIN * (high - low))
        active = [a for a, row in enumerate(self.hessian) if any(not entry.is_zero() for entry in row)]
        stack = [([arb(0)] * len(self.radius), self.radius)]
        for _ in range(_MOST):
            if not stack:
                return True
            if self.budget is not None:
                self.budget.balls(3 * len(active) ** 2 + len(self.radius) * (2 * len(cuts) + 12))
            centre, radius = stack.pop()
            if not all(cut.meets(centre, radius) for cut in cuts):
                continue
            value, slope = self._at(centre, active)
            spread = arb(0)
            for a, size in enumerate(radius):
                spread += abs(slope[a]) * size
            below = above = arb(0)
            shares = [arb(0)] * len(radius)
            for a in active:
                row, own = self.hessian[a], radius[a]
                cross = arb(0)
                for b in active:
                    if b != a:
                        cross += abs(row[b]) * radius[b]
                spread += cross * own / 2
                square = row[a] * own * own / 2
                above += arb.max(square.upper(), arb(0))
                below += arb.min(square.lower(), arb(0))
                shares[a] = (abs(slope[a]) + cross) * own + abs(square)
            over, under = value + spread + above, value - spread + below
            if under >= bottom and over <= top:
                continue
            if vain:
                return None
            if (value > top or value < bottom) and all(cut.holds(centre) for cut in cuts):
                return False if value > high + self.error or value < low - self.error else None
            if not any(size > 0 for size in radius):
                return None
            for a, size in enumerate(radius):
                if a not in active:
                    shares[a] = abs(slope[a]) * size
            stack += _halves(centre, radius, shares, slope, bool(over - top > bottom - under))
        return None

    def _at(self, x: Point, active: Sequence[int]) -> tuple[arb, Point]:
        """Value and gradient at a point."""
        slope = list(self.gradient)
        for a in active:
            row = self.hessian[a]
            total = slope[a]
            for b in active:
                total += row[b] * x[b]
            slope[a] = total
        value = self.value
        for a, offset in enumerate(x):
            if not offset.is_zero():
                value += (self.gradient[a] + slope[a]) * offset / 2
        return value, slope


def _halves(centre: Point, radius: Point, shares: Point, slope: Point, upwards: bool) -> list[tuple[Point, Point]]:
    """The box cut in two along the coordinate of the largest share; the worse half comes last."""
    best = max(range(len(shares)), key=lambda a: float(shares[a]))
    half = radius[best] / 2
    small = [*radius[:best], half, *radius[best + 1 :]]
    signs = (-1, 1) if bool(slope[best] > 0) == upwards else (1, -1)
    return [([*centre[:best], centre[best] + sign * half, *centre[best + 1 :]], small) for sign in signs]
