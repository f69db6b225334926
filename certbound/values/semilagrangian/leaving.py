"""The door: bounds of the probability of leaving, for noise in one coordinate of two or three."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np

from certbound.arrays import Array, Mask
from certbound.errors import InfeasibleError
from certbound.problem.model import compile_numpy, jacobian
from certbound.problem.problem import Problem
from certbound.rigor.intervals import Interval
from certbound.values.continuous import ExitBounds
from certbound.values.grids import around_nodes
from certbound.values.scouting import Reached, Scouted, reached, scouted
from certbound.values.semilagrangian.backward import Bounds, Layout, back, highest, limited, lowest
from certbound.values.semilagrangian.carried import bound_carried_exits, carries
from certbound.values.semilagrangian.groundwork import layouts_of, nodes_of, together
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
_ROUGH = 0.2, (1.0, 0.008, 0.4, 0.12)  # where the model changes with time, and all others take too long
_BETWEEN = 5
_GROWTH = 0.12  # of the logarithm of nodes times steps from one plan to the next, about
_FIRST = 0.25  # share of the work that a first look may take where no scout tells how rare failing is
_SPARE = 1e-9
_OVERLOOKED = 1e-8  # what cells that are left out may cost, as a share of a scout's answer
_CAUTION = 0.1  # for a scout's answer
_RATE = 1_800_000
"""Nodes times steps that are done in a second on two cores (`_BESIDE` of that where an obstacle's tolls take the rest);
`_PREPARED` steps are what preparing the grid takes, `_IMAGED`
the images of its nodes at one more time.
"""
_PREPARED, _IMAGED = 20, 11
_BESIDE = 0.45
_LEAST, _MOST = 8, 2000
_PACE = 0.15  # the length of a scout's steps, as those of plans

Cells = tuple[float, float, float, float]


def bound_exits_by_steps(problem: Problem, *, seconds: float = 20.0) -> ExitBounds:
    """Bound P(X_t leaves the safe box for some t <= T) from above, for noise in one of two coordinates.

    Parameters
    ----------
    problem : Problem
        Two or three states in continuous time, constant noise in one of them; of two states time may act on that one.
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
    return _stepped_exits(setting, problem.delta, seconds, begin)


def _stepped_exits(setting: Setting, delta: float, seconds: float, begin: float) -> ExitBounds:
    turn, scout = _turn(setting), scout_of(setting)
    best, least, failed, done = 1.0, 0.0, None, []
    spare = _SPARE if scout is None else _CAUTION * _SHARE * scout.share
    rate = _RATE * (_BESIDE if any(wall.ends() is not None for wall in setting.walls) else 1.0)
    chosen = _affordable(setting, turn, rate * round(seconds, 1), scout)
    for k, (ratio, cells) in enumerate(chosen):
        plan = _plan(setting, turn, ratio, cells, spare)
        try:
            below = setting.timed or k == len(chosen) - 1
            upper, found = bounds_by_steps(setting, plan, scout=scout, below=below)
            best, least = min(best, upper), max(least, found)
        except InfeasibleError as error:  # shorter steps may do
            failed = error
            continue
        except OutOfTime:
            if not best < 1:
                raise
            break
        done.append(f"{plan.count} steps")
        if setting.timed and (best <= delta or least > delta):
            break  # every plan takes its time
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
            return nodes_of(setting, plan, scout) * (2 * plan.count + _prepared(setting, plan.count))
        except InfeasibleError:  # shorter steps may do
            return 0.0

    low, high = 0, _BETWEEN * (len(_PLANS) - 1) + 1
    if setting.timed and needed(1) > work:  # the usual case, and every look at a plan costs a second
        return [_graded(0)] if needed(0) <= work else [_ROUGH, _graded(0)]
    middle = (low + high) // 2
    while high - low > 1:
        found = needed(middle)
        low, high = (middle, high) if found <= work else (low, middle)
        away = math.floor(math.log(work / found) / _GROWTH) if found > 0 else high
        middle = min(max(middle + away, low + 1), high - 1)
    looks = scout is None and low > 0 and 0 < needed(0) < _FIRST * work
    return [_graded(0), _graded(low)] if looks else [_graded(low)]


def scout_of(setting: Setting) -> Scouted | None:
    """Where paths that fail go, roughly; None where that is not found."""
    drift, broken = _motion(setting)
    steps = min(max(_LEAST, math.ceil(setting.horizon / (_PACE * _turn(setting)))), _MOST // 8)
    faces, starts, timed = setting.faces, setting.some_starts(), setting.timed
    return scouted(drift, setting.noise, faces, starts, setting.horizon, steps, broken, timed=timed)


def _motion(setting: Setting) -> tuple[Callable[[float, Array, Array], Array], Callable[[Array, Array], Mask]]:
    """The drift at a time and points, in floats, and which points walls forbid."""
    model = compile_numpy(setting.tape)

    def drift(t: float, p: Array, q: Array) -> Array:
        return np.moveaxis(np.broadcast_to(model(t, p, q), (len(p), 2)), -1, 0)

    def broken(p: Array, q: Array) -> Mask:
        found = np.zeros(len(p), dtype=bool)
        for wall in setting.walls:
            found |= ~wall.safe(wall.sizes(Interval.point(p), Interval.point(q)), np.zeros((1, 1)))
        return found

    return drift, broken


def _reached(setting: Setting, plan: Plan, scout: Scouted | None) -> Reached | None:
    """Where paths are after so many steps, in floats; None where that is not known."""
    if scout is None:
        return None
    drift, broken = _motion(setting)
    return reached(
        drift, setting.noise, setting.faces, setting.starts, setting.horizon / plan.count, plan.count,
        broken, overlooked=_OVERLOOKED * scout.share, timed=setting.timed,
    )  # fmt: skip


def bounds_by_steps(
    setting: Setting, plan: Plan, *, scout: Scouted | None = None, layouts: Iterable[Layout] | None = None,
    below: bool = True,
) -> tuple[float, float]:  # fmt: skip
    """Bounds (upper, lower) of the probability of leaving by the horizon from the worst start, from one plan.

    Parameters
    ----------
    layouts : iterable of Layout, optional
        Those of `layouts_of`, made if not given.
    below : bool
        Whether a lower bound is asked for; else it is 0.
    """
    values: list[Lines | None] = []
    layout: Layout | None = None
    seen = _reached(setting, plan, scout)
    with ThreadPoolExecutor(2) as pool:  # compiled kernels and arithmetic of arrays run without the interpreter's lock
        for k, following in enumerate(layouts or layouts_of(setting, plan, scout, seen)):
            poll("a value function along the flow")
            sides = [following.above, following.below][: 1 + below]
            if layout is None:
                values = [terminal(following, bounds) for bounds in sides]
            elif following.bands is not layout.bands:  # what a step asks of the function at its end
                values = [v and limited(following.frame, side, v.nodal, v.bend) for side, v in zip(sides, values)]
            layout = following
            part = layout if seen is None else layout.on(plan.count - 1 - k, seen)
            values = list(pool.map(partial(_stepped, part), (part.above, part.below), values))
            if not any(values):
                break
    assert layout is not None
    upper, lower, rare = 1.0, 0.0, _RARE * plan.count * plan.spare
    if values[0] is not None:
        best = highest(layout.frame, values[0], setting, layout.clock.shear)
        upper = min(1.0, (best + rare) * (1 + 1e-12))
    if below and values[1] is not None:
        best = -lowest(layout.frame, values[1], setting.some_starts(), layout.clock.shear)
        lower = max(0.0, best * (1 - 1e-12) - rare)
    return upper, lower


def _stepped(layout: Layout, side: Bounds, value: Lines | None) -> Lines | None:
    """One side, one step back; None where it has grown beyond what is paid for."""
    if value is None:
        return None
    value = back(layout.frame, layout.bands, side, value)
    return None if np.abs(value.nodal).max() > _TALLEST else value


def terminal(layout: Layout, bounds: Bounds) -> Lines:
    """The function at the horizon: 0 but outside of the safe set."""
    stepped = around_nodes(layout.frame.live.astype(float), largest=True) > 0
    shape = stepped.shape
    return limited(layout.frame, bounds, np.where(stepped, 0.0, -np.inf), np.zeros((shape[0], shape[1] - 1)))


def _prepared(setting: Setting, count: int) -> int:
    """Preparing so many steps, in units of steps."""
    return math.ceil(count / together(setting, count)) * _PREPARED + count * _IMAGED if setting.timed else _PREPARED


def _turn(setting: Setting) -> float:
    """The time in which the linearised flow turns or grows by one radian, about; the median over the safe set."""
    grid = np.meshgrid(*(np.linspace(*ends, 9) for ends in setting.faces))
    times = np.linspace(0.0, setting.horizon, 5 if setting.timed else 1)
    jacobians = compile_numpy(jacobian(setting.tape, (1, 2)))
    with np.errstate(all="ignore"):
        every = [np.asarray(jacobians(float(t), *(a.ravel() for a in grid))) for t in times]
    slopes = np.concatenate([np.broadcast_to(found, (grid[0].size, 2, 2)) for found in every])
    rates = _rates(slopes[np.isfinite(slopes).all(axis=(1, 2))])
    if not len(rates):
        raise InfeasibleError("the model is undefined all over the safe set.")
    return 1 / max(float(np.median(rates)), 1e-3 / setting.horizon)


def _rates(slopes: Array) -> Array:
    return np.asarray(np.abs(np.linalg.eigvals(slopes)).max(axis=1))
