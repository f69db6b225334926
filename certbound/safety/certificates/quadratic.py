"""Quadratic value bounds as data: the matrices H of every wall, and the multipliers with which they are proved."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from certbound.arrays import Array
from certbound.errors import CertificateError
from certbound.problem.problem import Problem
from certbound.problem.sets import Faces
from certbound.quadratic import QuadraticBound
from certbound.safety.answers import EngineAnswer, Proof, exact
from certbound.safety.certificates.parts import packed

_ROOMS = (0.01, 0.1, 1.0)  # of log P: what the checker's own bounds of remainders may cost, in each wall's rates
_CLAIMS = (0.1, 0.3, 1.0)  # of log10 P; the claim becomes what is proved
_LEAST = 1e-6  # of log P
_BITS = 44  # of a multiplier
_LONGEST = 15 * 2**20


def quadratic_proof(problem: Problem, answer: EngineAnswer, attempt: int = 0) -> Proof:
    """The proof's data, the claimed log10 of the probability, and no assumptions.

    CertificateError where the checker knows no proof of what was bounded.
    """
    found: QuadraticBound | None = answer.details
    if found is None or found.setting is None or not found.upper < 0:
        raise CertificateError("no quadratic value bound was found.")
    effort = min(attempt, len(_ROOMS) - 1)
    walls = []
    for key, item in zip(_keys(problem, found), found.walls, strict=True):
        proved = item.proved
        if proved is None or len(proved.rates) != item.pieces:
            raise CertificateError(f"nothing was proved at the wall '{item.wall.label}'.")
        wall, n = proved.proposal, problem.system.dimension
        room = _ROOMS[effort] / float(problem.horizon)
        walls.append({
            "wall": key,
            "held": [int(a) for a in item.held],
            "large": [int(a) for a in item.large],
            "cuts": exact([np.linspace(-1.0, 1.0, count + 1) for count in item.slabs]),
            "times": exact(wall.times),
            "matrices": exact(wall.matrices),
            "moves": packed(_rounded(wall.moves)),
            "weights": packed(_rounded(np.maximum(wall.weights, 0.0))),
            "wall_weights": exact(np.maximum(wall.wall_weights, 0.0)),
            "wall_rows": exact(wall.wall_rows.reshape(len(wall.times), -1) if item.wall.row is not None else
                               np.zeros((len(wall.times), 0))),
            "lam": exact([rate * (1 + 0.1 * effort) + room for rate in proved.rates]),
            "gap": exact(float(proved.gap * (1 + 1e-3)) + _LEAST * (n + 1)),
        })  # fmt: skip
    if sum(len(wall[name]) for wall in walls for name in ("moves", "weights")) > _LONGEST:
        raise CertificateError(f"the multipliers take over {_LONGEST // 2**20} MiB: too much for a certificate.")
    center, width = exact(found.setting.center), exact(found.setting.width)
    data = {"engine": "quadratic", "center": center, "width": width, "walls": walls}
    return data, _claim(found.upper, problem.delta, _CLAIMS[effort]), []


def _keys(problem: Problem, found: QuadraticBound) -> list[list[int]]:
    """What each wall is for the checker: a constraint and a face, or a side of the working box."""
    n = problem.system.dimension
    keys: list[list[int]] = []
    own = _constraint_walls(problem)
    for item in found.walls:
        row = None if item.wall.row is None else np.asarray(item.wall.row.mid)
        if row is not None and np.count_nonzero(row[:n]) == 1:
            axis = int(np.flatnonzero(row[:n])[0])
            keys.append([-1 - axis, int(row[axis] > 0)])
        else:
            keys.append(next(own, [1000, 0]))
    if next(own, None) is not None or [1000, 0] in keys:
        raise CertificateError("the checker does not know why some walls were left out.")
    return keys


def _constraint_walls(problem: Problem) -> Iterator[list[int]]:
    """Constraints and faces that are walls of their own, in their order."""
    for number, constraint in enumerate(problem.constraints):
        form = constraint.region.form
        if not isinstance(form, Faces) or constraint.outside:
            yield [number, 0]
            continue
        for face, normal in enumerate(form.normals):
            if np.count_nonzero(normal) > 1:
                yield [number, face]


def _rounded(numbers: Array) -> Array:
    """Fewer bits of each number, for a smaller file."""
    step = np.frexp(numbers)[1] - _BITS
    return np.asarray(np.ldexp(np.rint(np.ldexp(numbers, -step)), step))


def _claim(log10: float, delta: float, room: float) -> float:
    """log10 of a probability a little above, and not above delta where the other was not."""
    left = math.log10(delta) - log10
    return min(log10 + (min(room, left) if left > 0 else room), 0.0)
