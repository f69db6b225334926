"""The Kummer tube and its Bessel form (Thms K1 and K2 of docs/theory.md).

With F_a(z) = 1F1(a; nu/2; z), A_t = e^{a I_t} and h_t(S) = A_t F_a(||S||^2/(2 v_t)), the process h_t(S_t) - 1 is a
nonnegative supermartingale for every a > 0 and v_0 > 0. Everything is divided by a, so that a = 0 is allowed (item
7.13): with E_a = (F_a - 1)/a and phi(I) = (e^{a I} - 1)/a,

- K1: r_t = sqrt(2 v_t z_t), E_a(z_t) = e^{-a I_t} (X/delta - phi(I_t)), X = phi(I_0) when S_0 = 0;
- K2: P(exists t: ||S_t|| > r_t) <= X / min_t [phi(I_t) + e^{a I_t} E_a(r_t^2/(2 v_t))].

The Bessel form is the limit a -> infinity with a/v fixed: v' = 2 c v, F_a(z) replaced by 0F1(; nu/2; a z).
With ||S_0|| <= start plus an isotropic sub-Gaussian part of proxy std start_sigma (item 7.4),
X = (E[h_0(S_0)] - 1)/a.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from flint import arb

from certbound.arrays import Array
from certbound.rigor.balls import bessel_excess, excess_floor, kummer_excess, lower, precision, solve_upward, upper
from certbound.tubes.ballpath import BallPath, ball_path
from certbound.tubes.constants import Constants, check_delta
from certbound.tubes.excess import log_excess_one, log_phi, log_phi_one, solve_excess, solve_excess_one
from certbound.tubes.piecewise import PiecewiseProfile
from certbound.tubes.question import Question, Start
from certbound.tubes.schedule import Schedule
from certbound.tubes.tube import Tube

_LARGEST_EXPONENT = 1e8


def log_initial(schedule: Schedule, a: float, v0: float, info: float, start: Start, bessel: bool) -> float:
    """log X in floating point; inf where v_0 is too small for the random part of the start."""
    unit = schedule.unit
    spread = (start.sigma / unit) ** 2
    v = v0
    if spread > 0:
        if not bessel and spread >= v0:
            return math.inf
        info += spread / v0 if bessel else -math.log1p(-spread / v0)
        v = v0 if bessel else v0 - spread
    base = math.log(info) + log_phi_one(a * info) if info > 0 else -math.inf
    if start.offset == 0:
        return base
    offset = log_excess_one(a, schedule.nu / 2, (start.offset / unit) ** 2 / (2 * v), bessel=bessel)[0]
    return float(np.logaddexp(base, a * info + offset))


def log_target(a: Any, info: Any, log_x: Any, log_delta: float) -> Any:
    """log of e^{-a I_t} (X/delta - phi(I_t)) in floating point; X >= phi(I_0) >= phi(I_t), whatever rounding says."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        level = log_x - log_delta
        spent = np.log(info) + log_phi(a * info) - level
        return level + np.log1p(-np.exp(np.minimum(spent, log_delta))) - a * info


@dataclass(frozen=True, eq=False, kw_only=True)
class KummerProfile(PiecewiseProfile):
    """Radius of Thm K1 for given a and v_0 (``v0`` in units of ``schedule.unit``^2)."""

    a: float
    v0: float
    delta: float
    bessel: bool = False
    start: Start = field(default_factory=Start)

    def to_dict(self) -> dict[str, Any]:
        """Parameters as plain data; ``v0`` is in units of ``unit``^2."""
        return {
            "kind": "bessel" if self.bessel else "kummer", "a": self.a, "v0": self.v0, "unit": self.schedule.unit,
            "delta": self.delta, "start": self.start.offset, "start_sigma": self.start.sigma,
        }  # fmt: skip

    def radius(self, t: Array) -> Array:
        """Floating-point radius; in balls where a I_0 is so large that floats lose the difference of exponents."""
        data = self.schedule
        whole = float(data.path(np.asarray(self.v0), bessel=self.bessel)[1][0])
        if not self.a * whole < _LARGEST_EXPONENT:
            places = zip(data.locate(t).ravel().tolist(), t.ravel().tolist())
            return np.array([self.stretch(piece, s, s)[0] for piece, s in places]).reshape(t.shape)
        v, info = data.path_at(self.v0, t, bessel=self.bessel)
        log_x = log_initial(data, self.a, self.v0, whole, self.start, self.bessel)
        target = log_target(self.a, info, log_x, math.log(self.delta))
        z = solve_excess(np.asarray(self.a), data.nu / 2, target, bessel=self.bessel)
        with np.errstate(over="ignore"):
            radius = data.unit * np.sqrt(2 * v * z)
        if not data.continuous and self.start.sigma == 0:
            radius = np.where(t == 0, self.start.offset, radius)
        return np.asarray(radius)

    def stretch(self, piece: int, start: float, end: float) -> tuple[float, float]:
        """v is monotone on a piece and z_t rises: sup r <= sqrt(2 max(v_s, v_e) z_e)."""
        data = self.schedule
        if not data.continuous and self.start.sigma == 0 and start == 0:
            if end == 0:
                return self.start.offset, self.start.offset
            bound, value = self.stretch(piece, 1.0, end)
            return max(bound, self.start.offset), value
        with precision():
            v_end, info = self.path.at(piece, end)
            v_start = self.path.at(piece, start)[0] if start < end else v_end
            z = self._level(info)
            unit = arb(data.unit)
            last = unit * (2 * v_end * z).sqrt()
            largest = unit * (2 * arb.max(v_start, v_end) * z).sqrt()
            return upper(largest), lower(last)

    def rough(self, piece: int, start: float, end: float) -> float:
        """The same with z at one of a few later nodes, where it is larger."""
        count = len(self.schedule.lengths)
        stride = max(1, count // 16)
        node = min(count, (piece // stride + 1) * stride)
        with precision():
            if node not in self._milestones:
                self._milestones[node] = self._level(self.path.nodes[1][node])
            z = self._milestones[node]
            ends = [self.path.at(piece, t)[0] for t in (start, end)]
            return upper(arb(self.schedule.unit) * (2 * arb.max(*ends) * z).sqrt())

    @cached_property
    def path(self) -> BallPath:
        """v and I in ball arithmetic."""
        return ball_path(self.schedule, self.v0, bessel=self.bessel)

    @cached_property
    def initial(self) -> arb:
        """Ball of X."""
        with precision():
            return initial_ball(self.path, self.a, self.start)

    @cached_property
    def _milestones(self) -> dict[int, arb]:
        return {}

    @cached_property
    def _known(self) -> dict[float, arb]:
        return {}

    def _level(self, info: arb) -> arb:
        """Float z (as a ball) with E_a(z) >= the target proved."""
        key = float(info)
        a = arb(self.a)
        spent = phi_ball(a, info)
        target = (self.initial / arb(self.delta) - spent) * (-a * info).exp()
        if target.is_zero():  # no noise, and a start at 0: E_a(0) = 0
            return arb(0)
        if not (target > 0):
            return arb.pos_inf()
        known = self._known.get(key)
        excess = excess_function(self.a, self.schedule.nu / 2, self.bessel)
        if known is None or not (excess(known) >= target):
            near = self._known.get(min(self._known, key=lambda other: abs(other - key), default=key))
            guess = solve_excess_one(
                self.a, self.schedule.nu / 2, float(target.log()), bessel=self.bessel,
                guess=0.0 if near is None else float(near),
            )  # fmt: skip
            known = arb(solve_upward(excess, target, guess))
            self._known[key] = known
        return known


def excess_function(a: float, b: float, bessel: bool) -> Callable[[arb], arb]:
    """Lower bound of E_a, or of its Bessel companion, as a function of balls: sharp where it is within reach."""
    power, half = arb(a), arb(b)
    return lambda z: excess_floor(power, half, z, bessel=bessel)


def phi_ball(a: arb, info: arb) -> arb:
    """(e^{a I} - 1)/a, and I at a = 0."""
    return info if a.is_zero() else (a * info).expm1() / a


def initial_ball(path: BallPath, a: float, start: Start) -> arb:
    """Ball of X = (E[h_0(S_0)] - 1)/a."""
    data = path.schedule
    unit, power = arb(data.unit), arb(a)
    info, v = path.nodes[1][0], path.start
    spread = (arb(start.sigma) / unit) ** 2
    if start.sigma > 0:
        if path.bessel:
            info += spread / v
        else:
            if not (v > spread):
                return arb.pos_inf()
            info -= (-spread / v).log1p()
            v -= spread
    base = phi_ball(power, info)
    if start.offset > 0:
        z = (arb(start.offset) / unit) ** 2 / (2 * v)
        half = arb(data.nu / 2)
        excess = bessel_excess(half, power * z) / power if path.bessel else kummer_excess(power, half, z)
        base += (power * info).exp() * excess
    return base


def kummer_tube(
    constants: Constants,
    *,
    horizon: float,
    delta: float,
    a: float,
    v0: float,
    bessel: bool = False,
    start: Start | None = None,
) -> Tube:
    """The tube of Thm K1 for stated a and v_0: P(||S_t|| <= r_t for all t <= T) >= 1 - delta.

    Parameters
    ----------
    constants : Constants
        Rate or gain, sigma, effective dimension.
    horizon : float
        T in s, or in whole steps.
    delta : float
        Probability of leaving the tube, in (0, 1).
    a : float
        Kummer parameter, a >= 0 (0 is the limit of item 7.13); a < nu/2 for sub-Gaussian noise with nu < n in DT.
    v0 : float
        Start of v, positive, in squared units of the state. In the Bessel form a/v0 alone matters.
    bessel : bool
        The Bessel form (a > 0).
    start : Start, optional
        Deviation at time 0.

    Raises
    ------
    ValueError
        If a parameter is outside its range.

    Source: Thm K1, items 7.4, 7.13 and 7.14 of docs/theory.md.

    Examples
    --------
    >>> constants = Constants(rate=-0.5, sigma=0.1**0.5, dimension=1)
    >>> tube = kummer_tube(constants, horizon=5.0, delta=1e-3, a=0.3, v0=0.1)
    >>> 1.2 < tube.maximum < 1.4
    True
    """
    delta = check_delta(delta)
    question = Question.of(constants, horizon, clearance=math.inf, start=start)  # no radius is asked for
    schedule = question.schedule
    check_power(schedule, a, bessel=bessel)
    if not (math.isfinite(v0) and v0 > 0):
        raise ValueError(f"`v0` must be positive and finite, got {v0}.")
    profile = KummerProfile(
        schedule=schedule, a=float(a), v0=v0 / schedule.unit**2, delta=delta, bessel=bessel, start=question.start
    )
    return question.tube("bessel" if bessel else "kummer", delta, {"a": float(a), "v0": float(v0)}, profile)


def check_power(schedule: Schedule, a: float, *, bessel: bool) -> None:
    """Refuse a outside the range that Thm K1 proves."""
    if not (math.isfinite(a) and a >= 0) or (bessel and a == 0):
        raise ValueError(f"`a` must be finite and {'positive' if bessel else 'not negative'}, got {a}.")
    if not schedule.any_power and (bessel or a >= schedule.nu / 2):
        got = "the Bessel form (a = infinity)" if bessel else f"{a}"
        raise ValueError(
            f"`a` must be below nu/2 = {schedule.nu / 2:g} for sub-Gaussian noise with nu < n in discrete time, "
            f"got {got}; state `gaussian=True` if the noise is Gaussian, or `effective_dimension=None`."
        )
