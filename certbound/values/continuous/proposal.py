"""Floating-point proposals of V in one state; nothing here is certified.

u solves u_t + f u' + a u''/2 = 0 backward in time with u = 1 on the faces. `sketch` solves it by a monotone,
exponentially fitted scheme. `propose` solves the equation of V = log u,

    V_tau = sup_d f V' + a (V'' + V'^2) / 2,        tau = T - t,

in quintic splines by collocation at Greville's points, with the Rosenbrock method RODAS3 (Hairer and Wanner, Solving
Ordinary Differential Equations II; order 3, stiffly accurate) on banded matrices. Its steps become the slabs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.values.continuous.surface import Surface
from certbound.watch import poll

_DEGREE = 5
_BAND = 5
_THICKEST = 1e-4  # share of the largest a below which cells beside held ends grow no finer
_THINNEST = 1e-6  # share of a cell that a bent one keeps
_GAMMA = 1 - 0.5**0.5  # the L-stable two-stage method of order 2
_NEAR = 6.0  # below the answer, as a logarithm: what a path hardly meets on its way
_FARTHEST = 1e-3  # weight of errors much farther below


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Line:
    """What a proposal needs to know: floats and float functions.

    ``drift(t, x)`` has shape (branches, len(x)), ``square(t, x)`` shape (len(x),).
    """

    low: float
    high: float
    horizon: float
    drift: Callable[[float, Array], Array]
    square: Callable[[float, Array], Array]
    starts: tuple[float, float]
    autonomous: bool
    held: tuple[bool, bool] = (False, False)  # ends that no path crosses: the equation itself holds there

    @property
    def absorbing(self) -> bool:
        """Whether paths end at a held end, from where nothing is met any more: log u has no limit there."""
        places = [x for x, held in zip((self.low, self.high), self.held) if held]
        return any(not self.drift(t, np.array([x])).any() for x in places for t in (0.0, self.horizon))

    def spread_of(self, x: Array) -> Array:
        """Lengths in which the noise is 1, as far as grids are made by them: beside held ends they end somewhere."""
        a = self.square(0.5 * self.horizon, x)
        middle = self.square(0.5 * self.horizon, np.array([0.5 * sum(self.starts)]))[0]
        least = min(_THICKEST * float(np.max(a)), 0.01 * float(middle)) if any(self.held) else 0.0
        return 1 / np.sqrt(np.maximum(a, max(least, 1e-300)))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Sketch:
    """log u(0, .) on a grid, its largest value over the starts, and d log P / d log T."""

    nodes: Array
    values: Array
    level: float
    growth: float


def sketch(
    line: Line, *, cells: int = 400, steps: int = 240, begin: Callable[[Array], Array] | None = None
) -> Sketch:
    """A rough solution, accurate to some per cent at any size of u (monotone rates, an L-stable step of order 2).

    u is 0 at the horizon unless ``begin`` says what it is. InfeasibleError where the model is undefined at a node.
    """
    from scipy.linalg import solve_banded

    x = graded(line, cells, [0.002 * (line.high - line.low)] * 2)
    left, right = np.diff(x)[:-1], np.diff(x)[1:]
    u = np.zeros(len(x)) if begin is None else begin(x)
    for side in (0, -1):
        u[side] = u[side] if line.held[side] else 1.0
    tau = line.horizon * np.concatenate([[0.0], np.geomspace(1e-5, 1.0, steps)])
    rates = _rates(line, 0.0, x, u, left, right)
    before = 0.0
    inside = (x >= line.starts[0]) & (x <= line.starts[1])
    inside |= np.arange(len(x)) == np.argmin(np.abs(x - 0.5 * sum(line.starts)))
    for step, end in zip(np.diff(tau), tau[1:]):
        if not line.autonomous or rates is None or len(line.drift(0.0, x)) > 1:
            rates = _rates(line, line.horizon - end, x, u, left, right)
        down, up = rates
        bands = np.zeros((3, len(x)))
        bands[1] = 1.0
        bands[1, 1:-1] += _GAMMA * step * (down + up)
        bands[0, 2:], bands[2, :-2] = -_GAMMA * step * up, -_GAMMA * step * down
        for side, row in ((0, 0), (-1, 2)):
            if line.held[side]:  # no noise: the drift alone leads inside
                along = float(np.abs(line.drift(line.horizon - end, x[[side]])).max()) / abs(x[side] - x[1 + 3 * side])
                bands[1, side] += _GAMMA * step * along
                bands[row, 1 + 3 * side] = -_GAMMA * step * along
        if not np.isfinite(bands).all():
            raise InfeasibleError("the model is undefined somewhere in the safe set; value functions prove nothing.")
        before = float(np.max(u[inside]))
        stage = solve_banded((1, 1), bands, u)
        u = np.maximum(solve_banded((1, 1), bands, u + (1 / _GAMMA - 1) * (stage - u)), 0.0)
    level = float(np.log(max(np.max(u[inside]), 1e-300)))
    growth = (level - np.log(max(before, 1e-300))) / np.log(tau[-1] / tau[-2])
    return Sketch(nodes=x, values=np.log(np.maximum(u, 1e-300)), level=level, growth=float(max(growth, 0.0)))


def _rates(line: Line, t: float, x: Array, u: Array, left: Array, right: Array) -> tuple[Array, Array]:
    """Jump rates to the left and right neighbour, exact for 1, x and exp(-2 f x / a)."""
    drifts = line.drift(t, x)
    best = np.argmax(drifts * np.gradient(u, x), axis=0)
    f, a = drifts[best, np.arange(len(x))][1:-1], np.maximum(line.square(t, x)[1:-1], 1e-300)
    slope = np.clip(2 * f / a, -300 / np.maximum(left, right), 300 / np.maximum(left, right))
    slope = np.where(np.abs(slope) * (left + right) < 1e-7, 1e-7 / (left + right), slope)
    rise = np.expm1(slope * left)
    fall = -np.expm1(-slope * right)
    up = f / (right - left * fall / rise)
    fast = np.abs(f) * (left + right) > 600 * a
    up = np.where(np.abs(2 * f / a) * (left + right) < 1e-7, a / (right * (left + right)), up)
    down = np.maximum((up * right - f) / left, 0.0)
    up = np.where(fast, np.maximum(f, 0.0) / right, np.maximum(up, 0.0))
    return np.where(fast, np.maximum(-f, 0.0) / left, down), up


def graded(line: Line, cells: int, layers: list[float]) -> Array:
    """Nodes that crowd at both faces: cells in proportion to the distance (by the noise), down to ``layers``."""
    fine = np.linspace(line.low, line.high, 8001)
    scale = line.spread_of(fine)
    way = np.concatenate([[0.0], np.cumsum(0.5 * (scale[1:] + scale[:-1]) * np.diff(fine))])
    density = np.full(len(fine), 0.8 / way[-1])
    for distance, layer in ((way, layers[0] * scale[0]), (way[-1] - way, layers[1] * scale[-1])):
        weight = 1 / (distance + layer)
        density += 0.5 * weight / np.trapezoid(weight, way)
    total = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(way))])
    nodes = np.interp(np.linspace(0, total[-1], cells + 1), total, fine)
    nodes[0], nodes[-1] = line.low, line.high
    return through(nodes, line.starts)


def through(nodes: Array, points: tuple[float, float]) -> Array:
    """Nodes bent a little so that the inner ones nearest to the points lie on them; as they were where that fails.

    It fails where a cell would all but vanish, as beside a point on an end: collocation is singular there.
    """
    places = [1 + int(np.argmin(np.abs(nodes[1:-1] - point))) for point in points]
    if places[0] == places[1] and points[0] != points[1]:
        return nodes
    known = {0: 0.0, len(nodes) - 1: 0.0} | {k: point - nodes[k] for k, point in zip(places, points)}
    order = sorted(known)
    moved = nodes + np.interp(np.arange(len(nodes)), order, [known[k] for k in order])
    moved[[0, -1]] = nodes[[0, -1]]
    moved[places] = points
    return moved if np.all(np.diff(moved) > _THINNEST * np.diff(nodes)) else nodes


class Splines:
    """Collocation matrices of splines with given nodes, quintic if nothing is said, banded."""

    def __init__(self, nodes: Array, degree: int = _DEGREE) -> None:
        from scipy.interpolate import BSpline

        knots = np.concatenate([[nodes[0]] * degree, nodes, [nodes[-1]] * degree])
        self.count = len(knots) - degree - 1
        self.points = np.array([knots[k + 1 : k + degree + 1].mean() for k in range(self.count)])
        self.points[0], self.points[-1] = nodes[0], nodes[-1]
        spline = BSpline(knots, np.eye(self.count), degree)
        self.band, self.spline = degree, spline
        self.dense = [spline(self.points, order) for order in range(3)]
        self.at = [self._banded(matrix) for matrix in self.dense]
        self.at_nodes = [spline(nodes, order) for order in range(3)]

    def _banded(self, matrix: Array) -> Array:
        """Rows of the band: entry (i, k) is matrix[i, i + k - self.band]."""
        size = len(matrix)
        band = np.zeros((size, 2 * self.band + 1))
        for offset in range(-self.band, self.band + 1):
            rows = np.arange(max(0, -offset), min(size, size - offset))
            band[rows, offset + self.band] = matrix[rows, rows + offset]
        return band

    def times(self, band: Array, vector: Array) -> Array:
        padded = np.zeros(len(vector) + 2 * self.band)
        padded[self.band:-self.band] = vector
        windows = np.ndarray((len(vector), 2 * self.band + 1), float, padded, strides=2 * padded.strides)
        return np.asarray(np.einsum("ij,ij->i", band, windows))


class _Banded:
    """An LU factorisation of a matrix given by the rows of its band."""

    def __init__(self, band: Array) -> None:
        from scipy.linalg.lapack import dgbtrf

        size = len(band)
        storage = np.zeros((3 * _BAND + 1, size))
        for offset in range(-_BAND, _BAND + 1):
            rows = np.arange(max(0, -offset), min(size, size - offset))
            storage[2 * _BAND - offset, rows + offset] = band[rows, offset + _BAND]
        self.lu, self.pivots, info = dgbtrf(storage, _BAND, _BAND)
        if info != 0:
            raise FloatingPointError("singular")

    def solve(self, right: Array) -> Array:
        from scipy.linalg.lapack import dgbtrs

        return np.asarray(dgbtrs(self.lu, _BAND, _BAND, right, self.pivots)[0])


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Boundary:
    """Start profile at tau = 0, and V with its rate at both faces as functions of tau.

    ``step`` is the first step of time. At a ``free`` face V' = 0 instead.
    """

    profile: Callable[[Array], Array]
    faces: Callable[[float], tuple[Array, Array]]
    step: float
    free: tuple[bool, bool] = (False, False)


def propose(
    line: Line, nodes: Array | None, boundary: Boundary, *, tolerance: float, level: float, most_steps: int = 4000
) -> Surface | None:
    """V on the given nodes; None where there are none, or the integration breaks down.

    Errors count little where V is far below ``level``, log P: the proof pays for those places in units of P.
    """
    if nodes is None:
        return None
    system = _Collocation(line, nodes, boundary)
    coefficients, tau = system.start(), 0.0
    step, smallest = boundary.step, 1e-9 * line.horizon
    ends, values, first, last = [0.0], [coefficients], [], []
    rate = system.rate(tau, coefficients)
    for _ in range(most_steps):
        poll("a proposal of the value function")
        step = min(step, line.horizon - tau)
        try:
            new, error = system.step(tau, coefficients, step)
        except FloatingPointError:
            return None
        highest = np.maximum(system.value(new), system.value(coefficients))
        weight = _FARTHEST + 1 / (1 + np.exp(np.clip(level - _NEAR - highest, -50, 50)))
        size = float(np.max(weight * np.abs(error))) / tolerance if np.isfinite(error).all() else np.inf
        if size > 1:
            step *= max(0.2, 0.8 * size ** (-1 / 3)) if np.isfinite(size) else 0.1
            if step < smallest:
                return None
            continue
        tau = line.horizon if line.horizon - tau - step < 1e-12 * line.horizon else tau + step
        first.append(rate)
        rate = system.rate(tau, new)
        last.append(rate)
        coefficients = new
        ends.append(tau)
        values.append(coefficients)
        step *= min(2.0, 0.85 * max(size, 1e-9) ** (-1 / 3))
        if tau >= line.horizon:
            return _surface(line, nodes, system.splines, ends, values, first, last)
    return None


class _Collocation:
    """The semi-discrete equation: mass matrix times rate of the coefficients = right-hand side."""

    def __init__(self, line: Line, nodes: Array, boundary: Boundary) -> None:
        self.line, self.boundary = line, boundary
        self.splines = Splines(nodes)
        self.weights = self.splines.at[0].copy()
        for row, free in zip((0, -1), boundary.free):
            if free:
                self.weights[row] = self.splines.at[1][row]
        self.mass = _Banded(self.weights)
        x = self.splines.points
        self.fixed = self._model(0.0, x) if line.autonomous else None

    def _model(self, t: float, x: Array) -> tuple[Array, Array]:
        return self.line.drift(t, x), self.line.square(t, x)

    def start(self) -> Array:
        values = self.boundary.profile(self.splines.points)
        values[[0, -1]] = np.where(self.boundary.free, 0.0, self.boundary.faces(0.0)[0])
        for side in (0, -1):
            if self.line.held[side]:
                values[side] = self.boundary.profile(self.splines.points[[side]])[0]
        return self.mass.solve(values)

    def value(self, coefficients: Array) -> Array:
        return self.splines.times(self.splines.at[0], coefficients)

    def rate(self, tau: float, coefficients: Array) -> Array:
        return self.mass.solve(self._right(tau, coefficients)[0])

    def _right(self, tau: float, coefficients: Array) -> tuple[Array, Array, Array]:
        s = self.splines
        f, a = self.fixed or self._model(self.line.horizon - tau, s.points)
        slope, bend = s.times(s.at[1], coefficients), s.times(s.at[2], coefficients)
        best = f[0] if len(f) == 1 else f[np.argmax(f * slope, axis=0), np.arange(len(slope))]
        value = best * slope + 0.5 * a * (bend + slope * slope)
        speed = best + a * slope
        ends = np.where(self.boundary.free, 0.0, self.boundary.faces(tau)[1])
        value[[0, -1]] = np.where(self.line.held, value[[0, -1]], ends)
        return value, speed, a

    def step(self, tau: float, c: Array, h: float) -> tuple[Array, Array]:
        """One step of RODAS3: the new coefficients and the estimated error."""
        s = self.splines
        value, speed, a = self._right(tau, c)
        jacobian = speed[:, None] * s.at[1] + 0.5 * a[:, None] * s.at[2]
        jacobian[[0, -1]] *= np.array(self.line.held)[:, None]
        matrix = _Banded(2 / h * self.weights - jacobian)
        small = 1e-3 * h
        change = (self._right(tau + small, c)[0] - value) / small
        k1 = matrix.solve(value + 0.5 * h * change)
        k2 = matrix.solve(value + 1.5 * h * change + 4 / h * s.times(self.weights, k1))
        value = self._right(tau + h, c + 2 * k1)[0]
        k3 = matrix.solve(value + s.times(self.weights, k1 - k2) / h)
        value = self._right(tau + h, c + 2 * k1 + k3)[0]
        k4 = matrix.solve(value + s.times(self.weights, k1 - k2 - 8 / 3 * k3) / h)
        return c + 2 * k1 + k3 + k4, s.times(s.at[0], k4)


def _surface(
    line: Line, nodes: Array, splines: Splines, ends: list[float], values: list[Array], first: list[Array],
    last: list[Array],
) -> Surface:
    def data(rows: list[Array]) -> Array:
        table = np.array(rows)
        return np.stack([table @ matrix.T for matrix in splines.at_nodes], axis=-1)[::-1]

    forward = line.horizon - np.array(ends)[::-1]
    forward[0], forward[-1] = 0.0, line.horizon
    return Surface(axes=(nodes,), times=forward, values=data(values), start_rates=-data(last), end_rates=-data(first))
