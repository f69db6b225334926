"""The grid of splines, the equation for their coefficients, and what bounds their residual there."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from certbound.arrays import Array, Index, Mask
from certbound.errors import InfeasibleError
from certbound.problem.model import Tape, compile_numpy, jacobian
from certbound.rigor.intervals import Interval
from certbound.values.discrete import evaluate
from certbound.values.grids import graded_axis
from certbound.values.semilagrangian.noisy_axis import Setting
from certbound.values.semilagrangian.sources.drift_cells import DriftCells, drift_cells
from certbound.values.semilagrangian.sources.residuals import residual_bounds
from certbound.values.semilagrangian.sources.spline_axes import Axis

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

_ALONG = 0.002, 0.1, 0.02
"""Cells along p: at its faces, how they grow with the distance, and the widest; in units of half the safe set."""
_ACROSS = 0.01, 0.05, 0.03  # along q, from where p turns at its faces; in units of half the box
_CUTS = 6, 4, 3, 2
"""Parts of the cells beside p's faces for which the residual is bounded."""
_OVER, _LIFT, _CORNER = (1.01, 1.04, 1.5), 0.3, 0.03
"""What U is set to at p's faces, at limits of q and at other ends of q; more at p's where p turns, and how far."""
_BESIDE = 0.02  # where differences along p are one-sided, in units of half the safe set
_PACE = 0.018, 0.05  # of the time that noise needs to cross p, of the time in which the flow turns by a radian
_SHORT = 0.05  # of the horizon, at most
_DAMPED = 1 / 12


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Ground:
    """Splines on p x q for a problem.

    Attributes
    ----------
    p, q : Axis
        Quadratic, and cubic.
    cells : DriftCells
    exits : (ndarray of bool, ndarray of bool)
        Cells along q at p's lower and upper face through which p may leave.
    turn : csr_matrix
        From coefficients to the drift and noise part of their rate.
    step : float
        The length of a step.
    noise : float
        s^2.
    real : ((bool, bool), (bool, bool))
        Which faces of p and q are limits, and not ends of what paths come to.
    """

    p: Axis
    q: Axis
    cells: DriftCells
    exits: tuple[Mask, Mask]
    turn: csr_matrix
    step: float
    noise: float
    real: tuple[tuple[bool, bool], tuple[bool, bool]]
    turns: Array

    @property
    def shape(self) -> tuple[int, int]:
        """Of the coefficients."""
        return self.p.size, self.q.size

    def outside(self) -> Mask:
        """Coefficients that tell of the faces: all that count on q's, and where p may leave on its own."""
        found = np.zeros(self.shape, dtype=bool)
        found[:, [0, -1]] = True
        for row, leaving in zip((0, -1), self.exits):
            for k in range(self.q.degree + 1):
                found[row, k : k + self.q.cells] |= leaving
        return found

    def levels(self) -> Array:
        """What an upper bound is set to where paths leave: more where p turns, in whose corner it falls steeply."""
        found = np.full(self.shape, _OVER[0])
        found[:, 0], found[:, -1] = (_OVER[1] if limit else _OVER[2] for limit in self.real[1])
        for row in (0, -1):
            near = (self.q.places - self.turns[row]) / (_CORNER * (self.q.knots[-1] - self.q.knots[0]))
            found[row] += _LIFT * np.exp(-(near**2))
        return found

    def measure(self) -> Callable[[Array, Array, Array, float], tuple[Array, Array, Array, Array]]:
        """`residual_bounds` on this ground, of (values, rates, source, step); by `parts`."""
        cell, low, high = self.parts
        rows, columns = self.p.pieces(cell, low, high), self.q.whole
        widths, wide = (high - low, np.diff(self.q.knots)), np.diff(self.p.knots)[cell]
        corners, remainder = self.cells.corners[:, cell], np.ascontiguousarray(self.cells.remainder[:, cell])
        ends = [((end - self.p.knots[cell]) / wide)[None, :, None, None] for end in (low, high)]
        parts = [corners[..., 0, :] * (1 - end) + corners[..., 1, :] * end for end in ends]
        corners = np.ascontiguousarray(np.stack(parts, axis=-2))

        def bounds(values: Array, rates: Array, source: Array, step: float) -> tuple[Array, Array, Array, Array]:
            return residual_bounds(
                values, rates, source, rows, columns, cell, widths, corners, remainder, self.noise, step
            )

        return bounds

    @property
    def parts(self) -> tuple[Index, Array, Array]:
        """Cells of p cut into parts, finely beside its faces: (cell, low, high) of each."""
        counts = np.ones(self.p.cells, dtype=int)
        counts[: len(_CUTS)], counts[-len(_CUTS) :] = _CUTS, _CUTS[::-1]
        cell = np.repeat(np.arange(self.p.cells), counts)
        place = np.concatenate([np.arange(count) for count in counts])
        first, wide = self.p.knots[cell], np.diff(self.p.knots)[cell]
        low = np.where(place == 0, first, first + wide * (place / counts[cell]))
        high = np.where(place + 1 == counts[cell], self.p.knots[cell + 1], first + wide * ((place + 1) / counts[cell]))
        return cell, low, high

def ground_of(setting: Setting, grain: float) -> Ground:
    """Splines for a problem; ``grain`` multiplies cells and steps.

    Raises
    ------
    InfeasibleError
        The drift is undefined somewhere.
    """
    (p0, p1), (q0, q1) = setting.faces
    half = (p1 - p0) / 2
    places = np.linspace(p0, p1, 4001)
    beside, more, most = _ALONG
    near = np.minimum(places - p0, p1 - places)
    p = Axis(knots=graded_axis(p0, p1, places, grain * np.minimum(beside * half + more * near, most * half)), degree=2)
    marks, tall = _turns(setting), (q1 - q0) / 2
    places = np.linspace(q0, q1, 4001)
    beside, more, most = _ACROSS
    near = np.min([np.abs(places - mark) for mark in (q0, q1, *marks)], axis=0)
    q = Axis(
        knots=graded_axis(q0, q1, places, grain * np.minimum(beside * tall + more * near, most * tall), marks), degree=3
    )
    beside_faces = (p0, float(p.knots[1])), (p1, float(p.knots[-2]))
    exits = [_exits(setting.tape, ends, q.knots, sign) for ends, sign in zip(beside_faces, (-1.0, 1.0))]
    step = grain * _step(setting)
    noise = setting.noise**2 * (1 + 2 * setting.spread)
    return Ground(
        p=p, q=q, cells=drift_cells(setting.tape, p.knots, q.knots), exits=(exits[0], exits[1]),
        turn=_turn(setting.tape, p, q, noise), step=step, noise=noise,
        real=tuple(tuple(math.isfinite(end) for end in ends) for ends in setting.beyond),  # type: ignore[arg-type]
        turns=np.array([marks[0], marks[-1]] if marks else [np.inf, np.inf]),
    )  # fmt: skip


def cells_of(setting: Setting, grain: float) -> float:
    """About how many cells times steps."""
    ground_p = 2 * (1 / _ALONG[1] * math.log(_ALONG[2] / _ALONG[0]) + (1 - 0.18) / _ALONG[2])
    ground_q = 2 * (1 / _ACROSS[1] * math.log(_ACROSS[2] / _ACROSS[0]) + (1 - 0.4) / _ACROSS[2])
    step = _step(setting)
    return ground_p * ground_q * setting.horizon / step / grain**3


def _step(setting: Setting) -> float:
    half = (setting.faces[0][1] - setting.faces[0][0]) / 2
    across = _PACE[0] * math.cbrt(half / setting.noise) ** 2
    return min(across, _PACE[1] / _rate(setting), _SHORT * setting.horizon)


def _turns(setting: Setting) -> list[float]:
    """Where along q p's drift changes its sign at its faces, about."""
    (q0, q1), model = setting.faces[1], compile_numpy(setting.tape)
    q = np.linspace(q0, q1, 2001)
    found = []
    for face in setting.faces[0]:
        drift = np.broadcast_to(model(0.0, np.full(len(q), face), q), (len(q), 2))[:, 0]
        for k in np.flatnonzero(np.sign(drift[:-1]) * np.sign(drift[1:]) <= 0):
            root = q[k] - drift[k] * (q[k + 1] - q[k]) / (drift[k + 1] - drift[k] or 1.0)
            found.append(0.0 if abs(root) < 1e-9 * (q1 - q0) else float(root))
    found.sort()
    return [mark for k, mark in enumerate(found) if k == 0 or mark - found[k - 1] > 1e-6 * (q1 - q0)]


def _rate(setting: Setting) -> float:
    """How fast the flow turns or grows, over most of the safe set."""
    grid = [part.ravel() for part in np.meshgrid(*(np.linspace(*ends, 15) for ends in setting.faces))]
    with np.errstate(all="ignore"):
        slopes = np.broadcast_to(compile_numpy(jacobian(setting.tape, (1, 2)))(0.0, *grid), (len(grid[0]), 2, 2))
    slopes = slopes[np.isfinite(slopes).all(axis=(1, 2))]
    if not len(slopes):
        raise InfeasibleError("the model is undefined all over the safe set.")
    return max(float(np.quantile(np.abs(np.linalg.eigvals(slopes)).max(axis=1), 0.9)), 1e-3 / setting.horizon)


def _exits(tape: Tape, ends: tuple[float, float], q: Array, sign: float) -> Mask:
    """Cells along q of one of p's faces that hold every point of it through which a path may leave.

    Who leaves at a point has a drift outward there, or none. A cell on which the drift leads nowhere outward, and
    vanishes at most at one of its ends, is left out if the end's other cell is not. ``ends`` are the face and the next
    knot of p: where something jumps in between, what leads to the face counts.
    """
    still, face = Interval.point(np.zeros(1)), ends[0]
    sides = [Interval.point(np.full(len(q) - 1, face)), Interval(q[:-1], q[1:])]
    ranges = evaluate(tape, [still, *sides])[0]
    across = Interval(np.full(len(q) - 1, min(ends)), np.full(len(q) - 1, max(ends)))
    jumps = evaluate(tape, [still, across, sides[1]])[2]
    drift = sign * ranges[:, 0]
    slopes, _, broken = evaluate(jacobian(tape, (1, 2)), [still, *sides])
    strict = (slopes[:, 1].lo > 0) | (slopes[:, 1].hi < 0)
    found = np.asarray((drift.hi > 0) | ((drift.hi == 0) & ~strict) | jumps | broken)
    nodes = sign * evaluate(tape, [still, Interval.point(np.full(len(q), face)), Interval.point(q)])[0][:, 0]
    for k in np.flatnonzero(nodes.hi >= 0):
        around = [j for j in (k - 1, k) if 0 <= j < len(found)]
        if not found[around].any():
            found[around] = True
    return found


def _turn(tape: Tape, p: Axis, q: Axis, noise: float) -> csr_matrix:
    """F d/dp + g d/dq + noise/2 d2/dq2 as differences of coefficients.

    Along p they are one-sided beside its faces, and elsewhere central with a fourth difference that damps what the
    grid does not resolve; along q central, with more noise where a cell would hold too little.
    """
    from scipy.sparse import csr_matrix, diags, eye, kron

    place = np.meshgrid(p.places, q.places, indexing="ij")
    flat = [part.ravel() for part in place]
    drift = np.broadcast_to(compile_numpy(tape)(0.0, *flat), (len(flat[0]), 2))
    wide, tall = np.gradient(p.places)[:, None], np.gradient(q.places)[None]
    half = (p.knots[-1] - p.knots[0]) / 2
    near = np.minimum(place[0] - p.knots[0], p.knots[-1] - place[0]) / (_BESIDE * half)
    one_sided = np.clip(2 - near, 0.0, 1.0)
    flow, push = (np.abs(drift[:, k]).reshape(place[0].shape) for k in (0, 1))
    along, across = eye(p.size), eye(q.size)
    second = p.differences(2)
    more = np.maximum(push * tall - noise, 0.0) / 2

    def times(values: Array) -> csr_matrix:
        return csr_matrix(diags(values.ravel()))

    found = times(drift[:, 0]) @ kron(p.differences(1), across) + times(drift[:, 1]) @ kron(along, q.differences(1))
    found += times(one_sided * flow * wide / 2) @ kron(second, across)
    found -= times((1 - one_sided) * flow * wide**3 * _DAMPED) @ kron(second @ second, across)
    return csr_matrix(found + times(noise / 2 + more) @ kron(along, q.differences(2)))
