"""The paper's closed-form radii, as the baselines to compare with (Sec. 2 of docs/theory.md).

With eps1(e) = log(1/(1 - e^2))/e^2, eps2(e) = 2/e^2 and B(e, n, ell) = eps1 n + eps2 ell, every radius is sqrt(B)
times one or two roots of V_t = int_0^t sigma^2 e^{2(C_t - C_s)} ds, W_T = int_0^T sigma^2 e^{-2 C_s} ds (sums in
discrete time), C_t = int_0^t c:

- variance: sqrt(V_t B) (Props 1 and 2 with ell = log 1/delta, Prop 3 with ell = log T/delta);
- scaled: e^{C_t} sqrt(W_T B), ell = log 1/delta (Thms 2 and 4; the printed Thm 4 misses a factor 1/L, E1);
- windows: (sqrt(V_t) + sqrt(window)) sqrt(B), ell = log 2N/delta, N = ceil(T/step) (Thms 3 and 5).

For n = 1 the cosh variant takes B = 2 log 2 + 2 ell (E3). Markov and Chebyshev take nu/delta and n/delta for B.
The sharp tail (item 7.11) is B = 2 x, (e^k - 1)/(0F1(; nu/2; k x) - 1) = delta/count with the best k > 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from flint import arb

from certbound.rigor.balls import bessel_excess, precision, solve_upward
from certbound.tubes.ballpath import BallPath, ball_path, integral
from certbound.tubes.excess import log_phi_one, solve_excess_one
from certbound.tubes.line_search import golden
from certbound.tubes.piecewise import MonotoneProfile


def growth(epsilon: float, dimension: float, level: float) -> float:
    """B(e, n, ell) = eps1 n + eps2 ell of eq. (7) of the paper, in floating point.

    Examples
    --------
    >>> round(growth(15 / 16, 1, 7.0), 3)
    18.331
    """
    square = epsilon * epsilon
    return (-math.log1p(-square) * dimension + 2 * level) / square


def growth_ball(epsilon: float, dimension: float, level: arb) -> arb:
    """B(e, n, ell) as a ball."""
    square = arb(epsilon) ** 2
    return (-(-square).log1p() * dimension + 2 * level) / square


def best_growth(dimension: float, level: float) -> float:
    """min over e of B(e, n, ell): n u with u - 1 - log u = 2 ell/n (the derivative in e^2 set to 0)."""
    target = 2 * level / dimension
    u = 1 + math.sqrt(2 * target) + target
    for _ in range(50):
        step = (u - 1 - math.log(u) - target) * u / (u - 1)
        u -= step
        if abs(step) < 1e-15 * u:
            break
    return dimension * u


def best_epsilon(dimension: float, level: float) -> float:
    """The e in (0, 1) that minimises B(e, n, ell): e^2 = 1 - n/B."""
    epsilon = math.sqrt(max(0.0, 1 - dimension / best_growth(dimension, level)))
    return min(max(epsilon, 1e-8), math.nextafter(1.0, 0.0))


@dataclass(frozen=True, kw_only=True)
class Tail:
    """The factor B of a radius."""

    # ``"growth"`` (eq. (7) with ``epsilon``), ``"cosh"`` (n = 1), ``"moment"`` (``weight``/delta) or ``"sharp"``
    # (``power`` k)
    kind: str
    delta: float  # level
    dimension: float  # n (nu for the sharp tail)
    count: float = 1.0  # number of events that share delta: ell = log(count/delta)
    # as ``kind`` asks
    epsilon: float = 0.0
    weight: float = 0.0
    power: float = 0.0

    def ball(self) -> arb:
        """B as a ball."""
        if self.kind == "moment":
            return arb(self.weight) / arb(self.delta)
        share = arb(self.count) / arb(self.delta)
        if self.kind == "sharp":
            return 2 * arb(self._sharp(arb(self.power).expm1() * share))
        level = share.log()
        if self.kind == "cosh":
            return 2 * arb(2).log() + 2 * level
        return growth_ball(self.epsilon, self.dimension, level)

    def _sharp(self, target: arb) -> float:
        half, power = self.dimension / 2, arb(self.power)
        guess = solve_excess_one(self.power, half, float((target / power).log()), bessel=True)
        return solve_upward(lambda x: bessel_excess(arb(half), power * x), target, guess)


def sharp_tail(*, delta: float, dimension: float, count: float = 1.0) -> Tail:
    """The sharp tail (item 7.11) with its best k, found by golden section on log k."""
    half, level = dimension / 2, math.log(count) - math.log(delta)

    def size(x: float) -> float:
        power = math.exp(x)
        return solve_excess_one(power, half, log_phi_one(power) + level, bessel=True)

    # the best k is near the exponent of the growth bound, r^2/(2 V)
    middle = math.log(best_growth(dimension, max(level, 1e-6)) / 2)
    power = math.exp(golden(size, middle - 6.0, middle + 3.0, 1e-6))
    return Tail(kind="sharp", delta=delta, dimension=dimension, count=count, power=power)


@dataclass(frozen=True, eq=False, kw_only=True)
class RootProfile(MonotoneProfile):
    """sqrt(B) times the roots named by ``kind``."""

    tail: Tail  # B
    kind: str  # ``"variance"``, ``"scaled"``, ``"printed"`` (Thm 4 as printed) or ``"windows"`` (constant data)
    step: float = 0.0  # window length of ``"windows"``
    count: int = 1  # N = ceil(T/step) of ``"windows"``; the length is at least T/N whatever the rounding of ``step``

    def to_dict(self) -> dict[str, Any]:
        """Parameters as plain data."""
        return {"kind": self.kind, "step": self.step, "unit": self.schedule.unit, "tail": vars(self.tail)}

    @cached_property
    def _path(self) -> BallPath:
        if self.kind in ("scaled", "printed"):
            return ball_path(self.schedule, 1.0, bessel=True)
        return ball_path(self.schedule, 0.0)

    @cached_property
    def _root(self) -> arb:
        """unit sqrt(B), times sqrt(W_T) where the kind asks for it."""
        data = self.schedule
        with precision():
            square = self.tail.ball()
            if self.kind in ("scaled", "printed"):
                square *= self._path.nodes[1][0]
            if self.kind == "printed":
                square *= arb(float(data.slopes[0])) ** 2
            return arb(data.unit) * square.sqrt()

    @cached_property
    def _window(self) -> arb:
        """int_0^step sigma^2 e^{-2 c s} ds (CT); sigma^2 (L^{-2(step-1)} - 1)/(L^{-2} - 1) (DT)."""
        with precision():
            rate, noise = self._path.pieces[0]
            if self.schedule.continuous:
                length = arb.max(arb(self.step), arb(self.schedule.horizon) / self.count)
                return noise * integral(-2 * rate, length)
            inside = noise * integral(-2 * rate, arb(self.step) - 1)
            return inside * (2 * rate).exp()

    def point(self, piece: int, t: float) -> arb:
        """The radius: V_t and C_t are monotone on a piece."""
        square = self._path.at(piece, t)[0]
        root = arb.max(square, arb(0)).sqrt()
        if self.kind == "windows":
            root += self._window.sqrt()
        return self._root * root
