"""A lower bound of the probability of failing from one start, by the linear response of those who have not failed.

Theorem. Let X start at a point of X_0 under one constant disturbance, X = p + Z + R with Z the Gaussian response of the
linearised model. Let E be the event that Z keeps levels which it leaves with probability delta_N at most, and let
bounds of R hold at every time until which a path is in E and no constraint is broken. A path in E that never fails then
satisfies w . Z_t <= b - w . p_t - inf w . R_t for every half-space w . x <= b that holds what is asked at a time t.
So P(fail) >= P(some w . Z_t is beyond) - delta_N.

The safe set bounds the state of a path that has not failed. Where it bounds all coordinates that enter nonlinearly, R
is bounded by the range of what the linearisation leaves out over that set; no levels are needed, and delta_N = 0.

The same holds under noise that is pushed towards failing, where it is likely at some early time, and the nominal leads
out; what that says of the noise as it is: `certbound.reach.below.pushes`.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from certbound.arrays import Array
from certbound.checks import assign
from certbound.errors import CertboundError
from certbound.gaussian.scalar import log_tail
from certbound.problem.jumps_as_plan import in_pieces
from certbound.problem.problem import Problem
from certbound.problem.sets import Box, Quadratic
from certbound.problem.systems import DiscreteSystem
from certbound.reach.below.breaches import Breach, breaches, events_of
from certbound.reach.below.pushes import Pushed, plainly
from certbound.reach.below.survival import Survival
from certbound.reach.linear import FEWEST_PIECES, Linearisation, Share, depends_on_state, fitted
from certbound.reach.nominal import Cells
from certbound.reach.remainder import hidden_jump
from certbound.watch import poll

_SHARES = (None, 0.01, 0.03, 0.1)
_FITTED = 0.1
_MARGIN = 0.6  # standard deviations by which a pushed nominal leaves
_OPTIMISM = 1.0  # standard deviations by which the model may be nearer to failing than its linearisation says
_DOUBLINGS, _FINER = 6, 2.0**0.5
_HOPELESS = 0.3  # of the target: what the linear model says, less than which nothing is tried
_MOST_STEPS, _MOST_STATES, _MOST_PIECES = 2000, 40, 200
_COARSER = 4
_INSIDE = 1 - 1e-9  # of the way to the boundary of the starts
_ENOUGH = 3.0  # times the target: a bound beyond which nothing better is looked for


@dataclass(frozen=True, eq=False, kw_only=True)
class LeastFailing:
    """P(fail) >= ``probability`` from ``start`` under the constant ``disturbance``.

    ``label`` is the constraint that is likeliest to be broken, at ``time``; ``levels`` is delta_N, and ``cost`` the c
    of pushed noise.
    """

    probability: float
    start: Array
    disturbance: Array
    label: str
    time: float
    levels: float
    cost: float


@dataclass(frozen=True, eq=False, kw_only=True)
class _Attempt:
    """What a guess of the remainder promises, and what it takes to prove it."""

    promise: float
    share: float
    levels: Array
    run: Survival
    found: list[Breach]
    cost: float

    def proved(self) -> LeastFailing | None:
        run, problem = self.run, self.run.engine.problem
        bounds = run.include(self.levels, 1)  # of a linear model too: its nominal is only followed in steps
        if bounds is None:
            return None
        probability, label, time = _least(run, self.found, bounds)
        least = plainly(probability - self.share, self.cost) * (1 - 1e-12)
        box = problem.system.disturbance
        return None if least <= 0 else LeastFailing(
            probability=least, start=np.asarray(problem.initial.middle), label=label, time=time, levels=self.share,
            disturbance=np.zeros(0) if box is None else box.low, cost=self.cost,
        )  # fmt: skip


def least_failing(problem: Problem) -> LeastFailing | None:
    """The largest lower bound that a few times and levels give; None where nothing is found, or nothing is hoped for.

    Additive Gaussian noise; a finite horizon without a target, and a single set of starts.
    """
    system = problem.system
    if problem.reach is not None or problem.endless or problem.ending or problem.hold is not None:
        return None
    if problem.unknown or problem.random or len(problem.starts) > 1 or system.dimension > _MOST_STATES:
        return None
    if isinstance(system, DiscreteSystem) and not (system.noise.gaussian and problem.horizon <= _MOST_STEPS):
        return None
    problem = in_pieces(problem)
    if depends_on_state(problem) or hidden_jump(problem) is not None:
        return None
    with np.errstate(all="ignore"):
        single = _single(problem, None if problem.initial.random else problem.initial.middle)
        best = _best(single, None)
        if best is None or best.probability <= problem.delta:
            start = _farther(problem, single)
            best = best if start is None else _best(_single(problem, start), best)
    return best


def least_failing_of(problem: Problem, cells: Cells) -> float:
    """A lower bound of the probability of failing that holds from every start of a cell, under a constant disturbance.

    Additive Gaussian noise, and what `least_failing` asks of the rest; 0 where nothing is found.
    """
    single = _single(problem, None)
    with np.errstate(all="ignore"):
        for attempt in _tried(single, Linearisation.of(single, cells=cells)):
            found = attempt.proved()
            if found is not None:
                return found.probability
    return 0.0


def _best(single: Problem, best: LeastFailing | None) -> LeastFailing | None:
    """The larger one of ``best`` and what is proved from one start."""
    for attempt in _attempts(single):
        found = attempt.proved() if best is None or attempt.promise > 1.1 * best.probability else None
        if found is not None and (best is None or found.probability > best.probability):
            best = found
        if best is not None and best.probability > _ENOUGH * single.delta:
            break
    return best


def _farther(problem: Problem, single: Problem) -> Array | None:
    """A start on the side from which the nearest constraint is nearer than from the middle; None of a point."""
    start = problem.initial
    if start.random or start.is_point:
        return None
    engine = _linearised(single)
    found = breaches(engine)
    if not found:
        return None
    which, last, _ = _nearest(engine, found)
    node = round(last / engine.step)
    place = node - int(engine.continuous)
    sizes = engine.response.covariance[0, node]
    near = next(one for one in found if one.place == which)
    rows = near.rows[:, place]
    row = rows[int(np.argmax(near.levels[:, place] / np.sqrt(np.einsum("ji,ik,jk->j", rows, sizes, rows))))]
    for k in range(node - 1, -1, -1):
        row = row @ engine.response.transition[0, k]
    middle = np.asarray(start.middle)
    if isinstance(start, Box):
        offset = np.where(row > 0, start.high, start.low) + start.center_at() - middle
    elif isinstance(start.form, Quadratic):
        offset = start.form.radius * start.form.shape @ row / math.sqrt(row @ start.form.shape @ row)
    else:
        return None
    inner = middle + _INSIDE * np.where(row == 0, 0.0, offset)
    return inner if np.all(np.isfinite(inner)) and start.contains(inner) else None


def _single(problem: Problem, point: Array | None) -> Problem:
    """The problem from a single start, unless that is random, under a single disturbance."""
    system = problem.system
    if system.disturbance is not None:
        middle = (system.disturbance.low + system.disturbance.high) / 2
        system = copy.copy(system)
        assign(system, disturbance=Box(middle, middle))
    return problem.replace(system=system) if point is None else problem.replace(system=system, initial=point)


def _attempts(problem: Problem) -> Iterator[_Attempt]:
    """Those that are worth a proof, in turn."""
    engine = _linearised(problem)
    found = breaches(engine)
    if not found:
        return
    events, _ = events_of(engine, found, [(np.zeros_like(one.levels),) * 2 for one in found])
    if not len(events.nodes) or events.union(engine.response) < _HOPELESS * problem.delta:
        return
    if not len(engine.model.active):
        yield from _tried(problem, engine)
        return
    yield from _pushed(problem, engine, found)
    if engine.pieces <= _MOST_PIECES:
        yield from _tried(problem, engine)


def _pushed(problem: Problem, engine: Linearisation, found: list[Breach]) -> Iterator[_Attempt]:
    """With pushes towards the nearest breach, until a few times: the best one of them."""
    which, last, far = _nearest(engine, found)
    if isinstance(problem.system, DiscreteSystem) and np.count_nonzero(
        problem.system.noise.proxy - np.diag(np.diag(problem.system.noise.proxy))
    ):
        return
    whole = engine.continuous and problem.input_sequence is not None
    best: _Attempt | None = None
    times = [last / 2**k for k in range(_DOUBLINGS, -1, -1)] if not whole else [float(problem.horizon)]
    tried: list[tuple[float, float]] = []

    def at(time: float) -> _Attempt | None:
        nonlocal best
        own = list(_at(problem, time, which))
        if own and (best is None or own[0].promise > best.promise):
            best = own[0]
        tried.append((own[0].promise if own else 0.0, time))
        return own[0] if own else None

    for time in sorted({time if engine.continuous else float(math.ceil(time)) for time in times}):
        if np.exp(log_tail(far(time) - _OPTIMISM)) < _HOPELESS * problem.delta:
            continue
        attempt = at(time)
        if best is not None and (attempt is None or attempt.promise < best.promise / 2):
            break
    if best is not None and engine.continuous and not whole:
        middle = max(tried)[1]
        for time in (middle / _FINER, middle * _FINER):
            if time < problem.horizon:
                at(time)
    if best is not None:
        yield best


def _at(problem: Problem, time: float, which: tuple[int, int]) -> Iterator[_Attempt]:
    """What is promised with pushes until a time, the best first."""
    poll("pushes of the noise")
    try:
        part = _until(problem, time)
        if len(part.safe) < len(problem.safe):
            return  # breaches have other numbers
        pushed = Pushed(part)
        steered = pushed.steered(which, _MARGIN)
        if steered is None or np.exp(log_tail(steered[1] - _MARGIN)) < _HOPELESS * problem.delta:
            return
        under = pushed.under(steered[0])
        engine = Linearisation(under, pieces=pushed.count if pushed.continuous else None)
        yield from _tried(under, engine, steered[1])
    except (CertboundError, ArithmeticError):
        return


def _tried(problem: Problem, engine: Linearisation, cost: float = 0.0) -> list[_Attempt]:
    """What guesses of the remainder promise, by shares for the levels, the best first."""
    try:
        engine = fitted(engine, Share.of(_FITTED), make=Survival)
        found = breaches(engine)
        run = Survival(engine, [rows for one in found for rows in one.rows])
        attempts = []
        for share in _SHARES if run.curved else (None,):
            if share is None and run.curved and not run.enclosed:
                continue
            levels = run.unbounded_levels if share is None else run.levels(Share.of(share))[0]
            guess = run.guess(levels, run.nothing, run.nothing, 0.02) if run.curved else run.nothing
            if guess is not None:
                promise = plainly(_least(run, found, guess)[0] - (share or 0.0), cost)
                attempts.append(_Attempt(
                    promise=promise, share=share or 0.0, levels=levels, run=run, found=found, cost=cost))
        return sorted((one for one in attempts if one.promise > 0), key=lambda one: -one.promise)
    except (CertboundError, ArithmeticError):
        return []


def _nearest(engine: Linearisation, found: list[Breach]) -> tuple[tuple[int, int], float, Callable[[float], float]]:
    """The breach that is the fewest standard deviations away at some node, and the first time at which it nearly is.

    The third entry says how many that are until a time, at the least.
    """
    offset, best = int(engine.continuous), (math.inf, 0, float(engine.problem.horizon))
    course = np.full(1, np.inf)
    for which, one in enumerate(found):
        v = engine.response.covariance[0, offset : offset + len(one.asked)]
        sizes = np.sqrt(np.maximum(np.einsum("jki,kil,jkl->jk", one.rows, v, one.rows), 0.0))
        far = np.where(one.asked & (sizes > 0).all(axis=0), (one.levels / sizes).max(axis=0), np.inf)
        least = float(far.min())
        if least < best[0]:
            place = int(np.argmax(far <= least + 0.02 * abs(least)))
            best, course = (least, which, (place + offset) * engine.step), np.minimum.accumulate(far)

    def until(time: float) -> float:
        return float(course[max(min(math.ceil(time / engine.step - 1e-9) - offset, len(course) - 1), 0)])

    return found[best[1]].place, best[2], until


def _linearised(problem: Problem) -> Linearisation:
    """On a grid that is as coarse as the linear response bears: its defect is in what the remainder bounds."""
    fine = Linearisation.of(problem)
    if not fine.continuous or fine.pieces <= FEWEST_PIECES:
        return fine
    return Linearisation(problem, pieces=max(math.ceil(fine.pieces / _COARSER), FEWEST_PIECES))


def _until(problem: Problem, horizon: float) -> Problem:
    """The problem until a time: what is asked later is left out."""
    if horizon >= problem.horizon:
        return problem
    kept = [one for one in problem.safe if one.during is None or one.during[0] <= horizon]
    cut = [one if one.during is None else replace(one, during=(one.during[0], min(one.during[1], horizon)))
           for one in kept]
    return problem.replace(safe=cut, horizon=horizon if problem.system.time == "continuous" else int(horizon))


def _least(run: Survival, found: list[Breach], bounds: tuple[Array, Array]) -> tuple[float, str, float]:
    """P(some breach at single times) from below, given bounds of beta; what is likeliest, and when."""
    support, engine = run.supports[0], run.engine
    low, high, _ = support.remainder(bounds[0][0], bounds[1][0])
    low, high = (part[:, run.inner :] for part in (low - support.y, high + support.y))
    remainder, place = [], 0
    for one in found:
        own = slice(place, place + len(one.rows))
        place += len(one.rows)
        remainder.append((low[:, own].T, high[:, own].T))
    events, labels = events_of(engine, found, remainder)
    if not len(events.nodes):
        return 0.0, "", 0.0
    chances = events.chances(engine.response)
    likeliest = int(np.argmax(chances))
    return events.union(engine.response), labels[likeliest], float(events.nodes[likeliest] * engine.step)
