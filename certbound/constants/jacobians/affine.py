"""Jacobian sets with parameters: J0 + sum theta_k M_k, and the sector form A + B Delta C (Sec. 6)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array, Mask
from certbound.checks import assign, frozen
from certbound.constants.jacobians.arguments import (
    UNIT,
    factor,
    finite_array,
    is_near,
    matrix_batch,
    metric_roots,
    parameter_range,
    square_matrix,
)

_VERTEX_LIMIT = 1 << 16


@dataclass(frozen=True, eq=False, kw_only=True)
class AffineSet:
    """{J0 + sum_k theta_k M_k + E : low <= theta <= high, |E| <= slack entrywise}."""

    center: ArrayLike  # (n, n): J0
    terms: ArrayLike  # (k, n, n): M_k; entries that share a parameter stay correlated
    # (k,): finite range of each parameter
    low: ArrayLike
    high: ArrayLike
    # (n, n): entrywise error, which carries the rounding of J0 and M_k; zero when omitted
    slack: ArrayLike | None = None
    J0: Array = field(init=False, repr=False)
    M: Array = field(init=False, repr=False)
    box: Array = field(init=False, repr=False)
    error: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        center = square_matrix("center", self.center)
        n = len(center)
        box = parameter_range(self.low, self.high)
        terms = finite_array("terms", self.terms).reshape(-1, n, n) if box.shape[1] else np.zeros((0, n, n))
        if len(terms) != box.shape[1]:
            raise ValueError(
                f"`terms` must hold one {n} x {n} matrix per parameter, got {len(terms)} for {box.shape[1]}."
            )
        slack = np.zeros((n, n)) if self.slack is None else square_matrix("slack", self.slack)
        if slack.shape != center.shape or np.any(slack < 0):
            raise ValueError(f"`slack` must be a non-negative {n} x {n} matrix, got shape {slack.shape}.")
        assign(self, J0=frozen(center), M=frozen(terms), box=frozen(box), error=frozen(slack))

    @property
    def dimension(self) -> int:
        return len(self.J0)

    @property
    def vertex_count(self) -> int:
        return 1 << int(np.count_nonzero(self.box[1] > self.box[0]))

    def contains(self, matrices: ArrayLike, tolerance: float = 1e-9) -> Mask:
        batch = matrix_batch(matrices, self.dimension)
        columns = self.M.reshape(len(self.M), -1).T
        bounds = list(zip(*self.box))
        allowed = self.error.ravel() + tolerance
        targets = (batch - self.J0).reshape(-1, self.dimension**2)
        flags = [is_near(columns, target, allowed, bounds) for target in targets]
        return np.array(flags, dtype=bool).reshape(batch.shape[:-2])

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        theta = rng.uniform(self.box[0], self.box[1], size=(count, len(self.M)))
        ends = rng.random(theta.shape) < 0.25  # extremes matter most
        theta = np.where(ends, np.where(rng.random(theta.shape) < 0.5, self.box[0], self.box[1]), theta)
        noise = rng.uniform(-1.0, 1.0, size=(count, *self.J0.shape)) * self.error
        return np.asarray(self.J0 + np.tensordot(theta, self.M, axes=1) + noise)

    def support(self, directions: ArrayLike) -> Array:
        batch = matrix_batch(directions, self.dimension)
        slopes = np.einsum("...ij,kij->...k", batch, self.M)
        spread = np.maximum(slopes * self.box[0], slopes * self.box[1]).sum(axis=-1)
        constant = (batch * self.J0).sum(axis=(-2, -1)) + (np.abs(batch) * self.error).sum(axis=(-2, -1))
        return np.asarray(constant + spread)

    def vertices(self) -> Array:
        return np.asarray(self.J0 + np.tensordot(self.corners(), self.M, axes=1))

    def corners(self) -> Array:
        """Parameter values of the vertices, shape (v, k)."""
        wide = np.flatnonzero(self.box[1] > self.box[0])
        if self.vertex_count > _VERTEX_LIMIT:
            raise ValueError(f"the set has 2**{len(wide)} vertices; use its sector form (`sector()`) instead.")
        signs = (np.arange(1 << len(wide))[:, None] >> np.arange(len(wide))) & 1
        theta = np.repeat(self.box[:1], len(signs), axis=0)
        theta[:, wide] = np.where(signs == 1, self.box[1, wide], self.box[0, wide])
        return theta

    def in_metric(self, metric: ArrayLike) -> AffineSet:
        root, inverse = metric_roots(metric)
        return replace(
            self,
            center=root @ self.J0 @ inverse,
            terms=root @ self.M @ inverse,
            slack=np.abs(root) @ self.error @ np.abs(inverse),
        )

    def sector(self) -> SectorSet:
        """The same set (up to rounding that goes into ``slack``) as A + B Delta C.

        A term that is one row or one column is split exactly, another by its singular values: one diagonal
        entry of Delta per unit of rank.
        """
        left, right, group = [], [], []
        slack = self.error.copy()
        for k, term in enumerate(self.M):
            columns, rows, residue = factor(term)
            left.append(columns)
            right.append(rows)
            group += [k] * columns.shape[1]
            slack += np.nextafter(residue * np.max(np.abs(self.box[:, k])) * (1 + 4 * UNIT), np.inf) * (residue > 0)
        n = self.dimension
        index = np.array(group, dtype=int)
        return SectorSet(
            A=self.J0,
            B=np.concatenate(left, axis=1) if left else np.zeros((n, 0)),
            C=np.concatenate(right, axis=0) if right else np.zeros((0, n)),
            low=self.box[0, index],
            high=self.box[1, index],
            slack=slack * (1 + len(self.M) * UNIT),
            groups=tuple(group),
        )


class AffineForm:
    """The methods of a set that is an ``AffineSet`` in another form."""

    affine: AffineSet

    @property
    def dimension(self) -> int:
        return self.affine.dimension

    @property
    def vertex_count(self) -> int:
        return self.affine.vertex_count

    def contains(self, matrices: ArrayLike, tolerance: float = 1e-9) -> Mask:
        return self.affine.contains(matrices, tolerance)

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        return self.affine.sample(rng, count)

    def support(self, directions: ArrayLike) -> Array:
        return self.affine.support(directions)

    def vertices(self) -> Array:
        return self.affine.vertices()


@dataclass(frozen=True, eq=False, kw_only=True)
class SectorSet(AffineForm):
    """{A + B Delta C + E : Delta = diag(delta), low <= delta <= high, |E| <= slack entrywise}."""

    A: ArrayLike  # (n, n)
    B: ArrayLike  # (n, k)
    C: ArrayLike  # (k, n)
    # (k,): range of each slope
    low: ArrayLike
    high: ArrayLike
    slack: ArrayLike | None = None  # (n, n): entrywise error; zero when omitted
    groups: tuple[int, ...] | None = None  # entries of Delta with the same number are equal; all differ when omitted
    left: Array = field(init=False, repr=False)
    right: Array = field(init=False, repr=False)
    affine: AffineSet = field(init=False, repr=False)

    def __post_init__(self) -> None:
        a = square_matrix("A", self.A)
        box = parameter_range(self.low, self.high)
        b, c = finite_array("B", self.B), finite_array("C", self.C)
        n, k = len(a), box.shape[1]
        if b.shape != (n, k) or c.shape != (k, n):
            raise ValueError(f"`B` and `C` must have shapes ({n}, {k}) and ({k}, {n}), got {b.shape} and {c.shape}.")
        groups = tuple(range(k)) if self.groups is None else tuple(self.groups)
        if len(groups) != k:
            raise ValueError(f"`groups` must hold {k} numbers, got {len(groups)}.")
        first = [groups.index(g) for g in sorted(set(groups))]
        member = np.array([[g == groups[i] for g in groups] for i in first], dtype=float).reshape(len(first), k)
        if np.any(box != box[:, [groups.index(g) for g in groups]]):
            raise ValueError("`groups` must join entries of equal range only.")
        terms = np.zeros((len(first), n, n))
        for term, mine in zip(terms, member > 0):
            term += b[:, mine] @ c[mine]
        affine = AffineSet(center=a, terms=terms, low=box[0, first], high=box[1, first], slack=self.slack)
        assign(self, left=frozen(b), right=frozen(c), groups=groups, affine=affine)

    @property
    def box(self) -> Array:
        """Ranges of the diagonal of Delta, shape (2, k)."""
        return np.array([self.low, self.high], dtype=float).reshape(2, -1)

    def in_metric(self, metric: ArrayLike) -> SectorSet:
        root, inverse = metric_roots(metric)
        return replace(
            self,
            A=root @ self.affine.J0 @ inverse,
            B=root @ self.left,
            C=self.right @ inverse,
            slack=np.abs(root) @ self.affine.error @ np.abs(inverse),
        )
