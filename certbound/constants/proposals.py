"""Metrics that are worth certifying: of least c or L, and of least erosion. Proposals, in floating point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from certbound.constants.affine import AffineForm, AffineSet
from certbound.constants.blocks import VERTEX_LIMIT, lmi_blocks
from certbound.constants.centers import center_metric, reachable_value
from certbound.constants.jacobians import JacobianSet
from certbound.constants.lmi import RateProgram
from certbound.constants.tightening import RadiusModel, Rooms, tighten
from certbound.errors import SolverError

__all__ = ["Proposal", "erosion_proposals", "rate_proposals", "smallest_value", "spectral_bound"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True)
class Proposal:
    """A metric and what proposed it."""

    metric: Array
    status: str


def rate_proposals(members: JacobianSet, *, continuous: bool, share: float = 5e-3) -> list[Proposal]:
    """A metric of nearly least c or L: the method of centres, or a semidefinite program where it stalls."""
    lower = spectral_bound(members, continuous=continuous)
    tolerance = share * max(abs(lower if continuous else 1 - lower), 1e-6)
    blocks = lmi_blocks(members, form=_form(members))
    if len(blocks) <= 4 * VERTEX_LIMIT:
        center = center_metric(blocks, continuous=continuous, lower=lower, tolerance=tolerance)
        metric = _normalised(center.metric)
        if metric is not None:
            return [Proposal(metric=metric, status="method of centres")]
    program = RateProgram(members, continuous=continuous, form=_form(members))
    proposal, _ = smallest_value(program, members, continuous=continuous, lower=lower, tolerance=tolerance)
    metric = _normalised(proposal)
    if metric is None:
        raise SolverError("the semidefinite program returned a metric that is not positive definite.")
    return [Proposal(metric=metric, status=f"semidefinite program: {program.status}")]


def erosion_proposals(
    members: JacobianSet, targets: Rooms, noise: Sequence[Array], radius: RadiusModel
) -> list[Proposal]:
    """The tightened metric, and the one of least c or L that it was searched from."""
    start = rate_proposals(members, continuous=radius.continuous, share=2e-3)[0]
    result = tighten(members, targets, noise, radius, start.metric, form=_form(members))
    metric = _normalised(result.metric)
    first = [] if metric is None else [Proposal(metric=metric, status=f"tightening: {result.status}")]
    return [*first, start]


def _form(members: JacobianSet) -> str:
    """Sector form where there are many vertices and a sector form exists."""
    structured = isinstance(members, AffineSet | AffineForm)
    return "sector" if structured and members.vertex_count > 16 else "vertices"


def spectral_bound(members: JacobianSet, *, continuous: bool) -> float:
    """A lower bound of c or L^2 in every metric: spectral abscissa or radius over some members."""
    matrices = members.sample(np.random.default_rng(0), 64)
    if members.vertex_count <= 512:
        matrices = np.concatenate([matrices, members.vertices()])
    elif isinstance(members, AffineSet):
        ends = np.tensordot(members.box, members.M, axes=1) + members.J0
        matrices = np.concatenate([matrices, ends])
    eigenvalues = np.linalg.eigvals(matrices)
    return float(eigenvalues.real.max() if continuous else (np.abs(eigenvalues) ** 2).max())


def _normalised(metric: Array) -> Array | None:
    """P scaled to smallest eigenvalue 1, exactly symmetric; None where it is not positive definite."""
    symmetric = (metric + metric.T) / 2
    if not np.all(np.isfinite(symmetric)):
        return None
    values = np.linalg.eigvalsh(symmetric)
    if values[0] <= 1e-12 * values[-1]:
        return None
    return np.asarray(symmetric / values[0])


def smallest_value(
    program: RateProgram,
    jacobians: JacobianSet,
    *,
    continuous: bool,
    lower: float,
    tolerance: float,
    max_solves: int = 30,
) -> tuple[Array, float]:
    """Bisection: a metric of nearly least c or L^2, and the value that it reaches in floating point.

    Parameters
    ----------
    program : RateProgram
        The program of ``jacobians``.
    jacobians : JacobianSet
    continuous : bool
    lower : float
        A lower bound of the value: the spectral abscissa, or the squared spectral radius, of a member.
    tolerance : float
        Width at which the bisection stops.
    max_solves : int

    Raises
    ------
    SolverError
        From the first solve; a later one ends the search at the best metric so far.
    """
    metric = np.eye(jacobians.dimension)
    upper = reachable_value(metric, jacobians, continuous=continuous)
    low = lower
    for count in range(max_solves):
        if upper - low <= tolerance:
            break
        target = low + (0.02 if count == 0 else 0.5) * (upper - low)
        try:
            proposal, margin = program.propose(target)
        except SolverError:
            if count == 0:
                raise
            break
        reached = reachable_value(proposal, jacobians, continuous=continuous)
        if reached < upper:
            metric, upper = proposal, reached
        if margin <= 0:
            low = target
        elif reached >= upper and reached > target:
            break  # a positive margin that the metric does not keep: the solver's accuracy ends here
    return metric, upper
