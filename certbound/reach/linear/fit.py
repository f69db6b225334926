"""Slopes for Thm K7 that leave little to the remainder: the dynamics' affine fit over the tube.

Any slope Jhat is valid. The Jacobian at the nominal point leaves all curvature to the remainder; the least-squares
fit over the deviations that have to be reckoned with leaves half of it or less, and the remainder then feeds itself
later. Everything here proposes.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from certbound.arrays import Array
from certbound.reach.linear.fixed_point import Inclusion
from certbound.reach.linear.linearisation import Linearisation
from certbound.reach.linear.shares import Share
from certbound.watch import poll

_PICARD = 10
_CLOSE = 0.02
_LARGEST = 1.0  # remainder, at most so many times what it came from
_EARLY = 5
_STEEPEST = 2.0  # ||Jhat|| h, at most so many times that of the Jacobian, or 1/2


def fitted(
    engine: Linearisation, nonlinear: Share, *, make: Callable[[Linearisation], Inclusion] = Inclusion
) -> Linearisation:
    """``engine`` with slopes fitted over the deviations that a probability of ``nonlinear`` leaves out.

    The fit is repeated where the remainder of the first one was large; ``make`` says which deviations there are.
    """
    if not len(engine.model.active):
        return engine
    run = make(engine)
    for _ in range(2):
        tube = _tube(run, nonlinear)
        if tube is None:
            break
        low, high, grown = tube
        found = engine.model.fitted(engine.frame, low, high, run.flat_extra)
        other = engine.fitted(found.reshape(*engine.shape, engine.n))
        steepest, plain = (e.step * float(np.abs(s).sum(-1).max()) for e, s in (
            (other, other.slopes[0]), (engine, engine.tangents[0])))
        if not steepest <= _STEEPEST * max(0.5, plain):
            break
        engine = other
        if grown < _LARGEST / 4:
            break
        run = make(engine)
    return engine


def _tube(run: Inclusion, nonlinear: Share) -> tuple[Array, Array, float] | None:
    """Rough bounds of the deviation along the inner rows (B N, D), and the remainder's share of them.

    None where the deviation without any remainder is beyond all use already.
    """
    levels = _levels(run, nonlinear)
    base = run.deviations(levels, *run.nothing)
    if base is None:
        return None
    grown = 0.0
    tube = base
    for _ in range(_PICARD):
        poll("slopes that fit the tube")
        sample = run.sampled(tube)
        if not (np.isfinite(sample[0]).all() and np.isfinite(sample[1]).all()):
            return *base, np.inf
        found = run.deviations(levels, *sample)
        if found is None:
            return *tube, np.inf
        size = _LARGEST * (base[1] - base[0])
        following = np.maximum(found[0], base[0] - size), np.minimum(found[1], base[1] + size)
        moved = max(float(np.max(np.abs(a - b) / (size + 1e-300))) for a, b in zip(following, tube, strict=True))
        tube = following
        grown = float(np.max((tube[1] - tube[0]) / (base[1] - base[0] + 1e-300))) - 1
        if moved < _CLOSE:
            break
    return *tube, grown


def _levels(run: Inclusion, nonlinear: Share) -> Array:
    """Levels of |Z| along the inner rows from their standard deviations alone."""
    v = run.engine.response.covariance
    variance = [np.einsum("bkdi,bkij,bkdj->bkd", run.rows, ends, run.rows) for ends in (v[:, :-1], v[:, 1:])]
    deviation = np.sqrt(np.maximum(np.maximum(*variance) if run.engine.continuous else variance[0], 0.0))
    early = max(1, deviation.shape[1] // _EARLY)
    if run.engine.continuous:
        deviation[:, :early] = np.maximum(deviation[:, :early], deviation[:, early - 1 : early])
    return np.asarray(np.sqrt(2 * (np.log(4.0 * max(run.rows.shape[2], 1)) - nonlinear.log)) * deviation)
