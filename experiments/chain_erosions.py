"""What the linear response takes from each requirement of the chain along its plan, beside simulated quantiles.

Erosion of a requirement: level of its scalar event at an even share of delta, plus what the remainder adds, largest
over the steps. The quantile next to it is that of the largest deviation along the same row, at the same share. Then
the largest multiple of the noise at which the whole problem is still proved SAFE, for two values of delta.
"""

from __future__ import annotations

import numpy as np

import certbound as cb
from certbound.gaussian.response import level_scale
from certbound.problem.problem import Problem
from certbound.reach.linear import Linearisation, LinearRun, Share, linear_answer
from certbound.reach.linear.fit import fitted
from certbound.simulation.estimates.deviations import Measure, sup_deviation
from experiments.harness import Arrays, Claims, main

__all__ = ["compute", "erosions", "largest_multiple", "quantiles"]

DELTA = 0.002
SHARES = (0.03, 0.05, 0.07, 0.1, 0.14, 0.2)
FIT = 0.02  # the slopes are fitted over deviations of this probability: the likely ones count most here
SIGMA = 0.43


def compute(full: bool) -> tuple[Arrays, Claims]:
    """Erosions, quantiles and the largest multiples of the noise."""
    problem = cb.load("chain").replace(delta=DELTA)
    labels, found = erosions(problem)
    simulated = quantiles(problem, 1_000_000 if full else 100_000)
    claims: Claims = {"delta": DELTA, "requirements": labels, "erosions": found.tolist(),
                      "simulated": simulated.tolist()}
    for delta in (DELTA, 1e-6):
        claims[f"largest_multiple_{delta:g}"] = largest_multiple(delta, 0.02 if full else 0.1)
    return {"erosions": found, "simulated": simulated}, claims


def erosions(problem: Problem) -> tuple[list[str], np.ndarray]:
    """Labels and erosions of the requirements, for the share of delta whose erosions are least on the whole."""
    best: np.ndarray | None = None
    for share in SHARES:
        nonlinear = Share.of(problem.delta * share)
        run = LinearRun(fitted(Linearisation.of(problem), Share.of(FIT)))
        bounds = run.include(run.levels(nonlinear)[0], 3)
        if bounds is None:
            continue
        asked, events = run.requirements[0], run.events(0, nonlinear)
        support = run.supports[0]
        _, high, _ = support.remainder(bounds[0][0], bounds[1][0])
        taken = (support.y + high)[:, run.inner :]
        target = float(np.log(problem.delta * (1 - share) / len(asked)))
        found = []
        for number, requirement in enumerate(asked):
            event = events.along(requirement.rows)
            found.append(float(np.max(level_scale(event, event.profile, target) * event.profile + taken[:, number])))
        if best is None or sum(found) < best.sum():
            best = np.array(found)
    if best is None:
        raise ArithmeticError("the remainder feeds itself at every share of delta.")
    return [requirement.label for requirement in asked], best


def quantiles(problem: Problem, paths: int) -> np.ndarray:
    """Simulated quantiles of the largest deviation along the requirements' rows, at an even share of delta each."""
    run = LinearRun(Linearisation.of(problem))
    rows = np.array([requirement.rows[0] for requirement in run.requirements[0]])
    found = sup_deviation(problem, paths=paths, rng=np.random.default_rng(43), measure=Measure(directions=rows))
    level = 1 - problem.delta / len(rows)
    return np.array([found.quantile(level, row=row).value for row in range(len(rows))])


def largest_multiple(delta: float, step: float) -> float:
    """Largest multiple of the noise (up to ``step``) at which the problem is proved SAFE."""
    low, high = 1.0, 5.0
    while high - low > step:
        middle = (low + high) / 2
        problem = cb.load("chain", sigma=SIGMA * middle).replace(delta=delta)
        low, high = (middle, high) if linear_answer(problem).log10_delta <= np.log10(delta) else (low, middle)
    return low


if __name__ == "__main__":
    main("chain_erosions", compute)
