"""The door: bounds of the probability that a continuous-time problem leaves its safe set."""

from __future__ import annotations

import itertools
import math
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.problem.model import Node, Tape, compile_numpy, edged, jacobian
from certbound.problem.problem import Problem
from certbound.problem.sets import Box
from certbound.problem.systems import ContinuousSystem
from certbound.rigor.intervals import Interval
from certbound.values.continuous.coefficients import Reader, enclose, squared_diffusion
from certbound.values.continuous.hypotheses import Model, covers, extreme_over, prove_lower, prove_upper
from certbound.values.continuous.payment import Payment
from certbound.values.continuous.proposal import Line, sketch
from certbound.values.continuous.room import Room, safe_room, starts_of
from certbound.values.continuous.shapes import propose_lower, propose_upper, sealed
from certbound.values.continuous.surface import Surface

Starts = list[tuple[float, float]]

_LN10 = math.log(10)
_LEAD = 0.012
_SHARES = (0.003, 0.1)


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
    proposed : tuple of (Surface, Payment)
        V of every upper bound that was better than those before, and what it was paid with.
    """

    upper: float
    lower: float | None
    words: str
    seconds: float
    proposed: tuple[tuple[Surface, Payment], ...] = ()


def bound_exits(
    problem: Problem, *, target: Any = None, seconds: float = 10.0, lower: bool = True
) -> ExitBounds:
    """Bound P(X_t leaves the safe set for some t <= T) from above and from below by Theorem K8-CT.

    Parameters
    ----------
    problem : Problem
        Continuous time, one or two states, noise of full rank, a bounded safe box (obstacles only in one state).
    target : region, optional
        Not served yet.
    seconds : float
        When to stop refining; the first attempt is finished in any case.
    lower : bool
        Whether to look for a lower bound too (one state; there is none in two).

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
    room = safe_room(problem)
    model = _model(problem)
    _check_noise(model, room, problem)
    proposed: list[tuple[Surface, Payment]] = []
    if problem.system.dimension == 1:
        upper, least, words, proposed = _one_state(problem, model, room, begin + seconds, lower)
    else:
        from certbound.values.continuous.two_states import two_states

        upper, least, words, proposed = two_states(problem, model, room, begin + seconds)
    return ExitBounds(
        upper=min(0.0, upper / _LN10 * (1 - 1e-15)), lower=None if least is None else least / _LN10 * (1 + 1e-15),
        words=words, seconds=time.perf_counter() - begin, proposed=tuple(proposed),
    )  # fmt: skip


def _check(problem: Problem, target: Any, seconds: float) -> None:
    if not isinstance(problem, Problem):
        raise TypeError(f"`problem` must be a Problem, got {problem!r}.")
    if not seconds > 0:
        raise ValueError(f"`seconds` must be positive, got {seconds!r}.")
    if problem.system.time != "continuous":
        raise InfeasibleError("value functions of this kind need continuous time; the problem is discrete.")
    if problem.system.dimension > 2:
        raise InfeasibleError(
            f"value functions in continuous time serve one or two states, the problem has {problem.system.dimension}."
        )
    if target is not None:
        raise InfeasibleError("value functions in continuous time do not serve targets yet.")
    if problem.initial.random:
        raise InfeasibleError("value functions in continuous time do not serve a random start; use a set of starts.")
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


def _check_noise(model: Model, room: Room, problem: Problem) -> None:
    """Refuse noise that may vanish somewhere: the proof needs none, but what is proposed would be useless."""
    fine = [np.linspace(low, high, 17) for low, high in zip(room.inner_low, room.inner_high)]
    low = np.meshgrid(*(axis[:-1] for axis in fine), indexing="ij")
    high = np.meshgrid(*(axis[1:] for axis in fine), indexing="ij")
    time_ = [Interval(0.0, float(problem.horizon)).broadcast_to((low[0].size,))]
    values, _ = enclose(model.square.tape, time_ + [Interval(a.ravel(), b.ravel()) for a, b in zip(low, high)])
    n = len(fine)
    smallest = values[0].lo
    if n == 2:
        cross = np.maximum(np.abs(values[1].lo), np.abs(values[1].hi))
        smallest = np.minimum(np.minimum(values[0].lo, values[3].lo), values[0].lo * values[3].lo - cross**2)
    if not np.all(smallest > 0):
        raise InfeasibleError(
            "value functions in continuous time need noise of full rank everywhere in the safe set; here some "
            "direction has none somewhere (noise in the velocities only, say): another engine's answer stands."
        )


def _line(problem: Problem, model: Model, low: float, high: float) -> Line:
    drift, square = compile_numpy(model.drift.tape), compile_numpy(model.square.tape)
    corners = [[float(value.mid) for value in branch] for branch in model.branches]

    def drifts(t: float, x: Array) -> Array:
        return np.array([np.broadcast_to(drift(t, x, *corner)[..., 0], np.shape(x)) for corner in corners])

    return Line(
        low=low, high=high, horizon=float(problem.horizon), drift=drifts,
        square=lambda t, x: np.broadcast_to(square(t, x)[..., 0, 0], np.shape(x)),
        starts=starts_of(problem)[0], autonomous=model.autonomous,
    )  # fmt: skip


def _one_state(
    problem: Problem, model: Model, room: Room, deadline: float, lower: bool
) -> tuple[float, float | None, str, list[tuple[Surface, Payment]]]:
    """Refine both sides until the time is spent or a refinement gains less than half a per cent."""
    starts = starts_of(problem)
    inner = _line(problem, model, room.inner_low[0], room.inner_high[0])
    outer = _line(problem, model, room.outer_low[0], room.outer_high[0])
    rough = sketch(inner)
    found = _Found(level=rough.level)
    effort, tolerance, lead = 60.0, 1.5e-4, _LEAD
    for attempt in range(5):
        begin = time.perf_counter()
        cells = int(effort * (1 + 0.2 * min(-found.level, 80)))
        span = inner.horizon * lead / max(rough.growth, 1.0)
        gain = _raise_upper(found, inner, model, starts, span, cells, tolerance)
        if lower:
            gain = max(gain, _raise_lower(found, outer, model, starts, 3 * span, cells, tolerance))
        spent = time.perf_counter() - begin
        if (gain < 0.005 and attempt > 0) or time.perf_counter() + 2.5 * spent > deadline:
            break
        effort, tolerance, lead = effort * 1.4, tolerance / 3, lead * 0.6
    words = f"value function in one state, cells x slabs of time: {', '.join(found.done) or 'none came to an end'}"
    return found.upper, found.lower, words, found.proposed


@dataclass(slots=True)
class _Found:
    """The best bounds so far (natural logarithms), and log P as far as it is known."""

    level: float
    upper: float = 0.0
    lower: float | None = None
    done: list[str] = field(default_factory=list)
    proposed: list[tuple[Surface, Payment]] = field(default_factory=list)


def _raise_upper(
    found: _Found, line: Line, model: Model, starts: Starts, span: float, cells: int, tolerance: float
) -> float:
    """One attempt at the upper bound; what it gained."""
    short, _ = sealed(line, found.level)
    surface = propose_upper(short, found.level, span, share=_SHARES[0], cells=cells, tolerance=tolerance)
    if surface is None or not covers(surface, line.horizon, [line.low], [line.high], within=True):
        return 0.0
    found.done.append(f"{cells} x {surface.slabs}")
    found.level = min(found.level, extreme_over(surface, starts, upper=True))
    payment = prove_upper(surface, model, starts)
    gain = found.upper - payment.log
    if gain > 0:
        found.upper = payment.log
        found.proposed.append((surface, payment))
    return gain


def _raise_lower(
    found: _Found, line: Line, model: Model, starts: Starts, span: float, cells: int, tolerance: float
) -> float:
    """One attempt at the lower bound; what it gained."""
    _, far = sealed(line, found.level)
    surface = propose_lower(line, found.level, span, far, share=_SHARES[1], cells=cells, tolerance=0.3 * tolerance)
    if surface is None or not covers(surface, line.horizon, [line.low], [line.high], within=False):
        return 0.0
    payment = prove_lower(surface, model, starts)
    if payment is None:
        return 0.0
    gain = math.inf if found.lower is None else payment.log - found.lower
    found.lower = payment.log if found.lower is None else max(found.lower, payment.log)
    return gain
