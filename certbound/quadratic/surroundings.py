"""Working boxes: the safe set's own sides where paths come near them, sides beyond the sampled paths elsewhere."""

from __future__ import annotations

import numpy as np

from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.problem.model import Tape, compile_numpy
from certbound.problem.problem import Problem
from certbound.problem.sets import Quadratic
from certbound.quadratic.setting import diffusion_of, never_crossed, safe_sides
from certbound.rigor.intervals import Interval

_PATHS, _STEPS, _SEED = 160, 300, 20
_ROOMY = 1.05  # a ball's sides are moved out by this, so that they are no walls
_LEAST = 0.3  # least margin as a share of what the paths cover
_NEAR = 1.5  # own sides are taken up to this multiple of the distance at which a side would be chosen


def working_box(problem: Problem, margin: float) -> tuple[Array, Array]:
    """Ends of a finite box: ``margin`` standard deviations beyond sampled paths, or a safe side that is about as near.

    Raises
    ------
    InfeasibleError
        The sampled paths run away.
    """
    low, high = safe_sides(problem)
    for constraint in problem.constraints:
        if not constraint.outside and isinstance(constraint.region.form, Quadratic):
            places, hull = constraint.region.places(len(low)), constraint.region.hull()
            half = (hull.hi - hull.lo) / 2 * _ROOMY
            low[places] = np.maximum(low[places], hull.mid - half)
            high[places] = np.minimum(high[places], hull.mid + half)
    bottom, top, spread = _sampled(problem, low, high)
    least = _LEAST * np.maximum(top - bottom, 1e-6 * np.maximum(np.abs(top), 1.0))
    reach = np.maximum(margin * spread, least)
    own_low, own_high = bottom - low <= _NEAR * reach, high - top <= _NEAR * reach
    found = np.where(own_low, low, bottom - reach), np.where(own_high, high, top + reach)
    for axis in range(len(low)):  # a state that stays positive
        if found[0][axis] < 0 <= bottom[axis] and not own_low[axis] and low[axis] <= 0:
            box = Interval(*found)
            if never_crossed(problem, box, axis, 0.0):
                found[0][axis] = 0.0
    return found


def _sampled(problem: Problem, low: Array, high: Array) -> tuple[Array, Array, Array]:
    """Lowest and highest states on paths inside the box, and the largest standard deviation of each state."""
    rng = np.random.default_rng(_SEED)
    x = problem.initial.sample(rng, _PATHS)
    drift, step = compile_numpy(problem.closed_loop), float(problem.horizon) / _STEPS
    diffusion = diffusion_of(problem)
    noise = compile_numpy(diffusion) if isinstance(diffusion, Tape) else None
    box = problem.system.disturbance
    d = np.zeros((_PATHS, 0)) if box is None else np.where(rng.random((_PATHS, len(box.low))) < 0.5, box.low, box.high)
    bottom, top, spread = x.min(axis=0), x.max(axis=0), np.zeros(x.shape[1])
    for k in range(_STEPS):
        t = k * step
        gain = np.asarray(diffusion)[None] if noise is None else noise(t, *x.T)
        shock = (gain @ rng.standard_normal((_PATHS, diffusion.shape[1], 1)))[..., 0]
        x = x + step * drift(t, *x.T, *d.T) + np.sqrt(step) * shock
        x = np.clip(x, low, high)
        if not np.all(np.isfinite(x)):
            raise InfeasibleError("sampled paths run away; quadratic value bounds need them bounded.")
        bottom, top = np.minimum(bottom, x.min(axis=0)), np.maximum(top, x.max(axis=0))
        spread = np.maximum(spread, x.std(axis=0))
    return bottom, top, spread
