"""Fig. K2: how much each method takes from the four constraints of the chain at rest, delta = 0.002, 50 steps.

Markov, Theorem 5 and Kummer tubes bound all directions at once in the common metric that erodes least; metrics of
their own share delta between the constraints; linear response and simulation look at one constraint at a time.
"""

from __future__ import annotations

import numpy as np

import certbound as cb
from certbound.problem.problem import Problem
from certbound.simulation.estimates.deviations import Measure, sup_deviation
from experiments.harness import Arrays, Claims, main

ROWS = {
    "p1": [-1, 0, 0, 0, 0, 0],
    "dp21": [1, -1, 0, 0, 0, 0],
    "dp32": [0, 1, -1, 0, 0, 0],
    "v3": [0, 0, 0, 0, 0, 1],
}
ROOMS = (1.2, 1.2, 1.2, 2.0)
DELTA = 0.002
METHODS = ("markov", "thm5", "kummer", "own", "linear", "simulated")


def compute(full: bool) -> tuple[Arrays, Claims]:
    """Erosions, shape (methods, constraints)."""
    problem = cb.load("chain_rest")
    rows = np.array(list(ROWS.values()), dtype=float)
    common = cb.bound_constants(problem, objective="erosion")
    found = {
        "markov": erosions(problem, common, rows, DELTA, method="markov"),
        "thm5": erosions(problem, common, rows, DELTA, method="thm5", epsilon=15 / 16, step=1),
        "kummer": erosions(problem, common, rows, DELTA, method="kummer"),
        "own": own_metrics(problem, rows),
    }
    paths = 1_000_000 if full else 100_000
    measure = Measure(directions=rows)
    simulated = sup_deviation(problem, paths=paths, rng=np.random.default_rng(12), measure=measure)
    found["simulated"] = [simulated.quantile(1 - DELTA, row=index).value for index in range(len(rows))]
    halvings = 6 if full else 3
    found["linear"] = [smallest_limit(problem, *pair, halvings) for pair in zip(rows, found["simulated"])]
    table = np.array([found[method] for method in METHODS])
    claims: Claims = {method: [float(value) for value in row] for method, row in zip(METHODS, table)}
    claims["paths"] = paths
    claims["linear_over_simulated"] = float(np.max(table[-2] / table[-1]))
    claims["thm5_over_linear"] = float(np.min(table[1] / table[-2]))
    claims["markov_fits"] = bool(np.all(table[0] < ROOMS))
    claims["thm5_fits"] = bool(np.all(table[1] < ROOMS))
    return {"erosions": table, "rooms": np.array(ROOMS)}, claims


def erosions(
    problem: Problem, known: cb.Constants, rows: np.ndarray, delta: float, method: str, **fixed: float
) -> list[float]:
    """Largest extent of one tube along each row."""
    tube = cb.tune_tube(known, horizon=problem.horizon, delta=delta, method=method, **fixed)
    steps = np.arange(problem.horizon + 1.0)
    return [float(np.max(tube.extent(row, steps))) for row in rows]


def own_metrics(problem: Problem, rows: np.ndarray) -> list[float]:
    """A metric for each constraint, with a quarter of delta."""
    metrics = cb.bound_metrics(problem)
    share = DELTA / len(rows)
    return [erosions(problem, known, row[None], share, method="auto")[0] for row, known in zip(rows, metrics)]


def smallest_limit(problem: Problem, row: np.ndarray, quantile: float, halvings: int) -> float:
    """Smallest b for which row . x <= b alone is certified at delta by the linear response, sought above a quantile."""

    def safe(bound: float) -> bool:
        alone = problem.replace(safe=[cb.Inside(cb.HalfSpace(row, bound))])
        return cb.verify_safety(alone, method="linear").status == "SAFE"

    low, high = quantile, 1.25 * quantile
    while not safe(high):
        low, high = high, 1.25 * high
    for _ in range(halvings):
        middle = (low + high) / 2
        low, high = (low, middle) if safe(middle) else (middle, high)
    return high


if __name__ == "__main__":
    main("figk2", compute)
