"""Fig. 9: the chain of masses along a certified plan: four constraints, input and cost, 3000 noisy paths.

Parameters and noise level are reconstructed (see ``certbound.problem.models.chain``).
"""

from __future__ import annotations

import math

import numpy as np

import certbound as cb
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
        **feasibility(),
    }
    return arrays, claims


def _bound(verdict, direction: np.ndarray) -> np.ndarray:  # type: ignore[no-untyped-def]
    """The tube's half-width along a direction at each step (0 at the start)."""
    if verdict.tube is not None and hasattr(verdict.tube, "half_widths"):
        return np.abs(direction) @ verdict.tube.half_widths.T
    half = np.abs(direction) @ verdict.deviation.extent.T
    return np.concatenate([[0.0], half])


def feasibility() -> Claims:
    """Which tubes leave the origin inside every constraint, in the common metric that erodes least.

    A plan can only be found where the origin, to which the chain is driven, survives the erosion.
    """
    rest = cb.load("chain_rest")
    known = cb.bound_constants(rest, objective="erosion")
    steps = np.arange(rest.horizon + 1.0)
    rows = {name: np.array(row, dtype=float) for name, (row, _, _) in ROWS.items()}
    room = {name: min(abs(low), abs(high)) for name, (_, low, high) in ROWS.items()}

    def share(delta: float, method: str, **fixed: float) -> float:
        tube = cb.tune_tube(known, horizon=rest.horizon, delta=delta, method=method, **fixed)
        return max(float(np.max(tube.extent(row, steps))) / room[name] for name, row in rows.items())

    markov = share(0.002, "markov")
    return {
        "markov_fits_005": share(0.05, "markov") <= 1,
        "markov_fits_003": share(0.03, "markov") <= 1,
        "markov_share": markov,
        "markov_threshold": 0.002 * markov**2,
        "thm5_share": share(0.002, "thm5", epsilon=15 / 16, step=1),
        "kummer_share": share(0.002, "kummer"),
    }


if __name__ == "__main__":
    main("fig9", compute)
