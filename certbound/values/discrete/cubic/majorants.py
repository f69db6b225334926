"""How large the derivatives of phi = h(f) are at most, of fifth and sixth order, cell by cell.

With |v|_s = |(v_k / s_k)_k| and D_i the sides of a cell let q_m be at least |d^beta f|_s D^beta on the cell for all
beta of order m that matter. For every p and all vectors
    |D^p h(m)[v_1, ..., v_p]| <= C_p |v_1|_s ... |v_p|_s H(m),   C_p = kappa^(n - 1) A_p   (``dominance``),
since in units of s the density is isotropic: at each place z of the noise D^p phi_s is a symmetric form of p vectors,
whose norm is that of its values at p equal unit vectors e (Banach), (-1)^p He_p(z e) phi(z). So, by the formula of Faa
di Bruno,
    |d^beta phi| D^beta <= H sum_k C_k B_{m, k}(q_1, q_2, ...)   for |beta| = m,
B the partial Bell polynomials. H is the largest one on what the cell's image meets.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.problem.model import Tape, jacobian
from certbound.rigor.intervals import Interval
from certbound.values.discrete.dominance import KAPPA, dominance
from certbound.values.discrete.fields import Tables
from certbound.values.discrete.steps import Dynamics, evaluate
from certbound.values.grids import Grid

Alpha = tuple[int, ...]

HIGHEST = 6
_LONGEST = 3000  # nodes of the tapes of derivatives, all together


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Majorants:
    """|d^beta phi| D^beta <= near[|beta|] H + beyond[|beta|] sup |U| on every cell, arrays of shape grid.shape."""

    near: dict[int, Array]
    beyond: dict[int, Array]


def needed(n: int) -> list[Alpha]:
    """The derivatives of f that those of phi by 2 e_i + 2 e_j + 2 e_l and by parts of this are made of."""
    tops = [tuple(2 * picks.count(k) for k in range(n)) for picks in itertools.product(range(n), repeat=3)]
    found = {beta for top in set(tops) for beta in itertools.product(*(range(t + 1) for t in top)) if any(beta)}
    return sorted(found, key=lambda beta: (sum(beta), beta))


def derivatives(dynamics: Dynamics) -> dict[Alpha, Tape] | None:
    """Tapes of those derivatives, without such as vanish with one before them; None where they are too long."""
    tapes: dict[Alpha, Tape] = {(0,) * dynamics.n: dynamics.tape}
    total = 0
    for beta in needed(dynamics.n):
        axis = next(k for k, count in enumerate(beta) if count)
        before = tapes.get(tuple(count - (k == axis) for k, count in enumerate(beta)))
        if before is None or _vanishes(before):
            continue
        tape = jacobian(before, [dynamics.columns[axis]])
        tapes[beta] = Tape(inputs=tape.inputs, nodes=tape.nodes, outputs=tape.outputs, shape=(len(tape.outputs),))
        total += len(tape.nodes)
        if total > _LONGEST:
            return None
    return tapes


def _vanishes(tape: Tape) -> bool:
    nodes = [tape.nodes[output] for output in tape.outputs]
    return all(node.op == "const" and node.value == 0.0 for node in nodes)


def majorants(dynamics: Dynamics, t: int, grid: Grid, tables: Tables) -> Majorants | None:
    """The bounds on every cell; None where f is not smooth on some cell, or too long."""
    tapes = derivatives(dynamics)
    if tapes is None:
        return None
    boxes, nothing = grid.cells(), Interval.point(np.empty(0))
    arguments = dynamics.arguments(t, boxes, nothing)
    sizes = [np.zeros(len(boxes)) for _ in range(HIGHEST + 1)]
    for beta, tape in tapes.items():
        found, undefined, jumps = evaluate(tape, arguments)
        if np.any(undefined | jumps) or not np.isfinite(found.mag).all():
            return None
        if any(beta):
            width = math.prod(grid.widths(i) ** count for i, count in enumerate(beta))
            length = np.sqrt(np.sum((found.mag / tables.sigma) ** 2, axis=1)) * (1 + 1e-9)
            order = sum(beta)
            sizes[order] = np.maximum(sizes[order], length * np.broadcast_to(width, grid.shape).ravel())
    rows = [size.reshape(grid.shape) for size in sizes]
    forms, tails = _forms(tables)
    bell = _bell(rows)
    orders = (HIGHEST - 1, HIGHEST)
    near, beyond = (
        {m: np.sum([one[k] * bell[m, k] for k in range(1, m + 1)], axis=0) * (1 + 1e-9) for m in orders}
        for one in (forms, tails)
    )
    return Majorants(near=near, beyond=beyond)


def _forms(tables: Tables) -> tuple[list[float], list[float]]:
    """C_k, and the same of what lies far out, of each order; |v_1| / s_1 + ... + |v_n| / s_n <= sqrt(n) |v|_s."""
    n = tables.n
    forms = [KAPPA ** (n - 1) * dominance(k) * (1 + 1e-9) for k in range(HIGHEST + 1)]
    tails = []
    for k in range(HIGHEST + 1):
        orders = [alpha for alpha in itertools.product(range(k + 1), repeat=n) if sum(alpha) == k]
        tails.append(n ** (k / 2) * max(tables.beyond(alpha) for alpha in orders))
    return forms, tails


def _bell(sizes: Sequence[Array]) -> dict[tuple[int, int], Array]:
    """B_{m, k}(q_1, ..., q_{m - k + 1}) by recursion over the block that holds the first element."""
    found: dict[tuple[int, int], Array] = {(0, 0): np.ones_like(sizes[1])}
    for m in range(1, HIGHEST + 1):
        for k in range(1, m + 1):
            parts = [
                math.comb(m - 1, size - 1) * sizes[size] * found[m - size, k - 1]
                for size in range(1, m + 1) if (m - size, k - 1) in found
            ]  # fmt: skip
            found[m, k] = np.sum(parts, axis=0)
    return found
