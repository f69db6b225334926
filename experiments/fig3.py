"""Fig. 3: how Theorem 3 is put together: one-time bounds at window ends, Theorem 2 inside each window.

c = -0.5, T = 3, windows of 0.5 (wide enough to be seen), sigma^2 = 0.1, delta = 1e-3, eps = 15/16.
"""

from __future__ import annotations

import math

import numpy as np

from experiments.harness import Arrays, Claims, main
from experiments.linear import DELTA, paths, tube

RATE, HORIZON, WINDOW, EPSILON = -0.5, 3.0, 0.5, 15 / 16


def compute(full: bool) -> tuple[Arrays, Claims]:
    """The curves of the strategy: every one has its share of delta, as in the proof."""
    windows = math.ceil(HORIZON / WINDOW)
    share = DELTA / (2 * windows)
    times = np.linspace(0.0, HORIZON, 601)
    inside = np.linspace(0.0, WINDOW, 61)
    one_time = tube("prop1", RATE, HORIZON, delta=share, epsilon=EPSILON)
    window = tube("thm2", RATE, WINDOW, delta=share, epsilon=EPSILON)
    thm3 = tube("thm3", RATE, HORIZON, epsilon=EPSILON, step=WINDOW)
    starts = WINDOW * np.arange(windows)
    at_starts = np.asarray(one_time.radius(starts))
    within = at_starts[:, None] * np.exp(RATE * inside) + np.asarray(window.radius(inside))
    path_times, values = paths(RATE, HORIZON, count=2000 if full else 300, points=300, seed=3)
    arrays: Arrays = {
        "times": times,
        "one_time": np.asarray(one_time.radius(times)),
        "thm2": np.asarray(tube("thm2", RATE, HORIZON, epsilon=EPSILON).radius(times)),
        "thm3": np.asarray(thm3.radius(times)),
        "kummer": np.asarray(tube("kummer", RATE, HORIZON).radius(times)),
        "starts": starts,
        "at_starts": at_starts,
        "inside": inside,
        "window": np.asarray(window.radius(inside)),
        "within": within,
        "path_times": path_times,
        "paths": np.abs(values).astype(np.float32),
    }
    reach = np.interp(starts[:, None] + inside, times, arrays["thm3"])
    claims: Claims = {
        "windows": windows,
        "share": share,
        "strategy_below_thm3": bool(np.all(within <= reach * (1 + 1e-9))),
        "thm3_largest": float(arrays["thm3"].max()),
        "kummer_largest": float(arrays["kummer"].max()),
        "thm2_largest": float(arrays["thm2"].max()),
    }
    return arrays, claims


if __name__ == "__main__":
    main("fig3", compute)
