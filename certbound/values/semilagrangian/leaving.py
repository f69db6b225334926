"""The door: bounds of the probability of leaving, for noise in one coordinate of two or three."""

from __future__ import annotations

import math
import time

import numpy as np

from certbound.arrays import Array, Mask
from certbound.errors import InfeasibleError
from certbound.problem.model import compile_numpy, jacobian
from certbound.problem.problem import Problem
from certbound.rigor.intervals import Interval
from certbound.values.continuous import ExitBounds
from certbound.values.grids import around_nodes
from certbound.values.scouting import Scouted, scouted
from certbound.values.semilagrangian.backward import Bounds, back, highest, limited, lowest
from certbound.values.semilagrangian.carried import bound_carried_exits, carries
from certbound.values.semilagrangian.groundwork import Layout, layout_of, nodes_of
from certbound.values.semilagrangian.local_steps import Plan
from certbound.values.semilagrangian.noisy_axis import Setting, setting_of
from certbound.values.semilagrangian.smoothing import Lines
from certbound.watch import OutOfTime, poll

_RARE = 560_000
"""What rare events cost a step in units of ``Plan.spare``: four events, in which a function of `_TALLEST` is lost."""
_TALLEST = 1.2e5
_SHARE = 1e-3
_PLANS = (
    (0.2, (0.7, 0.005, 0.3, 0.06)), (0.17, (0.9, 0.0035, 0.24, 0.02)), (0.16, (0.9, 0.003, 0.2, 0.013)),
    (0.13, (0.8, 0.0025, 0.18, 0.009)), (0.1, (0.7, 0.002, 0.17, 0.006)), (0.08, (0.6, 0.0016, 0.16, 0.004)),
)  # fmt: skip
"""Lengths of the steps, relative to the time in which the flow turns by one radian, and cells, finer and finer.

Shorter steps ask for smaller cells, since every step pays for its interpolation. There are `_BETWEEN` plans from one to
the next.
"""
_BETWEEN = 5
_FIRST = 0.25  # share of the work that a first look may take where no scout tells how rare failing is
_SPARE = 1e-9
_CAUTION = 0.1  # for a scout's answer
_RATE = 800_000
"""Nodes times steps that are done in a second; `_PREPARED` steps are what preparing the grid takes."""
_PREPARED = 20
_LEAST, _MOST = 8, 2000
_PACE = 0.15  # the length of a scout's steps, as those of plans

Cells = tuple[float, float, float, float]


def bound_exits_by_steps(problem: Problem, *, seconds: float = 20.0) -> ExitBounds:
    """Bound P(X_t leaves the safe box for some t <= T) from above, for noise in one of two coordinates.

    Parameters
    ----------
    problem : Problem
        Two or three states in continuous time, constant noise in one of them, no time in the model.
    seconds : float
        About what may be spent, as a number of nodes and steps: bounds do not depend on the clock. The coarsest grid
        is finished in any case.

    Raises
    ------
    InfeasibleError
        The problem is of another kind, or the step's noise hardly moves the other coordinate.

    Examples
    --------
    >>> import certbound as cb
    >>> system = cb.ContinuousSystem(lambda x: [x[1], -x[0] - x[1]], states=2, diffusion=[[0], [0.8]])
    >>> problem = cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -2], [1, 2]))], horizon=1)
    >>> found = bound_exits_by_steps(problem, seconds=1.0)
    >>> -3.1 < found.upper < -0.5  # -3.08 by simulation, with more time
    True
    """
    if not seconds > 0:
        raise ValueError(f"`seconds` must be positive, got {seconds!r}.")
    if carries(problem):
        return bound_carried_exits(problem, seconds=seconds)
    begin = time.process_time()
    setting = setting_of(problem)
    turn, scout = _turn(setting), scout_of(setting)
    best, least, failed, done = 1.0, 0.0, None, []
    spare = _SPARE if scout is None else _CAUTION * _SHARE * scout.share
    chosen = _affordable(setting, turn, _RATE * round(seconds, 1), scout)
    for k, (ratio, cells) in enumerate(chosen):
        plan = _plan(setting, turn, ratio, cells, spare)
        try:
            layout = layout_of(setting, plan, scout)
            best = min(best, bound_by_steps(setting, plan, layout))
            if k == len(chosen) - 1:
                least = bound_by_steps_below(setting, plan, layout)
        except InfeasibleError as error:  # shorter steps may do
            failed = error
            continue
        except OutOfTime:
            if not best < 1:
                raise
            break
        done.append(f"{plan.count} steps")
        spare = _SHARE * best
    if failed is not None and not done:
        raise failed
    words = f"value function along the flow, {', '.join(done)}"
    upper = min(0.0, math.log10(best) * (1 - 1e-15) + 1e-15)
    lower = math.log10(least) * (1 + 1e-15) - 1e-15 if least > 0 else None
    return ExitBounds(upper=upper, lower=lower, words=words, seconds=time.process_time() - begin)


def _plan(setting: Setting, turn: float, ratio: float, cells: Cells, spare: float) -> Plan:
    """``spare``: what all rare events may cost together."""
    count = min(max(_LEAST, math.ceil(setting.horizon / (ratio * turn))), _MOST)
    fine, wide, cell, loss = cells
    spare = max(min(spare, 0.01) / (_RARE * count), 1e-200)
    return Plan(count=count, fine=fine, wide=wide, cell=cell, loss=loss, spare=spare)


def _graded(grade: int) -> tuple[float, Cells]:
    """One of the plans: `_PLANS`, and `_BETWEEN` - 1 from each to the next."""
    k = min(grade // _BETWEEN, len(_PLANS) - 2)
    one, two = (np.array([ratio, *cells]) for ratio, cells in _PLANS[k : k + 2])
    ratio, *cells = (one * (two / one) ** (grade / _BETWEEN - k)).tolist()
    return ratio, tuple(cells)


def _affordable(
    setting: Setting, turn: float, work: float, scout: Scouted | None = None
) -> list[tuple[float, Cells]]:
    """The finest of the plans whose nodes times steps are at most ``work``; one that tells how rare failing is before.

    That costs little, or is left out; where `scout` tells it, it is not needed.
    """

    def needed(grade: int) -> float:
        plan = _plan(setting, turn, *_graded(grade), _SPARE)
        try:
            return nodes_of(setting, plan, scout) * (2 * plan.count + _PREPARED)  # from above and from below
        except InfeasibleError:  # shorter steps may do
            return 0.0

    low, high = 0, _BETWEEN * (len(_PLANS) - 1) + 1
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if needed(middle) <= work else (low, middle)
    looks = scout is None and low > 0 and 0 < needed(0) < _FIRST * work
    return [_graded(0), _graded(low)] if looks else [_graded(low)]


def scout_of(setting: Setting) -> Scouted | None:
    """Where paths that fail go, roughly; None where that is not found."""
    model = compile_numpy(setting.tape)

    def drift(p: Array, q: Array) -> Array:
        return np.moveaxis(np.broadcast_to(model(0.0, p, q), (len(p), 2)), -1, 0)

    def broken(p: Array, q: Array) -> Mask:
        found = np.zeros(len(p), dtype=bool)
        for wall in setting.walls:
            found |= ~wall.safe(wall.sizes(Interval.point(p), Interval.point(q)), np.zeros((1, 1)))
        return found

    steps = min(max(_LEAST, math.ceil(setting.horizon / (_PACE * _turn(setting)))), _MOST // 8)
    return scouted(drift, setting.noise, setting.faces, setting.some_starts(), setting.horizon, steps, broken)


def bound_by_steps(setting: Setting, plan: Plan, layout: Layout | None = None) -> float:
    """Upper bound of the probability of leaving by the horizon, from one plan; at most 1."""
    layout = layout or layout_of(setting, plan)
    value = _stepped(layout, layout.above, plan)
    if value is None:
        return 1.0
    best = highest(layout.frame, value, setting, layout.clock.shear)
    return min(1.0, (best + _RARE * plan.count * plan.spare) * (1 + 1e-12))


def bound_by_steps_below(setting: Setting, plan: Plan, layout: Layout | None = None) -> float:
    """Lower bound of the probability of leaving by the horizon from some start; at least 0."""
    layout = layout or layout_of(setting, plan)
    value = _stepped(layout, layout.below, plan)
    if value is None:
        return 0.0
    best = -lowest(layout.frame, value, setting.some_starts(), layout.clock.shear)
    return max(0.0, best * (1 - 1e-12) - _RARE * plan.count * plan.spare)


def _stepped(layout: Layout, bounds: Bounds, plan: Plan) -> Lines | None:
    """The function at time 0, unless it grows too large."""
    value = terminal(layout, bounds)
    for _ in range(plan.count):
        poll("a value function along the flow")
        value = back(layout.frame, layout.bands, bounds, value)
        if np.abs(value.nodal).max() > _TALLEST:
            return None
    return value


def terminal(layout: Layout, bounds: Bounds) -> Lines:
    """The function at the horizon: 0 but outside of the safe set."""
    stepped = around_nodes(layout.frame.live.astype(float), largest=True) > 0
    shape = stepped.shape
    return limited(layout.frame, bounds, np.where(stepped, 0.0, -np.inf), np.zeros((shape[0], shape[1] - 1)))


def _turn(setting: Setting) -> float:
    """The time in which the linearised flow turns or grows by one radian, about; the median over the safe set."""
    grid = np.meshgrid(*(np.linspace(*ends, 9) for ends in setting.faces))
    with np.errstate(all="ignore"):
        slopes = np.asarray(compile_numpy(jacobian(setting.tape, (1, 2)))(0.0, *(a.ravel() for a in grid)))
    slopes = np.broadcast_to(slopes, (grid[0].size, 2, 2))
    rates = _rates(slopes[np.isfinite(slopes).all(axis=(1, 2))])
    if not len(rates):
        raise InfeasibleError("the model is undefined all over the safe set.")
    return 1 / max(float(np.median(rates)), 1e-3 / setting.horizon)


def _rates(slopes: Array) -> Array:
    return np.asarray(np.abs(np.linalg.eigvals(slopes)).max(axis=1))
