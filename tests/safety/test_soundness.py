"""Certified probabilities against 10^5 simulated paths each, on 40 random nonlinear systems (slow, run on purpose)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import binom

import certbound as cb
from certbound.problem.model.evaluation import compile_numpy

Array = NDArray[np.float64]

SYSTEMS, PATHS = 40, 100_000


def random_dynamics(rng: np.random.Generator, n: int, discrete: bool) -> Callable[..., Any]:
    """A stable linear part plus polynomial, trigonometric and tanh terms."""
    matrix = rng.normal(size=(n, n)) / np.sqrt(n)
    shift = max(np.linalg.eigvals(matrix).real.max(), 0.0) + rng.uniform(0.2, 1.0)
    matrix = matrix - shift * np.eye(n)
    first, second, third = rng.normal(size=(3, n, n)) * 0.3
    scale = rng.uniform(0.1, 0.6, 3)

    def f(t: Any, x: Any) -> Any:
        bend = scale[0] * np.sin(first @ x) + scale[1] * np.tanh(second @ x) + scale[2] * (third @ x) * x
        drift = matrix @ x + bend
        return x + 0.1 * drift if discrete else drift

    return f


def boundless_problem(index: int) -> cb.Problem:
    """Problem number ``index`` in a box that no path leaves."""
    rng = np.random.default_rng([7, index])
    n, discrete = 1 + index % 4, index % 2 == 1
    f = random_dynamics(rng, n, discrete)
    sigma = rng.uniform(0.02, 0.12)
    start = rng.uniform(-0.4, 0.4, n)
    system: Any
    if discrete:
        system = cb.DiscreteSystem(f, states=n, noise=cb.Gaussian(std=0.3 * sigma))
        horizon: float = 20
    else:
        system = cb.ContinuousSystem(f, states=n, diffusion=sigma * (np.eye(n) + 0.3 * rng.normal(size=(n, n))))
        horizon = 2.0
    initial = cb.Box(start - 0.02, start + 0.02)
    return cb.Problem(
        system, initial=initial, safe=[cb.Inside(cb.Box([-50.0] * n, [50.0] * n))], horizon=horizon, delta=1e-2
    )


def random_problem(index: int) -> cb.Problem:
    """The same in a box that roughly 3 paths in 10^4 leave."""
    wide = boundless_problem(index)
    paths = cb.sample_paths(wide, paths=4000, rng=np.random.default_rng(index))
    low, high = paths.min(axis=1), paths.max(axis=1)
    middle = (low.mean(axis=0) + high.mean(axis=0)) / 2
    spread = np.maximum(np.quantile(high, 0.998, axis=0) - middle, middle - np.quantile(low, 0.002, axis=0))
    half = 1.2 * spread
    return wide.replace(safe=[cb.Inside(cb.Box(middle - half, middle + half))])


def test_random_dynamics_trace_to_what_they_compute() -> None:
    for index in range(4):
        problem = boundless_problem(index)
        x = np.random.default_rng(0).uniform(-1, 1, problem.system.dimension)
        f = random_dynamics(np.random.default_rng([7, index]), problem.system.dimension, index % 2 == 1)
        value = np.asarray(compile_numpy(problem.closed_loop)(0.0, *x))
        np.testing.assert_allclose(value, f(0.0, x), rtol=1e-12)


@pytest.mark.slow
def test_no_certified_probability_is_contradicted_by_simulation() -> None:
    certified, eligible, lines = 0, 0, []
    for index in range(SYSTEMS):
        problem = random_problem(index)
        verdict = cb.verify_safety(problem)
        found = cb.simulate_exits(problem, paths=PATHS, rng=np.random.default_rng([11, index]), halve=False)
        bound = 10**verdict.log10_delta
        lines.append(
            f"{index:2d} n={problem.system.dimension} {problem.system.time:10s} {verdict.status:7s} "
            f"{verdict.method:8s} bound {bound:.3g} simulated {found.probability:.3g}"
        )
        assert binom.sf(found.exits - 1, PATHS, bound) >= 1e-6, lines[-1]
        if found.probability <= 1e-3:
            eligible += 1
            certified += verdict.status == "SAFE"
    print("\n".join(lines))  # noqa: T201  (the report of a slow test)
    print(f"{certified} of {eligible} certified")  # noqa: T201
    assert eligible >= 30
    assert certified >= 30
