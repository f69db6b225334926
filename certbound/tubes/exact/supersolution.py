"""Exit probability of the radial diffusion, bounded rigorously by a supersolution (CT; item 7.9 of docs/theory.md).

If u >= 0 on [0, T] x [0, r_t], u(t, r_t) >= 1 and -u_t >= H[u], then P(exists t <= T: ||S_t|| > r_t) <= u(0, 0), with

- exact noise (g g^T = sigma_t^2 I): H[u] = c s u_s + (sigma^2/2)(u_ss + (n - 1) u_s/s), at a constant radius R;
- any noise with g g^T <= sigma_t^2 I, tr <= nu sigma_t^2 (state-dependent g included): the largest over
  0 <= rho <= 1 of c s u_s + (sigma^2/2)(rho u_ss + min(nu - rho, n - 1) u_s/s), for u rising in s. Without radial
  noise s^2 = y moves by y' = 2 c y + (n - 1) sigma^2, so that the radius is taken as y_b^{1/2} with y_b(T) = R^2 and
  y_b' = max(0, 2 c y_b + (n - 1) sigma^2): points beyond would leave for sure.

In xi = y/y_b and the time theta with d theta = sigma^2/y_b dt both are u_theta = max 2 rho xi u_xixi + (rho +
tangential - kappa xi) u_xi on [0, 1], kappa = -2 c R^2/sigma^2 (exact) or max(n - 1, -2 c y_b/sigma^2). u is a cubic in
theta on slabs and a C^1 cubic in xi on cells, so that the defect of the inequality is a polynomial on each rectangle:
it is bounded through its Bernstein coefficients, control by control, with an a-priori bound of all rounding. A
remaining defect a + p u is paid for: e^{int p} (u + int a) is a supersolution. (At the joints u_xixi and u_theta jump:
mollifying u keeps the inequality in the limit, because H is convex with continuous coefficients.) The proposal comes
from collocation in xi and Radau steps in theta with a slightly inflated H, which leaves room in proportion to every
term of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from certbound.arrays import Array
from certbound.tubes.line_search import golden

_GAUSS = 0.5 + np.array([-1.0, 1.0]) * math.sqrt(3) / 6
_ROUNDING = 128 * 2.0**-53
"""Bound of the relative rounding of each term of a defect: a product of at most 40 rounded factors and sums.

Nodes, states and the ends of slabs are exact as they stand, a slab's length is one rounded subtraction, and no
function but + - * / enters: sizes carry the absolute values of all summands. 60 of the units are left for kappa and
the durations, which come from at most 12 rounded operations, each of them within 4 units.
"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Supersolution:
    """The problem on xi in [0, 1]."""

    pieces: tuple[tuple[float, float], ...]  # (duration in theta, kappa), in the order of time
    dimension: int  # n
    nu: float  # effective dimension (read for ``worst`` only)
    worst: bool  # any noise below sigma (True) or exactly sigma (False)
    target: float  # probability of interest: it sets the mesh and what small corrections may cost
    # relative room left in H, which widens the radius for a given probability by about as much; for probabilities
    # below 1e-3 it grows with the square of their logarithm
    inflation: float = 3e-4
    coarseness: float = 1.0  # factor on the mesh widths and steps

    @cached_property
    def controls(self) -> list[tuple[float, float]]:
        """(rho, tangential) candidates: the expression is concave and piecewise linear in rho."""
        n, nu = float(self.dimension), self.nu
        if not self.worst:
            return [(1.0, n - 1)]
        top = min(1.0, nu)
        values = sorted({0.0, min(max(nu - n + 1, 0.0), top), top})
        return [(rho, min(nu - rho, n - 1)) for rho in values]

    @cached_property
    def horizon(self) -> float:
        """Whole duration in theta."""
        return sum(duration for duration, _ in self.pieces)

    @cached_property
    def first(self) -> float:
        """Time to go at which the computation starts: the terminal data are those of a half-space."""
        return 2e-4 * min(self.horizon, 1.0)

    @cached_property
    def _fineness(self) -> float:
        """Relative mesh width: the tail of size ``target`` is steeper the smaller it is."""
        return self.coarseness * 0.015 / self._depth

    @cached_property
    def _depth(self) -> float:
        """How far out the tail is, 1 for probabilities that are not small."""
        return max(1.0, -math.log(self.target) / 7)

    @cached_property
    def _room(self) -> float:
        """Relative room left in H: the deeper the tail, the larger the defects beside its values."""
        return self.inflation * self._depth**2

    @cached_property
    def mesh(self) -> Array:
        """xi at the cell ends, finer towards 1."""
        fast = max(0.0, max(kappa for _, kappa in self.pieces) / 2)
        steady = 1 / fast if fast > 0 else math.inf
        layer, widest = min(math.sqrt(self.first), steady, 1.0), min(1 / 3, 3 * steady)
        ends, s = [0.0], 0.0
        while s < 1.0:
            s += self._fineness * min(max(layer, s), widest)
            ends.append(min(s, 1.0))
        if len(ends) > 2 and ends[-1] - ends[-2] < (ends[-2] - ends[-3]) / 2:
            del ends[-2]
        mesh = (1.0 - np.array(ends)[::-1]) ** 2
        mesh[0] = 0.0
        return mesh

    @cached_property
    def _basis(self) -> tuple[Array, Array, Array, Array]:
        """Values at the Gauss points of each cell's four unknowns: u, y u_y, y u_yy, u_y; shape (N, 2, 4)."""
        y, h = self.mesh[:-1, None], np.diff(self.mesh)[:, None]
        t = _GAUSS[None, :]
        at, one = y + t * h, np.ones((len(h), 2))
        value = np.stack([
            (1 + 2 * t) * (1 - t) ** 2 * one, t * (1 - t) ** 2 * h, t * t * (3 - 2 * t) * one, t * t * (t - 1) * h
        ], axis=-1)  # fmt: skip
        slope = np.stack([
            6 * t * (t - 1) / h, (1 - t) * (1 - 3 * t) * one, 6 * t * (1 - t) / h, t * (3 * t - 2) * one
        ], axis=-1)  # fmt: skip
        bend = np.stack([
            (12 * t - 6) / h**2, (6 * t - 4) / h, (6 - 12 * t) / h**2, (6 * t - 2) / h
        ], axis=-1)  # fmt: skip
        return value, at[..., None] * slope, at[..., None] * bend, slope

    def _operator(self, piece: int, state: Array) -> Array:
        """Inflated H of the basis at the Gauss points, with the controls that are best for ``state``."""
        _, drift, bend, slope = self._basis
        kappa, noise = self.pieces[piece][1], 1 + self._room
        kappa -= self._room * abs(kappa)
        local = _local(state[0::2], state[1::2])
        options = [-kappa * drift + noise * (2 * r * bend + (r + t) * slope) for r, t in self.controls]
        if len(options) == 1:
            return options[0]
        sizes = np.array([(option * local).sum(axis=-1) for option in options])
        # full noise unless less is better beyond doubt: where u is tiny, rounding must not stop the diffusion
        sizes[-1] += 1e-5 * self.target / self.horizon
        return np.asarray(np.choose(np.argmax(sizes, axis=0)[..., None], options))

    def _matrices(self, piece: int, state: Array) -> tuple[Array, Array]:
        """Banded mass and operator matrices of the unknowns (u_0, m_0, u_1, m_1, ...)."""
        mass, flow = _banded(self._basis[0]), _banded(self._operator(piece, state))
        mass[2, 0] = 1.0
        flow[1, 1] = (1 + self._room) * max(r + t for r, t in self.controls)
        mass[3, -2] = 1.0  # the last row holds u_N at 1
        return mass, flow

    def _terminal(self) -> Array:
        """erfc of the distance to R, bent so that H vanishes at R as u_t does there."""
        from scipy.special import erfc

        s = np.sqrt(self.mesh)
        width = math.sqrt(2 * self.first)
        spread = max(rho + tangential for rho, tangential in self.controls) - 1
        bend = width * (spread - self.pieces[-1][1]) / 2
        d = (1.0 - s) / width
        distance = d + bend * d**2 / (1 + d**2)
        state = np.empty(2 * len(s))
        state[0::2] = erfc(distance)
        slope = 2 / math.sqrt(math.pi) * np.exp(-(distance**2)) * (1 + bend * 2 * d / (1 + d**2) ** 2) / width
        state[1::2] = slope / (2 * np.maximum(s, 1e-3))
        state[-2] = 1.0
        # slopes that keep every cubic rising, hence positive
        rise = 3 * np.diff(state[0::2]) / np.diff(self.mesh)
        pair = state[1:-2:2] + state[3::2]
        share = np.where(pair > rise, rise / np.maximum(pair, 1e-300), 1.0) * (1 - 1e-9)
        state[1::2] *= np.minimum(np.append(share, 1.0), np.append(1.0, share))
        return state

    def _slabs(self) -> list[_Slab]:
        """From T backwards: the proposal."""
        state, pace = self._terminal(), 2 * self._fineness
        ends = np.append(0.0, np.cumsum([duration for duration, _ in self.pieces]))
        t, step = float(ends[-1]), pace * self.first
        slabs: list[_Slab] = []
        for piece in range(len(self.pieces) - 1, -1, -1):
            begin, flow, outward = float(ends[piece]), None, -self.pieces[piece][1]
            if slabs and self.pieces[piece][1] != self.pieces[piece + 1][1]:
                step = min(step, 4 * pace * self.first)
            while t > begin:
                earlier = t - step if t - 1.01 * step > begin else begin
                size, new = t - earlier, state
                for _ in range(1 if len(self.controls) == 1 else 2):
                    stage, new = _radau(*self._matrices(piece, new), state, size)
                # derivatives of the collocation parabola at its ends; the end of one is the start of the next
                first = (4.5 * (stage - state) - 0.5 * (new - state)) if flow is None else flow * size
                last = 2.5 * (new - stage) - 2.0 * (stage - state)
                inner = state + first / 3, new - last / 3
                slabs.append(_Slab(size=size, piece=piece, states=np.stack([state, *inner, new])))
                state, t, flow = new, earlier, last / size
                step = min(pace * (float(ends[-1]) - t + self.first), 1.5 * step)
                if outward > 0:
                    step = min(step, self._fineness / outward)
        return slabs

    def estimate(self) -> float:
        """The proposal's value, unproved."""
        return float(self._slabs()[-1].states[-1, 0])

    def bound(self) -> float:
        """Upper bound of the probability; 1 when the check fails."""
        slabs = self._slabs()
        # a small multiple of y makes u rise strictly; it vanishes at 0 and costs only through H
        lift = 1e-4 * self.target if self.worst else 0.0
        added = grown = 0.0
        for slab in slabs:
            extra, rate = self._payment(slab, lift)
            added, grown = added + extra * slab.size, grown + rate * slab.size
        start = _Bernstein.cubic(slabs[0].states[:1], np.diff(self.mesh))
        if np.any(start.value - _ROUNDING * start.size < 0) or not grown < 700:
            return 1.0
        # the sums over the slabs, and exp, in double precision
        result = (float(slabs[-1].states[-1, 0]) + added) * math.exp(grown) * (1 + 1e-10)
        return min(1.0, result) if result == result else 1.0

    @cached_property
    def _rounding(self) -> Array:
        """Relative rounding of the terms of a defect, per piece.

        To that of the evaluation comes that of the pieces' ends, sums of durations: a piece that lasts (1 + eta)
        times as long is one with (1 + eta) times the noise and drift.
        """
        durations = np.array([duration for duration, _ in self.pieces])
        return _ROUNDING + 2.0**-52 * (len(durations) + 2) * self.horizon / durations

    def _payment(self, slab: _Slab, lift: float) -> tuple[float, float]:
        """(a, p) with H[u] - u_tau <= a + p u on the slab: then e^{int p} (u + int a) is a supersolution."""
        defect, value = self._defect(slab, lift)
        if not np.all(np.isfinite(defect)):
            return math.inf, 0.0
        kept = (defect > 0) | (value < 0)
        defect, value = defect[kept], value[kept]
        if not len(defect):
            return 0.0, 0.0

        def extra(p: float) -> float:
            return max(0.0, float(np.max(defect - p * value + abs(p) * _ROUNDING)))

        x = golden(lambda x: extra(math.exp(x)) + math.exp(x) * self.target, -18.0, 9.0, 0.3)
        p = math.exp(x)
        return (extra(p), p) if extra(p) + p * self.target < extra(0.0) else (extra(0.0), 0.0)

    def _defect(self, slab: _Slab, lift: float) -> tuple[Array, Array]:
        """Bernstein coefficients of upper bounds of H[u] - u_tau (tau the time to go) for all controls, and of u."""
        h, y = np.diff(self.mesh), self.mesh
        kappa = self.pieces[slab.piece][1]
        flow = _Bernstein.cubic(_raise(3 * np.diff(slab.states, axis=0) / slab.size), h)
        slope, bend = _Bernstein.slope(slab.states, h), _Bernstein.bend(slab.states, h)
        value = _Bernstein.cubic(slab.states, h)
        if self.worst and np.any(slope.value - _ROUNDING * slope.size + lift < 0):
            return np.array(math.inf), value.value
        drift, bent, flat = slope.times(y).raised(3), bend.times(y).raised(3), slope.raised(3)
        lifted = _raise(_raise(np.stack([y[:-1], y[1:]])))[:, None, :] * (-kappa * lift)
        worst = np.full(value.value.shape, -np.inf)
        for rho, tangential in self.controls:
            outer = rho + tangential
            total = -kappa * drift.value + 2 * rho * bent.value + outer * flat.value
            total += lifted + outer * lift - flow.value
            size = abs(kappa) * drift.size + 2 * rho * bent.size + outer * flat.size
            size += np.abs(lifted) + outer * lift + flow.size
            worst = np.maximum(worst, total + self._rounding[slab.piece] * size)
        return worst, value.value


@dataclass(frozen=True, eq=False, kw_only=True)
class _Slab:
    """Bernstein coefficients in time of the unknowns, from the later end to the earlier one; shape (4, 2 N + 2)."""

    size: float
    piece: int
    states: Array


@dataclass(frozen=True, eq=False)
class _Bernstein:
    """Bernstein coefficients (degree + 1, level, cell) on the cells, with the sum of the sizes behind each."""

    value: Array
    size: Array

    @staticmethod
    def cubic(states: Array, h: Array) -> _Bernstein:
        u, m = states[:, 0::2], states[:, 1::2]
        left, right = u[:, :-1], u[:, 1:]
        inner, outer = m[:, :-1] * (h / 3), m[:, 1:] * (h / 3)
        value = np.stack([left, left + inner, right - outer, right])
        size = np.stack([np.abs(left), np.abs(left) + np.abs(inner), np.abs(right) + np.abs(outer), np.abs(right)])
        return _Bernstein(value, size)

    @staticmethod
    def slope(states: Array, h: Array) -> _Bernstein:
        u, m = states[:, 0::2], states[:, 1::2]
        left, right = m[:, :-1], m[:, 1:]
        chord = 3 * (u[:, 1:] - u[:, :-1]) / h
        value = np.stack([left, chord - left - right, right])
        return _Bernstein(value, np.stack([np.abs(left), np.abs(chord) + np.abs(left) + np.abs(right), np.abs(right)]))

    @staticmethod
    def bend(states: Array, h: Array) -> _Bernstein:
        u, m = states[:, 0::2], states[:, 1::2]
        left, right = m[:, :-1], m[:, 1:]
        chord = 3 * (u[:, 1:] - u[:, :-1]) / h
        value = np.stack([chord - 2 * left - right, 2 * right + left - chord]) * (2 / h)
        ends = np.abs(chord) + 2 * np.abs(left) + np.abs(right), np.abs(chord) + np.abs(left) + 2 * np.abs(right)
        return _Bernstein(value, np.stack(ends) * (2 / h))

    def times(self, y: Array) -> _Bernstein:
        """Product with y, whose coefficients on a cell are its ends."""
        return _Bernstein(_by_line(self.value, y), _by_line(self.size, y))

    def raised(self, degree: int) -> _Bernstein:
        """The same polynomial with more coefficients."""
        value, size = self.value, self.size
        while len(value) - 1 < degree:
            value, size = _raise(value), _raise(size)
        return _Bernstein(value, size)


def _by_line(c: Array, y: Array) -> Array:
    """Coefficients of the product with lines that have the values ``y`` at the ends of the cells."""
    degree, low, high = len(c) - 1, y[:-1], y[1:]
    result = np.zeros((degree + 2, *c.shape[1:]))
    for k in range(degree + 1):
        result[k] += c[k] * low * ((degree + 1 - k) / (degree + 1))
        result[k + 1] += c[k] * high * ((k + 1) / (degree + 1))
    return result


def _raise(c: Array) -> Array:
    """The same polynomials with one coefficient more."""
    return _by_line(c, np.ones(2))


def _local(u: Array, m: Array) -> Array:
    """The four unknowns of each cell, broadcast over its two Gauss points: shape (N, 1, 4)."""
    return np.stack([u[:-1], m[:-1], u[1:], m[1:]], axis=-1)[:, None, :]


def _banded(rows: Array) -> Array:
    """Collocation rows (N, 2, 4) in the band storage of :func:`scipy.linalg.solve_banded` with two bands each side."""
    count = 2 * len(rows) + 2
    bands = np.zeros((5, count))
    for row in range(2):
        for column in range(4):
            bands[3 - column + row, column : column + 2 * len(rows) : 2] = rows[:, row, column]
    return bands


def _times(bands: Array, x: Array) -> Array:
    """Product of a band matrix with a vector."""
    result = bands[2] * x
    for k in (1, 2):
        result[:-k] += bands[2 - k, k:] * x[k:]
        result[k:] += bands[2 + k, :-k] * x[:-k]
    return np.asarray(result)


def _radau(mass: Array, flow: Array, state: Array, step: float) -> tuple[Array, Array]:
    """Stages at 1/3 and 1 of u' = mass^-1 flow u by the two-stage Radau IIA method, from one complex solve."""
    from scipy.linalg import solve_banded

    pole = 2 + 1j * math.sqrt(2)
    solution = solve_banded((2, 2), step * flow - pole * mass, _times(mass, state) + 0j, check_finite=False)
    stage: Array = 2 * np.real((6 - 2 * pole) / (2j * math.sqrt(2)) * solution)
    new: Array = 2 * np.real((6 + 2 * pole) / (2j * math.sqrt(2)) * solution)
    stage[-2] = new[-2] = 1.0
    return stage, new
