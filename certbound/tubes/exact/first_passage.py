"""Tubes of constant radius from first-passage laws, certified (Sec. 4 end, items 7.9 and 7.10 of docs/theory.md).

- ``exact``: the law of the linear isotropic system s -> c s, s -> L s with noise exactly sigma I, which dominates
  every system with these constants and ``isotropic=True``. The probability is bounded in
  :mod:`certbound.tubes.exact.supersolution` (CT) or :mod:`certbound.tubes.exact.recursion` (DT); where the latter would
  be too large, the chain is compared with the diffusion that has its law at whole steps.
- ``worst_case``: the exact worst case over g g^T <= sigma^2 I, tr <= nu sigma^2, state-dependent g included (CT).

Floating point finds the radius; the number that is compared with delta is a rigorous upper bound.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from flint import arb

from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.rigor.balls import lower, precision
from certbound.tubes.ballpath import integral
from certbound.tubes.constants import Constants
from certbound.tubes.exact.recursion import Recursion
from certbound.tubes.exact.supersolution import Supersolution
from certbound.tubes.question import Question
from certbound.tubes.schedule import Schedule, make_schedule
from certbound.tubes.tube import Tube

_LARGEST_CHAIN = 2.0e10
_MOST_KERNELS = 12
_MOST_ENTRIES = 5.0e7  # of one kernel: it and what it is made of take some two gigabytes
_OUTWARD = 180.0
"""K of the boundary in expanding systems: it costs about 0.8/K of the radius."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ConstantProfile:
    """The same radius at every time."""

    value: float
    horizon: float

    @property
    def times(self) -> Array:
        """One piece."""
        return np.array([0.0, self.horizon])

    def radius(self, t: Array) -> Array:
        """The radius."""
        return np.full(np.shape(t), self.value)

    def stretch(self, piece: int, start: float, end: float) -> tuple[float, float]:
        """The radius, twice."""
        return self.value, self.value

    def rough(self, piece: int, start: float, end: float) -> float:
        """The radius."""
        return self.value

    def to_dict(self) -> dict[str, Any]:
        """Parameters as plain data."""
        return {"kind": "constant", "radius": self.value}


def _backwards(schedule: Schedule) -> list[tuple[float, float, float]]:
    """(rate, noise, length) of every piece, the last one first."""
    return list(zip(schedule.rates.tolist(), schedule.noise.tolist(), schedule.lengths.tolist()))[::-1]


def _exact_pieces(schedule: Schedule, square: float) -> tuple[tuple[float, float], ...]:
    """(duration, kappa) per piece along a boundary y_b <= R^2 with y_b(T) = R^2; pieces without noise are left out.

    Where the rate is positive the boundary moves by y_b' = 2 c y_b + kappa sigma^2, kappa = -min(2 c y_b/sigma^2, K):
    far before the end it stands K^{1/2} standard deviations out, and who leaves there would leave R^2 as well.
    """
    pieces: list[tuple[float, float]] = []
    with precision():
        y = arb(square)
        for rate, noise, length in _backwards(schedule):
            if noise == 0 and rate > 0:
                raise InfeasibleError("`method` 'exact' needs noise wherever the rate is positive; use 'worst_case'.")
            if noise == 0:
                continue
            kappa = -2 * rate * float(y) / noise
            if kappa < -_OUTWARD:
                y, duration = _moved(y, rate, noise, length, -_OUTWARD)
                pieces.append((duration, -_OUTWARD))
            else:
                pieces.append((float(arb(noise) * arb(length) / y), kappa))
    return tuple(reversed(pieces))


def _moved(y: arb, rate: float, noise: float, length: float, kappa: float) -> tuple[arb, float]:
    """(y at the start, duration int sigma^2/y) of a piece with y' = 2 c y + kappa sigma^2 that ends at ``y``."""
    spread = arb(noise) * integral(-2 * arb(rate), arb(length))
    start = y * (-2 * arb(rate) * arb(length)).exp() - arb(kappa) * spread
    if not lower(start) > 0:
        return start, math.nan
    # y e^{-2 C} gains kappa * spread over the piece, and its logarithm gains kappa * duration
    return start, float((arb(kappa) * spread / start).log1p() / kappa if kappa != 0 else spread / start)


def _worst_pieces(schedule: Schedule, dimension: int, square: float) -> tuple[tuple[float, float], ...] | None:
    """(duration, kappa) per piece along y_b' = max(0, 2 c y_b + kappa_0 sigma^2), y_b(T) = R^2; None if y_b meets 0."""
    spin = min(schedule.nu, dimension - 1.0)
    kappa = spin + 0.1 if spin > 0 else 0.0  # a little faster than needed: the corner at the boundary then is smooth
    pieces: list[tuple[float, float]] = []
    with precision():
        y = arb(square)
        for rate, noise, length in _backwards(schedule):
            if 2 * arb(rate) * y + arb(kappa) * arb(noise) > 0:
                y, duration = _moved(y, rate, noise, length, kappa)
                if math.isnan(duration):
                    return None
                if noise > 0:
                    pieces.append((duration, kappa))
            elif noise > 0:
                pieces.append((float(arb(noise) * arb(length) / y), float(-2 * arb(rate) * y / arb(noise))))
    return tuple(reversed(pieces))


def _diffusion(
    constants: Constants, schedule: Schedule, radius: float, target: float, *, worst: bool, coarseness: float = 1.0
) -> Supersolution | None:
    """The normalised problem for a radius; None when the bound is 1."""
    square = (radius / schedule.unit) ** 2
    pieces = (
        _worst_pieces(schedule, constants.dimension, square) if worst else _exact_pieces(schedule, square)
    )  # fmt: skip
    if pieces is None:
        return None
    # an outward drift carries defects along: a finer mesh and a little more room
    outward = not worst and any(kappa < -1 for _, kappa in pieces)
    return Supersolution(
        pieces=pieces, dimension=constants.dimension, nu=schedule.nu, worst=worst, target=target,
        coarseness=coarseness * (0.6 if outward else 1.0), inflation=1e-3 if outward else 3e-4,
    )  # fmt: skip


def chain_of(constants: Constants, schedule: Schedule, radius: float) -> Recursion | None:
    """The recursion for a radius; None when it would be too large."""
    steps = np.round(schedule.lengths).astype(np.intp)
    if (
        np.any(schedule.sigmas == 0)
        or len(set(zip(schedule.slopes.tolist(), schedule.sigmas.tolist()))) > _MOST_KERNELS
    ):
        return None
    chain = Recursion(
        gains=schedule.slopes, sigmas=schedule.sigmas / schedule.unit, counts=steps, dimension=constants.dimension,
        radius=radius / schedule.unit,
    )  # fmt: skip
    small = chain.size**2 * float(steps.sum()) < _LARGEST_CHAIN and chain.entries < _MOST_ENTRIES
    return chain if small else None


def bound_exact_exit(constants: Constants, *, horizon: float, radius: float, target: float = 1e-3) -> float:
    """Upper bound of P(exists t <= T: ||S_t||_P > radius) for noise that is exactly isotropic.

    ``target`` is the expected size of the probability: it sets the mesh.

    Raises
    ------
    ValueError
        If the constants do not assert isotropic noise.

    Source: Sec. 4 end, item 7.9 of docs/theory.md.
    """
    _check_isotropic(constants)
    schedule = make_schedule(constants, horizon)
    if not schedule.continuous:
        chain = chain_of(constants, schedule, radius)
        if chain is not None:
            return chain.bound()
    problem = _diffusion(constants, schedule, radius, target, worst=False)
    return 1.0 if problem is None else problem.bound()


def bound_worst_exit(constants: Constants, *, horizon: float, radius: float, target: float = 1e-3) -> float:
    """Upper bound of P(exists t <= T: ||S_t||_P > radius) for all noise with g g^T <= sigma^2 I, tr <= nu sigma^2 (CT).

    Raises
    ------
    ValueError
        In discrete time.

    Source: item 7.9 of docs/theory.md.
    """
    _check_continuous(constants)
    problem = _diffusion(constants, make_schedule(constants, horizon), radius, target, worst=True)
    return 1.0 if problem is None else problem.bound()


def _check_isotropic(constants: Constants) -> None:
    if not constants.isotropic:
        raise ValueError(
            "`method` 'exact' needs `isotropic=True`: the noise must be exactly sigma I in the metric, not below it; "
            "use 'worst_case' (continuous time), 'mixture' or 'kummer'."
        )


def _check_continuous(constants: Constants) -> None:
    if not constants.continuous:
        raise ValueError("`method` 'worst_case' is for continuous time; use 'mixture' or 'kummer'.")


def first_passage_tube(question: Question, delta: float, *, worst: bool, above: float) -> Tube:
    """The tube of least constant radius: P(||S_t|| <= R for all t <= T) >= 1 - delta.

    The exact law needs ``isotropic=True``, the worst case continuous time; ``above`` is a radius that is known to be
    large enough: the search starts below it.

    Raises
    ------
    ValueError
        If the hypotheses fail.
    InfeasibleError
        If no radius up to ``above`` could be certified.

    Source: item 7.9 of docs/theory.md.
    """
    constants, schedule = question.constants, question.schedule
    (_check_continuous if worst else _check_isotropic)(constants)
    chained = not schedule.continuous and chain_of(constants, schedule, above) is not None

    def bound(radius: float, coarseness: float = 0.0) -> float:
        if chained:
            chain = chain_of(constants, schedule, radius)
            return 1.0 if chain is None else chain.bound()
        problem = _diffusion(constants, schedule, radius, delta, worst=worst, coarseness=coarseness or 1.0)
        if problem is None:
            return 1.0
        return problem.estimate() if coarseness else problem.bound()

    radius, value = _least_radius(bound, above, delta, coarseness=0.0 if chained else 4.0)
    profile = ConstantProfile(value=radius, horizon=schedule.horizon)
    return question.tube(
        "worst_case" if worst else "exact", delta, {"radius": radius, "probability": value}, profile
    )


def _least_radius(bound: Callable[..., float], above: float, delta: float, *, coarseness: float) -> tuple[float, float]:
    """About the least radius with bound(radius) <= delta: a search on coarse estimates, then certified steps."""
    target = math.log(delta)

    def log_estimate(x: float) -> float:
        return math.log(min(1.0, max(bound(math.exp(x), coarseness), 1e-300)))

    x = math.log(above) - 0.01
    fx, slope = log_estimate(x), -20.0
    for _ in range(12):
        new = x - min(max((fx - target) / -slope * -1, -0.25), 0.25)
        value = log_estimate(new)
        if new != x and (value - fx) / (new - x) < -0.5:
            slope = (value - fx) / (new - x)
        done = abs(new - x) < 2e-5
        x, fx = new, value
        if done:
            break
    y = x + (fx - target + (0.0 if coarseness == 0.0 else 0.04)) / -slope + 1e-7
    before: tuple[float, float] | None = None
    best: tuple[float, float] | None = None
    for _ in range(6):
        certified = bound(math.exp(y))
        level = math.log(certified) if certified > 0 else -math.inf
        if certified <= delta:
            retry = best is None and level < target - 0.01
            best = math.exp(y), certified
            if not retry:
                break
            y -= min(0.9 * (target - level) / -slope, 0.02)
            continue
        if best is not None:
            break
        if before is not None and level < before[1]:
            slope = max(slope, (level - before[1]) / (y - before[0]))
        before = y, level
        y += (1.1 * (level - target) + 1e-3) / -slope if certified < 1 else 0.02
    if best is not None:
        return best
    raise InfeasibleError(
        f"no constant radius near {math.exp(x):.6g} could be certified at delta = {delta:g} "
        f"(last bound {certified:.3g}); use 'kummer'."
    )
