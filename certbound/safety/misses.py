"""Targets: noise-free trajectories that provably miss them, and the time at which the target is best met."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np

from certbound.arrays import Array
from certbound.errors import CertboundError, EngineError
from certbound.problem.problem import Problem
from certbound.problem.sets import Inside, Outside
from certbound.reach.nominal import Flow
from certbound.reach.sets import constraint_clearance
from certbound.rigor.norms import Norm
from certbound.safety.falsification import ATTEMPTS, Violation, candidates, follow, proved, rooms

_DOUBLINGS, _SETTLED = 12, 3
_NEARLY = 0.1  # of the depth that an earlier time, with less noise until then, is worth


def window_of(problem: Problem) -> tuple[float, float]:
    """When the target counts."""
    return problem.reach.during or (0.0, float(problem.horizon))


def best_time(problem: Problem) -> float:
    """The time of the target's window at which the worst of a few noise-free trajectories is deepest in it.

    In floating point: whatever it is, to meet the target then is one way of not failing. Without an end the time of
    `arrival`, where there is one; where inputs are held a sampling time, as if they followed at once.

    EngineError where inputs are held, and are not computed within the window.
    """
    if problem.hold is not None:
        return _at_sample(problem)
    if problem.endless:
        last, stay = arrival(problem)
        return last if stay else _deepest(_until(problem, last), _NEARLY)
    first, last = window_of(problem)
    if first == last or (isinstance(problem.plan, np.ndarray) and problem.system.time == "continuous"):
        return last
    return _deepest(problem, 0.0)


def _at_sample(problem: Problem) -> float:
    """The sampling time at which trajectories under inputs that follow at once are deepest in the target."""
    step, (first, last) = Fraction(problem.horizon) / problem.samples, map(Fraction, window_of(problem))
    samples = [number * step for number in range(max(1, math.ceil(first / step)), math.floor(last / step) + 1)]
    found = [float(time) for time in samples if Fraction(float(time)) == time]
    if not found:
        raise EngineError(
            f"the target counts from {float(first):g} to {float(last):g}, when no inputs are computed, which are held "
            f"for {problem.hold:g}, at a time that is exactly a float; let its `during` hold a multiple of that which "
            "is one, such as the horizon."
        )
    times, _, _, paths, flow = _followed(problem.replace(hold=None))
    depth = rooms(Inside(problem.reach.region, (0.0, times[-1])), flow, times, paths).min(axis=0)
    depth = np.interp(found, times, np.where(np.isfinite(depth), depth, -np.finfo(float).max))
    return found[int(np.argmax(depth))]


def _deepest(problem: Problem, less: float) -> float:
    """The first time at which the worst trajectory is deepest, or by such a part less deep."""
    first, last = window_of(problem)
    times, _, _, paths, flow = _followed(problem)
    depth = rooms(Inside(problem.reach.region, (first, last)), flow, times, paths).min(axis=0)
    depth = np.where(np.isfinite(depth) & (times > 0), depth, -np.inf)
    most = depth.max()
    return float(times[np.argmax(depth >= most - less * abs(most))]) if np.isfinite(most) else last


def arrival(problem: Problem) -> tuple[float, bool]:
    """A time by which noise-free trajectories are well inside the target, and whether they ever stay there."""
    last, inside = 1.0, 0
    for _ in range(_DOUBLINGS):
        last *= 2
        times, _, _, paths, flow = _followed(_until(problem, last))
        inside += bool(rooms(Inside(problem.reach.region), flow, times, paths)[:, -1].min() > 0)
        if inside == _SETTLED:
            break
    return last, inside == _SETTLED


def _until(problem: Problem, last: float) -> Problem:
    return problem.replace(horizon=int(last) if problem.system.time == "discrete" else last)


def find_miss(problem: Problem) -> Violation | None:
    """A noise-free trajectory that provably is not in the target before it has broken a constraint, or at all.

    Proves: the trajectory from ``start`` under one constant disturbance lies in ``reach``, which does not meet the
    target within its window, or not until ``time``, when a constraint is broken.
    None of a random start, whose mean says nothing of what is drawn.
    """
    if problem.initial.spread:
        return None
    times, starts, signals, paths, flow = _followed(problem)
    first, last = window_of(problem)
    inside = rooms(Inside(problem.reach.region, (first, last)), flow, times, paths)
    broken = np.full(len(paths), len(times))
    which: dict[int, Inside] = {}
    for constraint in problem.safe:
        out = rooms(constraint, flow, times, paths) < 0
        when = np.where(out.any(axis=1), out.argmax(axis=1), len(times))
        which |= dict.fromkeys(np.flatnonzero(when < broken).tolist(), constraint)
        broken = np.minimum(broken, when)
    index = np.arange(len(times))
    nearest = np.where(np.isfinite(inside) & (index <= broken[:, None]), inside, -np.inf).max(axis=1)
    for path in np.argsort(nearest)[:ATTEMPTS].tolist():
        found = None
        if nearest[path] < 0 and times[min(broken[path], len(times) - 1)] >= last:
            found = _never(problem, starts[path], signals[path], last, -float(nearest[path]))
        elif nearest[path] < 0:
            found = _broken(problem, starts[path], signals[path], float(times[broken[path]]), which[path])
        if found is not None:
            return found
    return None


def _followed(problem: Problem) -> tuple[Array, Array, Array, Array, Flow]:
    plain = problem.replace(reach=None)
    flow = Flow(plain)
    starts, signals = candidates(plain, flow, np.random.default_rng(0))
    times, paths = follow(flow, starts, signals)
    return times, starts, signals, paths, flow


def _never(problem: Problem, start: Array, signal: Array, last: float, depth: float) -> Violation | None:
    """The miss, if the enclosed trajectory stays out of the target over its whole window."""
    from certbound.reach.contraction import local_contraction_tube

    try:
        reach = local_contraction_tube(Flow(problem.replace(initial=start, reach=None), only=signal))
    except (CertboundError, ValueError):
        return None
    off = Outside(problem.reach.region, during=(window_of(problem)[0], last))
    room = constraint_clearance(reach, off, Norm(problem.system.dimension)).radius
    if reach.end < last or not np.all(room > 0):
        return None
    return Violation(reach=reach, constraint=problem.reach, time=last, depth=depth, start=start)


def _broken(problem: Problem, start: Array, signal: Array, when: float, constraint: Inside) -> Violation | None:
    """The miss, if a constraint is provably broken at a time until which the target is not met."""
    first, plain = window_of(problem)[0], problem.replace(reach=None)
    found = proved(plain, start, signal, when, constraint, 0.0)
    if found is None or first > when:
        return found
    off = Outside(problem.reach.region, during=(first, when))
    room = constraint_clearance(found.reach, off, Norm(problem.system.dimension)).radius
    return found if np.all(room > 0) else None
