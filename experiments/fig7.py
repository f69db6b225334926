"""Fig. 7: the smallest safe interval [-R, R] of the linear system with c = -1, against 1/delta (T = 2 and 5).

Eq. (R >=) with Dt = 0.01 and (eps1, eps2) = (2 log 2, 2), the top delta quantile of simulated paths, the
Kummer tube and the exact limit.
"""

from __future__ import annotations

import numpy as np

from experiments.harness import Arrays, Claims, main
from experiments.linear import largest_deviations, limit, tube

RATE, WINDOW = -1.0, 0.01
HORIZONS = {"left": 2.0, "right": 5.0}
EXPONENTS = (1, 2, 3, 4, 5)


def compute(full: bool) -> tuple[Arrays, Claims]:
    """Radii at delta = 1e-1 ... 1e-5, and at a finer grid for the curves."""
    count = 3_000_000 if full else 200_000
    grid = np.linspace(1.0, 5.0, 33 if full else 17)
    arrays: Arrays = {"exponents": grid, "decades": np.array(EXPONENTS)}
    claims: Claims = {"paths": count}
    for seed, (side, horizon) in enumerate(HORIZONS.items()):
        methods = {"paper": ("thm3_cosh", {"step": WINDOW}), "kummer": ("kummer", {})}
        for key, (method, fixed) in methods.items():
            tubes = [tube(method, RATE, horizon, delta=10.0**-x, **fixed) for x in grid]
            values = np.array([one.bound(0.0, horizon) for one in tubes])
            arrays[f"{side}_{key}"] = values
            claims[f"{side}_{key}"] = [float(np.interp(x, grid, values)) for x in EXPONENTS]
        exact = np.array([limit(RATE, horizon, delta=10.0**-x).maximum for x in grid])
        arrays[f"{side}_exact"] = exact
        claims[f"{side}_exact"] = [float(np.interp(x, grid, exact)) for x in EXPONENTS]
        largest = np.sort(largest_deviations(RATE, horizon, count=count, steps=round(horizon * 100), seed=70 + seed))
        ranks = np.minimum(np.ceil(count * (1 - 10.0**-grid)).astype(int), count - 1)
        seen = 10.0**-grid * count >= 10
        arrays[f"{side}_simulated"] = np.where(seen, largest[ranks], np.nan)
        claims[f"{side}_simulated"] = [
            float(largest[min(int(np.ceil(count * (1 - 10.0**-x))), count - 1)]) for x in (1, 2, 3)
        ]
        claims[f"{side}_simulated_over_exact"] = max(
            abs(a / b - 1) for a, b in zip(claims[f"{side}_simulated"], claims[f"{side}_exact"])
        )
    return arrays, claims


if __name__ == "__main__":
    main("fig7", compute)
