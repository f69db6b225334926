"""Quadratic value bounds as data: the matrices H of every V, and the multipliers with which they are proved."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.errors import CertificateError
from certbound.problem.problem import Problem
from certbound.problem.sets import Faces
from certbound.quadratic import QuadraticBound
from certbound.quadratic.setting import Setting, Wall
from certbound.quadratic.wall_attempts import Attempt
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
    if problem.system.time == "discrete":
        raise CertificateError("no certificate states quadratic value bounds in discrete time yet.")
    found: QuadraticBound | None = answer.details
    if found is None or found.setting is None or not found.upper < 0:
        raise CertificateError("no quadratic value bound was found.")
    effort = min(attempt, len(_ROOMS) - 1)
    room = _ROOMS[effort] / float(problem.horizon)
    keys = _keys(problem, found.setting)
    bounds = [_bound(item, keys, growth=1 + 0.1 * effort, room=room) for item in found.walls]
    if sum(len(one[name]) for one in bounds for name in ("moves", "weights")) > _LONGEST:
        raise CertificateError(f"the multipliers take over {_LONGEST // 2**20} MiB: too much for a certificate.")
    center, width = exact(found.setting.center), exact(found.setting.width)
    data = {"engine": "quadratic", "center": center, "width": width, "bounds": bounds}
    return data, _claim(found.upper, problem.delta, _CLAIMS[effort]), []


def _bound(item: Attempt, keys: dict[Wall, list[int]], *, growth: float, room: float) -> dict[str, Any]:
    """What is stated of one V."""
    proved = item.proved
    if proved is None:
        raise CertificateError(f"nothing was proved at the wall '{item.wall.label}'.")
    found, walls = proved.proposal, (item.wall, *item.others)
    n = found.matrices.shape[-1] - 1
    given = ((found.wall_weights, found.wall_rows), *found.others)
    before = found.degree * found.first
    return {
        "walls": [keys[wall] for wall in walls],
        "first": int(found.first),
        "degree": int(found.degree),
        "held": [int(a) for a in proved.held],
        "cuts": exact([np.linspace(-1.0, 1.0, count + 1) for count in item.slabs]),
        "times": exact(found.times),
        "matrices": exact(found.matrices),
        "moves": packed(_rounded(found.moves)),
        "weights": packed(_rounded(np.maximum(found.weights, 0.0))),
        "wall_weights": [exact(np.maximum(weights[before:], 0.0)) for weights, _ in given],
        "wall_rows": [exact(rows[before:] if wall.row is not None else np.zeros((len(rows) - before, 0)))
                      for wall, (_, rows) in zip(walls, given, strict=True)],
        "lam": exact([rate * growth + room for rate in proved.rates]),
        "gap": exact(float(proved.gap * (1 + 1e-3)) + _LEAST * (n + 1)),
    }  # fmt: skip


def _keys(problem: Problem, setting: Setting) -> dict[Wall, list[int]]:
    """What each wall is for the checker: a constraint and a face, or a side of the working box."""
    keys: dict[Wall, list[int]] = {}
    own = _constraint_walls(problem)
    for wall in setting.walls:
        keys[wall] = next(own, [1000, 0]) if wall.side is None else [-1 - wall.side[0], wall.side[1]]
    if next(own, None) is not None or [1000, 0] in keys.values():
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
    return min(log10 + (min(room, left / 2) if left > 0 else room), 0.0)
