"""The door: an upper bound of the probability of leaving a box, for noise in one of two coordinates."""

from __future__ import annotations

import math
import time

import numpy as np

from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.problem.model import compile_numpy, jacobian
from certbound.problem.problem import Problem
from certbound.values.continuous import ExitBounds
from certbound.values.semilagrangian.backward import back, highest, limited
from certbound.values.semilagrangian.groundwork import Layout, Plan, layout_of, nodes_of
from certbound.values.semilagrangian.noisy_axis import Setting, setting_of
from certbound.values.semilagrangian.smoothing import Lines
from certbound.watch import OutOfTime, poll

_RARE = 32
"""Rare events a step, each of probability ``Plan.spare``, that are paid for; see the package."""
_TALLEST = 6.0  # the payment for rare events takes U to be at most 8
_SHARE = 1e-3
_PLANS = (
    (0.2, (0.7, 0.005, 0.33)), (0.16, (0.6, 0.0035, 0.3)), (0.13, (0.5, 0.0025, 0.25)), (0.1, (0.45, 0.002, 0.22)),
    (0.08, (0.4, 0.0016, 0.2)),
)  # fmt: skip
"""Lengths of the steps, relative to the time in which the flow turns by one radian, and cells, finer and finer.

Shorter steps ask for smaller cells, since every step pays for its interpolation.
"""
_FIRST = 0.25  # share of the work that a first look may take, which tells how rare failing is
_SPARE = 1e-13
_RATE = 900_000
"""Nodes times steps that are done in a second; `_PREPARED` steps are what preparing the grid takes."""
_PREPARED = 20
_LEAST, _MOST = 8, 2000

Cells = tuple[float, float, float]


def bound_exits_by_steps(problem: Problem, *, seconds: float = 20.0) -> ExitBounds:
    """Bound P(X_t leaves the safe box for some t <= T) from above, for noise in one of two coordinates.

    Parameters
    ----------
    problem : Problem
        Two states in continuous time, constant noise in one of them, a bounded safe box, no time in the model.
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
    begin = time.process_time()
    setting = setting_of(problem)
    turn = _turn(setting)
    best, failed, done, spare = 1.0, None, [], _SPARE
    for ratio, cells in _affordable(setting, turn, _RATE * round(seconds, 1)):
        plan = _plan(setting, turn, ratio, cells, spare)
        try:
            best = min(best, bound_by_steps(setting, plan))
        except InfeasibleError as error:  # shorter steps may do
            failed = error
            continue
        except OutOfTime:
            if not best < 1:
                raise
            break
        done.append(f"{plan.count} steps")
        spare = max(min(_SHARE * best / (_RARE * plan.count), _SPARE), 1e-200)
    if failed is not None and not done:
        raise failed
    words = f"value function along the flow, {', '.join(done)}"
    upper = min(0.0, math.log10(best) * (1 - 1e-15) + 1e-15)
    return ExitBounds(upper=upper, lower=None, words=words, seconds=time.process_time() - begin)


def _plan(setting: Setting, turn: float, ratio: float, cells: Cells, spare: float) -> Plan:
    count = min(max(_LEAST, math.ceil(setting.horizon / (ratio * turn))), _MOST)
    return Plan(count=count, fine=cells[0], wide=cells[1], cell=cells[2], spare=min(spare, 0.01 / (_RARE * count)))


def _affordable(setting: Setting, turn: float, work: float) -> list[tuple[float, Cells]]:
    """The finest of the plans whose nodes times steps are at most ``work``, after the coarsest if that costs little."""
    chosen, first = _PLANS[0], math.inf
    for ratio, cells in _PLANS:
        plan = _plan(setting, turn, ratio, cells, _SPARE)
        try:
            needed = nodes_of(setting, plan) * (plan.count + _PREPARED)
        except InfeasibleError:  # shorter steps may do
            continue
        first = min(first, needed)
        if needed > work:
            break
        chosen = ratio, cells
    return [_PLANS[0], chosen] if chosen != _PLANS[0] and first < _FIRST * work else [chosen]


def bound_by_steps(setting: Setting, plan: Plan) -> float:
    """Upper bound of the probability of leaving by the horizon, from one plan; at most 1."""
    layout = layout_of(setting, plan)
    value = terminal(layout)
    for _ in range(plan.count):
        poll("a value function along the flow")
        value = back(layout.frame, layout.bands, layout.bounds, value)
        if value.nodal.max() > _TALLEST:
            return 1.0
    best = highest(layout.frame, value, setting.starts, layout.clock.shear)
    return min(1.0, (best + _RARE * plan.count * plan.spare) * (1 + 1e-12))


def terminal(layout: Layout) -> Lines:
    """The function at the horizon: 0 but near the faces."""
    shape = layout.bounds.level.shape
    return limited(layout.frame, layout.bounds, np.zeros(shape), np.zeros((shape[0], shape[1] - 1)))


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
