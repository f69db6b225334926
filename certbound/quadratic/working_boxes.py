"""Working boxes: the safe set's own sides where paths come near them, sides beyond the sampled paths elsewhere."""

from __future__ import annotations

import numpy as np

from certbound.arrays import Array
from certbound.problem.model import Tape, compile_numpy
from certbound.problem.problem import Problem
from certbound.problem.sets import Quadratic
from certbound.quadratic.corners import curved_axes
from certbound.quadratic.setting import Setting, deviation_of, diffusion_of, never_crossed, safe_sides
from certbound.rigor.intervals import Interval
from certbound.rigor.rounding import quiet

_PATHS, _STEPS, _SEED = 160, 300, 20
_MARGINS = (4.0, 7.0, 2.5)
_ROOMY = 1.05  # a ball's sides are moved out by this, so that they are no walls
_LEAST = 0.3  # least margin as a share of what the paths cover
_SHARE = 0.25  # of the bound that the box's own sides may cost together
_FACTORS = 0.6, 1.6  # by which a side's distance is changed at once
_LITTLE = 0.1
_FAR = 1.75  # what the margin is multiplied by along coordinates in which the model is affine
_NEARLY = 1.25
_CLEAR = 0.1  # least distance from the starts, in half widths of the box
_NEAR = 1.5  # own sides are taken up to this multiple of the distance at which a side would be chosen


def working_boxes(problem: Problem) -> list[tuple[Array, Array]]:
    """Different working boxes, in the order in which they are tried."""
    found = [working_box(problem, margin) for margin in _MARGINS]
    return list({low.tobytes() + high.tobytes(): (low, high) for low, high in found}.values())


def working_box(problem: Problem, margin: float) -> tuple[Array, Array]:
    """Ends of a finite box: ``margin`` standard deviations beyond sampled paths, or a safe side that is about as near.

    Sides along which drift and diffusion are affine are farther, as that costs nothing.

    Raises
    ------
    InfeasibleError
        The sampled paths run away.
    """
    low, high = safe_sides(problem)
    curved = curved_axes(problem)
    margins = np.array([margin if axis in curved else _FAR * margin for axis in range(len(low))])
    for constraint in problem.constraints:
        if not constraint.outside and isinstance(constraint.region.form, Quadratic):
            places, hull = constraint.region.places(len(low)), constraint.region.hull()
            half = (hull.hi - hull.lo) / 2 * _ROOMY
            low[places] = np.maximum(low[places], hull.mid - half)
            high[places] = np.minimum(high[places], hull.mid + half)
    bottom, top, spread = _sampled(problem, low, high)
    least = _LEAST * np.maximum(top - bottom, 1e-6 * np.maximum(np.abs(top), 1.0))
    reach = np.maximum(margins * spread, least)
    own_low, own_high = bottom - low <= _NEAR * reach, high - top <= _NEAR * reach
    found = _evened(problem, bottom - reach, top + reach)
    found = np.where(own_low, low, found[0]), np.where(own_high, high, found[1])
    for axis in range(len(low)):  # a state that stays positive
        if found[0][axis] < 0 <= bottom[axis] and not own_low[axis] and low[axis] <= 0:
            box = Interval(*found)
            if never_crossed(problem, box, axis, 0.0):
                found[0][axis] = 0.0
    return found


def _evened(problem: Problem, low: Array, high: Array) -> tuple[Array, Array]:
    """Ends as far from the middle of the starts on both sides, where they nearly are: a mirrored bound serves both."""
    middle = problem.initial.hull().mid
    below, above = middle - low, high - middle
    near = np.maximum(below, above) <= _NEARLY * np.minimum(below, above)
    reach = np.maximum(below, above)
    return np.where(near, middle - reach, low), np.where(near, middle + reach, high)


def moved_sides(problem: Problem, setting: Setting, levels: Array, level: float) -> tuple[Array, Array] | None:
    """The working box with its sides moved to where leaving costs a share of the whole; None where that changes little.

    ``levels`` are the logarithms of the walls' bounds, ``level`` that of their sum. The logarithm of a wall's bound is
    about quadratic in its distance from the middle of the starts. What the model is affine in stays where it is.
    """
    low, high = setting.center - setting.width, setting.center + setting.width
    safe, hull, curved = safe_sides(problem), problem.initial.hull(), curved_axes(problem)
    sides = [(wall, wall.side, at) for wall, at in zip(setting.walls, levels) if wall.side and wall.side[0] in curved]
    aim, ends, most = level + np.log(_SHARE / max(len(sides), 1)), (low.copy(), high.copy()), 0.0
    for wall, (axis, side), at in sides:
        factor = float(np.clip(np.sqrt(aim / min(at, -1e-3)), _FACTORS[0], _FACTORS[1] if wall.own else 1.0))
        middle, start = hull.mid[axis], (hull.lo, hull.hi)[side][axis]
        place = middle + factor * ((low, high)[side][axis] - middle)
        gap = _CLEAR * setting.width[axis]
        place = max(place, start + gap) if side else min(place, start - gap)
        ends[side][axis] = min(place, safe[1][axis]) if side else max(place, safe[0][axis])
        most = max(most, abs(factor - 1.0))
    return ends if most > _LITTLE else None


@quiet
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
        bottom, top = np.minimum(bottom, x.min(axis=0)), np.maximum(top, x.max(axis=0))
        spread = np.maximum(spread, deviation_of(x))
    return bottom, top, spread
