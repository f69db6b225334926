"""Constants along a tube, in metrics that are fitted to it: one that stands still, or coordinates that move.

In z = T(t) (X_t - x_t), T(t) invertible, continuous and linear between the ``times``, the deviation of continuous time
obeys dz = ((T' + T J) T^-1) z dt + T g dW, J an average of Jacobians. So |z| has the rate mu_2((T' + T J) T^-1) and the
noise |T g|: the time-varying metric P = T^T T with J^T P + P J + P' <= 2 c P (docs/theory.md). A tube |z| <= r(t) holds
|a . (X_t - x_t)| <= r(t) |T^-T a|.

Proof on a piece: with R near T^-1 in its middle, N = T R and w = R^-1 (X - x), d|N w|^2 = 2 w^T N^T (T' R + T J R) w dt
for the part without noise, and | |N w|^2 - |w|^2 | <= e |w|^2 for e >= |N^T N - I|. So with
m >= lambda_max(sym N^T (T' R + T J R)) the rate is at most m/(1 - e) where m >= 0 and m/(1 + e) where not.
Nothing rests on how T was found.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.constants.bounds import constants_along
from certbound.constants.certification import slope_weights
from certbound.constants.enclosures import Metric, Spread, enclose, split_boxes
from certbound.constants.model_data import model_of
from certbound.constants.programs import rate_proposals, sampled_polytope
from certbound.constants.state_jacobian import StateJacobian
from certbound.errors import EnclosureError, InfeasibleError, SolverError
from certbound.parallel import alone
from certbound.problem.model import Tape
from certbound.problem.systems import ContinuousSystem
from certbound.rigor.definite import eigenvalue_upper
from certbound.rigor.intervals import Interval, matmul
from certbound.rigor.rounding import lower, upper
from certbound.tubes.constants import Constants
from certbound.tubes.tube import Tube
from certbound.watch import poll

MOST_STATES = 6
"""States up to which moving coordinates are looked for."""

_NODES = 4  # of T in time, as it is searched for
_COARSE = 24  # pieces that the search looks at
_SAMPLES = 8  # Jacobians a piece that the search looks at


def fitted_constants_along(source: Any, times: ArrayLike, boxes: Interval, *, refine: int = 16) -> Constants:
    """Constants per time piece in the better of two metrics: the identity, and one fitted to the boxes.

    Proves what `constants_along` proves, in the metric of the result. The fitted one nearly minimises the largest
    rate or gain over Jacobians at the middles of the boxes; it is kept where the mean square of the deviation
    (`noise_spread`) is smaller, and the metrics are scaled to ||x||_2 <= ||x||_P so that the two compare.

    Parameters
    ----------
    source : system or Problem
    times : array_like, shape (K + 1,)
    boxes : Interval, shape (K, n)
    refine : int
        As for `constants_along`.

    Returns
    -------
    Constants

    Raises
    ------
    EnclosureError, ValueError
        As `constants_along`; a fit that fails leaves the identity.

    Source: Thm K4 and Sec. 6 of docs/theory.md.
    """
    plain = constants_along(source, times, boxes, refine=refine)
    model = model_of(source, None, float(np.asarray(times, dtype=float)[-1]))
    if model.dimension == 1:
        return plain
    jacobian = StateJacobian(model.dynamics, model.state_slots, model.ranges)
    middles = model.along(np.asarray(times, dtype=float), boxes).mid[:, list(jacobian.active)]
    matrices = jacobian.values(middles)
    matrices = matrices[np.isfinite(matrices).all(axis=(1, 2))]
    if not len(matrices):
        return plain
    try:
        proposals = rate_proposals(sampled_polytope(matrices), continuous=model.continuous)
    except SolverError:
        return plain
    found = [constants_along(source, times, boxes, metric=one.metric, refine=refine) for one in proposals]
    return min([plain, *found], key=noise_spread)


def noise_spread(constants: Constants) -> float:
    """log of the largest mean square of ||X - x||_P that the constants allow over their pieces, in floating point.

    It solves v' = 2 c v + nu sigma^2 (CT) or v+ = L^2 v + nu sigma^2 (DT) from v = 0; -inf without noise.
    """
    if constants.times is None:
        raise ValueError("`constants` must have time pieces, got constants that hold at all times.")
    spans = np.diff(np.asarray(constants.times, dtype=float))
    rates = np.asarray(constants.slope, dtype=float)
    values = np.broadcast_to(rates, spans.shape)
    power = np.broadcast_to(constants.nu * np.asarray(constants.sigma, dtype=float) ** 2, spans.shape)
    level, largest = -np.inf, -np.inf  # logarithms: an expanding rate over a long tube overflows
    with np.errstate(divide="ignore"):
        added = np.log(power)
    for value, span, share in zip(values, spans, added):
        if constants.continuous:
            growth = 2 * float(value) * float(span)
            room = np.log(span) + (np.log(np.expm1(growth) / growth) if 0 < abs(growth) < 500 else max(growth, 0.0))
        else:
            growth, room = 2 * float(np.log(value)), 0.0
        level = float(np.logaddexp(level + growth, share + room))
        largest = max(largest, level)
    return largest


@dataclass(frozen=True, eq=False, kw_only=True)
class MovingConstants:
    """What `moving_constants_along` proves, piece by piece."""

    times: Array  # (K + 1,)
    frames: Array  # (K + 1, n, n): T at the times, linear between
    rate: Array  # (K,), in 1/s
    sigma: Array  # (K,)
    effective_dimension: float  # nu with tr(T g g^T T^T) <= nu sigma^2 on each piece
    sampled: Array  # (K,): the rates that sampling found
    _inverse: Array  # (K, n, n): R, and e above |T R - I|
    _error: Array

    @property
    def integral(self) -> float:
        """The integral of the rate over all pieces."""
        return float(np.diff(self.times) @ self.rate)

    def constants(self) -> Constants:
        """The constants of z, in its Euclidean norm, for tubes of z: they carry no proof, for they are none of x."""
        n = self.frames.shape[-1]
        return Constants(
            rate=self.rate, sigma=self.sigma, dimension=n, effective_dimension=self.effective_dimension,
            times=self.times,
        )  # fmt: skip

    def extent(self, tube: Tube, directions: ArrayLike) -> Array:
        """Upper bounds (K,) of |W (X_t - x_t)| over each piece while |z| <= the tube's radius, W = ``directions``."""
        rows = matmul(np.atleast_2d(np.asarray(directions, dtype=float)), self._inverse)
        square = np.maximum(eigenvalue_upper(matmul(rows, rows.T)), 0.0)
        radius = np.asarray(tube.bound(self.times[:-1], self.times[1:]), dtype=float)
        return np.asarray(upper(upper(upper(np.sqrt(square)) * radius) / lower(1.0 - self._error)))


@alone()
def moving_constants_along(
    source: Any,
    times: ArrayLike,
    boxes: Interval,
    *,
    frames: ArrayLike | None = None,
    directions: ArrayLike | None = None,
    refine: int = 256,
) -> MovingConstants:
    """Rates and noise per time piece over given boxes, in coordinates that move (continuous time; Thm K4).

    Proves: for t in [times[k], times[k+1]] and states in boxes[k], |z| has the rate ``rate[k]`` and the noise
    ``sigma[k]``.

    Parameters
    ----------
    source : system or Problem
    times : array_like, shape (K + 1,)
        Piece ends, rising from 0.
    boxes : Interval, shape (K, n)
        States on each piece.
    frames : array_like, shape (K + 1, n, n), optional
        T at the times; when omitted, such as make |W (X - x)| small over sampled Jacobians.
    directions : array_like, shape (d, n), optional
        W; the identity when omitted.
    refine : int
        Sub-boxes that each box is cut into.

    Raises
    ------
    InfeasibleError
        In discrete time, or beyond ``MOST_STATES`` states without frames.
    ValueError, EnclosureError
        Frames that are not invertible; a Jacobian or noise that is unbounded on a piece.
    """
    ends = np.asarray(times, dtype=float)
    model = model_of(source, None, float(ends[-1]))
    n = model.dimension
    if not isinstance(model.system, ContinuousSystem):
        raise InfeasibleError("moving coordinates need continuous time; use constants_along.")
    if boxes.shape != (len(ends) - 1, n):
        raise ValueError(f"`boxes` must have shape {(len(ends) - 1, n)}, got {boxes.shape}.")
    jacobian = StateJacobian(model.dynamics, model.state_slots, model.ranges)
    pieces = model.along(ends, boxes)
    active = Interval(pieces.lo[:, list(jacobian.active)], pieces.hi[:, list(jacobian.active)])
    if frames is None:
        if n > MOST_STATES:
            raise InfeasibleError(f"moving coordinates are found for up to {MOST_STATES} states, not {n}: give them.")
        rows = np.eye(n) if directions is None else np.atleast_2d(np.asarray(directions, dtype=float))
        frames = _search(ends, _samples(jacobian, active), _middle_noise(model.system.diffusion, pieces), rows)
    moves = _Moves(ends, np.asarray(frames, dtype=float), n)
    rate = _rates(jacobian, active, moves, refine)
    if not np.all(np.isfinite(rate)):
        place = int(np.argmin(np.isfinite(rate)))
        raise EnclosureError(
            f"`boxes` must keep the Jacobian bounded; on piece {place}, {jacobian.explain(active[place])} is unbounded."
        )
    sigma, nu = _noise(model.system.diffusion, pieces, moves)
    sampled = moves.sampled(jacobian.values(active.mid))
    return MovingConstants(
        times=ends, frames=moves.frames, rate=rate, sigma=sigma, effective_dimension=nu, sampled=sampled,
        _inverse=moves.inverse, _error=moves.error,
    )  # fmt: skip


class _Moves:
    """T, T' and N = T R over each piece."""

    def __init__(self, times: Array, frames: Array, n: int) -> None:
        if frames.shape != (len(times), n, n) or not np.all(np.isfinite(frames)):
            raise ValueError(f"`frames` must be finite, of shape {(len(times), n, n)}, got shape {frames.shape}.")
        first, last = frames[:-1], frames[1:]
        self.frames = frames
        self.inverse: Array = np.asarray(np.linalg.inv(first / 2 + last / 2), dtype=float)
        self.frame = Interval(np.minimum(first, last), np.maximum(first, last))
        span = (Interval.point(times[1:]) - times[:-1])[:, None, None]
        self.rise = matmul((Interval.point(last) - first) / span, self.inverse)  # T' R
        a, b = matmul(first, self.inverse), matmul(last, self.inverse)
        self.near = Interval(np.minimum(a.lo, b.lo), np.maximum(a.hi, b.hi))  # N
        self.error = _spectral(self.near - np.eye(n))
        self.gram_error = _spectral(matmul(self.near.T, self.near) - np.eye(n))
        if not np.all((self.error < 0.5) & (self.gram_error < 0.5)):
            raise ValueError("`frames` must be invertible and change by less than half on every piece; cut the pieces.")

    def image(self, jacobians: Interval, owner: Any) -> Interval:
        """N^T T J R."""
        inverse, frame, near = self.inverse[owner], self.frame[owner], self.near[owner].T
        if len(jacobians.shape) == 4:
            inverse, frame, near = inverse[:, None], frame[:, None], near[:, None]
        return matmul(near, matmul(frame, matmul(jacobians, inverse)))

    def measure(self, norm: Metric, jacobians: Interval, spread: Spread | None, owner: Any) -> Array:
        """Upper bounds of the rate."""
        centre = self.image(jacobians, owner) + matmul(self.near[owner].T, self.rise[owner])
        moved = None if spread is None else Spread(self.image(spread.slopes, owner), spread.reach)
        value, error = norm.measure(centre, moved), self.gram_error[owner]
        return np.asarray(upper(value / np.where(value >= 0, lower(1.0 - error), upper(1.0 + error))))

    def sampled(self, jacobians: Array) -> Array:
        """Rates in the middles of the pieces, in floating point."""
        middle = np.linalg.inv(self.inverse)
        whole = self.rise.mid + middle @ jacobians @ self.inverse
        return np.asarray(np.linalg.eigvalsh(whole / 2 + np.swapaxes(whole, -1, -2) / 2)[..., -1])


def _spectral(x: Interval) -> Array:
    """Upper bounds of spectral norms."""
    return np.asarray(upper(np.sqrt(np.maximum(eigenvalue_upper(matmul(x.T, x)), 0.0))))


def _rates(jacobian: StateJacobian, boxes: Interval, moves: _Moves, refine: int) -> Array:
    norm, owner, parts = Metric(None, jacobian.dimension), np.arange(len(boxes)), boxes
    while True:
        poll("rates in moving coordinates")
        value = moves.measure(norm, jacobian.enclose(parts), None, owner)
        form = jacobian.spread(parts)
        weights = parts.width
        if form is not None:
            value = np.fmin(value, moves.measure(norm, *form, owner))
            weights = slope_weights(norm, form[1], weights)
        if len(parts) * 2 > refine * len(boxes) or not jacobian.active:
            break
        parts, owner = split_boxes(parts, weights), np.concatenate([owner, owner])
    rate = np.full(len(boxes), -np.inf)
    np.maximum.at(rate, owner, np.where(np.isnan(value), np.inf, value))
    return rate


def _noise(g: Array | Tape, pieces: Interval, moves: _Moves) -> tuple[Array, float]:
    """sigma per piece and nu. |T g| and tr(T g g^T T^T) are convex in T, so that the ends count where g is constant."""
    if isinstance(g, Tape):
        slots = [pieces[:, k] for k in range(len(g.inputs))]
        images = [matmul(moves.frame, enclose(g, slots, undefined="infinite"))]
    else:
        both = matmul(moves.frames, np.asarray(g))
        images = [both[:-1], both[1:]]
    squares = [matmul(image, image.T) for image in images]
    if not all(np.all(np.isfinite(square.mag)) for square in squares):
        raise EnclosureError("`boxes` must keep the diffusion bounded.")
    level = np.max([np.maximum(eigenvalue_upper(square), 0.0) for square in squares], axis=0)
    diagonal = [np.diagonal(square.hi, axis1=-2, axis2=-1) for square in squares]
    trace = np.max([Interval.point(d).sum(axis=-1).hi for d in diagonal], axis=0)
    sigma = np.asarray(upper(np.sqrt(level)))
    loud = sigma > 0
    ratio = upper(trace[loud] / lower(lower(sigma[loud] * sigma[loud])))
    return sigma, min(float(np.max(ratio, initial=1.0)), float(moves.frames.shape[-1]))


def _samples(jacobian: StateJacobian, boxes: Interval) -> Array:
    """Jacobians in the middle and at random corners of every box, (K, samples, n, n); zero where undefined."""
    rng = np.random.default_rng(0)
    found = [jacobian.values(boxes.mid)]
    for _ in range(_SAMPLES - 1):
        found.append(jacobian.values(np.where(rng.random(boxes.shape) < 0.5, boxes.lo, boxes.hi)))
    matrices = np.stack(found, axis=1)
    return np.where(np.isfinite(matrices), matrices, 0.0)


def _middle_noise(g: Array | Tape, pieces: Interval) -> Array:
    """g in the middles of the pieces, (K, n, m)."""
    if not isinstance(g, Tape):
        return np.broadcast_to(np.asarray(g), (len(pieces), *np.shape(g)))
    middles = Interval.point(pieces.mid)
    found = enclose(g, [middles[:, k] for k in range(len(g.inputs))], undefined="infinite").mid
    return np.where(np.isfinite(found), found, 0.0)


def _search(times: Array, jacobians: Array, noise: Array, rows: Array) -> Array:
    """T at the times, lower triangular between ``_NODES`` nodes: it nearly minimises the largest v |W T^-1|^2.

    v' = 2 c v + nu sigma^2 from 0 bounds E |z|^2; c is taken over sampled Jacobians.
    """
    from scipy.optimize import minimize

    n, pieces = jacobians.shape[-1], len(times) - 1
    keep = np.unique(np.linspace(0, pieces, min(pieces, _COARSE) + 1).astype(int))
    lower_part = np.tril_indices(n)
    diagonal = lower_part[0] == lower_part[1]
    nodes = np.linspace(0.0, times[-1], _NODES)

    def frames(theta: Array, at: Array) -> Array:
        table = theta.reshape(_NODES, -1)
        entries = np.stack([np.interp(at, nodes, column) for column in table.T], axis=-1)
        found = np.zeros((len(at), n, n))
        found[:, lower_part[0], lower_part[1]] = np.where(diagonal, np.exp(np.clip(entries, -20, 20)), entries)
        return found

    coarse, spans = times[keep], np.diff(times[keep])
    seen, g = jacobians[keep[:-1]], noise[keep[:-1]]

    def size(theta: Array) -> float:
        poll("moving coordinates")
        T = frames(theta, coarse)
        inverse = np.linalg.inv(T)
        rise = (T[1:] - T[:-1]) / spans[:, None, None]
        rate = np.full(len(spans), -np.inf)
        for ends in (slice(None, -1), slice(1, None)):
            whole = (rise @ inverse[ends])[:, None] + T[ends, None] @ seen @ inverse[ends, None]
            values = np.linalg.eigvalsh(whole + np.swapaxes(whole, -1, -2))[..., -1]
            rate = np.maximum(rate, values.max(axis=1))
        power = np.sum((T[:-1] @ g) ** 2, axis=(-1, -2))
        stretch = np.linalg.norm(rows @ inverse, 2, axis=(-2, -1)) ** 2
        growth = np.clip(rate * spans, -500, 500)
        added = power * spans * np.where(growth == 0.0, 1.0, np.expm1(growth) / np.where(growth == 0.0, 1.0, growth))
        level, worst = 0.0, 1e-300
        for factor, more, wide in zip(np.exp(growth).tolist(), added.tolist(), stretch[1:].tolist()):
            level = level * factor + more
            worst = max(worst, level * wide)
        return 0.5 * float(np.log(worst))

    start = np.zeros((_NODES, len(diagonal))).ravel()
    best = minimize(size, start, method="BFGS", options={"maxiter": 40, "gtol": 1e-3})
    return frames(best.x if best.fun < size(start) else start, times)
