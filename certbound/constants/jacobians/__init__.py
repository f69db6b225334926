"""Sets that a Jacobian ranges over, how they are found on a tape, and their measures."""

from __future__ import annotations

from certbound.constants.jacobians.affine import AffineForm, AffineSet, SectorSet
from certbound.constants.jacobians.arguments import square_matrix
from certbound.constants.jacobians.jacobian_sets import IntervalMatrixSet, JacobianSet, UnionSet, VertexPolytope, as_set
from certbound.constants.jacobians.measures import diagonal_weights, induced_norm, matrix_measure
from certbound.constants.jacobians.structure import affine_set

__all__ = [
    "affine_set",
    "AffineForm",
    "AffineSet",
    "as_set",
    "diagonal_weights",
    "induced_norm",
    "IntervalMatrixSet",
    "JacobianSet",
    "matrix_measure",
    "SectorSet",
    "square_matrix",
    "UnionSet",
    "VertexPolytope",
]
