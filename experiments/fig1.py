"""Fig. 1: set erosion and tubes at several delta, for a planar system in a winding aisle.

A point is steered along y = A sin(w x) at unit speed. Its rate is certified on all of the plane, the tube comes
from it, and the walls are the curve's own, one unit above and below it.
"""

from __future__ import annotations

import numpy as np

import certbound as cb
from certbound.problem.problem import Problem
from experiments.harness import Arrays, Claims, main

AMPLITUDE, FREQUENCY, GAIN, SIGMA, HORIZON = 0.6, 1.1, 2.0, 0.1, 6.0
HALF_WIDTH, DELTA, LEVELS = 0.75, 1e-3, (1e-1, 1e-3, 1e-6)


def path(x: np.ndarray) -> np.ndarray:
    """Centre of the aisle."""
    return AMPLITUDE * np.sin(FREQUENCY * x)


def problem() -> Problem:
    """The steered point (the walls are drawn from the tube alone, so that they need not be convex sets)."""

    def dynamics(t, x):  # type: ignore[no-untyped-def]
        slope = AMPLITUDE * FREQUENCY * np.cos(FREQUENCY * x[0])
        return np.array([1 - GAIN * (x[0] - t), slope - GAIN * (x[1] - AMPLITUDE * np.sin(FREQUENCY * x[0]))])

    system = cb.ContinuousSystem(dynamics, states=["px", "py"], diffusion=SIGMA * np.eye(2))
    frame = cb.Inside(cb.Box([-5.0, -5.0], [15.0, 5.0]))
    return cb.Problem(system, initial=[0.0, 0.0], safe=[frame], horizon=HORIZON, delta=DELTA, name="aisle")


def walls(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper wall."""
    return path(x) - HALF_WIDTH, path(x) + HALF_WIDTH


def distances(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Distance of points (N, 2) to a polyline (M, 2)."""
    start, along = corners[:-1], np.diff(corners, axis=0)
    length = np.sum(along**2, axis=1)
    found = np.full(len(points), np.inf)
    for a, d, size in zip(start, along, length):
        share = np.clip((points - a) @ d / size, 0.0, 1.0)
        found = np.minimum(found, np.linalg.norm(points - a - share[:, None] * d, axis=1))
    return found


def compute(full: bool) -> tuple[Arrays, Claims]:
    """Nominal, walls with the eroded band, tubes at three levels, sample paths."""
    aisle = problem()
    constants = cb.bound_constants(aisle, metric="euclidean")  # the pictures are of Euclidean balls
    tubes = [cb.tune_tube(constants, horizon=HORIZON, delta=level, method="kummer") for level in LEVELS]
    times = np.linspace(0.0, HORIZON, 241)
    count = 2000 if full else 200
    rng = np.random.default_rng(1)
    states = cb.sample_paths(aisle, paths=count, rng=rng, steps=1200, points=240)
    nominal = states - cb.sample_paths(
        aisle, paths=count, rng=np.random.default_rng(1), steps=1200, points=240, deviation=True
    )
    nominal = nominal[0]
    x = np.linspace(-0.8, HORIZON + 0.9, 281)
    low, high = walls(x)
    y = np.linspace(float(low.min()) - 0.4, float(high.max()) + 0.4, 141)
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    fine = np.linspace(x[0] - 1, x[-1] + 1, 400)
    to_wall = np.minimum(*(distances(grid, np.stack([fine, wall], axis=1)) for wall in walls(fine)))
    inside = np.abs(grid[:, 1] - path(grid[:, 0])) < HALF_WIDTH
    radii = np.stack([np.asarray(tube.radius(times)) for tube in tubes])
    clearance = np.minimum(*(distances(nominal, np.stack([fine, wall], axis=1)) for wall in walls(fine)))
    deviations = np.linalg.norm(states - nominal, axis=-1)
    arrays: Arrays = {
        "times": times,
        "nominal": nominal,
        "paths": states[:60].astype(np.float32),
        "x": x,
        "y": y,
        "low": low,
        "high": high,
        "distance": np.where(inside, to_wall, -1.0).reshape(len(y), len(x)).astype(np.float32),
        "radii": radii,
        "levels": np.array(LEVELS),
    }
    claims: Claims = {
        "paths": count,
        "rate": float(constants.rate),
        "certified": bool(constants.certified),
        "radius": float(radii[1].max()),
        "clearance": float(clearance.min()),
        "fits": bool(np.all(radii[1] < clearance)),
        "radii": [float(row.max()) for row in radii],
        "growth": float(radii[-1].max() / radii[0].max()),
        "left": [int((deviations > row).any(axis=1).sum()) for row in radii],
    }
    return arrays, claims


if __name__ == "__main__":
    main("fig1", compute)
