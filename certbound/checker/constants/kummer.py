"""Thm K2 in ball arithmetic: the probability that ||S_t||_P ever exceeds given radii.

With E_a(z) = (1F1(a; nu/2; z) - 1)/a, phi(I) = (e^{a I} - 1)/a (their limits at a = 0) and I_t = int_t^T sigma^2/v,
v' = 2 c v + sigma^2 (in discrete time sums of log(v_{k+1}/(L_k^2 v_k)), v_{k+1} = L_k^2 v_k + sigma_k^2),

    P(exists t: ||S_t||_P > r_t) <= X / min_t [phi(I_t) + e^{a I_t} E_a(r_t^2/(2 v_t))],   X = phi(I_0).

Bessel form: v' = 2 c v (v_{k+1} = L_k^2 v_k, I_t = sum of sigma^2/v_{k+1}), E_a(z) = (0F1(; nu/2; a z) - 1)/a. A random
start of proxy s^2 in P's norm enters through X (item 7.4 of docs/theory.md).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce

from flint import arb

from certbound.checker.balls import upper
from certbound.checker.report import BALL, FUNCTION, Budget, Unproved, unlimited

MOST_POWER = 1e5
_LARGEST = arb(10) ** 7
_CLOSE, _MOST_PARTS = 0.998, 1024
_TERMS = 3000
_BLOCK = 50
"""Terms between two looks at the budget."""
_SERIES, _PER_POWER, _MOST_PAID = 100_000, 800, 2_000
"""Units of work of a hypergeometric function, and of each unit of its power up to a limit: 20 to 1,700 us measured."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Kummer:
    """The scalars of the proof: per piece rate c or gain L, sigma, length and radius (None: nothing is asked)."""

    continuous: bool
    bessel: bool
    a: arb
    v0: arb
    half: arb
    start: arb
    slopes: Sequence[arb]
    sigmas: Sequence[arb]
    lengths: Sequence[arb]
    radii: Sequence[arb | None]


def exit_probability(data: Kummer, budget: Budget) -> arb:
    """Upper bound of P(exists t: ||S_t||_P > r_t); `Unproved` where v_0 is too small for a random start.

    In discrete time radii[k] belongs to step k (radii[0] to the start), in continuous time to piece k.
    """
    v: list[arb] = [data.v0]
    steps: list[arb] = []
    for slope, sigma, length in zip(data.slopes, data.sigmas, data.lengths):
        budget.balls(120, BALL)
        after, step = _advance(data, v[-1], slope, sigma, length)
        v.append(after)
        steps.append(step)
    info: list[arb] = [arb(0)]
    for step in reversed(steps):
        info.append(info[-1] + step)
    info.reverse()
    found = _least_continuous(data, v, info, budget) if data.continuous else _least_discrete(data, v, info, budget)
    if found is None:
        return arb(0)
    first = _initial(data, info[0])
    if not found > 0:
        return arb(1)
    return upper(arb.min(first / found, arb(1)))


def _least_discrete(data: Kummer, v: list[arb], info: list[arb], budget: Budget) -> arb | None:
    """Lower bound of the least gain over the steps; None where nothing is asked."""
    least: arb | None = None
    excess = lower_excess(data, budget)
    for k, radius in enumerate(data.radii):
        budget.check()
        if radius is None:
            continue
        value = _gain(data, excess, info[k], radius * radius / (2 * v[k])) if radius > 0 else arb(0)
        least = value if least is None else arb.min(least, value)
    return least


def _least_continuous(data: Kummer, v: list[arb], info: list[arb], budget: Budget) -> arb | None:
    """The same over the pieces: I falls and v is monotone on a piece, and pieces are cut where that loses much."""
    excess = lower_excess(data, budget)
    bounds: dict[int, arb] = {}
    attained: arb | None = None
    for k, radius in enumerate(data.radii):
        if radius is None:
            continue
        if not radius > 0:
            return arb(0)
        bounds[k] = _least_on(data, excess, radius, (v[k], v[k + 1]), (info[k], info[k + 1]), k, 1, budget)
        value = _gain(data, excess, info[k + 1], radius * radius / (2 * v[k + 1]))
        attained = value if attained is None else arb.min(attained, value)
    if attained is None:
        return None
    for k, bound in bounds.items():
        budget.check()
        radius, parts = data.radii[k], 1
        assert radius is not None
        while bound < attained * _CLOSE and parts < _MOST_PARTS:
            parts *= 4
            bound = _least_on(data, excess, radius, (v[k], v[k + 1]), (info[k], info[k + 1]), k, parts, budget)
        bounds[k] = bound
    return reduce(arb.min, bounds.values())


def _advance(data: Kummer, v: arb, slope: arb, sigma: arb, length: arb) -> tuple[arb, arb]:
    """v at the end of a piece, and the piece's part of I."""
    square = sigma * sigma
    if data.continuous:
        grown, back = v * (2 * slope * length).exp(), square * growth_integral(-2 * slope, length) / v
        if data.bessel:
            return grown, back
        return grown + square * growth_integral(2 * slope, length), back.log1p()
    grown = slope * slope * v
    ratio = square / grown
    return (grown, ratio) if data.bessel else (grown + square, ratio.log1p())


def growth_integral(rate: arb, length: arb) -> arb:
    """int_0^length e^{rate s} ds."""
    if rate.is_zero():
        return length
    x = rate * length
    if abs(x) < 0.25:  # a series: rate may be a ball around 0 or tiny
        total = term = arb(1)
        for k in range(1, 60):
            term = term * x / (k + 1)
            total += term
        return length * (total + arb(0, arb(2) ** -200))
    return x.expm1() / rate


def _phi(data: Kummer, info: arb) -> arb:
    return info if data.a.is_zero() else (data.a * info).expm1() / data.a


def lower_excess(data: Kummer, budget: Budget | None = None) -> Callable[[arb], arb]:
    """Lower bound of E_a, which grows with z: large z are cut, and a partial sum of positive terms serves."""
    limits = unlimited() if budget is None else budget
    work = _SERIES + int(_PER_POWER * min(float(data.a), _MOST_PAID))

    def value(z: arb) -> arb:
        limits.balls(1, work)
        z = arb.min(z.lower(), _LARGEST)
        a, b = data.a, data.half
        if not a.is_zero():
            exact = (a * z).hypgeom_0f1(b) if data.bessel else z.hypgeom_1f1(a, b)
            if exact.is_finite() and exact.rel_accuracy_bits() > 20:
                return ((exact - 1) / a).lower()
        return partial_excess(data, z, limits)

    return value


def partial_excess(data: Kummer, z: arb, budget: Budget | None = None) -> arb:
    """Some of the terms of the series of E_a, which are all positive: the first ones, and those about the largest."""
    limits = unlimited() if budget is None else budget
    first = _terms(data, z, 1, z / data.half, limits)
    if not z > 0:
        return first
    a, b = float(data.a), float(data.half)
    x = float(z)
    peak = math.sqrt(a * x) if data.bessel else (x - b + math.sqrt((x - b) ** 2 + 4 * a * x)) / 2
    k = int(peak) - _TERMS // 2
    if k <= 1:
        return first
    log = k * z.log() - (arb(k) + 1).lgamma() - (data.half + k).lgamma() + data.half.lgamma()
    if data.bessel:
        log += (k - 1) * data.a.log()
    else:
        log += (data.a + k).lgamma() - (data.a + 1).lgamma()
    return arb.max(first, _terms(data, z, k, log.exp(), limits))


def _terms(data: Kummer, z: arb, start: int, first: arb, budget: Budget) -> arb:
    """Lower bound of the sum of terms from number ``start`` on, the first of which is given."""
    a, b, little = data.a, data.half, arb(2) ** -60
    total = term = first
    for k in range(start, start + _TERMS):
        if (k - start) % _BLOCK == 0:
            budget.balls(_BLOCK, 6 * BALL)
        term = term * z / ((b + k) * (k + 1))
        term = term * a if data.bessel else term * (a + k)
        total += term
        if term < total * little:
            break
    return total.lower()


def _gain(data: Kummer, excess: Callable[[arb], arb], info: arb, z: arb) -> arb:
    low = info.lower()
    return (_phi(data, low) + (data.a * low).exp() * excess(z)).lower()


def _least_on(
    data: Kummer, excess: Callable[[arb], arb], radius: arb, ends: tuple[arb, arb], info: tuple[arb, arb], k: int,
    parts: int, budget: Budget,
) -> arb:
    """Lower bound over a piece that is cut into equal parts."""
    square = radius * radius / 2
    slope, sigma, length = data.slopes[k], data.sigmas[k], data.lengths[k] / parts
    v, rest = ends[0], info[0]
    best: arb | None = None
    for _ in range(parts):
        budget.balls(1, 120 * BALL + 4 * FUNCTION)
        after, step = _advance(data, v, slope, sigma, length)
        rest = rest - step
        value = _gain(data, excess, arb.max(rest, info[1]), square / arb.max(v, after))
        best = value if best is None else arb.min(best, value)
        v = after
    assert best is not None
    return best


def _initial(data: Kummer, info: arb) -> arb:
    """X = (E h_0(S_0) - 1)/a."""
    if data.start.is_zero():
        return _phi(data, info)
    spread = data.start * data.start / data.v0
    if data.bessel:
        return _phi(data, info + spread)
    if not spread < 1:
        raise Unproved("v_0 is too small for the random start")
    return _phi(data, info - (-spread).log1p())
