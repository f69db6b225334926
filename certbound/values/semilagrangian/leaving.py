"""The door: an upper bound of the probability of leaving a box, for noise in one of two coordinates."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.problem.model import compile_numpy, jacobian
from certbound.problem.problem import Problem
from certbound.values.continuous import ExitBounds
from certbound.values.semilagrangian.backward import back, highest, limited
from certbound.values.semilagrangian.groundwork import Layout, Plan, layout_of
from certbound.values.semilagrangian.noisy_axis import Setting, setting_of
from certbound.values.semilagrangian.smoothing import Lines

_RARE = 16
"""Rare events a step, each of probability ``Plan.spare``, that are paid for; see the package."""
_TALLEST = 3.0  # the payment for rare events takes U to be at most 4
_SHARE = 1e-3
_TURNS = (0.2, 0.13, 0.1, 0.08)
"""Lengths of the steps that are tried, relative to the time in which the flow turns by one radian."""
_CELLS = ((0.7, 0.005, 0.33), (0.5, 0.0025, 0.25), (0.45, 0.002, 0.22), (0.4, 0.0016, 0.2))
_LEAST, _MOST = 8, 2000

Cells = tuple[float, float, float]


@dataclass(slots=True)
class _Found:
    """The best bound so far, what was done, and what it cost."""

    upper: float = 1.0
    done: list[str] = field(default_factory=list)
    work: float = 0.0
    spent: float = 0.0


def bound_exits_by_steps(problem: Problem, *, seconds: float = 20.0) -> ExitBounds:
    """Bound P(X_t leaves the safe box for some t <= T) from above, for noise in one of two coordinates.

    Parameters
    ----------
    problem : Problem
        Two states in continuous time, constant noise in one of them, a bounded safe box, no time in the model.
    seconds : float
        Processor time after which refining stops; the first attempt is finished in any case.

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
    turn, found = _turn(setting), _Found()
    spare, failed = 1e-9, None
    for ratio, cells in _plans(setting, turn, found, begin + seconds):
        count = min(max(_LEAST, math.ceil(setting.horizon / (ratio * turn))), _MOST)
        plan = Plan(count=count, fine=cells[0], wide=cells[1], cell=cells[2], spare=min(spare, 0.01 / (_RARE * count)))
        start = time.process_time()
        try:
            bound = bound_by_steps(setting, plan)
        except InfeasibleError as error:  # shorter steps may do
            failed = error
            continue
        found.work, found.spent = _work(setting, turn, ratio, cells), time.process_time() - start
        found.done.append(f"{count} steps")
        found.upper = min(found.upper, bound)
        spare = max(_SHARE * found.upper / (_RARE * count), 1e-200)
    if failed is not None and not found.done:
        raise failed
    words = f"value function along the flow, {', '.join(found.done)}"
    upper = min(0.0, math.log10(found.upper) * (1 - 1e-15) + 1e-15)
    return ExitBounds(upper=upper, lower=None, words=words, seconds=time.process_time() - begin)


def _plans(setting: Setting, turn: float, found: _Found, deadline: float) -> Iterator[tuple[float, Cells]]:
    """The coarsest plan, and then the finest one that the time will do for."""
    yield _TURNS[0], _CELLS[0]
    if not found.work:
        yield _TURNS[1], _CELLS[1]
        return
    left = deadline - time.process_time()
    for ratio, cells in zip(_TURNS[:0:-1], _CELLS[:0:-1]):
        if found.spent * _work(setting, turn, ratio, cells) / found.work < left:
            yield ratio, cells
            return


def _work(setting: Setting, turn: float, ratio: float, cells: Cells) -> float:
    """About in proportion to the time that a plan takes."""
    steps = setting.horizon / (ratio * turn)
    return float((25 + steps) / cells[2] * ratio**-0.5)  # the preparation takes about as long as 25 steps


def bound_by_steps(setting: Setting, plan: Plan) -> float:
    """Upper bound of the probability of leaving by the horizon, from one plan; at most 1."""
    layout = layout_of(setting, plan)
    value = terminal(layout)
    for _ in range(plan.count):
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
