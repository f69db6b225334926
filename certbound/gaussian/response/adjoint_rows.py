"""Supports of a linear response along rows, by adjoint rows r_j = r_{j+1} F_j.

The residual of that float product meets the state of step j, whose size is known, so errors never wrap.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property

import numpy as np

from certbound.arrays import Array, Integers
from certbound.errors import EngineError
from certbound.gaussian.response.linear_response import TINY, LinearResponse, gamma
from certbound.rigor.rounding import quiet
from certbound.watch import poll

_MEMORY = 6 * 2**30  # bytes that the rows of one cell may take
_KEPT = 2**29  # bytes of absolute values that are kept beside the coefficients
_ROW, _ENTRIES = 4000, 2**22  # products in a sum, and entries of a matrix, up to which all steps are one matrix
_LARGE, _SPARSE = 40, 0.1  # states and share of nonzero entries from which on products are sparse


class RowResponse:
    """Supports, along chosen rows, of states driven through the response of one cell.

    The state obeys s_{j+1} = F_j s_j + b_j. For rows r at nodes k the class gives bounds of r . s_k from the sets
    of s_0 and b_j, by the adjoint rows of every earlier step. Where numbers overflow a bound is infinite, or no number.

    Parameters
    ----------
    rows : ndarray, shape (M, D, n)
        Rows at nodes 0 .. M - 1 (M <= N + 1).
    columns : ndarray of int, optional
        States that b_j is expected to move; what it does to the others is bounded coarsely (all when omitted).
    """

    @quiet
    def __init__(self, response: LinearResponse, cell: int, rows: Array, columns: Integers | None = None) -> None:
        self.nodes, asked, self.dimension = rows.shape
        n = self.dimension
        places: dict[bytes, int] = {}
        self.place = np.array([places.setdefault(rows[:, d].tobytes(), len(places)) for d in range(asked)], dtype=int)
        first = np.array([int(np.argmax(self.place == d)) for d in range(len(places))], dtype=int)
        self.count = len(places)
        self.transition, self.error = response.transition[cell], response.transition_error[cell]
        self.columns = np.arange(n) if columns is None else np.asarray(columns)
        self.others = np.setdiff1d(np.arange(n), self.columns)
        needed = 4.0 * self.nodes**2 * self.count * len(self.columns)  # bytes
        if needed > _MEMORY:
            raise EngineError(
                f"the linear engine would take {needed / 2**30:.3g} GiB of memory, for {self.count} rows at "
                f"{self.nodes} times, and stops at {_MEMORY / 2**30:g}; use another method, or a shorter horizon."
            )
        current = np.array(rows[:, first])
        self.coefficients: list[Array] = [np.empty(0)] * (self.nodes - 1)
        self.rest: list[Array] = [np.empty(0)] * (self.nodes - 1)  # row sums over the other columns
        for j in range(self.nodes - 2, -1, -1):
            poll()
            later = current[j + 1 :].reshape(-1, n).copy()
            self.coefficients[j] = np.ascontiguousarray(later[:, self.columns])
            if len(self.others):
                self.rest[j] = np.abs(later[:, self.others]).sum(axis=1) * (1 + 1e-12)
            current[j + 1 :] = _times(later, self.transition[j]).reshape(-1, self.count, n)
        self.initial = current

    def _gather(self, parts: Iterator[Array]) -> Array:
        """Sum over j of the contributions of step j to all later nodes: shape (M, D), or (M, D, ...) as they are."""
        total: Array | None = None
        for j, part in enumerate(parts):
            poll()
            more = part.reshape(-1, self.count, *part.shape[1:])
            total = np.zeros((self.nodes, *more.shape[1:])) if total is None else total
            total[j + 1 :] += more
        return np.zeros((self.nodes, len(self.place))) if total is None else total[:, self.place]

    def _sizes(self, bounds: Array) -> Array:
        """Sum over j of |coefficients| ``bounds``_j, (N, n) or (N, n, B): shape (M, D) or (M, D, B), not rounded."""
        few, own = bool(len(self.others)), bounds[:, self.columns]
        if (whole := self._whole) is not None and np.isfinite(bounds).all():  # 0 times infinity is no number
            steps = self.nodes - 1
            row = [own[:steps], bounds[:steps, self.others].max(axis=1, keepdims=True)] if few else [own[:steps]]
            flat = np.concatenate(row, axis=1).reshape(-1, *bounds.shape[2:])
            return np.asarray((whole @ flat).reshape(self.nodes, self.count, *bounds.shape[2:])[:, self.place])
        return self._gather(
            size @ own[j] + (np.multiply.outer(self.rest[j], bounds[j, self.others].max(axis=0)) if few else 0.0)
            for j, size in enumerate(self._magnitudes or map(np.abs, self.coefficients))
        )

    @cached_property
    def _magnitudes(self) -> list[Array] | None:
        """|coefficients|; None where they are large."""
        few = sum(part.nbytes for part in self.coefficients) <= _KEPT
        return [np.abs(part) for part in self.coefficients] if few else None

    @cached_property
    def _whole(self) -> Array | None:
        """|coefficients| of all steps, and the rest, as one matrix; None where it would be large."""
        # a sum of _ROW products, in any order, errs by less than the 1e-12 that whoever asks `_sizes` adds
        steps, width, few = self.nodes - 1, len(self.columns), int(len(self.others) > 0)
        if (terms := steps * (width + few)) > _ROW or terms * self.nodes * self.count > _ENTRIES:
            return None
        rows = np.zeros((self.nodes, self.count, steps, width + few))
        for j, c in enumerate(self.coefficients):
            rows[j + 1 :, :, j, :width] = np.abs(c).reshape(-1, self.count, width)
            rows[j + 1 :, :, j, width:] = self.rest[j].reshape(steps - j, self.count, few)
        return rows.reshape(self.nodes * self.count, terms)

    @quiet
    def errors(self, sizes: Array) -> Array:
        """Effect of the rounded adjoint rows for states with |s_j| <= ``sizes`` (N + 1, n): shape (M, D)."""
        steps = self.nodes - 1
        own = np.einsum("jab,jb->ja", np.abs(self.transition[:steps]), sizes[:steps]) * (2 * gamma(self.dimension))
        own = own + (self.error[:steps] * sizes[:steps].sum(axis=1))[:, None]
        return self._sizes(own * (1 + 1e-12) + TINY) * (1 + 1e-12)

    @quiet
    def start(self, generators: Array) -> Array:
        """Support of the zonotope of ``generators`` (G, n) at node 0, carried to every node: shape (M, D)."""
        if not len(generators):
            return np.zeros((self.nodes, len(self.place)))
        value = np.abs(self.initial @ generators.T).sum(-1)
        slack = gamma(self.dimension + len(generators)) * 2
        size = (np.abs(self.initial) @ np.abs(generators.T)).sum(-1)
        return np.asarray(value + slack * size + TINY)[:, self.place]

    @quiet
    def boxes(self, radii: Array) -> Array:
        """Support of the sum of the boxes |b_j| <= ``radii`` (N, n): shape (M, D)."""
        return np.asarray(self._sizes(radii) * (1 + gamma(2 * self.nodes + self.dimension) * 2 + 1e-12))

    @quiet
    def centred(self, values: Array, radii: Array) -> tuple[Array, Array]:
        """The response to b_j = ``values`` (N, n), and the support of the boxes |b_j| <= ``radii`` around them.

        The latter includes the rounding error of the former, and what the other columns do.
        """
        total = self._gather(c @ values[j, self.columns] for j, c in enumerate(self.coefficients))
        size, rounding = np.abs(values), gamma(2 * self.nodes + self.dimension) * 2
        both = self._sizes(np.stack([radii, size], axis=-1))
        slack = both[..., 0] * (1 + rounding + 1e-12) + both[..., 1] * rounding + TINY
        if len(self.others):
            slack = slack + self._gather(
                rest * size[j, self.others].max() for j, rest in enumerate(self.rest)) * (1 + 1e-12)
        return total, slack

    @quiet
    def segments(self, generators: Array) -> Array:
        """Support of the sum over j of the zonotopes of ``generators`` (N, G, n): shape (M, D)."""

        def part(j: int, c: Array) -> Array:
            own, count = generators[j][:, self.columns], generators.shape[1]
            size = np.abs(generators[j]).sum(axis=0)
            found = np.abs(c @ own.T).sum(-1) + np.abs(c) @ size[self.columns] * (gamma(self.dimension + count) * 2)
            return np.asarray(found + (self.rest[j] * size[self.others].max() if len(self.others) else 0.0))

        if not generators.size:
            return np.zeros((self.nodes, len(self.place)))
        total = self._gather(part(j, c) for j, c in enumerate(self.coefficients))
        return np.asarray(total * (1 + gamma(2 * self.nodes + generators.shape[1]) * 2 + 1e-12))


def _times(rows: Array, matrix: Array) -> Array:
    """``rows`` @ ``matrix``, by a sparse product where that pays."""
    if len(matrix) < _LARGE or np.count_nonzero(matrix) > matrix.size * _SPARSE:
        return rows @ matrix
    from scipy.sparse import csr_array

    return np.ascontiguousarray((csr_array(matrix.T) @ rows.T).T)
