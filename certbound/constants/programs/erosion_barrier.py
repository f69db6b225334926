"""Metrics of least erosion by Newton's method on a barrier: P, the multipliers and the value searched at once.

With the value v (c, or L^2) as a variable, and symbols of ``centers``, what is minimised is

    log q(P) + (alpha t + beta tr G'PG)/N_0 + log g(v)  -  mu [log det F(v, P, Lambda) + log det(t I - G'PG)]

where q is a smooth maximum of a_j' P^-1 a_j / room_j^2 and g(v) the squared radius of the real tube, followed to
second order in log(v - v_0) between two fits; alpha and beta majorise the concave dependence of g on nu as in
``least_erosion``. For fixed v the function is convex. Everything is evaluated again from P in floating point, and
what comes out is a proposal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from certbound.arrays import Array
from certbound.constants.programs.barrier_blocks import Block, Pairs
from certbound.constants.programs.least_erosion import (
    Fit,
    RadiusModel,
    Rooms,
    TightMetric,
    erosion_factors,
    noise_numbers,
)
from certbound.constants.programs.sectors import Sector
from certbound.watch import poll

_POWER = 16.0
"""Of the mean that stands for the tightest of several directions."""
_STAGES = (64.0, 8.0, 1.0)
"""Barrier weights mu, one stage each, in units of the last."""
_LAST = 0.012
"""The last weight times the order of the barrier: what is lost of log q there."""
_NEWTON = 12
"""Steps of a stage."""
_CENTRED = 1.5
"""Newton decrement (in units of sqrt(mu)) at which a stage ends."""
_FARTHEST = 0.5
"""How far log(v - v_0) may go in a step."""
_SHIFTS = np.linspace(-6.0, 2.0, 9)
"""Where log g is tabulated."""
_STEPS = 2.0 ** np.arange(3.0, -16.0, -0.5)


class Point(NamedTuple):
    """Where a search stands; ``shift`` is log of v - v_0 in units of the scale."""

    P: Array  # (n, n)
    multipliers: Array  # (k,)
    top: float  # t > lambda_max(G' P G)
    shift: float


class _Tube(NamedTuple):
    """What the real tube says near a point: weights of the noise, log g to second order in the shift, rooms."""

    alpha: float
    beta: float
    level: Any  # log g as a function of the shift: a cubic spline
    columns: Array  # (n, directions): each over its room


@dataclass(frozen=True, eq=False)
class _Value:
    """A function value with its derivatives in (P, multipliers, t, shift)."""

    gradient: Array
    hessian: Array


class ErosionBarrier:
    """The least erosion over room of one sector set; ``least`` is v_0, a value that some metric comes close to.

    ``noise`` are the matrices (n, m) at unit proxy, all of which the metric must serve. The best metric so far, by its
    own tube, is in ``best``.
    """

    def __init__(
        self, block: Sector, targets: Rooms, noise: Sequence[Array], model: RadiusModel, least: float
    ) -> None:
        self.block = Block(block, continuous=model.continuous)
        self.pairs = Pairs(self.block.n)
        self.targets, self.model, self.least = targets.coarse(), model, least
        self.noise = [G[:, G.any(axis=0)] for G in noise if G.any()]
        self.scale = abs(least if model.continuous else 1 - least) + 1 / model.horizon
        self.best: TightMetric | None = None
        self._fit: Fit | None = None
        self._level: Any = None
        self._columns: list[Array] = []

    def value(self, shift: float) -> float:
        """c or L^2 at a shift."""
        return self.least + self.scale * float(np.exp(shift))

    def start(self, P: Array, multipliers: Array, shift: float) -> Point | None:
        """A point from a metric and its multipliers; the shift is raised until they are strictly feasible there."""
        sigma2, _ = noise_numbers(P, self.noise)
        for _ in range(12):
            point = Point(P / sigma2, multipliers / sigma2, 1.5, shift)
            if np.isfinite(self._barrier(point)):
                return point
            shift += 0.4
        return None

    def search(self, point: Point, stages: Sequence[float] = _STAGES) -> Point:
        """Improve a strictly feasible point; the point near the end of the path is returned."""
        order = self.block.n + self.block.k + sum(G.shape[1] for G in self.noise)
        for mu in np.array(stages) * _LAST / order:
            tube = self._followed(point)
            if tube is None:
                break
            point = self._centre(point, tube, mu)
        self._followed(point)
        return point

    def _centre(self, point: Point, tube: _Tube, mu: float) -> Point:
        """Damped Newton steps at one barrier weight."""
        here = self._merit(point, tube, mu)
        for _ in range(_NEWTON):
            poll()
            found = self._derivatives(point, tube, mu)
            direction = _descent(found, mu)
            if direction is None:
                return point
            moved, there = self._line(point, here, direction, tube, mu)
            slope = -float(found.gradient @ direction)
            if moved is None or here - there < 1e-3 * mu:
                break
            point, here = moved, there
            if slope < _CENTRED**2 * mu:
                break
        return point

    def _line(self, point: Point, here: float, direction: Array, tube: _Tube, mu: float) -> tuple[Point | None, float]:
        """The best of some step lengths: a merit costs next to nothing beside a Hessian."""
        best, least = None, here
        for length in _STEPS:
            if length * abs(float(direction[-1])) > _FARTHEST and length > _STEPS[-1] * 2:
                continue
            moved = self._moved(point, direction, float(length))
            there = self._merit(moved, tube, mu)
            if there < least:
                best, least = moved, there
            elif best is not None:
                break
        return best, least

    def _moved(self, point: Point, direction: Array, length: float) -> Point:
        size, k = self.pairs.size, self.block.k
        return Point(
            point.P + length * self.pairs.matrix(direction[:size]),
            point.multipliers + length * direction[size : size + k],
            point.top + length * float(direction[-2]),
            point.shift + length * float(direction[-1]),
        )

    def _merit(self, point: Point, tube: _Tube, mu: float) -> float:
        if not _SHIFTS[0] <= point.shift <= _SHIFTS[-1]:
            return float(np.inf)
        barrier = self._barrier(point)
        if not np.isfinite(barrier):
            return float(np.inf)
        q, _, _ = self._reaches(point.P, tube)
        trace = sum(float(np.sum(G * (point.P @ G))) for G in self._widest(point.P))
        return (
            float(np.log(np.sum(q**_POWER)) / _POWER)
            + tube.alpha * point.top
            + tube.beta * trace
            + float(tube.level(point.shift))
            + mu * barrier
        )

    def _barrier(self, point: Point) -> float:
        """-log det of what must be positive definite; inf where it is not."""
        matrices = [point.P, self.block.matrix(self.value(point.shift), point.P, point.multipliers)]
        matrices += [point.top * np.eye(G.shape[1]) - G.T @ point.P @ G for G in self.noise]
        total = 0.0
        for place, matrix in enumerate(matrices):
            try:
                part = float(np.log(np.diagonal(np.linalg.cholesky(matrix))).sum())
            except np.linalg.LinAlgError:
                return float(np.inf)
            total -= 2 * part if place else 0.0
        return total

    def _widest(self, P: Array) -> list[Array]:
        """The noise matrix of the largest trace."""
        return [max(self.noise, key=lambda G: float(np.sum(G * (P @ G))))]

    def _reaches(self, P: Array, tube: _Tube) -> tuple[Array, Array, Array]:
        """q_j = a_j' P^-1 a_j / room_j^2 for all columns, u_j = P^-1 a_j / room_j, and P^-1."""
        inverse = np.linalg.inv(P)
        inverse = (inverse + inverse.T) / 2
        u = inverse @ tube.columns
        return np.maximum(np.sum(tube.columns * u, axis=0), 1e-300), u, inverse

    def _derivatives(self, point: Point, tube: _Tube, mu: float) -> _Value:
        size, k = self.pairs.size, self.block.k
        gradient, hessian = np.zeros(size + k + 2), np.zeros((size + k + 2, size + k + 2))
        self._add_sector(point, gradient, hessian)
        self._add_noise(point, gradient, hessian)
        gradient *= mu
        hessian *= mu
        self._add_objective(point, tube, gradient, hessian)
        upper = np.triu_indices(len(gradient), 1)
        hessian[upper[1], upper[0]] = hessian[upper]
        return _Value(gradient, hessian)

    def _add_sector(self, point: Point, gradient: Array, hessian: Array) -> None:
        """-log det F with respect to P, the multipliers and the shift (upper triangle)."""
        block, pairs, n, size, k = self.block, self.pairs, self.block.n, self.pairs.size, self.block.k
        value = self.value(point.shift)
        W = np.linalg.inv(block.matrix(value, point.P, point.multipliers))
        W = (W + W.T) / 2
        here = slice(size, size + k)
        block.add_barrier(value, W, pairs, here, gradient, hessian)
        rate = (2.0 if block.continuous else 1.0) * (value - self.least)  # d(v)/d(shift), times the factor of E'PE
        WE = W[:n] @ np.eye(n, n + k).T
        gain = rate * float(np.sum(WE * point.P))
        V = rate * W[:, :n] @ point.P @ W[:n]
        gradient[-1] -= gain
        hessian[-1, -1] += rate * float(np.sum(V[:n, :n] * point.P)) - gain
        hessian[here, -1] += np.diag(block.Qhat @ V @ block.Qhat.T) - np.diag(block.Chat @ V @ block.Chat.T)
        hessian[:size, -1] -= rate * pairs.gradient(WE)
        for c, X, Y in block.terms(value):
            hessian[:size, -1] += c * pairs.gradient(Y @ V @ X.T)

    def _add_noise(self, point: Point, gradient: Array, hessian: Array) -> None:
        """-log det(t I - G'PG) with respect to P and t (upper triangle)."""
        pairs, size = self.pairs, self.pairs.size
        for G in self.noise:
            W = np.linalg.inv(point.top * np.eye(G.shape[1]) - G.T @ point.P @ G)
            spread = G @ W @ G.T
            gradient[:size] += pairs.gradient(spread)
            gradient[-2] -= float(np.trace(W))
            hessian[:size, :size] += pairs.hessian(spread, spread)
            hessian[:size, -2] -= pairs.gradient(G @ W @ W @ G.T)
            hessian[-2, -2] += float(np.sum(W * W))

    def _add_objective(self, point: Point, tube: _Tube, gradient: Array, hessian: Array) -> None:
        """log q, the noise and log g."""
        pairs, size = self.pairs, self.pairs.size
        q, u, inverse = self._reaches(point.P, tube)
        shares = (q / q.max()) ** _POWER
        shares /= shares.sum()
        slopes = []
        for share, level, column in zip(shares, q, u.T):
            if share < 1e-6:
                continue
            slope = -pairs.gradient(np.outer(column, column)) / level
            slopes.append((share, slope))
            hessian[:size, :size] += (2 * share / level) * pairs.hessian(np.outer(column, column), inverse)
            hessian[:size, :size] += (_POWER - 1) * share * np.outer(slope, slope)
        mean = np.sum([share * slope for share, slope in slopes], axis=0)
        hessian[:size, :size] -= _POWER * np.outer(mean, mean)
        gradient[:size] += mean
        for G in self._widest(point.P):
            gradient[:size] += tube.beta * pairs.gradient(G @ G.T)
        gradient[-2] += tube.alpha
        gradient[-1] += float(tube.level(point.shift, 1))
        hessian[-1, -1] += float(tube.level(point.shift, 2))

    def _followed(self, point: Point) -> _Tube | None:
        """The real tube at a point, whose metric is noted; None where it overflows."""
        P, value = point.P, self.value(point.shift)
        sigma2, nu = noise_numbers(P, self.noise)
        factors = erosion_factors(P, self.targets.directions) * np.sqrt(sigma2)
        room = (self.targets.rooms / factors[:, None]).min(axis=0)
        fit = self.model.fit(value, nu, self.targets.times, room, self._fit)
        if not np.isfinite(fit.square):
            return None
        self._fit = fit
        ratio = float(np.sqrt(fit.square))
        if self.best is None or ratio < self.best.ratio:
            self.best = TightMetric(metric=P, value=value, ratio=ratio, status="barrier")
        if self._level is None:
            self._level = self._tabulated(nu, room)
        alpha = max(1 - fit.slope * nu, 0.0)
        share = 1 / (sigma2 * (alpha + fit.slope * nu))
        with np.errstate(all="ignore"):
            spread = np.sqrt(self.model.variances(value, self.targets.times))
            rooms = self.targets.effective(spread / spread.max())
        self._columns += self._widest_columns(P, rooms)
        return _Tube(alpha * share, fit.slope * share, self._level, np.concatenate(self._columns, axis=1))

    def _widest_columns(self, P: Array, rooms: Array) -> list[Array]:
        """Each direction over its room; of a round one, a (n, r), the axes of a' P^-1 a are added time after time."""
        found = []
        for a, room in zip(self.targets.directions, rooms):
            if a.shape[1] > 1:
                found.append(a @ np.linalg.eigh(a.T @ np.linalg.solve(P, a))[1] / room)
            elif not self._columns:
                found.append(a / room)
        return found

    def _tabulated(self, nu: float, room: Array) -> Any:
        """log g over the shifts, at one nu and one shape of the room over time."""
        from scipy.interpolate import CubicSpline

        levels, fit = [], self._fit
        for shift in _SHIFTS:
            fit = self.model.fit(self.value(shift), nu, self.targets.times, room, fit)
            levels.append(np.log(fit.square) if np.isfinite(fit.square) else np.inf)
        known = np.isfinite(levels)
        found = np.where(known, levels, np.max(np.array(levels)[known], initial=0.0) + 20.0)
        return CubicSpline(_SHIFTS, found)


def _descent(found: _Value, mu: float) -> Array | None:
    """The Newton direction; the curvature along the shift (the last entry), where it is not convex, is made so."""
    from scipy.linalg import cho_factor, cho_solve

    inner, cross = found.hessian[:-1, :-1], found.hessian[:-1, -1]
    for damping in (1e-13, 1e-10, 1e-7, 1e-4):
        try:
            factor = cho_factor(inner + damping * np.diag(np.diag(inner)))
        except np.linalg.LinAlgError:
            continue
        both = cho_solve(factor, np.stack([found.gradient[:-1], cross], axis=1))
        curvature = max(abs(float(found.hessian[-1, -1] - cross @ both[:, 1])), mu)
        shift = -float(found.gradient[-1] - cross @ both[:, 0]) / curvature
        return np.append(-both[:, 0] - shift * both[:, 1], shift)
    return None
