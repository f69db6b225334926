"""Fig. K5: value functions from both sides beside simulation, over the noise level, for four problems.

A double well and a reversed Van der Pol oscillator in continuous time, the logistic map and a pendulum in discrete
time, each from one start. The engine makes one attempt on a grid that does not depend on the clock, so that the
numbers are the same on every machine.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

import certbound as cb
from certbound.values.continuous import bound_exits
from certbound.values.discrete import bound_failure
from experiments.harness import Arrays, Claims, main
from experiments.values_discrete import logistic, pendulum

QUICK = {
    "well": (0.25, 0.35, 0.5), "oscillator": (0.3, 0.45), "logistic": (0.035, 0.04, 0.05), "pendulum": (0.12, 0.15)
}  # fmt: skip
FULL = {
    "well": (0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6),
    "oscillator": (0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5),
    "logistic": (0.025, 0.03, 0.035, 0.04, 0.045, 0.05, 0.06),
    "pendulum": (0.05, 0.06, 0.08, 0.1, 0.12, 0.15, 0.18),
}
CONFIDENCE = 0.99
ONE_ATTEMPT = 1e-3  # seconds: the first attempt is made in any case
NO_LIMIT = 1e6


def well(sigma: float) -> cb.Problem:
    """dx = (x - x^3) dt + sigma dW from the bottom of the right well."""
    system = cb.ContinuousSystem(lambda x: [x[0] - x[0] ** 3], states=1, diffusion=sigma)
    return cb.Problem(system, initial=[1.0], safe=[cb.Inside(cb.Box([0], [2.5]))], horizon=10)


def oscillator(sigma: float) -> cb.Problem:
    """A Van der Pol oscillator that runs backward: the origin attracts what starts near it."""
    system = cb.ContinuousSystem(
        lambda x: [-x[1], x[0] + (x[0] ** 2 - 1) * x[1]], states=2, diffusion=sigma * np.eye(2)
    )
    safe = [cb.Inside(cb.Box([-1.2, -1.2], [1.2, 1.2]))]
    return cb.Problem(system, initial=[0.0, 0.0], safe=safe, horizon=5)


PROBLEMS: dict[str, Callable[[float], cb.Problem]] = {
    "well": well,
    "oscillator": oscillator,
    "logistic": lambda sigma: logistic(cb.Gaussian(std=sigma)).replace(initial=[0.7]),
    "pendulum": lambda sigma: pendulum(sigma).replace(initial=[0.1, 0.1]),
}


def compute(full: bool) -> tuple[Arrays, Claims]:
    """Bounds, shape (levels,), and the limits of a simulation for every problem; nan where there is no lower bound."""
    paths = 200_000 if full else 20_000
    arrays: Arrays = {}
    for name, levels in (FULL if full else QUICK).items():
        rows = np.array([row(PROBLEMS[name](sigma), paths, full) for sigma in levels])
        arrays[f"{name}_sigma"] = np.array(levels)
        for column, part in enumerate(("upper", "lower", "simulated_low", "simulated_high")):
            arrays[f"{name}_{part}"] = rows[:, column]
    claims: Claims = {"paths": paths, "confidence": CONFIDENCE}
    claims["consistent"] = all(
        bool(np.all(arrays[f"{name}_upper"] >= arrays[f"{name}_simulated_low"])
             and not np.any(arrays[f"{name}_lower"] > arrays[f"{name}_simulated_high"]))
        for name in PROBLEMS
    )  # fmt: skip
    for name in PROBLEMS:
        upper, lower = arrays[f"{name}_upper"], arrays[f"{name}_lower"]
        claims[f"{name}_ratio"] = None if np.isnan(lower).any() else round(float(np.max(upper / lower)), 4)
    seen = arrays["oscillator_simulated_low"] > 0
    claims["oscillator_over"] = round(
        float(np.max((arrays["oscillator_upper"] / arrays["oscillator_simulated_high"])[seen])), 3
    )
    return arrays, claims


def row(problem: cb.Problem, paths: int, full: bool) -> tuple[float, float, float, float]:
    """Upper and lower bound, and the limits of the simulation."""
    if problem.system.time == "discrete":
        steps = bound_failure(problem, seconds=NO_LIMIT, ratio=1.02 if full else 1.15)
        upper, lower = steps.upper, steps.lower
    else:
        deep = full and problem.system.dimension == 1
        found = bound_exits(problem, seconds=NO_LIMIT if deep else ONE_ATTEMPT)
        upper, lower = 10.0**found.upper, np.nan if found.lower is None else 10.0**found.lower
    counts = cb.simulate_exits(problem, paths=paths, rng=np.random.default_rng(5), confidence=CONFIDENCE)
    return upper, lower, counts.lower, counts.upper


if __name__ == "__main__":
    main("figk5", compute)
