"""Working boxes: the safe set's own sides where paths come near them, sides beyond the sampled paths elsewhere."""

from __future__ import annotations

from collections.abc import Callable

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
    step = float(problem.horizon) / _STEPS
    move = _Mover(problem, rng, step)
    bottom, top, spread = x.min(axis=0), x.max(axis=0), np.zeros(x.shape[1])
    for k in range(_STEPS):
        x = move(k * step, x, noisy=True)
        x = np.clip(x, low, high)
        if not np.all(np.isfinite(x)):
            raise InfeasibleError("sampled paths run away; quadratic value bounds need them bounded.")
        bottom, top = np.minimum(bottom, x.min(axis=0)), np.maximum(top, x.max(axis=0))
        spread = np.maximum(spread, x.std(axis=0))
    return bottom, top, spread


def deviations(problem: Problem, nominal: Array) -> tuple[Array, Array]:
    """The largest deviation of the starts and of d from a noise-free path, and the largest standard deviation.

    ``nominal`` holds the path at equal steps, shape (steps, n).
    """
    rng = np.random.default_rng(_SEED)
    x = problem.initial.sample(rng, _PATHS)
    still = x.copy()
    step = float(problem.horizon) / len(nominal)
    move = _Mover(problem, rng, step)
    reach, spread = np.zeros(x.shape[1]), np.zeros(x.shape[1])
    for k, middle in enumerate(nominal):
        apart = x - still
        reach = np.maximum(reach, np.abs(still - middle).max(axis=0))
        spread = np.maximum(spread, np.sqrt((apart**2).mean(axis=0)))
        x, still = move(k * step, x, noisy=True), move(k * step, still, noisy=False)
        if not np.all(np.isfinite(x)):
            raise InfeasibleError("sampled paths run away; quadratic value bounds need them bounded.")
    return reach, spread


class _Mover:
    """Euler steps of many paths, each with a disturbance of its own."""

    def __init__(self, problem: Problem, rng: np.random.Generator, step: float) -> None:
        self.rng, self.step, self.drift = rng, step, compile_numpy(problem.closed_loop)
        diffusion = diffusion_of(problem)
        self.gain: Callable[..., Array] = lambda *_: np.asarray(diffusion)[None]
        if isinstance(diffusion, Tape):
            self.gain = compile_numpy(diffusion)
        self.noises, box = diffusion.shape[1], problem.system.disturbance
        corner = rng.random((_PATHS, 0 if box is None else len(box.low))) < 0.5
        self.d = np.where(corner, box.low, box.high) if box is not None else np.zeros((_PATHS, 0))

    def __call__(self, t: float, x: Array, *, noisy: bool) -> Array:
        moved = x + self.step * self.drift(t, *x.T, *self.d.T)
        if not noisy:
            return np.asarray(moved)
        shock = self.gain(t, *x.T) @ self.rng.standard_normal((_PATHS, self.noises, 1))
        return np.asarray(moved + np.sqrt(self.step) * shock[..., 0])
