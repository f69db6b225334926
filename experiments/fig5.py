"""Fig. 5: Theorem 3's radius over t for four windows, and over the window at four times (c = -0.5, T = 5)."""

from __future__ import annotations

import numpy as np

from experiments.harness import Arrays, Claims, main
from experiments.linear import limit, tube

RATE, HORIZON, EPSILON = -0.5, 5.0, 15 / 16
WINDOWS = (0.0005, 0.005, 0.05, 0.5)
INSTANTS = (0.5, 1.0, 2.0, 5.0)


def compute(full: bool) -> tuple[Arrays, Claims]:
    """Left: radius over time. Right: radius over the window, as proved (whole windows) and as printed."""
    times = np.linspace(0.0, HORIZON, 501)
    steps = np.geomspace(1e-4, 0.3, 241 if full else 121)
    arrays: Arrays = {
        "times": times,
        "steps": steps,
        "windows": np.array(WINDOWS),
        "instants": np.array(INSTANTS),
    }
    arrays["left"] = np.stack(
        [tube("thm3", RATE, HORIZON, epsilon=EPSILON, step=step).radius(times) for step in WINDOWS]
    )
    for key, method in (("right", "thm3"), ("right_printed", "thm3_as_printed")):
        radii = [
            tube(method, RATE, HORIZON, epsilon=EPSILON, step=float(step)).radius(np.array(INSTANTS)) for step in steps
        ]
        arrays[key] = np.stack(radii, axis=1)
    best = tube("thm3", RATE, HORIZON)
    kummer, exact = tube("kummer", RATE, HORIZON), limit(RATE, HORIZON)
    arrays["kummer"] = np.asarray(kummer.radius(times))
    arrays["kummer_instants"] = np.asarray(kummer.radius(np.array(INSTANTS)))
    arrays["exact"] = np.asarray(exact.radius(times))
    final = arrays["right_printed"][-1]
    claims: Claims = {
        "best_window": float(steps[np.argmin(final)]),
        "best_final": float(final.min()),
        "smallest_window_final": float(final[0]),
        "tuned_epsilon": float(best.parameters["epsilon"]),
        "tuned_step": float(best.parameters["step"]),
        "tuned_largest": float(best.bound(0.0, HORIZON)),
        "kummer_final": float(kummer.radius(HORIZON)),
        "exact_largest": float(arrays["exact"].max()),
    }
    return arrays, claims


if __name__ == "__main__":
    main("fig5", compute)
