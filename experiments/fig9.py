"""Fig. 9: the chain of masses along a certified plan: four constraints, input and cost, 3000 noisy paths.

Parameters and noise level are reconstructed (see ``certbound.problem.models.chain``).
"""

from __future__ import annotations

import math

import numpy as np

import certbound as cb
from certbound.errors import CertboundError
from certbound.problem.problem import Problem
from experiments.harness import Arrays, Claims, main

ROWS = {
    "p1": ([1, 0, 0, 0, 0, 0], -1.2, math.inf),
    "dp21": ([-1, 1, 0, 0, 0, 0], -1.2, math.inf),
    "dp32": ([0, -1, 1, 0, 0, 0], -1.2, math.inf),
    "v3": ([0, 0, 0, 0, 0, 1], -math.inf, 2.0),
}
INPUT_WEIGHT = 1e-4


def compute(full: bool) -> tuple[Arrays, Claims]:
    """Paths of the six panels, the tube's bounds, and which methods find the plan safe."""
    problem = cb.load("chain")
    verdict = cb.verify_safety(problem)
    count = 3000 if full else 600
    states = cb.sample_paths(problem, paths=count, rng=np.random.default_rng(9))
    quiet = cb.sample_paths(cb.load("chain", sigma=1e-12), paths=1, rng=np.random.default_rng(9))[0]
    plan = problem.input_sequence
    arrays: Arrays = {"steps": np.arange(problem.horizon + 1)}
    for name, (row, low, high) in ROWS.items():
        direction = np.array(row, dtype=float)
        arrays[name] = (states @ direction).astype(np.float32)
        arrays[f"{name}_nominal"] = quiet @ direction
        arrays[f"{name}_bound"] = _bound(verdict, direction)
        arrays[f"{name}_limit"] = np.array(low if np.isfinite(low) else high)
    arrays["input"] = np.abs(plan).max(axis=1)
    inputs = np.sum(plan**2, axis=1) * INPUT_WEIGHT
    arrays["cost"] = (np.sum(states[:, :-1] ** 2, axis=-1) + inputs).astype(np.float32)
    exits = cb.simulate_exits(problem, paths=3000, rng=np.random.default_rng(90))
    claims: Claims = {
        "paths": count,
        "status": verdict.status,
        "log10_delta": verdict.log10_delta,
        "violations": exits.exits,
        "largest_input": float(np.abs(plan).max()),
        "final_cost": float(arrays["cost"][:, -1].mean()),
        "sigma": float(problem.parameters["sigma"]),
        "markov_005": fits(problem, 0.05, "markov"),
        "markov_003": fits(problem, 0.03, "markov"),
        "markov_002": fits(problem, 0.002, "markov"),
        "thm5_002": fits(problem, 0.002, "thm5"),
        "kummer_002": fits(problem, 0.002, "kummer"),
    }
    return arrays, claims


def _bound(verdict, direction: np.ndarray) -> np.ndarray:  # type: ignore[no-untyped-def]
    """The tube's half-width along a direction at each step (0 at the start)."""
    if verdict.tube is not None and hasattr(verdict.tube, "half_widths"):
        return np.abs(direction) @ verdict.tube.half_widths.T
    half = np.abs(direction) @ verdict.deviation.extent.T
    return np.concatenate([[0.0], half])


def fits(problem: Problem, delta: float, method: str) -> bool:
    """Whether the nominal stays in the set eroded by one method's tube in the best common metric."""
    try:
        verdict = cb.verify_safety(problem.replace(delta=delta), method=method)
    except CertboundError:
        return False
    return verdict.margin is not None and verdict.margin >= 0


if __name__ == "__main__":
    main("fig9", compute)
