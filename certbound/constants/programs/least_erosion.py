"""Tightening: the metric in which the tube erodes the constraints least, against the room that they leave.

What counts is r_t sqrt(a_j^T P^-1 a_j) against the room b_j(t) along a_j, with r_t the real tube radius at the
given horizon and delta, not c or L alone. For a fixed value (c or L^2) the metric solves a semidefinite program
with the rooms as data (Sec. 6 and 7.17 of docs/theory.md); the noise enters as sigma^2 g(nu), g the squared
radius at sigma = 1. g is concave, so that its tangent at the current nu majorises it and each round improves.
A scalar search runs over the value. All in floating point: the result is a proposal.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from certbound.arrays import Array
from certbound.constants.jacobians import JacobianSet
from certbound.constants.programs.centers import reachable_value
from certbound.constants.programs.lmi import ErosionProgram
from certbound.errors import SolverError
from certbound.tubes.constants import Constants
from certbound.tubes.excess import log_excess, log_phi
from certbound.tubes.schedule import make_schedule

_ROUNDS = 2
_LEAST = 1e-24  # L^2 of a map that forgets its state
_POWERS = np.exp(np.linspace(np.log(0.03), np.log(100.0), 9))
_STARTS = np.array([1.0, 0.3, 0.1, 0.03, 0.01])
_STEPS = np.array([0.55, 1.0, 1.8])
_NODES = 24
_LEAST_SQUARE = 1e-24  # stands for L^2 = 0


@dataclass(frozen=True, eq=False, kw_only=True)
class Rooms:
    """Directions of erosion, and the room along each over time.

    ``directions`` are matrices a (n, r): the erosion is r_t sqrt(lambda_max(a^T P^-1 a)). ``times``, shape (K,), rise
    and are positive, the last one is the horizon. ``rooms``, shape (len(directions), K), are the smallest on
    (times[k-1], times[k]]: positive, inf where the constraint does not hold.
    """

    directions: tuple[Array, ...]
    times: Array
    rooms: Array

    def coarse(self, count: int = _NODES) -> Rooms:
        """``count`` of the times, dense after the start: the tightest of each group, and of each direction missed."""
        if len(self.times) <= count:
            return self
        ends = np.unique(np.round(len(self.times) * np.linspace(0, 1, count + 1) ** 2).astype(int))
        smallest = np.min(self.rooms, axis=1, keepdims=True)
        tightness = np.min(self.rooms / smallest, axis=0)
        keep = [a + int(np.argmin(tightness[a:b])) for a, b in pairwise(ends)]
        missed = ~np.any(np.isfinite(self.rooms[:, keep]), axis=1)  # a short window beside a tighter direction
        keep = sorted({*keep, *np.argmin(self.rooms[missed], axis=1).tolist()})
        return Rooms(directions=self.directions, times=self.times[keep], rooms=self.rooms[:, keep])

    @property
    def constant(self) -> bool:
        """Whether no room changes over time."""
        return bool(np.all(self.rooms == self.rooms[:, :1]))

    def effective(self, shape: Array) -> Array:
        """Room per direction for a radius of the given shape over time, relative to its maximum."""
        return np.asarray((self.rooms / shape).min(axis=1))


class Fit(NamedTuple):
    """g, the smallest max_t r_t^2 / room_t^2 at sigma = 1, the slope of log g in nu, and the tube's a and v_0."""

    square: float
    slope: float
    a: float
    v0: float


@dataclass(frozen=True, kw_only=True)
class RadiusModel:
    """The Kummer tube (Thm K1) at sigma = 1 in floating point, its two parameters fitted to the room.

    ``gaussian``: every Kummer parameter is allowed with nu < n in discrete time.
    """

    continuous: bool
    dimension: int
    horizon: float
    delta: float
    gaussian: bool

    def fit(self, value: float, nu: float, times: Array, room: Array, near: Fit | None = None) -> Fit:
        """The best tube for a room over time, at c (continuous time) or L^2 (discrete time).

        ``times`` are positive, ``room``, shape (K,), is in units of sigma; the search starts from the parameters of
        ``near`` where that is given, and from a coarse grid otherwise.
        """
        here = min(max(nu, 0.05), float(self.dimension))
        level = 1 / max(-2 * value if self.continuous else 1 - value, 1 / self.horizon)
        powers, starts = _POWERS, level * _STARTS
        if near is not None:
            powers, starts = near.a * _STEPS**0.7, near.v0 * _STEPS**0.7
        best = Fit(np.inf, 0.0, 1.0, level)
        for steps in (_STEPS, _STEPS**0.4) if near is None else (_STEPS,):
            a, v0 = (grid.ravel() for grid in np.meshgrid(powers, starts))
            if not (self.continuous or self.gaussian or nu >= self.dimension):
                a = np.minimum(a, 0.499 * here)
            squares = self._squares(value, here, times, room, a, v0)
            index = int(np.argmin(squares))
            if squares[index] < best.square:
                best = Fit(float(squares[index]), 0.0, float(a[index]), float(v0[index]))
            powers, starts = best.a * steps, best.v0 * steps
        step = 0.02 * here if here * 1.02 <= self.dimension else -0.02 * here
        a, v0 = np.array([best.a * 0.97]), np.array([best.v0])  # 0.97: below nu/2 at both
        pair = [float(self._squares(value, x, times, room, a, v0)[0]) for x in (here, here + step)]
        slope = float(np.log(pair[1] / pair[0])) / step if np.isfinite(pair[0] + pair[1]) else 0.0
        return best._replace(slope=max(slope, 0.0))

    def variances(self, value: float, times: Array) -> Array:
        """Variance of the linear recursion at sigma = 1, shape (K,)."""
        rate = 2 * value if self.continuous else float(np.log(max(value, _LEAST)))
        growth = np.expm1(rate * times) if abs(rate) > 1e-12 else times
        scale = 1.0 if abs(rate) <= 1e-12 else (rate if self.continuous else float(np.expm1(rate)))
        return np.asarray(growth / scale)

    def _squares(self, value: float, nu: float, times: Array, room: Array, a: Array, v0: Array) -> Array:
        """max_t r_t^2 / room_t^2 for each (a, v0): Newton's method on the probability of Thm K2, log in log."""
        constants = Constants(
            rate=value if self.continuous else None,
            gain=None if self.continuous else float(np.sqrt(max(value, _LEAST))),
            sigma=1.0,
            dimension=self.dimension,
            effective_dimension=nu,
            gaussian=self.gaussian or self.continuous,
        )
        v, info = make_schedule(constants, self.horizon).refined(times).path(v0)
        places = np.searchsorted(np.concatenate([[0.0], times]), times)
        power = a[:, None]
        whole = info[:, :1]
        with np.errstate(all="ignore"):
            info, base = info[:, places], (room**2 / (2 * v[:, places]))
            goal = (np.log(whole) + log_phi(power * whole))[:, 0] - np.log(self.delta)
            spent = np.log(info) + log_phi(power * info)
            x = np.log(np.max(2 * v[:, places] * (nu / 2 + np.log(1 / self.delta)) / room**2, axis=-1))
            for _ in range(12):
                excess, slope = log_excess(power, nu / 2, np.exp(x)[:, None] * base)
                level = np.logaddexp(spent, power * info + excess)
                worst = np.argmin(level, axis=-1)
                rows = np.arange(len(x))
                share = np.exp(power * info + excess - level)[rows, worst]
                step = np.clip((goal - level[rows, worst]) / (slope[rows, worst] * share), -1.5, 1.5)
                x = x + step
                if not np.any(np.abs(step) >= 1e-4):  # nan: out of range, and counted as endless below
                    break
            return np.asarray(np.nan_to_num(np.exp(x), nan=np.inf))


@dataclass(frozen=True, eq=False, kw_only=True)
class TightMetric:
    """A proposed metric, its c or L^2, and the largest erosion over room that it promises."""

    metric: Array
    value: float
    ratio: float
    status: str


class _Search:
    """One semidefinite program, solved for many values."""

    def __init__(
        self,
        jacobians: JacobianSet,
        targets: Rooms,
        noise: Sequence[Array],
        model: RadiusModel,
        start: Array,
        form: str,
    ) -> None:
        self.targets, self.noise, self.model = targets, noise, model
        self.program = ErosionProgram(
            jacobians, targets.directions, noise, start, continuous=model.continuous, form=form
        )
        self.best: TightMetric | None = None
        self.failures: list[str] = []
        value = _reached(start, jacobians, model)
        _, self.nu, self.fit = self.evaluate(start, value, None)

    def weights(self, value: float, steepness: float) -> Array:
        """Rooms that a radius growing like a power of the standard deviation leaves.

        SolverError where the standard deviation overflows within the horizon.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            spread = self.model.variances(value, self.targets.times)
        if not np.all(np.isfinite(spread)) or not spread.max() > 0:
            raise SolverError(f"the deviation overflows at the value {value:.3g} within the horizon.")
        return self.targets.effective((spread / spread.max()) ** (steepness / 2))

    def evaluate(self, metric: Array, value: float, near: Fit | None) -> tuple[float, float, Fit]:
        """(erosion over room, nu, fit) of a metric with the given c or L^2."""
        sigma2, nu = noise_numbers(metric, self.noise)
        factors = erosion_factors(metric, self.targets.directions) * np.sqrt(sigma2)
        room = (self.targets.rooms / factors[:, None]).min(axis=0)
        fit = self.model.fit(value, nu, self.targets.times, room, near)
        return float(np.sqrt(fit.square)), nu, fit

    def __call__(self, value: float, steepness: float) -> float:
        """Erosion over room at a fixed value: majorise and minimise over nu."""
        least = np.inf
        try:
            for _ in range(_ROUNDS):
                alpha = max(1 - self.fit.slope * self.nu, 0.0)
                total = alpha + self.fit.slope * self.nu
                metric = self.program.propose(
                    value, alpha / total, self.fit.slope / total, self.weights(value, steepness)
                )
                if float(np.linalg.eigvalsh(metric)[0]) <= 0:
                    raise SolverError("the semidefinite program returned an indefinite metric.")
                ratio, nu, fit = self.evaluate(metric, value, self.fit)
                moved = abs(nu - self.nu) * fit.slope
                if self.best is None or ratio < self.best.ratio:
                    self.best = TightMetric(metric=metric, value=value, ratio=ratio, status=self.program.status)
                    self.nu, self.fit = nu, fit
                least = min(least, ratio)
                if moved < 0.02:
                    break
        except SolverError as error:
            self.failures.append(str(error))
        return least


def tighten(
    jacobians: JacobianSet,
    targets: Rooms,
    noise: Sequence[Array],
    model: RadiusModel,
    start: Array,
    *,
    form: str = "auto",
) -> TightMetric:
    """The metric of least max_t,j erosion_j(t) / room_j(t), searched from a metric ``start`` of nearly least c or L.

    ``noise`` are the noise matrices (n, m) at unit proxy, ``form`` is that of `lmi_blocks`. SolverError where no value
    could be solved for.
    """
    search = _Search(jacobians, targets.coarse(), noise, model, start, form)
    least = _reached(start, jacobians, model)
    scale = abs(least if model.continuous else 1 - least) + 1 / model.horizon
    steep, shift = 1.0, -4.0

    def at(shift: float, steepness: float) -> float:
        return search(least + scale * float(np.exp(shift)), steepness)

    if not targets.constant:
        steep = _smallest(lambda s: at(shift, s), (0.6, 0.9, 1.1, 1.35), 0.08)
    shift = _smallest(lambda x: at(x, steep), (-5.5, -4.0, -2.5, -1.0), 0.5)
    if not targets.constant:
        _smallest(lambda s: at(shift, s), (steep - 0.12, steep, steep + 0.12), 0.04)
    if search.best is None:
        raise SolverError(f"the tightening found no metric: {search.failures[-1]}")
    return search.best


def _reached(metric: Array, jacobians: JacobianSet, model: RadiusModel) -> float:
    """c or L^2 that a metric reaches; a map without slope counts as one of gain 1e-12, since tubes exclude 0."""
    value = reachable_value(metric, jacobians, continuous=model.continuous)
    return value if model.continuous else max(value, _LEAST_SQUARE)


def _smallest(function: Callable[[float], float], points: Sequence[float], resolution: float) -> float:
    """Scalar search: the smallest of a few points, then halving steps around it."""
    known = {x: function(x) for x in points}
    best = min(known, key=lambda x: known[x])
    step = max(abs(points[1] - points[0]), resolution) / 2
    while step >= resolution:
        for x in (best - step, best + step):
            known[x] = function(x)
        best = min(known, key=lambda x: known[x])
        step /= 2
    return best


def noise_numbers(metric: Array, noise: Sequence[Array]) -> tuple[float, float]:
    """sigma^2 and nu in a metric, in floating point."""
    squares, traces = [0.0], [0.0]
    for G in noise:
        inner = G.T @ metric @ G
        squares.append(float(np.linalg.eigvalsh(inner)[-1]))
        traces.append(float(np.trace(inner)))
    sigma2 = max(squares)
    return (sigma2, max(traces) / sigma2) if sigma2 > 0 else (0.0, 1.0)


def erosion_factors(metric: Array, directions: Sequence[Array]) -> Array:
    """sqrt(lambda_max(a^T P^-1 a)) for each direction, in floating point."""
    inverse = np.linalg.inv(metric)
    return np.array([np.sqrt(np.linalg.eigvalsh(a.T @ inverse @ a)[-1]) for a in directions])
