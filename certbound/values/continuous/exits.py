"""The door: bounds of the probability that a continuous-time problem leaves its safe set."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from certbound.errors import InfeasibleError
from certbound.problem.goals import check_end
from certbound.problem.model import Node, Tape, edged, jacobian
from certbound.problem.problem import Problem
from certbound.problem.sets import Box
from certbound.problem.systems import ContinuousSystem
from certbound.rigor.intervals import Interval
from certbound.values.charts import Charts
from certbound.values.continuous.coefficients import Reader
from certbound.values.continuous.curved import bound_region, boxed, walled
from certbound.values.continuous.held_faces import check_noise
from certbound.values.continuous.hypotheses import Model
from certbound.values.continuous.payment import Payment
from certbound.values.continuous.plane import (
    bound_moving,
    bound_windows,
    confined,
    led,
    moving,
    two_states,
    windowed,
)  # fmt: skip
from certbound.values.continuous.surface import Surface
from certbound.values.enclosing import squared_diffusion
from certbound.values.room import limits_of, safe_room
from certbound.values.sets import as_stays

Proposed = tuple[Surface | tuple[Surface, ...], Payment]

_LN10 = math.log(10)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ExitBounds:
    """Certified bounds of the probability that a path has left its safe set by the horizon.

    Attributes
    ----------
    upper : float
        log10 of an upper bound, for every start and every disturbance; 0 says nothing.
    lower : float or None
        log10 of a lower bound for the worst start and the worst disturbance; None where none was found.
    words : str
        What was done.
    seconds : float
    proposed : tuple of (Surface or Surfaces of stages, Payment)
        V of every upper bound that was better than those before, and what it was paid with.
    proposed_below : tuple of (Surface or Surfaces of stages, Payment)
        The same of the lower bounds.
    hoped : float or None
        A guess at the lower bound that was left out.
    """

    upper: float
    lower: float | None
    words: str
    seconds: float
    proposed: tuple[Proposed, ...] = ()
    proposed_below: tuple[Proposed, ...] = ()
    hoped: float | None = None


def bound_exits(
    problem: Problem, *, target: Any = None, seconds: float = 10.0, lower: bool = True, delta: float = 0.0,
    above: bool = True, below: bool = True,
) -> ExitBounds:
    """Bound P(X_t leaves the safe set for some t <= T) from above and from below by Theorem K8-CT.

    Parameters
    ----------
    problem : Problem
        Continuous time, one or two states; noise of full rank. In one state any limits, windows,
        moving sets, obstacles and a random start; in two a bounded safe box, whose sides may move, boxes over windows,
        or any fixed limits and obstacles over the whole horizon.
    target : region, optional
        In one state, and in two within a fixed box: then the bounds are those of the probability of breaking a
        constraint before the target is entered, or of not entering it by the horizon.
    seconds : float
        How long to refine; the first attempt is finished in any case. In one state seconds stand for so many
        patches of work, so that the bounds do not depend on the machine or its load.
    lower : bool
        Whether to look for a lower bound too. Where a path ends as it leaves its domain there is one in one state, for
        limits that do not move and hold all the time; elsewhere leaving the domain counts as failing, from above.
    delta : float
        Where the upper bound is at most this, no lower bound is looked for in two states, which takes as long again.
    above : bool
        In two states: without it no upper bound is looked for where the lower one does not need it.
    below : bool
        The same of the lower bound.

    Returns
    -------
    ExitBounds

    Raises
    ------
    InfeasibleError
        The theorem, or this implementation of it, does not apply; the message says why.
    EnclosureError
        The model is undefined somewhere in the safe set.

    Examples
    --------
    >>> import certbound as cb
    >>> system = cb.ContinuousSystem(lambda x: -x, states=1, diffusion=0.4)
    >>> problem = cb.Problem(system, initial=[0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=1)
    >>> found = bound_exits(problem, seconds=2.0)
    >>> -3.12 < found.lower < -3.085 < found.upper < -3.07  # 8.2e-4
    True
    """
    begin = time.perf_counter()
    _check(problem, target, seconds)
    model, ended = _model(problem), None
    proposed: Sequence[Proposed] = ()
    earned: Sequence[Proposed] = ()
    guesses: list[float] | None = None if below else []
    if target is not None and problem.system.dimension == 2:
        from certbound.values.continuous.curved import ramps_for
        from certbound.values.continuous.plane import bound_failing

        _refuse_random(problem)
        found = bound_failing(problem, model, target, begin + seconds, ramps_for)
        upper, least, words, (proposed, earned) = found
    elif target is not None:
        from certbound.values.continuous.line import bound_arrival

        most, rest, words, (proposed, earned) = bound_arrival(problem, model, target)
        upper, least = most, None if rest == -math.inf else rest
    elif problem.system.dimension == 1:
        from certbound.values.continuous.line import bound_ended, bound_line

        ended = bound_ended(problem, model, seconds) if problem.ending else None
        upper, least, words, (proposed, earned) = ended or bound_line(problem, model, seconds, lower)
    elif moving(problem) and all(not c.outside for c in as_stays(problem.constraints)):
        _refuse_random(problem)
        wanted = (math.log(delta) if delta > 0 else -math.inf) if lower else math.inf
        upper, least, words = bound_moving(problem, model, begin + seconds, wanted)
    elif windowed(problem):
        _refuse_random(problem)
        upper, least, words, (proposed, earned) = bound_windows(problem, model, begin + seconds)
    elif walled(problem) and not (boxed(problem) and led(model)):
        from certbound.values.continuous.straight import bound_between

        _refuse_random(problem)
        wanted = (math.log(delta) if delta > 0 else -math.inf) if lower else math.inf
        upper, least, words, (proposed, earned) = bound_region(problem, model, begin + seconds, wanted, bound_between)
    else:
        from certbound.values.continuous.straight import bound_plane

        _refuse_random(problem)
        wanted = (math.log(delta) if delta > 0 else -math.inf) if lower else math.inf
        straight = partial(bound_plane, above=above, guesses=guesses)
        way, room = (two_states, limits_of(problem)) if led(model) else (straight, safe_room(problem))
        upper, least, words, (proposed, earned) = way(problem, model, room, begin + seconds, wanted)
    if problem.ending and ended is None:  # leaving the domain was counted as failing
        least, earned = None, ()
    return ExitBounds(
        upper=min(0.0, upper / _LN10 * (1 - 1e-15)), lower=None if least is None else least / _LN10 * (1 + 1e-15),
        words=words, seconds=time.perf_counter() - begin, proposed=tuple(proposed),
        proposed_below=tuple(earned), hoped=guesses[0] / _LN10 if guesses else None,
    )  # fmt: skip


def is_confined(problem: Problem) -> bool:
    """Whether noise moves one of two states only, and the drift keeps the other one in a box: splines serve that."""
    if problem.system.time != "continuous" or problem.system.dimension != 2 or not boxed(problem):
        return False
    plain = not moving(problem) and not windowed(problem) and not problem.initial.random
    return plain and problem.input_sequence is None and confined(problem, _model(problem), limits_of(problem))


def chart_exits(
    problem: Problem, *, levels: Sequence[float], times: int = 1, seconds: float = 10.0, lower: bool = True
) -> Charts:
    """Bound P(X leaves the safe set by T | X_t = x) for every safe x, not for the initial set alone (Theorem K8-CT).

    Parameters
    ----------
    problem : Problem
        As `bound_exits` takes it; its initial set does not matter, but for where the grid is fine.
    levels : sequence of float
        log10 of probabilities at which the bounds should be sharp.
    times : int
        In one state: how many times t, 0 the first of them. In two states only t = 0 is charted.
    seconds : float
        About what may be spent in two states, turned into a number of patches.
    lower : bool
        Whether to look for lower bounds too (one state).

    Returns
    -------
    Charts
        In two states without lower bounds.

    Raises
    ------
    InfeasibleError
        The theorem does not apply, or nothing was proved; the message says why.
    EnclosureError
        The model is undefined somewhere in the safe set.
    """
    _check(problem, None, seconds)
    model = _model(problem)
    logs = sorted(_LN10 * level for level in levels)
    if problem.system.dimension == 1:
        from certbound.values.continuous.line import chart_line

        charts = chart_line(problem, model, logs, times, lower)
    else:
        from certbound.values.continuous.plane import chart_plane

        room = safe_room(problem)
        check_noise(model, (0.0, float(problem.horizon)), list(zip(room.inner_low, room.inner_high)))
        charts = Charts(upper=tuple(chart_plane(problem, model, room, logs, seconds)))
    if not charts.upper:
        raise InfeasibleError("no value function over the whole safe set could be proved; give `seconds` more.")
    return charts


def chart_slabs_of(problem: Problem, *, step: float, last: float) -> Charts:
    """Charts as `chart_exits` makes them, of one state, at many times; after the first one beside the starts.

    Parameters
    ----------
    problem : Problem
        One state; its model must not depend on time.
    step : float
        About by how much log P moves between two charts.
    last : float
        Time after which no chart is made.

    Returns
    -------
    Charts

    Raises
    ------
    InfeasibleError
        The theorem does not apply; the message says why.
    EnclosureError
        The model is undefined somewhere in the safe set.
    """
    from certbound.values.continuous.line import chart_slabs

    _check(problem, None, 1.0)
    return chart_slabs(problem, _model(problem), step, last)


def _refuse_random(problem: Problem) -> None:
    if problem.initial.random:
        raise InfeasibleError("value functions in several states do not serve a random start; use a set of starts.")


def _check(problem: Problem, target: Any, seconds: float) -> None:
    if not isinstance(problem, Problem):
        raise TypeError(f"`problem` must be a Problem, got {problem!r}.")
    if not seconds > 0:
        raise ValueError(f"`seconds` must be positive, got {seconds!r}.")
    check_end(problem, "a value function in continuous time")
    if problem.system.time != "continuous":
        raise InfeasibleError("value functions of this kind need continuous time; the problem is discrete.")
    if problem.system.dimension > 2:
        raise InfeasibleError(
            "value functions in continuous time serve one or two states here, the problem has "
            f"{problem.system.dimension}; `method='backward'` takes three."
        )
    if problem.input_sequence is not None:
        raise InfeasibleError("value functions in continuous time need a feedback law; the plan is an array.")


def _model(problem: Problem) -> Model:
    n = problem.system.dimension
    system = problem.system
    if not isinstance(system, ContinuousSystem):
        raise TypeError(f"`problem` must be in continuous time, got {system!r}.")
    drift = problem.closed_loop
    return Model(
        drift=Reader(drift, n + 1),
        square=Reader(squared_diffusion(system.diffusion, system.states), n + 1),
        branches=_branches(drift, problem.system.disturbance, n + 1),
    )


def _branches(drift: Tape, disturbance: Box | None, first: int) -> tuple[tuple[Interval, ...], ...]:
    """The vertices of D where f is affine in d, else a partition of D into boxes."""
    if disturbance is None:
        return ((),)
    ends = list(zip(disturbance.low, disturbance.high))
    slots = list(range(first, first + len(ends)))
    curved = jacobian(jacobian(drift, slots), slots)
    if not edged(drift) and all(curved.nodes[output] == Node("const", (), 0.0) for output in curved.outputs):
        sides = [sorted({low, high}) for low, high in ends]
        return tuple(tuple(Interval.point(value) for value in corner) for corner in itertools.product(*sides))
    parts = max(1, round(16 ** (1 / len(ends))))
    edges = [np.linspace(low, high, parts + 1) for low, high in ends]
    pieces = [[Interval(a, b) for a, b in itertools.pairwise(edge)] for edge in edges]
    return tuple(itertools.product(*pieces))
