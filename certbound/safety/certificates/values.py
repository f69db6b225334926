"""Proofs by value functions as data.

In discrete time the grids are all: from them the checker finds the value functions itself, step by step backward, with
polynomials of a higher degree than the engine's, so that its cells may be larger.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.errors import CertificateError, InfeasibleError
from certbound.problem.problem import Problem
from certbound.problem.systems import DiscreteSystem
from certbound.safety.answers import EngineAnswer, Proof, exact
from certbound.values.discrete import FailureBounds, step_grids

_SHARES = {1: (0.42, 0.3, 0.2), 2: (0.55, 0.4, 0.28)}
_ROOMS = (0.05, 0.15, 0.5)
_PARTS = (12, 24, 48)  # of one disturbance; of several, their product
_INWARD = 1e-13  # of a side of the grid: its faces must lie in the safe set, whatever has been rounded


def values_proof(problem: Problem, answer: EngineAnswer, attempt: int = 0) -> Proof:
    """The proof's data, the claimed log10 of the probability, and no assumptions.

    CertificateError where the checker knows no proof of what was bounded.
    """
    if not isinstance(answer.details, FailureBounds):
        raise CertificateError("the checker does not know value functions in continuous time.")
    _refuse(problem)
    effort = min(attempt, len(_ROOMS) - 1)
    try:
        grids = step_grids(problem, _SHARES[problem.system.dimension][effort])
    except InfeasibleError as error:
        raise CertificateError(str(error)) from error
    distinct = list({id(grid): grid for grid in grids[1:]}.values())
    place = {id(grid): k for k, grid in enumerate(distinct)}
    data = {
        "engine": "values",
        "splits": exact(_splits(problem, grids[0].axes)),
        "parts": _parts(problem, _PARTS[effort]),
        "grids": [[exact(_inward(edges)) for edges in grid.axes] for grid in distinct],
        "steps": [place[id(grid)] for grid in grids[1:]],
    }
    return data, _claim(answer.log10_delta, problem.delta, _ROOMS[effort]), []


def _parts(problem: Problem, most: int) -> int:
    count = len(problem.system.disturbance_names)
    return max(2, round(most ** (1 / count))) if count else 1


def _inward(edges: Array) -> Array:
    """The edges, the outermost ones moved inward by next to nothing."""
    step = _INWARD * (edges[-1] - edges[0])
    return np.concatenate([[edges[0] + step], edges[1:-1], [edges[-1] - step]])


def _refuse(problem: Problem) -> None:
    system, law = problem.system, getattr(problem.system, "noise", None)
    if system.dimension > max(_SHARES):
        raise CertificateError(f"the checker knows value functions of at most {max(_SHARES)} states.")
    if problem.initial.random:
        raise CertificateError("the checker knows value functions for bounded starts only.")
    if not isinstance(system, DiscreteSystem) or law is None or not law.gaussian:
        raise CertificateError("the checker knows value functions for normal noise only.")


def _splits(problem: Problem, axes: tuple[Array, ...]) -> list[Any]:
    """Edges of cells that cover the starts, half as wide as those of the grid."""
    around = problem.initial.hull()
    most = 64 if len(axes) == 1 else 12
    found = []
    for low, high, edges in zip(around.lo, around.hi, axes):
        inside = int(np.sum((edges > low) & (edges < high)))
        count = min(2 * (inside + 1), most) if low < high else 1
        row = [float(x) for x in np.linspace(low, high, count + 1)]
        found.append(sorted({float(low), *row, float(high)}) if low < high else [float(low), float(high)])
    return found


def _claim(log10: float, delta: float, share: float) -> float:
    """log10 of a probability a little above, and not above delta where the other was not."""
    room = share * max(1.0, -0.1 * log10)
    left = math.log10(delta) - log10
    return min(log10 + (min(room, left / 2) if left > 0 else room), 0.0)
