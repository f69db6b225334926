"""Value functions in discrete time: certified bounds of the probability of failing, from both sides, and simulation.

Each row is one problem: the certified upper and lower bound, their ratio, the limits of a simulation (Clopper-Pearson,
99.9 %) from the worst of the initial set's corners and middle, the cells of the finest grid, and the seconds of
processor time for all grids.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable

import numpy as np
from scipy.stats import beta

import certbound as cb
from certbound.problem.model import compile_numpy
from certbound.values.discrete.failures import bound_failure
from experiments.harness import Arrays, Claims, main

__all__ = ["PROBLEMS", "compute", "row", "simulated"]

PATHS = {False: 100_000, True: 400_000}
CHUNK = 100_000
LEVEL = 1e-3


def logistic(noise: cb.Gaussian | cb.Uniform) -> cb.Problem:
    """The logistic map at rate 2.8."""
    system = cb.DiscreteSystem(lambda x: 2.8 * x * (1 - x), states=1, noise=noise)
    return cb.Problem(system, initial=cb.Box([0.6], [0.7]), safe=[cb.Inside(cb.Box([0.35], [0.95]))], horizon=20)


def pendulum(std: float) -> cb.Problem:
    """A damped pendulum with Euler steps of .1, noise on the angle and on the speed."""
    system = cb.DiscreteSystem(
        lambda x: [x[0] + 0.1 * x[1], x[1] - 0.1 * (9.81 * np.sin(x[0]) + 0.8 * x[1])],
        states=["angle", "speed"], noise=cb.Gaussian(std=std),
    )  # fmt: skip
    safe = [cb.Inside(cb.Box([-1.2, -4.0], [1.2, 4.0]))]
    return cb.Problem(system, initial=cb.Box([-0.1, -0.1], [0.1, 0.1]), safe=safe, horizon=20)


def decay(noise: cb.Gaussian | cb.Uniform, safe: list[cb.Inside], start: list[float], horizon: int = 10) -> cb.Problem:
    """x+ = .95 x in the plane."""
    system = cb.DiscreteSystem(lambda x: 0.95 * x, states=2, noise=noise)
    return cb.Problem(system, initial=start, safe=safe, horizon=horizon)


def rooms(std: float = 0.3) -> cb.Problem:
    """Three rooms in a row: walls between them, 5 degrees outside, heaters that steer to 22, a hundred periods."""

    def f(x: np.ndarray) -> list[object]:
        flow = [x[1] - x[0], x[0] + x[2] - 2 * x[1], x[1] - x[2]]
        return [x[k] + 0.08 * flow[k] + 0.02 * (5 - x[k]) + 0.35 * (22 - x[k]) for k in range(3)]

    system = cb.DiscreteSystem(f, states=3, noise=cb.Gaussian(std=std))
    safe = [cb.Inside(cb.Box([19.4] * 3, [22.8] * 3))]
    return cb.Problem(system, initial=cb.Box([20.8] * 3, [21.4] * 3), safe=safe, horizon=100)


SQUARE = cb.Inside(cb.Box([-1.0, -1.0], [2.0, 2.0]))
PROBLEMS: dict[str, Callable[[], cb.Problem]] = {
    "logistic map, std .04": lambda: logistic(cb.Gaussian(std=0.04)),
    "logistic map, std .06": lambda: logistic(cb.Gaussian(std=0.06)),
    "logistic map, uniform .12": lambda: logistic(cb.Uniform(halfwidth=0.12)),
    "pendulum, std .06": lambda: pendulum(0.06),
    "pendulum, std .1": lambda: pendulum(0.1),
    "pendulum, std .15": lambda: pendulum(0.15),
    ".95 x, std .1": lambda: decay(cb.Gaussian(std=0.1), [SQUARE], [0.0, 0.0]),
    ".95 x, correlation .5": lambda: decay(
        cb.Gaussian(covariance=[[0.01, 0.005], [0.005, 0.01]]), [cb.Inside(cb.Box([-1, -1], [1, 1]))], [0.0, 0.0]
    ),
    ".95 x, uniform .2": lambda: decay(cb.Uniform(halfwidth=0.2), [SQUARE], [0.0, 0.0]),
    ".95 x around a ball": lambda: decay(
        cb.Gaussian(std=0.1), [SQUARE, cb.Outside(cb.Ball([0.5, 0.5], 0.4))], [-0.3, -0.3]
    ),
    "three rooms, 100 steps": rooms,
}
QUICK = (".95 x, std .1", "logistic map, std .04", "logistic map, std .06")


def simulated(problem: cb.Problem, paths: int) -> tuple[float, float]:
    """Limits of the probability of failing from the worst of the initial box's corners and middle."""
    low, high = problem.initial.low, problem.initial.high
    starts = {tuple(point) for point in itertools.product(*zip(low, high))} | {tuple((low + high) / 2)}
    step = compile_numpy(problem.closed_loop)
    rng = np.random.default_rng(0)
    worst = 0
    for start in sorted(starts):
        bad = 0
        for _ in range(0, paths, CHUNK):
            x, safe = np.tile(np.array(start), (CHUNK, 1)), np.ones(CHUNK, dtype=bool)
            for t in range(problem.horizon):
                x = step(float(t), *x.T) + problem.system.noise.sample(rng, CHUNK)
                safe &= np.all([constraint.satisfied(x) for constraint in problem.constraints], axis=0)
            bad += int(np.sum(~safe))
        worst = max(worst, bad)
    below = float(beta.ppf(LEVEL / 2, worst, paths - worst + 1)) if worst else 0.0
    return below, float(beta.ppf(1 - LEVEL / 2, worst + 1, paths - worst))


def row(problem: cb.Problem, paths: int, seconds: float) -> dict[str, object]:
    """One row of the table."""
    begun = time.process_time()
    found = bound_failure(problem, seconds=seconds, ratio=1.03)
    spent = time.process_time() - begun
    low, high = simulated(problem, paths)
    return {
        "upper": found.upper, "lower": found.lower, "simulated_low": low, "simulated_high": high,
        "cells": list(found.cells), "seconds": spent,
    }  # fmt: skip


def compute(full: bool) -> tuple[Arrays, Claims]:
    """All rows; without ``full`` three problems and fewer paths."""
    rows = {}
    for name in PROBLEMS if full else QUICK:
        rows[name] = row(PROBLEMS[name](), PATHS[full], 300.0 if full else 20.0)
        cells = " x ".join(str(count) for count in rows[name]["cells"])
        print("{:26} [{lower:.4g}, {upper:.4g}]  simulated [{simulated_low:.4g}, {simulated_high:.4g}]".format(
            name, **rows[name]) + f"  {cells}, {rows[name]['seconds']:.1f} s")  # fmt: skip
    names = ("upper", "lower", "simulated_low", "simulated_high")
    arrays = {key: np.array([rows[name][key] for name in rows]) for key in names}
    claims = {name: {key: value for key, value in found.items() if key != "seconds"} for name, found in rows.items()}
    return arrays, claims


if __name__ == "__main__":
    main("values_discrete", compute)
