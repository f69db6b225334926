"""All paths of a model that is linear in its state, from a random start, without further noise.

X_t = p_t + Y_t z + K_t xi with p the path of the mean, Y and K the responses to the start's directions: on every piece
of time the path lies in the convex hull of control points that are affine in z and xi, widened by a box.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.reach.linear import Linearisation, LinearRun
from certbound.reach.starts.drawn_directions import FAR, StartDirections
from certbound.rigor.intervals import Interval
from certbound.rigor.rounding import quiet

_ROUND = 1e-13  # of all terms' sizes: more than a few dozen products and sums lose
_TRIES = 20


@dataclass(frozen=True, eq=False, kw_only=True)
class StartPaths:
    """Control points (N, C, n) of the mean's path, their gains (N, C, n, d) and (N, C, n, p), and a box (N, n).

    In discrete time a piece is a step, with one point. ``span`` are the pieces' times.
    """

    controls: Array
    gains: Array
    rest: Array
    slack: Array
    size: Array
    span: Interval
    reach: float

    @property
    def pieces(self) -> int:
        """Number N of pieces."""
        return len(self.controls)


def node_maps(engine: Linearisation) -> Array:
    """The transition matrices from time 0 to every node, (N + 1, n, n), in floats."""
    found = [np.eye(engine.n)]
    for step in engine.response.transition[0]:
        found.append(step @ found[-1])
    return np.stack(found)


@quiet
def start_paths(engine: Linearisation, start: StartDirections) -> StartPaths:
    """Enclose every path of a linear model from a start by its directions (Thm K7 without noise).

    Raises
    ------
    ArithmeticError
        If the paths grow beyond what floats bear.
    """
    controls, continuous, n = engine.controls[0], engine.continuous, engine.n
    count, d = len(controls), start.count
    unit = np.broadcast_to(np.eye(n), (count, n, n))
    support = engine.supports(0, unit)
    run = LinearRun(engine)
    bounds = run.include(np.zeros(run.rows.shape[:3]), 1)
    if bounds is None:
        raise ArithmeticError("the path of the mean is not enclosed.")
    low, high, _ = support.remainder(bounds[0][0], bounds[1][0])
    moved = np.maximum(np.abs(low), np.abs(high))
    columns = np.concatenate([start.gains, start.rest], axis=1)
    nodes = support.response.initial[:, support.response.place[:n]] @ columns  # (N + 1, n, d + p)
    weights = np.concatenate([np.full(d, FAR), np.full(columns.shape[1] - d, start.reach)])
    sizes = np.abs(nodes) @ weights + np.abs(support.response.initial[:, support.response.place[:n]]) @ start.slack
    whole = 1.001 * sizes + 1e-290
    for _ in range(_TRIES):
        error = support.response.errors(whole)[:, :n]
        if np.all(sizes + error <= whole):
            break
        whole = 2 * (sizes + error)
    if not (np.isfinite(whole).all() and np.all(sizes + error <= whole)):  # infinite sizes would bound each other
        raise _unbearable()
    error = error + np.abs(support.response.initial[:, support.response.place[:n]]) @ start.slack
    if not continuous:
        ends, off = nodes[:count, None], error[:count]
    else:
        along = np.array([0.0, 1 / 3, 2 / 3, 1.0])[:, None, None]
        ends = (1 - along) * nodes[:-1, None] + along * nodes[1:, None]
        bulge = np.einsum("kij,kj->ki", support.gathering.curve, whole[:-1])
        off = np.maximum(error[:-1], error[1:]) + bulge * (1 + _ROUND)
    size = np.abs(controls).max(axis=1) + (np.abs(ends) @ weights).max(axis=1)
    slack = off + moved + _ROUND * size
    if not all(np.isfinite(part).all() for part in (controls, ends, slack, size)):
        raise _unbearable()
    return StartPaths(
        controls=controls, gains=ends[..., :d], rest=ends[..., d:], slack=slack, size=size,
        span=engine.nominal(0).span(), reach=start.reach,
    )  # fmt: skip


def _unbearable() -> ArithmeticError:
    return ArithmeticError(
        "the paths, or what their rounding may cost, grow beyond what floats bear; shorten the horizon, or rescale the "
        "states."
    )
