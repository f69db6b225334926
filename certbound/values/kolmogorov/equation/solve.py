"""The backward equation u_t + L u + s = 0 in floats: finite differences, an implicit Runge-Kutta method, sparse LU.

Nothing here is trusted. Differences are of fourth order for noise and of third order, upwind, for drift; the method is
Alexander's third-order L-stable one (Alexander 1977, three stages).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as sl

from certbound.arrays import Array, Mask
from certbound.lazy import compiled
from certbound.values.kolmogorov.splines import Banded, back, thin

GAMMA = 0.4358665215084589
_MIDDLE = (1 + GAMMA) / 2
_FIRST = -(6 * GAMMA**2 - 16 * GAMMA + 1) / 4
_SECOND = (6 * GAMMA**2 - 20 * GAMMA + 5) / 4


def _method() -> tuple[Array, Array, Array, Array]:
    """Stage matrix, mixing matrix, weights and stage shares of the W-method, for stages that hold h k_i / gamma."""
    alpha, gamma = np.zeros((4, 4)), np.eye(4) * _DIAGONAL
    rows = np.tril_indices(4, -1)
    alpha[rows], gamma[rows] = _ALPHA, _GAMMAS
    inverse = np.linalg.inv(gamma)
    mixing = np.eye(4) / _DIAGONAL - inverse
    shares = np.zeros(4)
    for i in range(4):
        shares[i] = _DIAGONAL * (1 + mixing[i, :i] @ shares[:i])
    return alpha @ inverse, mixing, _BETA @ inverse, shares


_DIAGONAL = 0.4358665
_BETA = np.array([1.3879562598812465, -0.3364971634337403, 0.21948826650908373, -0.27094736295658994])
_ALPHA = np.array([-1.2966101254706222, 0.5964859394598576, -0.5178791536492169, -0.12819116594361657,
                   0.04928120740632802, -0.09249271923552177])  # fmt: skip
_GAMMAS = np.array([1.5858475867137631, -1.7098002380945074, 1.0515060232471816, -0.592385327006548,
                    0.20098564717326586, -0.5027022888802305])  # fmt: skip
_STAGE, _MIXED, _WEIGHTS, _SHARES = _method()

SPLIT_METHOD = _STAGE, _MIXED, _WEIGHTS, np.array([float(_STAGE[i, :i] @ _SHARES[:i]) for i in range(4)])
"""Stage and mixing matrices, weights and times of that method."""
SPLIT_DIAGONAL = _DIAGONAL

Stencils = Sequence[tuple[int, int]]
DRIFT: Stencils = ((-2, 3), (-1, 2))
"""Upwind, where the drift is positive: of fifth order, of third where that does not fit or little noise smooths."""
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


class Equation:
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
    """

    def __init__(self, nodes: Sequence[Array], flow: Array, spread: Array, dead: Mask, rate: Array) -> None:
        self.nodes, self.shape, self.live = list(nodes), flow.shape[1:], ~dead
        size = int(np.prod(self.shape))
        total = sp.csr_array((size, size))
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

    def step(self, values: Array, step: float, source: Source, given: Source) -> Array:
        """One step backward in time."""
        share = GAMMA * step

        def stage(at: Array, part: float) -> Array:
            return self.solve(share, self.speed(at, source(part), given(part)))

        first = stage(values, GAMMA)
        second = stage(values + step * (_MIDDLE - GAMMA) * first, _MIDDLE)
        partial = values + step * (_FIRST * first + _SECOND * second)
        return partial + step * GAMMA * stage(partial, 1.0)


class SplitEquation:
    """The same without a matrix, for three states and more.

    A four-stage W-method of third order (any approximate Jacobian will do): the Jacobian is a product over the axes of
    tridiagonal factors, of first order upwind for drift.

    Parameters
    ----------
    As of `Equation`.
    """

    def __init__(self, nodes: Sequence[Array], flow: Array, spread: Array, dead: Mask, rate: Array) -> None:
        self.nodes, self.shape, self.live = list(nodes), flow.shape[1:], ~dead
        self.rate = rate * self.live
        n = len(nodes)
        self.terms: list[tuple[int, Banded, Array]] = []
        self.mixed: list[tuple[int, int, Banded, Banded, Array]] = []
        self.ahead: list[Array] = []
        self.behind: list[Array] = []
        for i in range(n):
            f, a = flow[i] * self.live, spread[i, i] / 2 * self.live
            up, down = upwind(nodes[i], False)
            self.terms += [(i, banded(up), np.maximum(f, 0)), (i, banded(down), np.minimum(f, 0))]
            if a.any():
                self.terms.append((i, banded(difference(nodes[i], NOISE[-1:], 2)), a))
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
        self.terms = [term for term in self.terms if term[2].any()]

    def speed(self, values: Array, source: Array | float = 0.0, given: Array | float = 0.0) -> Array:
        """-u_t: L u and the source at live nodes, what is given at the others."""
        total = source - self.rate * values
        for axis, matrix, factor in self.terms:
            total += factor * matrix.along(values, axis)
        for i, j, first, second, factor in self.mixed:
            total += factor * first.along(second.along(values, j), i)
        return np.where(self.live, total, given)

    def solve(self, share: float, values: Array) -> Array:
        """About (1 - share L)^-1 values."""
        values = values / (1 + share * self.rate)
        for axis, (ahead, behind) in enumerate(zip(self.ahead, self.behind)):
            values = solve_along(values, axis, share * ahead, share * behind)
        return values

    def adjoint(self, share: float, values: Array) -> Array:
        """The same with the transposed factors: where paths from ``values`` are after a time ``share``."""
        for axis in reversed(range(len(self.nodes))):
            values = solve_along(values, axis, share * self.ahead[axis], share * self.behind[axis], transposed=True)
        return values / (1 + share * self.rate)

    def step(self, values: Array, step: float, source: Source, given: Source) -> Array:
        """One step backward in time."""
        stages: list[Array] = []
        for i in range(4):
            place = values
            for j in range(i):
                place = place + _STAGE[i, j] * stages[j]
            part = float(_STAGE[i, :i] @ _SHARES[:i])
            right = self.speed(place, source(part), given(part))
            for j in range(i):
                right = right + _MIXED[i, j] / step * stages[j]
            stages.append(self.solve(step * _DIAGONAL, step * _DIAGONAL * right))
        return np.asarray(values + sum(weight * stage for weight, stage in zip(_WEIGHTS, stages)))


Discretised = Equation | SplitEquation


def discretised(nodes: Sequence[Array], flow: Array, spread: Array, dead: Mask, rate: Array) -> Discretised:
    """A matrix and its factors where there are up to two states, else factors axis by axis."""
    return (Equation if len(nodes) < 3 else SplitEquation)(nodes, flow, spread, dead, rate)


def banded(matrix: sp.csr_array) -> Banded:
    """A sparse matrix by rows."""
    dense = matrix.toarray()
    start = np.array([np.flatnonzero(row)[0] for row in dense])
    width = max(int(np.flatnonzero(row)[-1] - first) + 1 for row, first in zip(dense, start))
    start = np.minimum(start, dense.shape[1] - width).astype(np.intp)
    return Banded(start, np.ascontiguousarray(np.take_along_axis(dense, start[:, None] + np.arange(width), axis=1)))


@compiled
def _thomas(values, ahead, behind):  # type: ignore[no-untyped-def]
    """Solve (1 + ahead + behind) x_j - ahead x_{j+1} - behind x_{j-1} = values along the middle axis, in place."""
    count, width = values.shape[1], values.shape[2]
    ratio = np.empty((count, width))
    for p in range(values.shape[0]):
        for j in range(count):
            for q in range(width):
                up, low = ahead[p, j, q], behind[p, j, q]
                if j == 0:
                    scale = 1.0 / (1.0 + up)
                    values[p, j, q] *= scale
                else:
                    scale = 1.0 / (1.0 + up + low - low * ratio[j - 1, q])
                    values[p, j, q] = (values[p, j, q] + low * values[p, j - 1, q]) * scale
                ratio[j, q] = up * scale
        for j in range(count - 2, -1, -1):
            for q in range(width):
                values[p, j, q] += ratio[j, q] * values[p, j + 1, q]


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


def solve_along(values: Array, axis: int, ahead: Array, behind: Array, *, transposed: bool = False) -> Array:
    """Solve tridiagonal systems along an axis (`_thomas`)."""
    given = thin(values.copy(), axis)
    (_thomas_transposed if transposed else _thomas)(given, thin(ahead, axis), thin(behind, axis))
    return back(given, values.shape, axis)


def _diagonal(values: Array) -> sp.dia_array:
    return sp.diags_array(np.ascontiguousarray(values, dtype=float).ravel())
