"""Small problems that every engine is asked: none takes more than a moment, each has something of its own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import certbound as cb

__all__ = ["ZOO"]

Noise = cb.Gaussian


def _steps(f: Any, n: int, noise: Any, start: Any, safe: Any, horizon: int, **options: Any) -> cb.Problem:
    system = cb.DiscreteSystem(f, states=n, noise=noise, disturbance=options.pop("disturbance", None))
    return cb.Problem(system, initial=start, safe=_constraints(safe), horizon=horizon, **options)


def _flow(f: Any, n: int, g: Any, start: Any, safe: Any, horizon: float, **options: Any) -> cb.Problem:
    system = cb.ContinuousSystem(f, states=n, diffusion=g, disturbance=options.pop("disturbance", None))
    return cb.Problem(system, initial=start, safe=_constraints(safe), horizon=horizon, **options)


def _constraints(safe: Any) -> list[Any]:
    return safe if isinstance(safe, list) else [cb.Inside(safe)]


ZOO: dict[str, Callable[[float, float], cb.Problem]] = {
    "walk": lambda s, T: _steps(lambda x: x, 1, Noise(std=0.1 * s), [0.0], cb.Box([-1], [1]), int(6 * T)),
    "decay": lambda s, T: _steps(lambda x: 0.5 * x, 1, Noise(std=0.2 * s), [0.5], cb.Box([-1], [1]), int(5 * T)),
    "logistic": lambda s, T: _steps(
        lambda x: 2.8 * x * (1 - x), 1, Noise(std=0.03 * s), cb.Box([0.6], [0.65]), cb.Box([0.35], [0.95]), int(4 * T)
    ),
    "sine": lambda s, T: _steps(
        lambda x: 0.8 * np.sin(x), 1, Noise(std=0.1 * s), cb.Box([-0.1], [0.1]), cb.HalfSpace([1.0], 0.8), int(5 * T)
    ),
    "uniform": lambda s, T: _steps(
        lambda x: 0.7 * x, 1, cb.Uniform(halfwidth=0.2 * s), [0.0], cb.Box([-0.6], [0.6]), int(5 * T)
    ),
    "coins": lambda s, T: _steps(
        lambda x: 0.7 * x, 1, cb.Rademacher(scale=0.1 * s), [0.0], cb.Box([-0.6], [0.6]), int(5 * T)
    ),
    "pushed": lambda s, T: _steps(
        lambda x, d: 0.5 * x + d, 1, Noise(std=0.1 * s), [0.0], cb.Box([-1], [1]), int(5 * T),
        disturbance=cb.Box([-0.1], [0.1]),
    ),
    "spiral": lambda s, T: _steps(
        lambda x: [0.8 * x[0] - 0.4 * x[1], 0.4 * x[0] + 0.8 * x[1]], 2, Noise(std=0.05 * s), [0.4, 0.0],
        cb.Box([-1, -1], [1, 1]), int(4 * T),
    ),
    "swing": lambda s, T: _steps(
        lambda x: [x[0] + 0.1 * x[1], x[1] - 0.5 * np.sin(x[0])], 2, Noise(std=0.05 * s), [0.2, 0.0],
        cb.Box([-1, -2], [1, 2]), int(5 * T),
    ),
    "post": lambda s, T: _steps(
        lambda x: [x[0] + 0.2, 0.9 * x[1]], 2, Noise(std=0.05 * s), [0.0, 0.0],
        [cb.Outside(cb.Ball([0.5, 0.6], 0.3))], int(4 * T),
    ),
    "relaxation": lambda s, T: _flow(lambda x: -x, 1, 0.3 * s, [0.0], cb.Box([-1], [1]), 1.0 * T),
    "double_well": lambda s, T: _flow(
        lambda x: x - x**3, 1, 0.25 * s, cb.Box([0.95], [1.05]), cb.Box([0.0], [2.5]), 1.0 * T
    ),
    "brownian": lambda s, T: _flow(lambda x: 0 * x, 1, 0.2 * s, [0.0], cb.Box([-1], [1]), 1.0 * T),
    "prices": lambda s, T: _flow(
        lambda x: -0.1 * x, 1, lambda x: [[0.2 * s * x[0]]], [1.0], cb.Box([0.3], [2.5]), 1.0 * T
    ),
    "leaning": lambda s, T: _flow(
        lambda x, d: -x + d, 1, 0.2 * s, [0.0], cb.HalfSpace([1.0], 1.0), 1.0 * T, disturbance=cb.Box([-0.2], [0.2])
    ),
    "window": lambda s, T: _flow(
        lambda x: -x, 1, 0.2 * s, [0.8], [cb.Inside(cb.Box([-0.9], [0.9]), during=(0.2, 0.2 + 0.3 * T))], 1.0 * T
    ),
    "pendulum": lambda s, T: _flow(
        lambda x: [x[1], -np.sin(x[0]) - 0.5 * x[1]], 2, s * np.array([[0.0], [0.1]]), [0.2, 0.0],
        cb.Box([-1.0, -1.5], [1.0, 1.5]), 1.0 * T,
    ),
    "circle": lambda s, T: _flow(
        lambda x: [-x[1], x[0]], 2, 0.1 * s * np.eye(2), [0.3, 0.0], cb.Ball([0.0, 0.0], 1.0), 1.0 * T
    ),
    "random_start": lambda s, T: _flow(
        lambda x: -x, 1, 0.1 * s, cb.GaussianStart([0.0], [[0.01]]), cb.Box([-1], [1]), 1.0 * T
    ),
    "spring": lambda s, T: _flow(
        lambda x: [x[1], -x[0] - x[0] ** 3 - x[1]], 2, s * np.array([[0.0], [0.2]]), [0.2, 0.0],
        cb.Box([-1.5, -1.5], [1.5, 1.5]), 1.0 * T,
    ),
}  # fmt: skip
"""By name: (noise, horizon) as factors, each in (0, 1], to the problem; delta is the default, 1e-3."""
