"""Stochastic runs of a planned closed loop: violations, inputs and costs."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from certbound.arrays import Array, Mask
from certbound.parallel import alone
from certbound.problem.problem import Problem
from certbound.problem.sets import Inside
from certbound.simulation.blocks import MEMORY_LIMIT
from certbound.simulation.estimates import bound_binomial, sample_paths, simulate_exits
from certbound.synthesis.costs import Cost, cost_of
from certbound.synthesis.plans import Synthesis

CONFIDENCE = 0.99


@dataclass(frozen=True, eq=False, kw_only=True)
class ClosedLoop:
    """What stochastic runs of a plan did."""

    # runs, and those that broke a constraint (input bounds under a feedback included)
    runs: int
    violations: int
    # Clopper-Pearson limits of the probability of breaking one, at 99 %
    lower: float
    upper: float
    max_input: float  # largest |u| over all runs
    times: Array  # (N + 1,)
    mean_cost: Array  # (N + 1,): mean stage cost at each time; at the last one of the state alone
    mean_final_cost: float  # its last entry
    by_constraint: dict[str, int]  # label to the number of runs that broke it (DT: and none that is stated before it)
    seconds: float


@alone()
def simulate_closed_loop(
    result: Synthesis,
    *,
    runs: int,
    rng: np.random.Generator | int | None = None,
    stage_cost: Callable[..., Any] | None = None,
) -> ClosedLoop:
    """Run the noisy closed loop of a plan.

    Nothing is certified here: the counts are beside the verdict, not part of it. In continuous time the violations are
    counted by ``simulate_exits`` on 1000 steps, the costs on the plan's own pieces.

    Parameters
    ----------
    result : Synthesis
    runs : int
    rng : numpy.random.Generator or int, optional
    stage_cost : callable, optional
        The one that the plan was made for; the problem's quadratic cost when omitted.

    Returns
    -------
    ClosedLoop

    Raises
    ------
    ValueError
        If ``runs`` is not positive or the noise has no law to sample from.
    """
    if isinstance(runs, bool) or int(runs) != runs or runs < 1:
        raise ValueError(f"`runs` must be a positive integer, got {runs!r}.")
    began = time.perf_counter()
    generator = np.random.default_rng(rng)
    problem = result.problem
    steps = len(result.plan)
    cost = cost_of(result.source, stage_cost)
    continuous = problem.system.time == "continuous"
    per_path = 8 * problem.system.dimension * (steps + 1)
    share = max(1, min(int(runs), MEMORY_LIMIT // (2 * per_path)))
    total, largest = np.zeros(steps + 1), 0.0
    counts: dict[str, int] = {constraint.label: 0 for constraint in problem.constraints}
    violations, done = 0, 0
    times = np.linspace(0.0, float(problem.horizon), steps + 1)
    while done < runs:
        count = min(share, int(runs) - done)
        paths = sample_paths(problem, paths=count, rng=generator, **_points(problem, steps))
        inputs = _inputs(result, paths)
        total += _costs(cost, times, paths, inputs).sum(axis=0)
        largest = max(largest, float(np.abs(inputs).max(initial=0.0)))
        if not continuous:
            broken = _broken(problem, paths, counts)
            violations += int(broken.sum())
        done += count
    if continuous:
        exits = simulate_exits(problem, paths=int(runs), rng=generator, halve=False)
        violations, counts = exits.exits, dict(exits.by_constraint)
    lower, upper = bound_binomial(violations, int(runs), CONFIDENCE)
    mean = total / runs
    return ClosedLoop(
        runs=int(runs), violations=violations, lower=float(lower), upper=float(upper), max_input=largest, times=times,
        mean_cost=mean, mean_final_cost=float(mean[-1]), by_constraint=counts, seconds=time.perf_counter() - began,
    )  # fmt: skip


def _points(problem: Problem, steps: int) -> dict[str, Any]:
    if problem.system.time == "discrete":
        return {}
    return {"points": steps, "steps": -(-1000 // steps) * steps}


def _inputs(result: Synthesis, paths: Array) -> Array:
    """The system's own inputs at the start of every piece, shape (runs, N, m)."""
    held = np.broadcast_to(result.plan, (len(paths), *result.plan.shape))
    return held if result.feedback is None else np.asarray(held + paths[:, :-1] @ result.feedback.T)


def _costs(cost: Cost, times: Array, paths: Array, inputs: Array) -> Array:
    running = cost.values(np.broadcast_to(times[:-1], (*paths.shape[:1], len(times) - 1)), paths[:, :-1], inputs)
    last = cost.values(times[-1:], paths[:, -1:], np.zeros_like(inputs[:, :1]))
    return np.concatenate([running, last], axis=1)


def _broken(problem: Problem, paths: Array, counts: dict[str, int]) -> Mask:
    """Which runs break a constraint at some step, before they end in leaving the domain; counted by constraint."""
    times = range(paths.shape[1])

    def kept(constraint: Inside) -> Mask:
        return np.stack([constraint.satisfied(paths[:, k], float(k)) for k in times], axis=1)

    asked, alive = problem.constraints, np.ones(paths.shape[:2], dtype=bool)
    if problem.ending:
        asked, alive = asked[:-1], np.logical_and.accumulate(kept(asked[-1]), axis=1)
    broken = np.zeros(len(paths), dtype=bool)
    for constraint in asked:
        first, last = (0, paths.shape[1] - 1) if constraint.during is None else (int(t) for t in constraint.during)
        found = (alive & ~kept(constraint))[:, first : last + 1].any(axis=1)
        counts[constraint.label] += int((found & ~broken).sum())
        broken |= found
    return broken
