"""The backward equation u_t + L u + s = 0 in floats: finite differences, an implicit Runge-Kutta method, sparse LU.

Nothing here is trusted. Differences are of fourth order for noise and of third order, upwind, for drift; the method is
Alexander's third-order L-stable one (Alexander 1977, three stages).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as sl

from certbound.arrays import Array, Index, Mask
from certbound.lazy import compiled
from certbound.values.kolmogorov.splines import Banded, back, thin

GAMMA = 0.4358665215084589
_MIDDLE = (1 + GAMMA) / 2
_FIRST = -(6 * GAMMA**2 - 16 * GAMMA + 1) / 4
_SECOND = (6 * GAMMA**2 - 20 * GAMMA + 5) / 4


Stencils = Sequence[tuple[int, int]]
DRIFT: Stencils = ((-2, 3), (-1, 2))
"""Upwind, where the drift is positive: of fifth order, of third where that does not fit or little noise smooths."""
SOLVED, ABOUT = 3e-3, 0.1
"""Relative residuals at which a system of `SplitEquation` counts as solved: for v, and for an error that need be right
to a tenth (a carried error of three problems changed by less than 1 %)."""

_ITERATIONS = 30  # at most
_LANES = 16  # lines along the last axis that are solved side by side
_WINDOW = 5  # nodes of the widest of the differences of `SplitEquation`
_PECLET = 10.0  # of drift times width to squared noise, beyond which differences of fifth order may grow
NOISE: Stencils = ((-3, 3), (-2, 2))
CENTRAL: Stencils = ((-2, 2),)

Source = Callable[[float], Array | float]
"""Of the share of a step that has passed."""


def difference_weights(place: float, nodes: Array, order: int) -> Array:
    """Weights of the ``order``-th derivative at a place from values at nodes (Fornberg 1988)."""
    count = len(nodes)
    table = np.zeros((count, order + 1))
    table[0, 0], product = 1.0, 1.0
    for i in range(1, count):
        most, own = min(i, order), 1.0
        for j in range(i):
            gap = nodes[i] - nodes[j]
            own *= gap
            if j == i - 1:
                for k in range(most, 0, -1):
                    table[i, k] = product * (k * table[i - 1, k - 1] - (nodes[i - 1] - place) * table[i - 1, k]) / own
                table[i, 0] = -product * (nodes[i - 1] - place) * table[i - 1, 0] / own
            for k in range(most, 0, -1):
                table[j, k] = ((nodes[i] - place) * table[j, k] - k * table[j, k - 1]) / gap
            table[j, 0] = (nodes[i] - place) * table[j, 0] / gap
        product = own
    return table[:, order]


def difference(nodes: Array, stencils: Stencils, order: int) -> sp.csr_array:
    """The matrix of a derivative from neighbours of each node: the first of the stencils (first, last) that fits.

    Where none fits the last one is moved inward.
    """
    return _difference(np.asarray(nodes, dtype=float).tobytes(), tuple(stencils), order)


@lru_cache(maxsize=64)
def _difference(line: bytes, stencils: tuple[tuple[int, int], ...], order: int) -> sp.csr_array:
    nodes = np.frombuffer(line)
    count = len(nodes)
    rows: list[int] = []
    columns: list[int] = []
    values: list[float] = []
    for i in range(count):
        fitting = [one for one in stencils if i + one[0] >= 0 and i + one[1] < count]
        first, last = fitting[0] if fitting else stencils[-1]
        width = last - first + 1
        begin = min(max(i + first, 0), count - width)
        rows += [i] * width
        columns += range(begin, begin + width)
        values += list(difference_weights(nodes[i], nodes[begin : begin + width], order))
    return sp.csr_array((values, (rows, columns)), shape=(count, count))


def upwind(nodes: Array, smooth: bool) -> tuple[sp.csr_array, sp.csr_array]:
    """First derivatives for positive and for negative drift; ``smooth`` where noise smooths over a cell."""
    stencils = DRIFT if smooth else DRIFT[-1:]
    return difference(nodes, stencils, 1), difference(nodes, [(-last, -first) for first, last in stencils], 1)


class _Stepped(Protocol):
    """A step of the Runge-Kutta method, for whatever solves."""

    def speed(self, values: Array, source: Array | float = 0.0, given: Array | float = 0.0) -> Array:
        """-u_t: L u and the source at live nodes, what is given at the others."""
        ...

    def solve(self, share: float, values: Array) -> Array:
        """(1 - share L)^-1 values."""
        ...

    def step(self, values: Array, step: float, source: Source, given: Source) -> Array:
        """One step backward in time."""
        share = GAMMA * step

        def stage(at: Array, part: float) -> Array:
            return self.solve(share, self.speed(at, source(part), given(part)))

        first = stage(values, GAMMA)
        second = stage(values + step * (_MIDDLE - GAMMA) * first, _MIDDLE)
        partial = values + step * (_FIRST * first + _SECOND * second)
        return partial + step * GAMMA * stage(partial, 1.0)


class Equation(_Stepped):
    """u_t + L u - rate (u - goal) + s = 0 on the nodes of a tensor grid.

    Parameters
    ----------
    nodes : sequence of ndarray
    flow, spread : ndarray, shapes (n, ...) and (n, n, ...)
        f and a at the nodes.
    dead : ndarray of bool
        Nodes whose values are given.
    rate : ndarray
        Soft killing.
    more : sparse array, shape (size, size), optional
        What L has besides.
    """

    def __init__(
        self, nodes: Sequence[Array], flow: Array, spread: Array, dead: Mask, rate: Array,
        more: sp.csr_array | None = None,
    ) -> None:  # fmt: skip
        self.nodes, self.shape, self.live = list(nodes), flow.shape[1:], ~dead
        size = int(np.prod(self.shape))
        total = sp.csr_array((size, size)) if more is None else more
        for i in range(len(nodes)):
            width = np.gradient(nodes[i]).reshape([-1 if k == i else 1 for k in range(len(nodes))])
            smooth = np.abs(flow[i]) * width <= _PECLET * spread[i, i]
            for there, order in ((smooth, True), (~smooth, False)):
                if there.any():
                    up, down = (self._on(i, one) for one in upwind(nodes[i], order))
                    total = total + _diagonal(there * np.maximum(flow[i], 0)) @ up
                    total = total + _diagonal(there * np.minimum(flow[i], 0)) @ down
            if spread[i, i].any():
                total = total + _diagonal(spread[i, i] / 2) @ self._on(i, difference(nodes[i], NOISE, 2))
            for j in range(i):
                if spread[i, j].any():
                    cross = [self._on(k, difference(nodes[k], CENTRAL, 1)) for k in (i, j)]
                    total = total + _diagonal(spread[i, j]) @ cross[0] @ cross[1]
        self.matrix = (_diagonal(self.live.astype(float)) @ (total - _diagonal(rate))).tocsc()
        self.inverses: dict[float, sl.SuperLU] = {}

    def _on(self, axis: int, matrix: sp.csr_array) -> sp.csr_array:
        before, behind = int(np.prod(self.shape[:axis])), int(np.prod(self.shape[axis + 1 :]))
        return sp.kron(sp.kron(sp.identity(before), matrix), sp.identity(behind)).tocsr()

    def speed(self, values: Array, source: Array | float = 0.0, given: Array | float = 0.0) -> Array:
        """-u_t: L u and the source at live nodes, what is given at the others."""
        result = (self.matrix @ values.ravel()).reshape(self.shape) + source
        return np.where(self.live, result, given)

    def solve(self, share: float, values: Array) -> Array:
        """(1 - share L)^-1 values."""
        solution: Array = self._factored(share).solve(values.ravel())
        return solution.reshape(self.shape)

    def adjoint(self, share: float, values: Array) -> Array:
        """The same with the transposed matrix: where paths from ``values`` are after a time ``share``."""
        solve: Any = self._factored(share).solve  # SciPy's types leave the second argument out
        return np.asarray(solve(values.ravel(), "T")).reshape(self.shape)

    def _factored(self, share: float) -> sl.SuperLU:
        key = float(np.format_float_positional(share, precision=9, unique=False, fractional=False))
        if key not in self.inverses:
            size = self.matrix.shape[0]
            matrix = (sp.identity(size) - key * self.matrix).tocsc()
            self.inverses[key] = sl.splu(  # stencils are nearly symmetric, and the diagonal is large
                matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
            )
        return self.inverses[key]


class SplitEquation(_Stepped):
    """The same without factors of a matrix, for three states and more.

    Systems are solved by BiCGSTAB (van der Vorst 1992). Its preconditioner solves, of the equation with drift of first
    order upwind, the tridiagonal systems along the lines of one axis after the other (line Gauss-Seidel): layers and
    strong drift across many cells are met by it, and what is smooth over many cells changes little within a step. A
    product of tridiagonal factors, once a step, would do where a step moves nothing by more than a cell or so; where it
    does, such a method hardly moves at all, and as a preconditioner it takes ten times as many iterations. Systems that
    follow each other have solutions near each other.

    Parameters
    ----------
    As of `Equation`, and

    solved : float
        Relative residual at which a system counts as solved.
    """

    def __init__(
        self, nodes: Sequence[Array], flow: Array, spread: Array, dead: Mask, rate: Array, solved: float = SOLVED,
        more: sp.csr_array | None = None,
    ) -> None:  # fmt: skip
        self.nodes, self.shape, self.live = list(nodes), flow.shape[1:], ~dead
        self.rate, self.solved, self.more = rate * self.live, solved, more
        self.known: tuple[float, Array, list[_Lines]] | None = None
        self.before: Array | None = None  # the last solution
        n = len(nodes)
        self.along: list[_Stencil] = []
        self.mixed: list[tuple[int, int, Banded, Banded, Array]] = []
        self.ahead: list[Array] = []
        self.behind: list[Array] = []
        for i in range(n):
            f, a = flow[i] * self.live, spread[i, i] / 2 * self.live
            if f.any() or a.any():
                self.along.append(_Stencil.of(i, nodes[i], f, a))
            gaps = np.diff(nodes[i])
            shape = [-1 if k == i else 1 for k in range(n)]
            ahead, behind = np.append(gaps, gaps[-1]).reshape(shape), np.append(gaps[0], gaps).reshape(shape)
            inner = np.ones(len(nodes[i]))
            inner[[0, -1]] = 0.0
            a = a * inner.reshape(shape) * 2 / (ahead + behind)
            self.ahead.append(np.ascontiguousarray(np.maximum(f, 0) / ahead + a / ahead))
            self.behind.append(np.ascontiguousarray(np.maximum(-f, 0) / behind + a / behind))
            for j in range(i):
                if spread[i, j].any():
                    first, second = (banded(difference(nodes[k], CENTRAL, 1)) for k in (i, j))
                    self.mixed.append((i, j, first, second, spread[i, j] * self.live))

    def _add_image(self, total: Array, values: Array, factor: float) -> None:
        """Add ``factor`` (L + rate) values to contiguous memory."""
        for stencil in self.along:
            stencil.add(total, values, factor)
        for i, j, first, second, weight in self.mixed:
            total += factor * weight * first.along(second.along(values, j), i)
        if self.more is not None:
            total += factor * (self.more @ values.ravel()).reshape(self.shape)

    def speed(self, values: Array, source: Array | float = 0.0, given: Array | float = 0.0) -> Array:
        """-u_t: L u and the source at live nodes, what is given at the others."""
        values = np.ascontiguousarray(values)
        total = source - self.rate * values
        self._add_image(total, values, 1.0)
        return np.where(self.live, total, given)

    def solve(self, share: float, values: Array) -> Array:
        """(1 - share L)^-1 values, to about `solved`."""
        given = np.ascontiguousarray(values)
        scale, lines = self._factored(share)

        def applied(row: Array) -> Array:
            one = row.reshape(self.shape)
            total = scale * one
            self._add_image(total, one, -share)
            return total.ravel()

        def relaxed(row: Array) -> Array:
            result = lines[0].solved(row.reshape(self.shape))
            for line in lines[1:]:
                rest = row.reshape(self.shape) - scale * result
                self._add_image(rest, result, share)
                result += line.solved(rest)
            return result.ravel()

        right, size = given.ravel(), values.size
        first = relaxed(right) if self.before is None else self.before + relaxed(right - applied(self.before))
        matrix, inverse = (sl.LinearOperator((size, size), matvec=one, dtype=float) for one in (applied, relaxed))
        solution, _ = sl.bicgstab(matrix, right, first, rtol=self.solved, maxiter=_ITERATIONS, M=inverse)
        self.before = solution
        return np.asarray(solution).reshape(self.shape)

    def _factored(self, share: float) -> tuple[Array, list[_Lines]]:
        """1 + share rate, and for each axis the factors of its own line's terms and of the others' diagonals."""
        if self.known is None or self.known[0] != share:
            scale = 1 + share * self.rate
            diagonal = scale + share * sum(one for rows in (self.ahead, self.behind) for one in rows)
            lines = [
                _Lines.of(i, diagonal, share * ahead, share * behind)
                for i, (ahead, behind) in enumerate(zip(self.ahead, self.behind))
            ]
            self.known = (share, scale, lines)
        return self.known[1:]

    def adjoint(self, share: float, values: Array) -> Array:
        """About where paths from ``values`` are after a time ``share``: one axis after the other."""
        for axis in reversed(range(len(self.nodes))):
            given = thin(values.copy(), axis)
            _thomas_transposed(given, thin(share * self.ahead[axis], axis), thin(share * self.behind[axis], axis))
            values = back(given, values.shape, axis)
        return values / (1 + share * self.rate)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Stencil:
    """f d + a d^2 / 2 along one axis: where each node's window begins, and the weights of the nodes in it.

    ``weights`` has shape (nodes of a window, ..., nodes, ...), the grid's with its axes before and behind run together.
    """

    axis: int
    start: Index
    weights: Array

    @classmethod
    def of(cls, axis: int, nodes: Array, flow: Array, half: Array) -> _Stencil:
        """Of drift and half of the squared noise at all nodes."""
        up, down = upwind(nodes, False)
        count = len(nodes)
        start = np.clip(np.arange(count) - _WINDOW // 2, 0, count - _WINDOW).astype(np.intp)
        columns = start[:, None] + np.arange(_WINDOW)
        total = np.zeros((_WINDOW, *thin(flow, axis).shape))
        for matrix, factor in (
            (up, np.maximum(flow, 0)),
            (down, np.minimum(flow, 0)),
            (difference(nodes, CENTRAL, 2), half),
        ):
            rows = np.take_along_axis(matrix.toarray(), columns, axis=1)
            total += rows.T[:, None, :, None] * thin(np.ascontiguousarray(factor), axis)
        return cls(axis=axis, start=start, weights=total)

    def add(self, total: Array, values: Array, factor: float) -> None:
        """Add ``factor`` times the image of ``values`` to contiguous memory."""
        out, given = thin(total, self.axis), thin(values, self.axis)
        if out.shape[2] > 1:
            _weighed(out, given, self.start, self.weights, factor)
        else:
            _weighed_along_last(out[:, :, 0], given[:, :, 0], self.weights[..., 0], factor)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Lines:
    """Factors of the tridiagonal matrices along the lines of one axis, and of diagonal ones with others' terms.

    ``factors`` has shape (3, before, along, behind): 1 / the pivots, and what elimination takes from the line's earlier
    and later neighbour. Along the last axis lines stand side by side, `_LANES` of them together.
    """

    axis: int
    factors: Array

    @classmethod
    def of(cls, axis: int, diagonal: Array, ahead: Array, behind: Array) -> _Lines:
        """Of diagonal x_j - ahead x_{j+1} - behind x_{j-1}; where a line begins, its diagonal is less by ``behind``."""
        parts = [thin(np.ascontiguousarray(one), axis) for one in (diagonal, ahead, behind)]
        if parts[0].shape[2] == 1:
            parts = [_side_by_side(one[:, :, 0]) for one in parts]
        factors = np.empty((3, *parts[0].shape))
        _factors(factors, *parts)
        return cls(axis=axis, factors=factors)

    def solved(self, values: Array) -> Array:
        """A new array with the systems' solutions."""
        given = thin(values.copy(), self.axis)
        if given.shape[2] > 1:
            _thomas(given, self.factors)
        else:
            _thomas_along_last(given[:, :, 0], self.factors)
        return back(given, values.shape, self.axis)


def _side_by_side(rows: Array) -> Array:
    """Lines along the last axis, shape (P, N), as (ceil(P / lanes), N, lanes); the last one fills what is left."""
    whole = np.concatenate([rows, np.repeat(rows[-1:], -len(rows) % _LANES, axis=0)])
    return np.ascontiguousarray(whole.reshape(-1, _LANES, rows.shape[1]).transpose(0, 2, 1))


Discretised = Equation | SplitEquation


def discretised(
    nodes: Sequence[Array], flow: Array, spread: Array, dead: Mask, rate: Array, solved: float = SOLVED,
    more: sp.csr_array | None = None,
) -> Discretised:  # fmt: skip
    """A matrix and its factors where there are up to two states, else factors axis by axis."""
    if len(nodes) < 3:
        return Equation(nodes, flow, spread, dead, rate, more)
    return SplitEquation(nodes, flow, spread, dead, rate, solved, more)


def banded(matrix: sp.csr_array) -> Banded:
    """A sparse matrix by rows."""
    dense = matrix.toarray()
    start = np.array([np.flatnonzero(row)[0] for row in dense])
    width = max(int(np.flatnonzero(row)[-1] - first) + 1 for row, first in zip(dense, start))
    start = np.minimum(start, dense.shape[1] - width).astype(np.intp)
    return Banded(start, np.ascontiguousarray(np.take_along_axis(dense, start[:, None] + np.arange(width), axis=1)))


@compiled
def _weighed(out, values, start, w, factor):  # type: ignore[no-untyped-def]
    """out[p, j, q] += factor sum_k w[k, p, j, q] values[p, start[j] + k, q] over five k."""
    for p in range(values.shape[0]):
        for j in range(start.size):
            s = start[j]
            for q in range(values.shape[2]):
                out[p, j, q] += factor * (
                    w[0, p, j, q] * values[p, s, q] + w[1, p, j, q] * values[p, s + 1, q]
                    + w[2, p, j, q] * values[p, s + 2, q] + w[3, p, j, q] * values[p, s + 3, q]
                    + w[4, p, j, q] * values[p, s + 4, q]
                )  # fmt: skip


@compiled
def _weighed_along_last(out, values, w, factor):  # type: ignore[no-untyped-def]
    """The same along the last axis: out[p, j] += factor sum_k w[k, p, j] values[p, j + k - 2], inward at ends."""
    count = values.shape[1]
    for p in range(values.shape[0]):
        for j in (0, 1, count - 2, count - 1):
            s = 0 if j < 2 else count - 5
            for k in range(5):
                out[p, j] += factor * w[k, p, j] * values[p, s + k]
        inner, v = out[p, 2 : count - 2], values[p]  # indices that may be negative would keep the loop from vectors
        w0, w1, w2, w3, w4 = w[0, p, 2:], w[1, p, 2:], w[2, p, 2:], w[3, p, 2:], w[4, p, 2:]
        v1, v2, v3, v4 = v[1:], v[2:], v[3:], v[4:]
        for j in range(inner.size):
            inner[j] += factor * (w0[j] * v[j] + w1[j] * v1[j] + w2[j] * v2[j] + w3[j] * v3[j] + w4[j] * v4[j])


@compiled
def _factors(out, diagonal, ahead, behind):  # type: ignore[no-untyped-def]
    """Factors of the matrices diagonal x_j - ahead x_{j+1} - behind x_{j-1} along the middle axis."""
    for p in range(diagonal.shape[0]):
        for j in range(diagonal.shape[1]):
            for q in range(diagonal.shape[2]):
                if j == 0:
                    scale = 1.0 / (diagonal[p, j, q] - behind[p, j, q])
                    out[1, p, j, q] = 0.0
                else:
                    scale = 1.0 / (diagonal[p, j, q] - behind[p, j, q] * out[2, p, j - 1, q])
                    out[1, p, j, q] = behind[p, j, q] * scale
                out[0, p, j, q], out[2, p, j, q] = scale, ahead[p, j, q] * scale


@compiled
def _thomas(values, factors):  # type: ignore[no-untyped-def]
    """Solve along the middle axis, in place."""
    count, width = values.shape[1], values.shape[2]
    for p in range(values.shape[0]):
        for q in range(width):
            values[p, 0, q] *= factors[0, p, 0, q]
        for j in range(1, count):
            for q in range(width):
                values[p, j, q] = factors[0, p, j, q] * values[p, j, q] + factors[1, p, j, q] * values[p, j - 1, q]
        for j in range(count - 2, -1, -1):
            for q in range(width):
                values[p, j, q] += factors[2, p, j, q] * values[p, j + 1, q]


@compiled
def _thomas_along_last(values, factors):  # type: ignore[no-untyped-def]
    """The same along the last axis, of lines side by side."""
    count, lanes = values.shape[1], factors.shape[3]
    held = np.zeros((count, lanes))
    for b in range(factors.shape[1]):
        begin = b * lanes
        many = min(lanes, values.shape[0] - begin)
        for p in range(many):
            for j in range(count):
                held[j, p] = values[begin + p, j]
        for p in range(lanes):
            held[0, p] *= factors[0, b, 0, p]
        for j in range(1, count):
            for p in range(lanes):
                held[j, p] = factors[0, b, j, p] * held[j, p] + factors[1, b, j, p] * held[j - 1, p]
        for j in range(count - 2, -1, -1):
            for p in range(lanes):
                held[j, p] += factors[2, b, j, p] * held[j + 1, p]
        for p in range(many):
            for j in range(count):
                values[begin + p, j] = held[j, p]


@compiled
def _thomas_transposed(values, ahead, behind):  # type: ignore[no-untyped-def]
    """The same with the transposed matrix."""
    count, width = values.shape[1], values.shape[2]
    ratio, scale = np.empty((count, width)), np.empty((count, width))
    for p in range(values.shape[0]):
        for j in range(count):
            for q in range(width):
                up, low = ahead[p, j, q], behind[p, j, q]
                if j == 0:
                    scale[j, q] = 1.0 / (1.0 + up)
                else:
                    scale[j, q] = 1.0 / (1.0 + up + low - low * ratio[j - 1, q])
                    values[p, j, q] += ratio[j - 1, q] * values[p, j - 1, q]
                ratio[j, q] = up * scale[j, q]
        for j in range(count - 1, -1, -1):
            for q in range(width):
                if j < count - 1:
                    values[p, j, q] += behind[p, j + 1, q] * values[p, j + 1, q]
                values[p, j, q] *= scale[j, q]


def _diagonal(values: Array) -> sp.dia_array:
    return sp.diags_array(np.ascontiguousarray(values, dtype=float).ravel())
