"""Fig. 9: the chain of masses under predictive control tightened by Theorem 5: constraints, input, cost, noisy paths.

Parameters and noise level are reconstructed (see ``certbound.problem.library.chain``).
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
EPSILON = 15 / 16


def compute(full: bool) -> tuple[Arrays, Claims]:
    """The plan of the predictive control, its paths, both tubes around it, and which methods leave a plan at all."""
    chain = cb.load("chain")
    planned = cb.synthesize_plan(chain, method="thm5", epsilon=EPSILON, step=1)
    problem = planned.problem
    verdict = cb.verify_safety(problem)
    count = 3000 if full else 600
    states = cb.sample_paths(problem, paths=count, rng=np.random.default_rng(9))
    plan = planned.plan
    steps = np.arange(problem.horizon + 1.0)
    arrays: Arrays = {"steps": steps}
    for name, (row, low, high) in ROWS.items():
        direction = np.array(row, dtype=float)
        arrays[name] = (states @ direction).astype(np.float32)
        arrays[f"{name}_nominal"] = planned.states @ direction
        arrays[f"{name}_thm5"] = np.asarray(planned.verdict.tube.extent(direction, steps))
        arrays[f"{name}_bound"] = _bound(verdict, direction, planned.states @ direction, low, high)
        arrays[f"{name}_limit"] = np.array(low if np.isfinite(low) else high)
    arrays["input"] = np.abs(plan).max(axis=1)
    inputs = np.sum(plan**2, axis=1) * INPUT_WEIGHT
    arrays["cost"] = (np.sum(states[:, :-1] ** 2, axis=-1) + inputs).astype(np.float32)
    exits = cb.simulate_exits(problem, paths=3000, rng=np.random.default_rng(90))
    claims: Claims = {
        "paths": count,
        "fits": planned.scale >= 1,
        "planned_status": planned.status,
        "status": verdict.status,
        "method": verdict.method,
        "log10_delta": verdict.log10_delta,
        "violations": exits.exits,
        "largest_input": float(np.abs(plan).max()),
        "final_cost": float(arrays["cost"][:, -1].mean()),
        "sigma": float(chain.parameters["sigma"]),
        "markov_fits_005": markov_fits(0.05),
        "markov_fits_003": markov_fits(0.03),
        **feasibility(),
    }
    return arrays, claims


def _bound(  # type: ignore[no-untyped-def]
    verdict, direction: np.ndarray, nominal: np.ndarray, low: float, high: float
) -> np.ndarray:
    """What the engine certifies along the constraint's own direction at each step (0 at the start).

    It is the room along the nominal less the room that is left: all constraints keep theirs at once but for delta.
    """
    details = verdict.answers["linear"].details
    sign, limit = (1.0, high) if np.isfinite(high) else (-1.0, low)
    for asked, left in details.rooms:
        if np.array_equal(asked.rows[0], sign * direction):
            return np.asarray(sign * (limit - nominal) - left)
    raise ValueError(f"no constraint is along {direction}.")


def markov_fits(delta: float) -> bool:
    """Whether the predictive control finds a plan inside the set that the Markov tube leaves."""
    return cb.synthesize_plan(cb.load("chain").replace(delta=delta), method="markov").scale >= 1


def feasibility() -> Claims:
    """Which tubes leave the origin inside every constraint, in the common metric that erodes least.

    A plan that ends near the origin can only be found where the origin survives the erosion.
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
        "markov_share": markov,
        "markov_threshold": 0.002 * markov**2,
        "thm5_share": share(0.002, "thm5", epsilon=EPSILON, step=1),
        "thm5_printed_share": share(0.002, "thm5", epsilon=1 / 16, step=1),
        "kummer_share": share(0.002, "kummer"),
    }


if __name__ == "__main__":
    main("fig9", compute)
