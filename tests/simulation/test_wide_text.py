"""Kernels of many states: loops say what one line a number says."""

from __future__ import annotations

import math

import numpy as np
import pytest

import certbound as cb
from certbound.problem.model import compile_scalar, trace
from certbound.simulation import kernel_source as writer
from certbound.simulation.estimates import sample_paths, simulate_exits, simulate_rare_exits
from certbound.simulation.tape_text import Parameters
from certbound.simulation.wide_text import array_function, fits, product, values_count

N = 20


def ring(t, x, d):
    pulls = [np.sin(x[(i + 1) % N] - x[i]) for i in range(N)]
    return [pulls[i] - pulls[i - 1] - 0.5 * x[i] ** 3 + (t * d[0] if i == 3 else 2.0) for i in range(N)]


def run(lines, p, **names):
    scope = {"math": math, "np": np, "INDEX": np.array(p.places), "p": np.array(p.values), **names}
    exec("\n".join(lines), scope)  # noqa: S102
    return scope


def test_a_function_over_arrays_has_the_values_of_its_tape():
    names = {"t": ["t"], "x": [f"x{i}" for i in range(N)], "d": ["d0"]}
    tape, p = trace(ring, names), Parameters(wide=True)
    assert fits(tape, N)
    assert not fits(tape, 16)
    scope = run(array_function("drift", tape, N, ["d_0"], p), p)
    x, out = np.linspace(-1.0, 2.0, N), np.full(N, np.nan)
    scope["drift"](scope["p"], 0.7, x, 0.3, np.empty(values_count(tape)), out)
    np.testing.assert_allclose(out, compile_scalar(tape)(0.7, *x, 0.3), rtol=1e-15, atol=1e-15)


@pytest.mark.parametrize("density", [0.05, 0.9, 0.0])
def test_a_product_in_loops_is_that_of_the_matrix(density):
    rng = np.random.default_rng(1)
    matrix = np.where(rng.random((12, 15)) < density, rng.normal(size=(12, 15)), 0.0)
    p, source, target = Parameters(), rng.normal(size=15), np.ones(12)
    run(product(matrix, "source", "target", p), p, source=source, target=target)
    np.testing.assert_allclose(target, 1.0 + matrix @ source, rtol=1e-13)


@pytest.mark.slow
def test_kernels_with_arrays_and_with_variables_give_the_same_paths_and_counts(monkeypatch):
    box = cb.Box(np.full(N, -0.7), np.full(N, 0.8))
    system = cb.ContinuousSystem(lambda t, x: ring(t, x, [1.0]), states=N, diffusion=0.3 * np.eye(N))
    problem = cb.Problem(system, initial=np.zeros(N), safe=[cb.Inside(box)], horizon=0.3, delta=1e-3)
    found = []
    for wide in (True, False):
        monkeypatch.setattr(writer, "fits", lambda tape, dimension, wide=wide: wide)
        paths = sample_paths(problem, paths=20, rng=3, steps=50, deviation=True)
        exits = simulate_exits(problem, paths=2000, rng=3, steps=50, halve=False)
        rare = simulate_rare_exits(problem, paths=200, particles=20, rng=3, steps=50)
        found.append((paths, exits.exits_by_time, rare.probability))
    np.testing.assert_allclose(found[0][0], found[1][0], rtol=1e-10, atol=1e-12)
    assert 20 < found[0][1].sum() < 1980
    np.testing.assert_array_equal(found[0][1], found[1][1])
    assert found[0][2] == pytest.approx(found[1][2], rel=1e-9)
