"""Whether constants speak of a problem: a proof vouches for numbers, not for the system that they came from.

Certified constants are proved again for the problem at hand, in their own metric. Stated ones are an assumption about
it already; only their time and their dimension are compared.
"""

from __future__ import annotations

import numpy as np

from certbound.constants.bounds import bound_constants
from certbound.errors import CertboundError
from certbound.problem.problem import Problem
from certbound.tubes.constants import Constants


def check_constants(problem: Problem, constants: Constants, name: str = "constants") -> None:
    """Refuse constants that cannot be those of ``problem``, for every input that it allows (of its plan, with one).

    ValueError where time or dimension differ, or certified constants are not proved for this problem too; ``name`` says
    in which argument they came.
    """
    continuous, n = problem.system.time == "continuous", problem.system.dimension
    if constants.continuous != continuous:
        asked, got = ("rate", "gain") if continuous else ("gain", "rate")
        raise ValueError(
            f"`{name}` must have a {asked} ({problem.system.time} time), got a {got}; take constants of this problem."
        )
    if constants.dimension != n:
        raise ValueError(f"`{name}` must have dimension {n}, got {constants.dimension}; take those of this problem.")
    if not constants.certified:
        return
    metric = "euclidean" if constants.metric is None else constants.metric
    try:
        proved = bound_constants(problem, metric=metric)
    except CertboundError as error:
        raise ValueError(f"`{name}` must hold for this problem on its whole domain, but {error}") from error
    if not implies(proved, constants):
        raise ValueError(
            f"`{name}` must hold for this problem on its whole domain, got {constants.summary()}, where "
            f"{proved.summary()} is proved in the same metric; take bound_constants(problem, metric=...), or leave "
            f"`{name}` out."
        )


def implies(proved: Constants, claimed: Constants) -> bool:
    """Whether constants in one metric imply others at all times (False where that is not obvious)."""
    same = np.array_equal(proved.matrix, claimed.matrix) and proved.continuous == claimed.continuous
    if not same or (claimed.gaussian and not proved.gaussian) or claimed.noise_bound is not None:
        return False
    if proved.worst_slope > np.min(np.asarray(claimed.slope)):
        return False
    sigma, stated = float(np.max(np.asarray(proved.sigma))), np.asarray(claimed.sigma)
    if claimed.isotropic:  # an equality
        return proved.isotropic and bool(np.all(stated == sigma))
    return bool(np.all(sigma <= stated)) and proved.nu <= claimed.nu
