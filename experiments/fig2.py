"""Fig. 2: |X_t| of the linear system and Theorem 2's tube, for c = 1, 0, -1 (T = 2) and c = -1 (T = 0.02)."""

from __future__ import annotations

import numpy as np

from experiments.harness import Arrays, Claims, main
from experiments.linear import limit, paths, tube

CASES = (("a", 1.0, 2.0), ("b", 0.0, 2.0), ("c", -1.0, 2.0), ("d", -1.0, 0.02))
POINTS = 240


def compute(full: bool) -> tuple[Arrays, Claims]:
    """Paths and radii of the four panels."""
    count = 5000 if full else 500
    arrays: Arrays = {}
    claims: Claims = {"paths": count}
    for seed, (name, rate, horizon) in enumerate(CASES):
        times, values = paths(rate, horizon, count=count, points=POINTS, seed=2 + seed)
        deviations = np.abs(values)
        tubes = {
            "paper": tube("thm2", rate, horizon, epsilon=15 / 16),
            "printed": tube("thm2", rate, horizon, epsilon=1 / 16),
            "kummer": tube("auto", rate, horizon),
            "exact": limit(rate, horizon),
        }
        arrays[f"{name}_times"] = times
        arrays[f"{name}_paths"] = deviations.astype(np.float32)
        for key, one in tubes.items():
            radius = np.asarray(one.radius(times))
            arrays[f"{name}_{key}"] = radius
            claims[f"{name}_{key}_largest"] = float(radius.max())
            claims[f"{name}_{key}_left"] = int((deviations > radius).any(axis=1).sum())
        claims[f"{name}_method"] = tubes["kummer"].method
        for key in ("paper", "printed", "kummer"):
            claims[f"{name}_{key}_ratio"] = claims[f"{name}_{key}_largest"] / claims[f"{name}_exact_largest"]
    return arrays, claims


if __name__ == "__main__":
    main("fig2", compute)
