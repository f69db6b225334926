"""A supersolution by its sources, stepped back from the horizon (docs/values.md).

U is linear in time within a step, so that its residual R = U_t + F U_p + g U_q + s^2 U_qq/2 is bounded at the step's
ends. What R lacks to be at most 0 is a source of the next step; what is left is paid.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from certbound.arrays import Array, Index, Mask
from certbound.errors import InfeasibleError
from certbound.values.semilagrangian.sources.ground import Ground
from certbound.watch import poll

_HELD = (1.05, 0.8), (1.1, 0.95)
"""By how much sources exceed what was lacking a step before, and how much of them is left in a step at least: else they
go on and off where U is about 1. The second pair is dearer, and settles more often.
"""
_FADING = 1.005, 1.03  # sources fade to 0 where U is between these: it need not be more than 1
_LEAST = 0.25  # of sources that count where U is given in part
_GRADES, _EACH = 4, 6  # halvings of the first step, and steps of each length
_DEAR = 1e-3  # the horizon is where a step begins to pay no more than this
_RARE = 0.1  # of the expected answer: where U is less, what is lacking is paid as a probability
_LOST, _MOST, _SETTLED = 1e6, 3.0, 150  # it begins after so many steps in any case


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Found:
    """What is proved: u <= (U + amount) e^rate, U the spline of the coefficients ``values``."""

    values: Array
    rate: float
    amount: float


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Sides:
    """Which coefficients are given, where parts of another cell begin, and what free ones count on parts at least."""

    fixed: Mask
    firsts: Index
    weights: Array

    def needed(self, lacking: Array, low: Array, margin: float) -> Array:
        """Coefficients of a source that is at least what is lacking without one, on every cell."""
        faded = np.clip((_FADING[1] - low) / (_FADING[1] - _FADING[0]), 0.0, 1.0)
        lacking = np.maximum.reduceat(np.maximum(lacking, 0.0) * faded / self.weights, self.firsts, axis=0)
        shape, (n, m) = self.fixed.shape, lacking.shape
        wide = np.zeros((n + 4, m + 6))
        wide[2:-2, 3:-3] = lacking
        across = np.max([wide[:, k : k + shape[1]] for k in range(4)], axis=0)
        found = np.max([across[k : k + shape[0]] for k in range(3)], axis=0)
        return np.where(self.fixed, 0.0, margin * found)


def march(ground: Ground, horizon: float, guess: float, *, steady: bool = False) -> Found:
    """Step back from the horizon; ``guess`` is about the answer, and decides how what is left is paid.

    Steps until a first one pays hardly anything lie beyond the horizon: U may be anything there that is at least 0 at
    the horizon itself, and at least 1 where paths leave. ``steady``: sources that settle more often, and cost more.

    Raises
    ------
    InfeasibleError
        Nothing is proved.
    """
    from scipy.sparse import csr_matrix, diags, eye
    from scipy.sparse.linalg import splu

    bounds, fixed = ground.measure(), ground.outside()
    turn = csr_matrix(diags((~fixed).ravel().astype(float)) @ ground.turn)
    sides = _Sides(fixed=fixed, firsts=np.flatnonzero(np.diff(ground.parts[0], prepend=-1)),
                   weights=_weights(bounds, fixed))  # fmt: skip
    now = np.where(fixed, ground.levels(), 0.0)
    source, (margin, hold) = np.zeros_like(now), _HELD[steady]
    rate, amount, length, past, early = 0.0, 0.0, 0.0, 0.0, True
    for count, step in enumerate(_steps(ground.step)):
        poll("a value function with sources")
        step = step if early else min(step, horizon * (1 + 1e-12) - past)
        if step != length:
            inverse, length = splu((eye(now.size) - step * turn).tocsc()), step
        moved = np.where(fixed, now, inverse.solve((now + step * source).ravel()).reshape(now.shape))
        ends = [bounds(part, (now - moved) / step, source, step) for part in (now, moved)]
        low = np.minimum(ends[0][2], ends[1][2])
        paid = payment(np.maximum(ends[0][0], ends[1][0]), low, guess)
        if early and count >= _GRADES * _EACH:
            amount = max(0.0, -float(ends[0][2].min()))
            early = (paid[0] + paid[1] / guess) * step + amount / guess >= _DEAR and count < _SETTLED
        now, source = moved, np.maximum(sides.needed(ends[1][1], low, margin), hold * source)
        if not early:
            past, rate, amount = (past + step) * (1 - 1e-15), rate + paid[0] * step, amount + paid[1] * step
        if past >= horizon:
            break
        if rate > _MOST or not np.abs(now).max() < _LOST:
            raise InfeasibleError("sources do not settle; value functions prove nothing here.")
    return Found(values=now, rate=rate * (1 + 1e-9), amount=amount * (1 + 1e-9))


def _steps(step: float) -> Iterator[float]:
    """Lengths of the steps, short ones first."""
    for k in range(_GRADES, 0, -1):
        yield from [step / 2**k] * _EACH
    while True:
        yield step


def _weights(bounds: Any, fixed: Mask) -> Array:
    """What coefficients that are not given at p's faces count on parts of cells at least, or `_LEAST`."""
    values = (~fixed).astype(float)
    values[1:-1, [0, -1]] = 1.0
    return np.asarray(np.maximum(bounds(values, values, values, 1.0)[2], _LEAST))


def payment(lacking: Array, low: Array, guess: float) -> tuple[float, float]:
    """(rate, amount) with R <= rate U + amount on every part, or U >= 1 there."""
    lacking = np.where(low >= 1, 0.0, lacking)
    known = low > _RARE * guess
    rate = float((np.maximum(lacking, 0.0)[known] / low[known]).max(initial=0.0)) * (1 + 1e-12)
    return rate, max(0.0, float((lacking - rate * low).max()) * (1 + 1e-12))
