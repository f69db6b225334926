"""What holds of a quadratic V, whatever proposed it.

Let R = V_t + f.grad V + tr(g g' V'')/2 + |g' grad V|^2/2 on [0, T] x S with V = z' H(t) z / 2, H a polynomial in
Bernstein form between its times. At fixed (t, x) and fixed values of f and g, R is convex in (H, H'), and (H, H')(t) is
a convex combination of control points: a bound there, for every f and g that the cells allow, holds on all of the
piece. The matrix

    M = -(H' + H A + A' H + sum_c G_c' H G_c)/2 - D(s) - H G G' H/2 - sum mu_i B_i

is concave in G and affine in each of the held values and the disturbances, so that M + e >= 0 at all
corners of a cell gives z' M z >= -e |z|^2 there, hence R <= e |z|^2 =: lam. The smallest eigenvalues are bounded from
below in outward-rounded arithmetic; the multipliers only have to be at least 0 and the splittings to cancel, which they
do by construction. The same is done on the wall, V >= -gap, and on the starts, V(0, .) <= top.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Integers
from certbound.quadratic.corners import Cells
from certbound.quadratic.form_matrices import enclosed_side_forms, splitting
from certbound.quadratic.setting import Setting, Wall
from certbound.quadratic.wall_program import Proposal, slopes, start_frame
from certbound.rigor.definite import eigenvalue_lower
from certbound.rigor.intervals import Interval, concatenate, matmul, stack

_MOST_CORNERS = 10  # log2 of the corners of the starts that are looked at


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Proved:
    """P(leaving through the wall from x) <= exp(growth + gap + V(0, x)) for every start x, in the time looked at.

    Attributes
    ----------
    growth : float
        Sum of lam_k h_k.
    gap : float
        V >= -gap on the wall.
    top : float
        Bound of V(0, .) over the starts.
    proposal : Proposal
        What it is proved of.
    rates : tuple of float
        lam_k.
    held : tuple of int
        Coordinates that are held at the corners of the cells.
    """

    growth: float
    gap: float
    top: float
    proposal: Proposal
    rates: tuple[float, ...] = ()
    held: tuple[int, ...] = ()

    @property
    def level(self) -> float:
        """Bound of the logarithm of the probability, for the worst start."""
        return float((Interval.point(self.growth) + Interval.point(self.gap) + Interval.point(self.top)).hi)


def prove(
    setting: Setting, wall: Wall, proposal: Proposal, cells: Sequence[Cells], *, others: Sequence[Wall] = ()
) -> Proved:
    """The bound that a proposal gives, of leaving through the wall or the others; +inf where something is unbounded.

    ``cells`` holds those of each piece of time, which must cover the safe part of the working box.
    """
    growth: Interval = Interval.point(0.0)
    rates = []
    for k, one in enumerate(cells):
        step = Interval.point(proposal.times[k + 1]) - Interval.point(proposal.times[k])
        worst = max(_excess(setting, proposal, k, side, one, step) for side in range(proposal.degree + 1))
        if not np.isfinite(worst):
            return Proved(growth=np.inf, gap=np.inf, top=np.inf, proposal=proposal)
        growth = growth + Interval.point(worst) * step
        rates.append(worst)
    known = zip((wall, *others), ((proposal.wall_weights, proposal.wall_rows), *proposal.others), strict=True)
    gap = max(_gap(setting, one, proposal, *multipliers) for one, multipliers in known)
    return Proved(growth=float(growth.hi), gap=gap, top=_top(setting, proposal), proposal=proposal,
                  rates=tuple(rates), held=cells[0].held)  # fmt: skip


def _excess(setting: Setting, proposal: Proposal, k: int, side: int, cells: Cells, step: Interval) -> float:
    """A bound of R at one control point of a piece, over all cells."""
    matrix = _slack_matrices(setting, proposal, k, side, cells, step)
    short = np.maximum(-eigenvalue_lower(matrix), 0.0)  # (V, C)
    size = Interval.point(np.maximum(cells.low**2, cells.high**2) * (1 + 1e-15)).sum(axis=-1) + 1.0
    return float(np.max((Interval.point(np.minimum(short, 1e300)) * size).hi))


def _slack_matrices(
    setting: Setting, proposal: Proposal, k: int, side: int, cells: Cells, step: Interval
) -> Interval:
    """M at every corner and cell, shape (V, C, n + 1, n + 1)."""
    half = Interval.point(0.5)
    base, (a, b, factor) = proposal.degree * k, slopes(proposal.degree)[side]
    matrix = Interval.point(proposal.matrices[base + side])
    rise = Interval.point(proposal.matrices[base + b]) - Interval.point(proposal.matrices[base + a])
    slope = rise * Interval.point(factor) / step
    product = matmul(matrix, cells.drift)
    total = (product + product.T) * half + slope * half + _trace(matrix, cells) * half
    border = matmul(matrix, cells.spread)
    total = total + matmul(border, border.T) * half
    total = total + _split(proposal.moves[k, side], cells) + _last(cells.toll, setting.dimension) + cells.bend
    return -(total + _weighed(setting, proposal.weights[k, side], cells))


def _last(values: Interval, n: int) -> Interval:
    """The forms that are constants, shape (C, n + 1, n + 1)."""
    lo, hi = np.zeros((2, len(values), n + 1, n + 1))
    lo[:, -1, -1], hi[:, -1, -1] = values.lo, values.hi
    return Interval(lo, hi)


def _trace(matrix: Interval, cells: Cells) -> Interval:
    """tr(g g' H) as forms over z, shape (1 or C, n + 1, n + 1)."""
    if cells.affine is not None:
        parts = matmul(cells.affine.T, matmul(matrix, cells.affine))
        return parts.sum(axis=0).reshape(1, *matrix.shape)
    return _last((cells.square * matrix[:-1, :-1]).sum(axis=(-1, -2)), matrix.shape[0] - 1)


def _split(moves: Array, cells: Cells) -> Interval:
    """D(s) at every corner and cell, for a member of the space of splittings that is near the given coefficients."""
    n = cells.low.shape[1]
    basis = splitting(n, cells.held)
    size = (n + 1) ** 2
    if not len(basis):
        return Interval.point(np.zeros((1, 1, n + 1, n + 1)))
    flat = basis.reshape(len(basis), -1)
    parts = matmul(Interval.point(moves), Interval.point(flat)).reshape(len(moves), len(cells.held), size)
    held = Interval.point(cells.values)[..., None, :]  # (V, C, 1, h)
    return matmul(held, parts).reshape(*cells.values.shape[:2], n + 1, n + 1)


def _weighed(setting: Setting, weights: Array, cells: Cells) -> Interval:
    """sum mu_i B_i at every corner and cell."""
    n = setting.dimension
    forms = stack([_known(low, high, setting.inside) for low, high in zip(cells.low, cells.high)])
    flat = forms.reshape(len(cells.low), -1, (n + 1) ** 2)
    positive = Interval.point(np.maximum(weights, 0.0))[..., None, :]
    return matmul(positive, flat).reshape(*weights.shape[:2], n + 1, n + 1)


def _known(low: Array, high: Array, *more: Interval) -> Interval:
    """Forms that are at least 0: the sides of a box, and others."""
    return concatenate([enclosed_side_forms(low, high), *more])


def _combined(weights: Array, forms: Interval) -> Interval:
    """The sum of the forms with weights that are made at least 0."""
    positive = Interval.point(np.maximum(weights, 0.0)).reshape(-1, 1, 1)
    return (positive * forms).sum(axis=0)


def _gap(setting: Setting, wall: Wall, proposal: Proposal, wall_weights: Array, wall_rows: Array) -> float:
    """A bound of -V over the wall at the control points of the time looked at, of which V is a convex combination."""
    n, worst = setting.dimension, 0.0
    known = _known(-np.ones(n), np.ones(n), setting.inside, wall.forms)
    for k in range(proposal.degree * proposal.first, len(proposal.matrices)):
        weights = wall_weights[k]
        matrix = Interval.point(proposal.matrices[k]) * Interval.point(0.5) - _combined(weights, known)
        if wall.row is not None:
            outer = wall.row.reshape(-1, 1) * Interval.point(wall_rows[k]).reshape(1, -1)
            matrix = matrix - (outer + outer.T) * Interval.point(0.5)
        worst = max(worst, float(-eigenvalue_lower(matrix)))
    return float((Interval.point(worst) * Interval.point(float(n + 1))).hi) if np.isfinite(worst) else np.inf


def _frame(setting: Setting) -> tuple[Integers, Interval]:
    """The wide coordinates of the starts, and the map to z with the narrow ones enclosed."""
    wide, frame = start_frame(setting)
    lo, hi = frame.copy(), frame.copy()
    for i in range(setting.dimension):
        if i not in wide:
            lo[i, -1], hi[i, -1] = setting.start.low[i], setting.start.high[i]
    return wide, Interval(lo, hi)


def _top(setting: Setting, proposal: Proposal) -> float:
    """A bound of V(0, .) over the starts."""
    start = setting.start
    wide, frame = _frame(setting)
    value = matmul(frame.T, matmul(Interval.point(proposal.matrices[0]), frame)) * Interval.point(0.5)
    forms = matmul(frame.T, matmul(start.forms, frame)) if len(start.forms) else start.forms
    known = enclosed_side_forms(start.low[wide], start.high[wide])
    if len(start.forms):
        known = concatenate([known, forms])
    corner = np.zeros(value.shape)
    corner[-1, -1] = proposal.level
    matrix = Interval.point(corner) - value - _combined(proposal.start_weights, known)
    short = Interval.point(max(float(-eigenvalue_lower(matrix)), 0.0))
    size = Interval.point(np.maximum(start.low[wide] ** 2, start.high[wide] ** 2) * (1 + 1e-15)).sum() + 1.0
    return float((Interval.point(proposal.level) + short * size).hi)


def corner_levels(setting: Setting, proved: Proved) -> Array | None:
    """Upper bounds at the corners of the starts of a convex function that is nowhere below the log of the probability.

    A sum of exponentials of convex functions is largest at a corner of a box. V(0, .) is made convex by k |y|^2, y the
    starts' coordinates scaled to [-1, 1], which costs at most k at the corners times their number. None where the
    starts are no box, or have too many corners.
    """
    start = setting.start
    wide, frame = _frame(setting)
    if len(start.forms) or len(wide) > _MOST_CORNERS:
        return None
    half = (Interval.point(start.high[wide]) - Interval.point(start.low[wide])) * Interval.point(0.5)
    value = matmul(frame.T, matmul(Interval.point(proved.proposal.matrices[0]), frame))
    lift: Interval = Interval.point(0.0)
    if len(wide):
        curve = half.reshape(-1, 1) * value[:-1, :-1] * half.reshape(1, -1)
        lift = Interval.point(max(0.0, float(-eigenvalue_lower(curve)))) * Interval.point(len(wide) / 2)
    bits = (np.arange(1 << len(wide))[:, None] >> np.arange(len(wide))) & 1
    ends = np.where(bits == 1, start.high[wide], start.low[wide])
    y = Interval.point(np.hstack([ends, np.ones((len(ends), 1))]))
    at = (matmul(y, value) * y).sum(axis=-1) * Interval.point(0.5)
    return np.asarray((at + lift + Interval.point(proved.growth) + Interval.point(proved.gap)).hi)
