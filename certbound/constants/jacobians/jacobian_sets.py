"""Sets that a Jacobian ranges over: what is known of D_x f, kept as structured as the model allows.

Every class is a convex set of n x n matrices (``UnionSet``: a union of them) with the same few methods:
``contains``, ``sample``, ``support``, ``vertices``, ``in_metric``. Vertices suffice for every bound made from
them, because mu_P(J) and ||J||_P are convex in J. Symbols of docs/theory.md, Sec. 6: J_i vertices; J0 + sum
theta_k M_k affine; A + B Delta C sector form, Delta diagonal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array, Mask
from certbound.checks import frozen
from certbound.constants.jacobians.affine import AffineForm, AffineSet
from certbound.constants.jacobians.arguments import (
    finite_array,
    is_near,
    matrix_batch,
    metric_roots,
    square_matrix,
)


@runtime_checkable
class JacobianSet(Protocol):
    """What every set of Jacobians offers."""

    @property
    def dimension(self) -> int:
        """State dimension n."""

    @property
    def vertex_count(self) -> int:
        """Number of matrices that ``vertices`` returns."""

    def contains(self, matrices: ArrayLike, tolerance: float = 1e-9) -> Mask:
        """Whether each matrix of a batch (..., n, n) lies in the set, up to ``tolerance`` entrywise."""

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """``count`` random members, shape (count, n, n)."""

    def support(self, directions: ArrayLike) -> Array:
        """Largest sum(direction * J) over the set, for a batch of directions (..., n, n)."""

    def vertices(self) -> Array:
        """Matrices (v, n, n) whose convex hull is the set (``slack`` left out)."""

    def in_metric(self, metric: ArrayLike) -> Self:
        """The set of P^{1/2} J P^{-1/2}: the same Jacobians in coordinates where the P-norm is Euclidean."""


@dataclass(frozen=True, eq=False, kw_only=True)
class VertexPolytope:
    """Convex hull of finitely many matrices.

    Examples
    --------
    >>> VertexPolytope(matrices=[[[0.0, 1.0], [-1.0, -1.0]], [[0.0, 1.0], [-2.0, -1.0]]]).vertex_count
    2
    """

    matrices: ArrayLike  # (v, n, n): the vertices; a single matrix (n, n) is a point (a linear time-invariant system)
    _stack: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        stack = finite_array("matrices", self.matrices)
        stack = stack[None] if stack.ndim == 2 else stack
        if stack.ndim != 3 or stack.shape[0] == 0 or stack.shape[1] != stack.shape[2] or stack.shape[1] == 0:
            raise ValueError(f"`matrices` must be a list of square matrices of one size, got shape {stack.shape}.")
        object.__setattr__(self, "_stack", frozen(stack))
        object.__setattr__(self, "matrices", self._stack)

    @property
    def dimension(self) -> int:
        return int(self._stack.shape[1])

    @property
    def vertex_count(self) -> int:
        return len(self._stack)

    def contains(self, matrices: ArrayLike, tolerance: float = 1e-9) -> Mask:
        batch = matrix_batch(matrices, self.dimension)
        columns = self._stack.reshape(len(self._stack), -1).T
        one = np.ones((1, columns.shape[1]))
        flags = [
            is_near(columns, target, tolerance, (0.0, None), one) for target in batch.reshape(-1, columns.shape[0])
        ]
        return np.array(flags, dtype=bool).reshape(batch.shape[:-2])

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        weights = rng.dirichlet(np.full(len(self._stack), 0.5), size=count)
        return np.asarray(np.tensordot(weights, self._stack, axes=1))

    def support(self, directions: ArrayLike) -> Array:
        batch = matrix_batch(directions, self.dimension)
        return np.asarray(np.einsum("...ij,vij->...v", batch, self._stack).max(axis=-1))

    def vertices(self) -> Array:
        return self._stack

    def in_metric(self, metric: ArrayLike) -> VertexPolytope:
        root, inverse = metric_roots(metric)
        return VertexPolytope(matrices=root @ self._stack @ inverse)


@dataclass(frozen=True, eq=False, kw_only=True)
class IntervalMatrixSet(AffineForm):
    """{J : low <= J <= high entrywise}; entries vary independently of each other."""

    low: ArrayLike  # (n, n)
    high: ArrayLike  # (n, n)
    box: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        low, high = square_matrix("low", self.low), square_matrix("high", self.high)
        if low.shape != high.shape:
            raise ValueError(f"`low` and `high` must have equal shapes, got {low.shape} and {high.shape}.")
        if np.any(low > high):
            raise ValueError("`low` must not exceed `high` in any entry.")
        object.__setattr__(self, "box", frozen(np.stack([low, high])))

    def in_metric(self, metric: ArrayLike) -> IntervalMatrixSet:
        """Smallest interval matrix that contains P^{1/2} J P^{-1/2} for every member (a superset)."""
        root, inverse = metric_roots(metric)
        mid = root @ (self.box[0] + self.box[1]) @ inverse / 2
        rad = np.abs(root) @ (self.box[1] - self.box[0]) @ np.abs(inverse) / 2
        return IntervalMatrixSet(low=mid - rad, high=mid + rad)

    @cached_property
    def affine(self) -> AffineSet:  # type: ignore[override]  # the base says property
        """The same set with one parameter per uncertain entry."""
        rows, columns = np.nonzero(self.box[1] > self.box[0])
        terms = np.zeros((len(rows), *self.box.shape[1:]))
        terms[np.arange(len(rows)), rows, columns] = 1.0
        center = np.where(self.box[1] > self.box[0], 0.0, self.box[0])
        return AffineSet(center=center, terms=terms, low=self.box[0][rows, columns], high=self.box[1][rows, columns])


@dataclass(frozen=True, eq=False, kw_only=True)
class UnionSet:
    """Union of Jacobian sets, one per sub-box; bounds hold for each member, hence for the union."""

    members: Sequence[JacobianSet]

    def __post_init__(self) -> None:
        members = tuple(self.members)
        if not members or len({member.dimension for member in members}) != 1:
            raise ValueError("`members` must hold at least one Jacobian set, all of one dimension.")
        object.__setattr__(self, "members", members)

    @property
    def dimension(self) -> int:
        return self.members[0].dimension

    @property
    def vertex_count(self) -> int:
        return sum(member.vertex_count for member in self.members)

    def contains(self, matrices: ArrayLike, tolerance: float = 1e-9) -> Mask:
        return np.asarray(np.any([member.contains(matrices, tolerance) for member in self.members], axis=0))

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        chosen = np.bincount(rng.integers(len(self.members), size=count), minlength=len(self.members))
        return np.concatenate([member.sample(rng, int(c)) for member, c in zip(self.members, chosen) if c])

    def support(self, directions: ArrayLike) -> Array:
        return np.asarray(np.max([member.support(directions) for member in self.members], axis=0))

    def vertices(self) -> Array:
        return np.concatenate([member.vertices() for member in self.members])

    def in_metric(self, metric: ArrayLike) -> UnionSet:
        return UnionSet(members=[member.in_metric(metric) for member in self.members])


def as_set(source: JacobianSet | ArrayLike) -> JacobianSet:
    """A Jacobian set as it is; a matrix (n, n) or a stack of vertices (v, n, n) as a ``VertexPolytope``."""
    return source if isinstance(source, JacobianSet) else VertexPolytope(matrices=source)
