"""Metrics that are worth certifying: of least c or L, and of least erosion. Proposals, in floating point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.constants.jacobians import AffineForm, AffineSet, JacobianSet, VertexPolytope
from certbound.constants.programs.centers import center_metric, center_multipliers, reachable_value, starting_metric
from certbound.constants.programs.lmi import RateProgram
from certbound.constants.programs.riccati import least_value
from certbound.constants.programs.sectors import VERTEX_LIMIT, Sector, lmi_blocks
from certbound.errors import SolverError

_FEW_BLOCKS = 4
"""Up to so many inequalities the method of centres is used; beyond, a semidefinite solver."""

MANY_STATES = 12
"""From here on a Riccati equation proposes first."""
MOST_STATES = 60
"""Beyond, nothing else proposes: semidefinite programs take hours."""
_TURNS = 4


@dataclass(frozen=True, eq=False, kw_only=True)
class Proposal:
    """A metric and what proposed it."""

    metric: Array
    status: str


def rate_proposals(
    members: JacobianSet, *, continuous: bool, share: float = 5e-3, wanted: float = np.inf
) -> list[Proposal]:
    """A metric of nearly least c or L: the method of centres, or semidefinite programs where it stalls.

    The sector form comes first: one inequality. Where it stays short of what the spectrum allows, few vertices
    are tried as well, for it may be conservative.

    With many states none is returned where the spectrum allows no value, c or L, below ``wanted``.
    """
    lower = spectral_bound(members, continuous=continuous)
    if members.dimension > MOST_STATES and (lower if continuous else np.sqrt(lower)) > wanted:
        return []
    tolerance = share * max(abs(lower if continuous else 1 - lower), 1e-6)
    found: list[tuple[float, Proposal]] = []
    structured = isinstance(members, AffineSet | AffineForm)
    if structured and members.dimension >= MANY_STATES:
        proposal, value = _riccati_proposal(members, continuous=continuous, lower=lower, tolerance=tolerance)
        if proposal is not None:
            found.append((value, proposal))
        if members.dimension > MOST_STATES or value <= lower + 4 * tolerance:
            return [_kept(found)]
    for form in ("sector", "vertices") if structured else ("vertices",):
        if form == "vertices" and structured and members.vertex_count > VERTEX_LIMIT:
            continue
        blocks = lmi_blocks(members, form=form)
        if len(blocks) <= _FEW_BLOCKS:
            center = center_metric(blocks, continuous=continuous, lower=lower, tolerance=tolerance)
            metric, value, status = center.metric, center.value, "method of centres"
        else:
            start = starting_metric(blocks, continuous=continuous)
            program = RateProgram(members, continuous=continuous, form=form, max_condition=1e5, start=start)
            metric, value = smallest_value(program, members, continuous=continuous, lower=lower, tolerance=tolerance)
            status = f"semidefinite program: {program.status}"
        scaled = normalised(metric)
        if scaled is not None:
            found.append((value, Proposal(metric=scaled, status=status)))
        if value <= lower + 4 * tolerance:
            break
    return [_kept(found)]


def _kept(found: list[tuple[float, Proposal]]) -> Proposal:
    if not found:
        raise SolverError("no program returned a positive definite metric; scale the states, or give a metric.")
    return min(found, key=lambda pair: pair[0])[1]


def _riccati_proposal(
    members: JacobianSet, *, continuous: bool, lower: float, tolerance: float
) -> tuple[Proposal | None, float]:
    """The metric of a Riccati equation, and the value that it reaches: multipliers and metric in turn."""
    (block,) = lmi_blocks(members, form="sector")
    assert isinstance(block, Sector)
    multipliers = np.ones(block.B.shape[1])
    best, least = None, np.inf
    for _ in range(_TURNS):
        found = least_value(block, multipliers, continuous=continuous, lower=lower, tolerance=tolerance / 4)
        metric = None if found is None else normalised(found.mean())
        if metric is None:
            break
        center = center_multipliers(metric, block, continuous=continuous)
        gained = least - center.value
        if gained > 0:
            best, least = metric, center.value
        if least <= lower + 2 * tolerance or not gained > tolerance or not len(multipliers):
            break
        multipliers = center.multipliers[0] / np.exp(np.mean(np.log(center.multipliers[0])))
    return None if best is None else Proposal(metric=best, status="Riccati equation"), least


def sampled_polytope(matrices: Array, *, limit: int = 24) -> VertexPolytope:
    """Convex hull of the extreme ones among sampled Jacobians: no superset of anything, but as tight as it gets.

    A metric proposed for it is certified over the whole domain like any other.
    """
    flat = matrices.reshape(len(matrices), -1)
    spread = flat.max(axis=0) - flat.min(axis=0)
    varying = np.flatnonzero(spread > 1e-12 * (1 + np.abs(flat).max()))
    directions = np.random.default_rng(0).normal(size=(2 * limit, len(varying)))
    directions = np.concatenate([np.eye(len(varying)), -np.eye(len(varying)), directions])
    scaled = flat[:, varying] / spread[varying]
    chosen = list(dict.fromkeys(int(k) for k in np.argmax(scaled @ directions.T, axis=0)))
    return VertexPolytope(matrices=matrices[chosen[:limit] or [0]])


def spectral_bound(members: JacobianSet, *, continuous: bool) -> float:
    """A lower bound of c or L^2 in every metric: spectral abscissa or radius over some members."""
    count = min(64, max(2, int(64 * (40 / members.dimension) ** 3)))
    matrices = members.sample(np.random.default_rng(0), count)
    if members.vertex_count <= 512:
        matrices = np.concatenate([matrices, members.vertices()])
    elif isinstance(members, AffineSet):
        ends = np.tensordot(members.box, members.M, axes=1) + members.J0
        matrices = np.concatenate([matrices, ends])
    eigenvalues = np.linalg.eigvals(matrices)
    return float(eigenvalues.real.max() if continuous else (np.abs(eigenvalues) ** 2).max())


def normalised(metric: Array) -> Array | None:
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

    ``program`` is that of ``jacobians``, ``lower`` a lower bound of the value (the spectral abscissa, or the squared
    spectral radius, of a member), ``tolerance`` the width at which the bisection stops. SolverError where the first
    solve fails; a later failure ends the search at the best metric so far.
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
        if normalised(proposal) is None:
            break  # the solver's accuracy ends here
        reached = reachable_value(proposal, jacobians, continuous=continuous)
        if reached < upper:
            metric, upper = proposal, reached
        if margin <= 0:
            low = target
        elif reached >= upper and reached > target:
            break  # a positive margin that the metric does not keep
    return metric, upper
