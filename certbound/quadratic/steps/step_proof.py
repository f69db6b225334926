"""What holds of a quadratic V at every step, whatever proposed it.

Let V_t = z' H_t z / 2 be convex in the state with N = I - G' H_t+1 G > 0. Given the state, y = f and w normal of
covariance G G', E exp(V_t+1(y + w)) = exp(y' W y / 2) det(N)^(-1/2) with W as in ``step_program``; for w of that
variance proxy, or of a smaller covariance, it is at most that, since V is convex. So if

    M = | H_t + (log det N) e e' - sum mu_i B_i, 0 ; 0, diag(tau) |  - C' tau C - L' W L

has M + eps >= 0, then E exp(V_t+1) <= exp(V_t + lam) with lam = eps sup |(z, p)|^2 / 2 on the box, for every p that
the model allows, since (C_k (z, p))^2 >= p_k^2, and wherever B_i >= 0. So exp(V_t(X_t) - sum lam), stopped where a path
leaves the box, is a supermartingale, and where one has left through the wall within the window V_t >= -gap. Hence

    P(leaving through it within the window) <= exp(sum lam + gap + V_0).

What is said of a step holds at all times. So V_t+k serves the window that is k steps earlier, with V_k at the start,
and P(leaving through the wall) is at most exp(sum lam + gap) times the sum of exp(V_k) over windows that cover the
horizon.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from flint import arb, arb_mat

from certbound.arrays import Array, Integers
from certbound.quadratic.form_matrices import enclosed_side_forms
from certbound.quadratic.setting import Wall
from certbound.quadratic.steps.step_program import StepProposal, Steps, beyond
from certbound.rigor.balls import precision, upper
from certbound.rigor.definite import eigenvalue_lower
from certbound.rigor.intervals import Interval, concatenate, matmul
from certbound.watch import poll

_CHUNK = 256
_GAPS = (0.0, 1e-9, 1e-6, 1e-4, 1e-2, 0.1)
_LIFT = 1e-8  # of the largest entry: what every curvature gains


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class StepProof:
    """P(leaving through the walls from x) <= exp(excess) sum_k exp V_k(x) for every start.

    Attributes
    ----------
    excess : float
        Sum of lam, and the gap; +inf where nothing is proved.
    starts : Interval, shape (windows, c)
        V_k at the corners of the starts, over which the sum is largest at one of them.
    proposal : StepProposal
        What it is proved of.
    """

    excess: float
    starts: Interval
    proposal: StepProposal

    def at_corners(self) -> list[arb]:
        """The bounds for the corners of the starts."""
        with precision():
            factor = arb(self.excess).exp()
            return [factor * sum((arb(float(value)).exp() for value in column), arb(0)) for column in self.starts.hi.T]


def prove_steps(given: Steps, walls: Sequence[Wall], proposal: StepProposal, until: float = math.inf) -> StepProof:
    """The bound that a proposal gives of leaving through the walls; none where it takes longer than ``until``."""
    lifted, n = _convex(proposal), given.setting.dimension
    first = _at(lifted, np.arange(0, given.horizon, lifted.window))
    corners = given.corners
    starts = (matmul(corners, Interval.point(first)) * corners).sum(axis=-1) * Interval.point(0.5)
    excess = math.inf
    if np.all(eigenvalue_lower(first[:, :n, :n]) >= 0):  # a sum of exponentials of convex functions
        gap = max(_gap(given, wall, lifted, place) for place, wall in enumerate(walls))
        excess = gap if gap == math.inf else _sum_up(gap, _growth(given, lifted, until))
    return StepProof(excess=excess, starts=starts, proposal=lifted)


def _sum_up(a: float, b: float) -> float:
    """a + b, rounded up."""
    return math.inf if math.inf in (a, b) else float((Interval.point(a) + Interval.point(b)).hi)


def _convex(proposal: StepProposal) -> StepProposal:
    """The proposal with a little curvature added: V is convex, and at least 0 beyond walls, in spite of rounding."""
    matrices = (proposal.matrices + proposal.matrices.transpose(0, 2, 1)) / 2
    n = matrices.shape[1] - 1
    least = float(np.linalg.eigvalsh(matrices[:, :n, :n]).min())
    matrices[:, np.arange(n), np.arange(n)] += max(0.0, -least) + _LIFT * float(np.abs(matrices).max())
    return replace(proposal, matrices=matrices)


def _between(proposal: StepProposal, parts: Array, steps: Integers) -> Array:
    """Multipliers (P, 2, k) at steps, between those at the ends of pieces: any floats that are at least 0 will do."""
    place = np.searchsorted(proposal.steps, steps, side="right") - 1
    start, length = proposal.steps[place], np.diff(proposal.steps)[place]
    within = np.clip((steps - start) / np.maximum(length - 1, 1), 0.0, 1.0)[:, None]
    return np.asarray(np.maximum(parts[place, 0] * (1 - within) + parts[place, 1] * within, 0.0))


def _at(proposal: StepProposal, steps: Integers) -> Array:
    """H at steps, the same floats whenever it is asked for."""
    place = np.clip(np.searchsorted(proposal.steps, steps, side="right") - 1, 0, len(proposal.steps) - 2)
    share = ((steps - proposal.steps[place]) / np.diff(proposal.steps)[place])[:, None, None]
    return np.asarray(proposal.matrices[place] * (1 - share) + proposal.matrices[place + 1] * share)


def _growth(given: Steps, proposal: StepProposal, until: float) -> float:
    """A bound of the sum of lam over all steps."""
    total = 0.0
    for first in range(0, given.horizon, _CHUNK):
        poll("quadratic value bounds")
        if total == math.inf or time.perf_counter() > until:
            return math.inf
        total = _sum_up(total, _excess(given, proposal, np.arange(first, min(first + _CHUNK, given.horizon))))
    return total


def _excess(given: Steps, proposal: StepProposal, steps: Integers) -> float:
    """A bound of the sum of lam over some steps; infinite where a hypothesis fails."""
    n, then = given.setting.dimension, _at(proposal, steps + 1)
    if np.any(eigenvalue_lower(then[:, :n, :n]) < 0):
        return math.inf
    h, noise = Interval.point(then), Interval.point(given.noise)
    free = Interval.point(np.eye(noise.shape[1])) - matmul(noise.T, matmul(h, noise))
    free = (free + free.swapaxes(-1, -2)) * Interval.point(0.5)
    least = eigenvalue_lower(free)
    if not np.all(least > 0):
        return math.inf
    joined, rows = given.secants.matrix, given.secants.rows
    pushed = matmul(h, joined)
    border = matmul(noise.T, pushed)
    image = matmul(joined.T, pushed) + matmul(border.swapaxes(-1, -2), matmul(_inverse(free, least), border))
    scales = _between(proposal, proposal.scales, steps)
    main = Interval.point(_at(proposal, steps)) - _known(given, _between(proposal, proposal.weights, steps))
    whole = _joined(main, _log_determinants(free), scales) - image
    whole = whole - matmul(rows.T, rows * Interval.point(scales)[..., None])
    low = eigenvalue_lower((whole + whole.swapaxes(-1, -2)) * Interval.point(0.5))
    if not np.all(np.isfinite(low)):
        return math.inf
    size = Interval.point(float(n + 1)) + _largest(given)
    return float((Interval.point(np.maximum(-low, 0.0)) * size * Interval.point(0.5)).sum().hi)


def _joined(main: Interval, offset: Interval, scales: Array) -> Interval:
    """main + offset e e' and diag(scales) as blocks."""
    size, k = main.shape[-1], scales.shape[1]
    lo, hi = np.zeros((2, len(scales), size + k, size + k))
    lo[:, :size, :size], hi[:, :size, :size] = main.lo, main.hi
    last = main[:, -1, -1] + offset
    lo[:, size - 1, size - 1], hi[:, size - 1, size - 1] = last.lo, last.hi
    places = np.arange(size, size + k)
    lo[:, places, places] = hi[:, places, places] = scales
    return Interval(lo, hi)


def _inverse(matrix: Interval, least: Array) -> Interval:
    """Matrices that are at least inv(N), N > least > 0.

    With K near inv(N) and R = I - N K, inv(N) = 2 K - K N K + R' inv(N) R.
    """
    near = np.linalg.inv(matrix.mid)
    k = Interval.point((near + near.swapaxes(-1, -2)) / 2)
    product = matmul(matrix, k)
    rest = Interval.point(np.eye(matrix.shape[-1])) - product
    square = (rest * rest).sum(axis=-1).sum(axis=-1) / Interval.point(least)
    over = Interval.point(np.eye(matrix.shape[-1])) * Interval.point(square.hi)[:, None, None]
    return k * Interval.point(2.0) - matmul(k, product) + over


def _log_determinants(matrix: Interval) -> Interval:
    """log det of positive definite matrices."""
    found = []
    with precision():
        for low, high in zip(matrix.lo, matrix.hi):
            rows = [[arb(float(a)).union(arb(float(b))) for a, b in zip(*pair)] for pair in zip(low, high)]
            value = arb_mat(rows).det().log()
            found.append((-upper(-value), upper(value)))
    lo, hi = np.array(found).T
    return Interval(lo, hi)


def _known(given: Steps, weights: Array) -> Interval:
    """sum mu_i B_i."""
    n = given.setting.dimension
    forms = concatenate([enclosed_side_forms(-np.ones(n), np.ones(n)), given.setting.inside])
    flat = forms.reshape(len(forms), -1)
    return matmul(Interval.point(weights), flat).reshape(len(weights), n + 1, n + 1)


def _largest(given: Steps) -> Interval:
    """sup |p|^2 over the box."""
    rows, n = given.secants.rows, given.setting.dimension
    bounds: list[Interval] = []
    for k in range(len(rows)):
        parts = [Interval.point(rows[k, : n + 1].mag).sum()]
        parts += [Interval.point(rows[k, n + 1 + place].mag) * bound for place, bound in enumerate(bounds)]
        bounds.append(sum(parts, Interval.point(0.0)))
    return sum((bound * bound for bound in bounds), Interval.point(0.0))


def _gap(given: Steps, wall: Wall, proposal: StepProposal, place: int) -> float:
    """V >= -gap beyond a wall at every step of the window: infinite if that is not shown."""
    worst, known = 0.0, proposal.wall_weights[place]
    for first in range(max(given.horizon - proposal.window, 0) + 1, given.horizon + 1, _CHUNK):
        steps = np.arange(first, min(first + _CHUNK, given.horizon + 1))
        mixed = np.array([np.interp(steps, proposal.steps, column) for column in known.T]).T.reshape(len(steps), -1)
        worst = max(worst, _gap_of(wall, _at(proposal, steps), mixed))
    return worst


def _gap_of(wall: Wall, matrices: Array, weights: Array) -> float:
    forms = beyond(wall)
    flat = matmul(Interval.point(np.maximum(weights, 0.0)), forms.reshape(len(forms), -1))
    matrix = Interval.point(matrices) * Interval.point(0.5) - flat.reshape(*matrices.shape)
    for gap in _GAPS:
        raised = np.zeros(matrices.shape[1:])
        raised[-1, -1] = gap
        if np.all(eigenvalue_lower(matrix + Interval.point(raised)) >= 0):
            return gap
    return np.inf
