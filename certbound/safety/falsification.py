"""Noise-free trajectories that provably leave the safe set.

Sampled trajectories propose a start, a constant disturbance and a time; the trajectory is then enclosed (Thm K5 with
local rates, from the start alone), and the violation is proved for every point of the enclosure.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.errors import CertboundError
from certbound.problem.model import compile_numpy, compile_scalar, edged, varying_outputs
from certbound.problem.problem import Problem
from certbound.problem.sets import Inside, Outside, clearance
from certbound.reach.nominal import Flow
from certbound.reach.sets import ReachTube, constraint_clearance
from certbound.rigor.norms import Norm
from certbound.watch import poll

PATHS = 64
STEPS = 400
ATTEMPTS = 3
_WHOLE = 4_000_000  # numbers of all paths up to which affine dynamics are followed at once


@dataclass(frozen=True, eq=False, kw_only=True)
class Violation:
    """A proved violation: the enclosed trajectory, the constraint, the time and the depth (Euclidean)."""

    reach: ReachTube
    constraint: Inside
    time: float
    depth: float
    start: Array


def find_violation(problem: Problem) -> Violation | None:
    """A noise-free trajectory from the initial set that provably breaks a constraint; None if none was found.

    Leaving the model's domain is not counted: there the model says nothing. Nor is the path of a random start's mean:
    no path need be near it.

    Proves: the trajectory from ``start`` under one constant disturbance lies in ``reach``, and every point of
    ``reach`` at ``time`` breaks ``constraint``.
    """
    if problem.initial.spread:
        return None
    flow = Flow(problem)
    rng = np.random.default_rng(0)
    starts, signals = candidates(problem, flow, rng)
    times, paths = follow(flow, starts, signals)
    deepest: dict[int, tuple[float, float, Inside]] = {}
    for constraint in problem.safe:
        room = rooms(constraint, flow, times, paths)
        when = np.argmin(room, axis=1)
        for path in np.flatnonzero(room.min(axis=1) < 0).tolist():
            depth = float(room[path, when[path]])
            if depth < deepest.get(path, (0.0,))[0]:
                deepest[path] = (depth, float(times[when[path]]), constraint)
    order = sorted(deepest, key=lambda path: deepest[path][0])
    for path in order[:ATTEMPTS]:
        depth, time, constraint = deepest[path]
        violation = proved(problem, starts[path], signals[path], time, constraint, -depth)
        if violation is not None:
            return violation
    return None


def rooms(constraint: Inside, flow: Flow, times: Array, paths: Array) -> Array:
    """Signed distances of every path to the constraint at every time: (paths, K + 1), inf where nothing is asked."""
    first, last = (0.0, flow.horizon) if constraint.during is None else constraint.during
    usable = np.all(np.isfinite(paths), axis=-1) & (times >= first) & (times <= last)
    states = np.where(usable[..., None], paths, 0.0)
    if constraint.region.moving:
        room = np.stack([clearance(constraint, states[:, k], None, float(t)) for k, t in enumerate(times)], axis=1)
    else:
        room = clearance(constraint, states)
    return np.where(usable, room, np.inf)


def candidates(problem: Problem, flow: Flow, rng: np.random.Generator) -> tuple[Array, Array]:
    """Starts and constant disturbances: the middles first, then corners, then random ones."""
    start = problem.initial
    starts = np.tile(start.middle, (PATHS, 1)) if start.random else np.asarray(start.sample(rng, PATHS))
    if not start.random:
        corners = start.corners(rng, PATHS // 2 - 1)
        starts[1 : 1 + len(corners)] = corners
        starts[0] = start.middle
    box = flow.disturbance
    signals = rng.uniform(box.lo, box.hi, (PATHS, box.shape[0]))
    signals[1::2] = np.where(rng.random(signals[1::2].shape) < 0.5, box.lo, box.hi)
    signals[0] = flow.centre_disturbance
    return starts, signals


def follow(flow: Flow, starts: Array, signals: Array) -> tuple[Array, Array]:
    """Times (K + 1,) and noise-free paths (paths, K + 1, n) in floating point."""
    steps = STEPS if flow.continuous else int(flow.horizon)
    times = np.linspace(0.0, flow.horizon, steps + 1)
    rows = flow.plan_rows(times[:-1] + (0.25 * (times[1] - times[0]) if flow.continuous else 0.0))
    paths = np.empty((len(starts), steps + 1, flow.dimension))
    paths[:, 0] = x = starts
    with np.errstate(all="ignore"):
        if paths.size <= _WHOLE and not edged(flow.tape) and not any(varying_outputs(flow.state_jacobian)):
            advance, pushes = _affine(flow, times, rows, signals)
            for k in range(steps):
                paths[:, k + 1] = x = x @ advance.T + pushes[:, k]
            return times, paths
        run, pushed = compile_scalar(flow.tape), signals.T  # it takes columns of numbers as well

        def function(t: float, x: Array, row: Array) -> Array:
            slopes = np.empty(x.shape)
            for place, value in enumerate(run(np.float64(t), *x.T, *row, *pushed)):
                slopes[:, place] = value
            return slopes

        for k in range(steps):
            poll()
            t, h, row = float(times[k]), float(times[k + 1] - times[k]), rows[k]
            k1 = function(t, x, row)
            if flow.continuous:
                k2 = function(t + h / 2, x + h / 2 * k1, row)
                k3 = function(t + h / 2, x + h / 2 * k2, row)
                k4 = function(t + h, x + h * k3, row)
                x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            else:
                x = k1
            paths[:, k + 1] = x
    return times, paths


def _affine(flow: Flow, times: Array, rows: Array, signals: Array) -> tuple[Array, Array]:
    """The same steps where f(t, x) = A x + b(t): x becomes R x + c, R (n, n) and c (paths, K, n)."""
    tape, n = flow.state_jacobian, flow.dimension
    a = compile_numpy(tape)(*np.zeros(len(tape.inputs)))
    origin, pushed = np.zeros((len(signals), 1, n)), signals[:, None]
    start = flow.value(times[:-1], origin, rows, pushed)
    if not flow.continuous:
        return a, start
    h = float(times[1] - times[0])
    middle, end = (flow.value(times[:-1] + share * h, origin, rows, pushed) for share in (0.5, 1.0))
    two = middle + h / 2 * start @ a.T
    three = middle + h / 2 * two @ a.T
    four = end + h * three @ a.T
    whole = h * a
    powers = np.eye(n) + whole @ (np.eye(n) + whole @ (np.eye(n) + whole @ (np.eye(n) + whole / 4) / 3) / 2)
    return powers, h / 6 * (start + 2 * two + 2 * three + four)


def proved(
    problem: Problem, start: Array, signal: Array, time: float, constraint: Inside, depth: float
) -> Violation | None:
    """The violation, if the enclosed trajectory shows it."""
    from certbound.reach.contraction import local_contraction_tube

    try:
        flow = Flow(problem.replace(initial=start), only=signal)
        reach = local_contraction_tube(flow)
    except (CertboundError, ValueError):
        return None
    if reach.end < time:
        return None
    opposite = Inside if constraint.outside else Outside
    room = constraint_clearance(reach, opposite(constraint.region, during=(time, time)), Norm(flow.dimension)).radius
    proved = np.any(np.isfinite(room) & (room > 0))
    return Violation(reach=reach, constraint=constraint, time=time, depth=depth, start=start) if proved else None
