"""Infinite horizons, any number of states: noise along a bounded state leads every path out.

**Theorem.** Let the safe set lie where l <= x_i <= h, and let s f_i >= -b and |g_i|^2 >= a > 0 on it for every
disturbance, f_i and g_i being the drift and the row of the diffusion of that state, s = 1 or -1. Then a path leaves the
safe set with probability 1, after at most 2 w (e^{k w} - 1)/(k a) in the mean, w = h - l and k = 2 b/a + 1/w.

*Proof.* u = e^{k s (x_i - c)}, c the end at which u is least, lies in [1, e^{k w}] on the safe set, and L u =
u k (s f_i + k |g_i|^2/2) >= k (k a/2 - b) = k a/(2 w). So by Ito's formula k a/(2 w) E[tau and t] <= E u(X) - u(x) <=
e^{k w} - 1 for every t, tau being the time of leaving. QED

**In discrete time** with normal noise of variance a > 0 along x_i, s x_i exceeds its bound e at the next step with
probability at least p = 1 - Phi((e + b)/sqrt(a)) from every safe state: leaving is certain, after 1/p steps at most in
the mean.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from certbound.arrays import Array
from certbound.errors import EnclosureError
from certbound.problem.model import JUMPS, Tape, jacobian, sources
from certbound.problem.problem import Problem
from certbound.problem.systems import ContinuousSystem, DiscreteSystem
from certbound.rigor.intervals import Interval
from certbound.values.enclosing import enclose, squared_diffusion

_PARTS = 64  # of the bounded state


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SureExit:
    """Every path leaves: s f_i >= -``drift`` and |g_i|^2 >= ``noise`` > 0 on the safe set, s = -1 where ``mirrored``.

    ``state`` is i; ``mean`` bounds the mean time of leaving, and is infinite where that is beyond all floats. In
    discrete time ``noise`` is the variance of a step along x_i.
    """

    state: int
    mirrored: bool
    noise: float
    drift: float
    mean: float


def leaves_surely(problem: Problem) -> SureExit | None:
    """Why every path leaves the safe set in the end; None where that is not proved.

    No target, limits that always hold and stand still, a model without t, and in continuous time no path that may run
    off to infinity before it leaves. An EnclosureError where the model is undefined somewhere in the box around the
    safe set.
    """
    system = problem.system
    square = _square(system)
    if square is None or problem.reach is not None or problem.hold is not None or problem.ending:
        return None
    if isinstance(problem.plan, np.ndarray):
        return None
    tapes = (problem.closed_loop, *([square] if isinstance(square, Tape) else []))
    if any(0 in slots for tape in tapes for slots in sources(tape)):
        return None
    around, n = _hull(problem), system.dimension
    box = system.disturbance
    pushes = [] if box is None else [Interval(a, b) for a, b in zip(box.low, box.high)]
    if isinstance(system, ContinuousSystem) and not _lasts(problem.closed_loop, system.diffusion, around, pushes):
        return None
    found: list[SureExit] = []
    for state in np.flatnonzero(np.isfinite(around.lo) & np.isfinite(around.hi)).tolist():
        edges = np.linspace(around.lo[state], around.hi[state], _PARTS + 1)
        edges[-1] = around.hi[state]
        sides = [*(around[k] for k in range(n)), *pushes]
        whole = [Interval(np.full(_PARTS, side.lo), np.full(_PARTS, side.hi)) for side in sides]
        cells = [Interval.point(np.zeros(_PARTS)), *whole]
        cells[1 + state] = Interval(edges[:-1], edges[1:])
        with np.errstate(all="ignore"):
            flow = enclose(problem.closed_loop, cells)[0][state]
            if isinstance(square, Tape):
                noise = float(np.min(enclose(square, cells[: n + 1])[0][state * (n + 1)].lo))
            else:
                noise = square[state]
        width = Interval.point(float(around.hi[state])) - Interval.point(float(around.lo[state]))
        for mirrored, drift in ((False, -float(np.min(flow.lo))), (True, float(np.max(flow.hi)))):
            if noise > 0 and width.lo > 0 and math.isfinite(drift):
                drift = drift if isinstance(system, DiscreteSystem) else max(drift, 0.0)
                mean = _mean_time(float(width.hi), noise, drift)
                if isinstance(system, DiscreteSystem):
                    mean = _mean_steps(float(-around.lo[state] if mirrored else around.hi[state]), noise, drift)
                found.append(SureExit(state=state, mirrored=mirrored, noise=noise, drift=drift, mean=mean))
    return min(found, key=lambda one: one.mean, default=None)


def _square(system: ContinuousSystem | DiscreteSystem) -> Tape | list[float] | None:
    """The tape of g g'; in discrete time the variances of normal noise that adds to the state, rounded down."""
    if isinstance(system, ContinuousSystem):
        return squared_diffusion(system.diffusion, system.states)
    if not system.noise.gaussian or system.gain is not None:
        return None
    rows = [[Fraction(entry) for entry in row] for row in system.noise_matrix.tolist()]
    law = system.noise.exact_covariance()
    variances = [sum(a * b * law[i][j] for i, a in enumerate(row) for j, b in enumerate(row)) for row in rows]
    return [float(np.nextafter(float(value), -np.inf)) for value in variances]


def _lasts(drift: Tape, diffusion: Array | Tape, around: Interval, pushes: Sequence[Interval]) -> bool:
    """Whether no path reaches infinity in finite time: the box is bounded, or the model Lipschitz on it."""
    n = len(around.lo)
    if np.isfinite([around.lo, around.hi]).all():
        return True
    for tape in (drift, *([diffusion] if isinstance(diffusion, Tape) else [])):
        inputs = [Interval.point(0.0), *(around[k] for k in range(n)), *pushes][: len(tape.inputs)]
        try:
            slopes = enclose(jacobian(tape, list(range(1, 1 + n))), inputs)[0]
        except EnclosureError:
            return False
        if any(node.op in JUMPS for node in tape.nodes) or not all(np.isfinite(slope.mag).all() for slope in slopes):
            return False
    return True


def _hull(problem: Problem) -> Interval:
    """A box around the safe set, rounded outward; infinite where nothing bounds a state at all times."""
    n = problem.system.dimension
    low, high = np.full(n, -np.inf), np.full(n, np.inf)
    for one in problem.kept:
        if one.outside or one.during not in (None, (0.0, float(problem.horizon))) or one.region.moving:
            continue
        around, places = one.region.hull(), one.region.places(n)
        low[places], high[places] = np.maximum(low[places], around.lo), np.minimum(high[places], around.hi)
    return Interval(low, high)


def _mean_time(width: float, noise: float, drift: float) -> float:
    """2 w (e^{k w} - 1)/(k a), rounded up."""
    slope = 2 * drift / noise + 1 / width
    if not slope * width < 700:
        return math.inf
    return 2 * width * math.expm1(slope * width * (1 + 1e-15)) / (slope * noise) * (1 + 1e-9)


def _mean_steps(end: float, noise: float, drift: float) -> float:
    """1/p, rounded up."""
    away = (end + drift) / math.sqrt(noise)
    chance = math.erfc(max(away, 0.0) * (1 + 1e-12) / math.sqrt(2)) / 2
    return (1 + 1e-9) / chance if chance > 1e-300 else math.inf
