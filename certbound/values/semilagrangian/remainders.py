"""What the linearisation of one noisy step leaves out, and how far a path strays inside a step.

Over a step from x write X_t = m_t + delta_t, m the noise-free flow; zeta solves the linearised equation d zeta =
Df(m_t) zeta dt + b dW, and R = delta - zeta. On the event E = {sup |W| <= omega sqrt(h)},

    |delta| <= D   where   |b| omega sqrt(h) + h N D <= D,   N = sup |Df| on the tube way +- D,
    R' = Df(m) R + D^2 f(.)[delta, delta]/2,   so   |R_t| <= r = h e^{N h} C[D, D]/2,   C = sup |D^2 f| on the tube.

Given zeta(h) = S^{1/2} e, the Gaussian zeta_i(t) has at most its own variance v_i(t) and a mean of square at most
v_i(t) |e|^2, so E[zeta_i(t)^2 | e] <= v_i(t) (1 + |e|^2) and, with I_i = (sqrt(int v_i) + r_i sqrt(h))^2,

    E[|R_k(h)| 1_E | e] <= rho_k (1 + |e|^2),   rho_k = sum_l (e^{N h})_kl sum_ij C_l,ij sqrt(I_i I_j)/2.

v_i(t) <= int_0^t (|b|_i + s g_i)^2 ds with g = N e^{N h} |b|, since |e^{N s} b| <= |b| + s N e^{N h} |b|.

*The chord.* For dp = F dt the path's distance from the chord between its ends is int G(t, u) dF_u with Green's function
G of the step. Where F_q is a constant a, the drift part of dF contributes at most t (h - t)/2 of its supremum, which is
at most h^2/8, and the noise part s |a| h^{3/2} k(t/h), k(t) = int min(t, u)(1 - max(t, u)) dB_u on the unit interval
(`bowed`). Elsewhere the distance is t (1 - t/h) times the difference of two means of F, at most h/4 of F's oscillation
over the tube.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Mask
from certbound.problem.model import Tape, jacobian
from certbound.rigor.intervals import Interval
from certbound.rigor.series import ZERO
from certbound.values.discrete import evaluate
from certbound.values.semilagrangian.flows import during, reachable

_UP = 1 + 1e-9
_PARTS = 400


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Remainders:
    """Per box of starts, shape (N,) each: r and rho of the module by coordinate, and how a path strays.

    Attributes
    ----------
    most, mean : ndarray, shape (2, N)
        r and rho.
    dip, bow : ndarray, shapes (2, N), (N,)
        How far p may be below (above) the chord between its ends, on E, but for the noise's part: that is ``bow`` k.
    inward : ndarray, shape (2, N)
        Largest drift of q upwards (downwards) on the tube.
    tube : (Interval, Interval)
        Where X stays on E.
    known : ndarray of bool
        Whether all this was shown.
    """

    most: Array
    mean: Array
    dip: Array
    bow: Array
    inward: Array
    tube: tuple[Interval, Interval]
    known: Mask


def upper_tail(z: float) -> float:
    """Upper bound of P(N(0, 1) > z)."""
    return 0.5 * math.erfc(z / math.sqrt(2)) * (1 + 1e-9) + 1e-300


def level_of(probability: float) -> float:
    """A z with 4 P(N(0, 1) > z) <= probability."""
    low, high = 0.0, 38.0
    for _ in range(80):
        middle = (low + high) / 2
        low, high = (middle, high) if 4 * upper_tail(middle) > probability else (low, middle)
    return high


def bowed(near: Array, far: float) -> Array:
    """Upper bounds of P(k(t) > near (1 - t) + far t for some t), k as in the module; near and far positive.

    Z = sqrt(3) k/(t (1 - t)) has variance 1 at all t, and Z' the variance 1/(t (1 - t)). It exceeds beta(t) =
    sqrt(3) (near/t + far/(1 - t)) where beta is least, or crosses it upwards later, or downwards before, as beta is
    convex. Rice's formula with a slope of beta that only helps: Phi(-min beta) plus int e^{-beta^2/2}/sqrt(t (1 - t))
    dt/(2 pi), and t = sin^2(a/2) makes that the mean of e^{-beta^2/2}/2 over a in [0, pi].
    """
    angles = np.linspace(0, np.pi, _PARTS + 1)[1:-1]
    t = np.sin(angles / 2) ** 2
    near = np.asarray(near, dtype=float)[..., None]
    beta = math.sqrt(3) * (near / t + far / (1 - t)) / _UP
    least = math.sqrt(3) * (np.sqrt(near) + math.sqrt(far)) ** 2 / _UP
    ends = np.full((*beta.shape[:-1], 1), np.inf)
    beta = np.concatenate([ends, beta, ends], axis=-1)
    lower = np.minimum(beta[..., 1:], beta[..., :-1])
    turn = 1 / (1 + np.sqrt(far / near))  # where beta is least: a mean of near/t and far/(1 - t)
    angle = 2 * np.arcsin(np.sqrt(turn))
    holds = np.abs(angle - (np.arange(_PARTS) + 0.5) * np.pi / _PARTS) <= 0.6 * np.pi / _PARTS
    lower = np.where(holds, least, lower)
    mean = np.exp(-0.5 * lower**2).mean(axis=-1) / 2
    tail = np.array([upper_tail(float(z)) for z in least.ravel()]).reshape(mean.shape)
    return np.asarray(np.minimum(tail + mean, 1.0) * _UP + 1e-300)


def remainders(
    tape: Tape, noise: float, p: Interval, q: Interval, *, step: float, omega: float, begin: Interval = ZERO
) -> Remainders:
    """Bound what the linearisation leaves out over one step from every box.

    Parameters
    ----------
    tape : Tape
        f over (t, p, q), its first row free of t.
    noise : float
        s; the noise moves q only.
    p, q : Interval, shape (N,)
        Boxes of starts.
    step, omega : float
    begin : Interval
        Times at which the step begins.
    """
    size = p.lo.shape
    way, known = reachable(tape, [p, q], step, begin)
    time = during(begin, step)
    first = jacobian(tape, (1, 2))
    second = jacobian(first, (1, 2))
    push = np.stack([np.zeros(size), np.full(size, noise * omega * math.sqrt(step) * _UP)])
    settled = np.zeros(size, dtype=bool)
    tube = [Interval(w.lo - d, w.hi + d) for w, d in zip(way, push)]
    slopes, _ = _magnitudes(first, time, tube)
    stray = 1.3 * (push + step * np.einsum("ijn,jn->in", slopes, push))
    for _ in range(8):
        tube = [Interval(w.lo - d, w.hi + d) for w, d in zip(way, stray)]
        slopes, fine = _magnitudes(first, time, tube)
        needed = (push + step * np.einsum("ijn,jn->in", slopes, stray)) * _UP
        settled = fine & np.all(needed <= stray, axis=0)
        if settled.all():
            break
        stray = np.where(settled, stray, np.where(fine, np.maximum(stray, 1.1 * needed), stray))
    known = known & settled
    bends, fine = _magnitudes(second, time, tube)
    known = known & fine
    bends = np.where(known, bends.reshape(2, 2, 2, *size), 0.0)
    slopes = np.where(known, slopes, 0.0)
    growth = _exponential(slopes * step)
    most = step * _through(growth, 0.5 * np.einsum("kijn,in,jn->kn", bends, stray, stray)) * _UP
    gain = np.stack([np.zeros(size), np.full(size, noise)])
    rate = np.einsum("ijn,jn->in", slopes, _through(growth, gain))
    spread = gain**2 * step**2 / 2 + gain * rate * step**3 / 3 + rate**2 * step**4 / 12
    root = np.sqrt(spread) + most * math.sqrt(step)
    mean = _through(growth, 0.5 * np.einsum("kijn,in,jn->kn", bends, root, root)) * _UP
    dip, bow, inward, fine = _strays((tape, first, second), noise, time, tube, step)
    return Remainders(
        most=most, mean=mean, dip=dip, bow=bow, inward=inward, tube=(tube[0], tube[1]), known=known & fine
    )


def _magnitudes(tape: Tape, time: Interval, tube: list[Interval]) -> tuple[Array, Mask]:
    """sup |outputs| over the boxes, shape (rows, columns, N), and where it is known."""
    found, undefined, jumps = evaluate(tape, [time, *tube])
    size = found.mag
    fine = np.isfinite(size).all(axis=1) & ~undefined & ~jumps
    return np.where(fine[:, None], size, 0.0).T.reshape(*tape.shape, -1), fine


def _exponential(matrix: Array) -> Array:
    """Upper bound of the exponential of non-negative 2 x 2 matrices, shape (2, 2, N), whatever the units."""
    cross = matrix[0, 1] + matrix[1, 0]
    ratio = np.sqrt((matrix[0, 1] + 1e-6 * cross) / np.maximum(matrix[1, 0] + 1e-6 * cross, 1e-300))
    unit = np.where(cross > 0, np.exp2(np.round(np.log2(np.maximum(ratio, 1e-9)))), 1.0)  # a power of 2: exact
    units = np.stack([np.stack([np.ones_like(unit), unit]), np.stack([1 / unit, np.ones_like(unit)])])
    return np.asarray(_balanced_exponential(matrix / units) * units)


def _balanced_exponential(matrix: Array) -> Array:
    total = np.broadcast_to(np.eye(2)[..., None], matrix.shape).copy()
    term = total.copy()
    for k in range(1, 12):
        term = np.einsum("ijn,jkn->ikn", term, matrix) / k
        total += term
    norm = matrix.sum(axis=1).max(axis=0)
    rest = np.where(norm < 6, norm**12 / math.factorial(12) / (1 - np.minimum(norm, 6.0) / 13), np.inf)
    return np.asarray((total + rest) * _UP)


def _through(matrix: Array, vector: Array) -> Array:
    return np.asarray(np.einsum("ijn,jn->in", matrix, vector))


def _strays(
    tapes: tuple[Tape, Tape, Tape], noise: float, time: Interval, tube: list[Interval], step: float
) -> tuple[Array, Array, Array, Mask]:
    """Bounds of the distance of p from its chord in two parts, and of q's drift, over the tube."""
    (f, bad, _), (a, worse, _), (c, worst, _) = (evaluate(tape, [time, *tube]) for tape in tapes)
    fine = ~bad & ~worse & ~worst & np.isfinite(np.hstack([f.mag, a.mag, c.mag])).all(axis=1)

    def safe(value: Interval) -> Interval:
        return Interval(np.where(fine, value.lo, 0.0), np.where(fine, value.hi, 0.0))

    slope = safe(a[:, 1])
    drift = safe(a[:, 0]) * safe(f[:, 0]) + slope * safe(f[:, 1]) + safe(c[:, 3]) * (0.5 * noise**2)
    middle = np.abs(slope.mid) + slope.rad
    varying = (c.mag[:, 2] > 0) | (c.mag[:, 3] > 0)
    across, width = (np.where(fine, part.hi - part.lo, 0.0) for part in tube)
    with np.errstate(over="ignore"):  # of tubes that run away, where nothing is known
        crude = step / 4 * (middle * width + safe(a[:, 0]).mag * across)
    down = np.where(varying, crude, np.maximum(drift.hi, 0.0) * step**2 / 8)
    over = np.where(varying, crude, np.maximum(-drift.lo, 0.0) * step**2 / 8)
    bow = np.where(varying, 0.0, noise * step**1.5 * middle)
    speed = safe(f[:, 1])
    inward = np.stack([np.maximum(speed.hi, 0.0), np.maximum(-speed.lo, 0.0)])
    return np.stack([down, over]) * _UP, bow * _UP, inward, fine
