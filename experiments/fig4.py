"""Fig. 4: c = -0.5, T = 5: Theorem 2 against Theorem 3 with windows of 0.05, and the Kummer tube."""

from __future__ import annotations

import math

import numpy as np

from experiments.harness import Arrays, Claims, main
from experiments.linear import limit, paths, tube

RATE, HORIZON, WINDOW = -0.5, 5.0, 0.05
POINTS = 300


def compute(full: bool) -> tuple[Arrays, Claims]:
    """Paths and radii of the two panels, and the two numbers of the paragraph above the figure."""
    count = 5000 if full else 500
    times, values = paths(RATE, HORIZON, count=count, points=POINTS, seed=4)
    deviations = np.abs(values)
    tubes = {
        "thm2": tube("thm2", RATE, HORIZON, epsilon=15 / 16),
        "thm2_printed": tube("thm2", RATE, HORIZON, epsilon=1 / 16),
        "thm3": tube("thm3", RATE, HORIZON, epsilon=15 / 16, step=WINDOW),
        "thm3_printed": tube("thm3", RATE, HORIZON, epsilon=1 / 16, step=WINDOW),
        "kummer": tube("kummer", RATE, HORIZON),
        "exact": limit(RATE, HORIZON),
    }
    arrays: Arrays = {"times": times, "paths": deviations.astype(np.float32)}
    claims: Claims = {"paths": count}
    for key, one in tubes.items():
        radius = np.asarray(one.radius(times))
        arrays[key] = radius
        claims[f"{key}_largest"] = float(radius.max())
        claims[f"{key}_final"] = float(radius[-1])
        claims[f"{key}_left"] = int((deviations > radius).any(axis=1).sum())
    for key in ("thm2", "thm3", "kummer"):
        claims[f"{key}_ratio"] = claims[f"{key}_largest"] / claims["exact_largest"]
    claims["thm2_over_thm3"] = claims["thm2_largest"] / claims["thm3_largest"]
    claims["growth_thm2"] = math.exp(0.5 * 10)
    claims["growth_thm3"] = math.exp(0.5 * 0.05) + math.sqrt(math.log(10 / 0.05))
    claims["root_log_1e6"] = math.sqrt(math.log(1e6))
    return arrays, claims


if __name__ == "__main__":
    main("fig4", compute)
