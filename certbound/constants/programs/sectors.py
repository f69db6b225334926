"""Jacobian sets as the semidefinite programs take them: vertices, or centred sectors with |delta| <= 1."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from certbound.arrays import Array, Index
from certbound.constants.jacobians import AffineSet, IntervalMatrixSet, JacobianSet, SectorSet, UnionSet, VertexPolytope

VERTEX_LIMIT = 32
"""Above this number of vertices a set that has a sector form is used in it."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Sector:
    """{A + B Delta C : Delta = diag(delta), |delta| <= 1}: a sector set, centred and scaled."""

    A: Array
    B: Array
    C: Array
    groups: tuple[int, ...]
    scale: Array


def lmi_blocks(jacobians: JacobianSet, *, form: str = "auto") -> list[Array | Sector]:
    """The pieces that a program imposes one inequality each for: vertices, or centred sectors.

    ``form`` is "vertices", "sector", or "auto", which keeps vertices up to ``VERTEX_LIMIT`` of them.
    """
    if form not in ("auto", "vertices", "sector"):
        raise ValueError(f'`form` must be "auto", "vertices" or "sector", got {form!r}.')
    if isinstance(jacobians, UnionSet):
        return [block for member in jacobians.members for block in lmi_blocks(member, form=form)]
    few = jacobians.vertex_count <= VERTEX_LIMIT
    if isinstance(jacobians, VertexPolytope) or form == "vertices" or (form == "auto" and few):
        return list(jacobians.vertices())
    if isinstance(jacobians, IntervalMatrixSet):
        jacobians = jacobians.affine
    if isinstance(jacobians, AffineSet):
        jacobians = jacobians.sector()
    if not isinstance(jacobians, SectorSet):
        raise ValueError(f'`form="sector"` needs a set with a sector form, got {type(jacobians).__name__}.')
    return [centred(jacobians)]


def varying(sector: SectorSet) -> Index:
    """Entries of Delta that have a range and reach the matrix."""
    low, high = sector.box
    reaches = sector.left.any(axis=0) & sector.right.any(axis=1)
    return np.flatnonzero((high > low) & reaches)


def centred(sector: SectorSet) -> Sector:
    """The sector set in floating point with |delta| <= 1 and columns of B as long as the rows of C."""
    low, high = sector.box
    wide = varying(sector)
    A = sector.affine.J0 + (sector.left * ((low + high) / 2)) @ sector.right
    B, C = sector.left[:, wide], ((high - low) / 2)[wide, None] * sector.right[wide]
    scale = np.sqrt(np.linalg.norm(C, axis=1) / np.linalg.norm(B, axis=0))
    assert sector.groups is not None
    groups = tuple(sector.groups[i] for i in wide)
    return Sector(A=A, B=B * scale, C=C / scale[:, None], groups=groups, scale=scale)


def transformed(block: Array | Sector, root: Array, inverse: Array) -> Array | Sector:
    """The block in coordinates y = root x."""
    if isinstance(block, Sector):
        return replace(block, A=root @ block.A @ inverse, B=root @ block.B, C=block.C @ inverse)
    return np.asarray(root @ block @ inverse)


def contraction_value(metric: Array, matrices: Array, *, continuous: bool) -> float:
    """c or L of given matrices in the norm of P, in floating point (a proposal's worth, not a bound)."""
    lower = np.linalg.cholesky(metric)
    inside = lower.T @ matrices @ np.linalg.inv(lower.T)
    if continuous:
        return float(np.linalg.eigvalsh((inside + inside.swapaxes(-1, -2)) / 2)[..., -1].max())
    return float(np.linalg.norm(inside, ord=2, axis=(-2, -1)).max())
