"""Proofs by value functions as data.

In discrete time the grids are all: from them the checker finds the value functions itself, step by step backward, with
polynomials of a higher degree than the engine's, so that its cells may be larger.
"""

from __future__ import annotations

import base64
import math
import zlib
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.errors import CertificateError, InfeasibleError
from certbound.problem.problem import Problem
from certbound.problem.systems import DiscreteSystem
from certbound.safety.answers import EngineAnswer, Proof, exact
from certbound.values.continuous import ExitBounds
from certbound.values.discrete import step_grids

_SHARES = {1: (0.42, 0.3, 0.2), 2: (0.55, 0.4, 0.28)}
_ROOMS = (0.05, 0.15, 0.5)
_PARTS = (12, 24, 48)  # of one disturbance; of several, their product
_COARSE = (0.04, 0.01, 0.0)  # of log P, for a smaller file
_MORE_ROOM = 3  # in continuous time and two states
_MORE = 1.02  # of lam, which the checker need not prove
_BITS = {"values": (42, 30, 22), "rates": (24, 18, 14)}  # of a value, a slope, a second derivative and beyond
_MOST_PATCHES = 400_000
_LONGEST = 15 * 2**20  # characters of the packed arrays
_INWARD = 1e-13  # of a side of the grid: its faces must lie in the safe set, whatever has been rounded


def values_proof(problem: Problem, answer: EngineAnswer, attempt: int = 0) -> Proof:
    """The proof's data, the claimed log10 of the probability, and no assumptions.

    CertificateError where the checker knows no proof of what was bounded.
    """
    effort = min(attempt, len(_ROOMS) - 1)
    flat = isinstance(answer.details, ExitBounds) and problem.system.dimension > 1
    claim = _claim(answer.log10_delta, problem.delta, _ROOMS[effort] * (_MORE_ROOM if flat else 1))
    if isinstance(answer.details, ExitBounds):
        return _passage(answer.details, effort), claim, []
    _refuse(problem)
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
    return data, claim, []


def _passage(found: ExitBounds, effort: int) -> dict[str, Any]:
    """Continuous time: V and what it is paid with; the coarsest one that costs little."""
    if not found.proposed:
        raise CertificateError(
            "no value function was found that a certificate can state: in two states it states boxes, no obstacles and "
            "no oblique or curved limits."
        )
    best = min(payment.log for _, payment in found.proposed)
    share = _COARSE[effort] * max(1.0, -0.1 * best)
    surface, payment = next(pair for pair in found.proposed if pair[1].log <= best + share)
    terms = payment.terms
    if terms is None:
        raise CertificateError("the value function bounds nothing.")
    surface = surface.raised(payment.lift)
    rates = np.concatenate([surface.start_rates, surface.end_rates[-1:]])
    if surface.slabs * math.prod(surface.cells) > _MOST_PATCHES:
        raise CertificateError(f"the value function has more than {_MOST_PATCHES} patches: too many for a certificate.")
    values, slopes = _packed(surface.values, _BITS["values"]), _packed(rates, _BITS["rates"])
    if len(values) + len(slopes) > _LONGEST:
        raise CertificateError(f"the value function takes over {_LONGEST // 2**20} MiB: too much for a certificate.")
    return {
        "engine": "values",
        "axes": [exact(axis) for axis in surface.axes],
        "times": exact(surface.times),
        "values": values,
        "rates": slopes,
        "edges": exact(terms.levels.edges),
        "m": exact(terms.levels.m),
        "q": exact(terms.levels.q),
        "lam": exact(terms.lam * _MORE),
        "eps": exact(terms.eps),
    }


def _packed(numbers: Array, bits: tuple[int, ...]) -> str:
    """Numbers as one compressed text.

    By the order of the derivative they keep so many bits: V is as smooth with any, and nearly as good with these.
    """
    order = np.zeros(numbers.shape, dtype=int)
    for axis in range(2, numbers.ndim, 2):
        order += np.arange(3).reshape([3 if k == axis else 1 for k in range(numbers.ndim)])
    step = np.frexp(numbers)[1] - np.asarray(bits)[np.minimum(order, len(bits) - 1)]
    rounded = np.ldexp(np.rint(np.ldexp(numbers, -step)), step)
    words = " ".join(value.hex() for value in rounded.ravel().tolist())
    return base64.b64encode(zlib.compress(words.encode("ascii"), 9)).decode("ascii")


def _parts(problem: Problem, most: int) -> int:
    count = len(problem.system.disturbance_names)
    return max(2, round((most / problem.system.dimension) ** (1 / count))) if count else 1


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
