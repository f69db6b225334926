"""Kernels written for LLVM line by line compute, to the bit, what numba makes of their text."""

import ast
from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.problem.model import OPERATIONS
from certbound.simulation.compiled import cache
from certbound.simulation.compiled.entry import KERNEL
from certbound.simulation.compiled.translation import translatable
from certbound.simulation.estimates.splitting import simulate_rare_exits

NAMES = (
    "stream, starts, signals, inputs, moving, windows, nominal, profile, marks, p, steps, counts, marginals, out, notes"
)
HEAD = f"""
import math
import numpy as np
from numba import njit
from certbound.simulation.compiled.elementary import atan2, sincos, tanh
from certbound.simulation.compiled.entry import KERNEL
from certbound.simulation.compiled.streams import draw_normal, uniform
from certbound.simulation.compiled.supremum import STRETCH, raise_top, touches

@njit(nogil=True, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)
def turned(p, t, a, b):
    v1, v2 = sincos(a)
    v3 = v1 * b + t
    return (v3, v2)

@njit(KERNEL, nogil=True, cache=@CACHE@, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)
def run({NAMES}):
"""

VALUES = [0.0, -0.0, 0.3, -0.7, 1.0, -1.0, 2.5, -8.25, 1e5, 1e300, -1e-310, np.inf, -np.inf, np.nan]

LANGUAGE = """
    noise = np.empty(3)
    track = np.empty(STRETCH + 1)
    w_0, w_1, w_2, w_3 = stream[4], stream[5], stream[6], stream[7]
    done = left = 0
    seen, half = False, p[1]
    for path in range(starts.shape[0]):
        x, y, at = starts[path, 0], starts[path, 1], 0
        track[0] = low = high = 0.0
        for k in range(1, steps):
            t = k * p[0]
            f, g = turned(p, t, x, y)
            for j in range(3):
                noise[j], w_0, w_1, w_2, w_3 = draw_normal(w_0, w_1, w_2, w_3)
            x, y = y + 0.1 * f + half * noise[0], -x * 0.5 + (noise[1] if noise[2] > p[2] else 0.0)
            low, high = min(low, x, -y), max(high, x, abs(y))
            at += 1
            track[at] = x
            out[path, k, 0] = x
            out[path, k, 1] = y + (g - 1.0) ** 2 / (t * t)
            if k % int(p[3]) == 0 and not seen and touches(stream, 0.5):
                seen = True
                continue
            elif x < -1.5 or y > 2.0 and uniform(stream) < 0.5 or x != x:
                left = path
                counts[left, 1 + k * (counts.shape[1] - 1) // steps] += 1
                break
            done += 1
            notes[0], notes[1] = path, k
        high = raise_top(stream, track, at, high, 0.25, 40.0)
        out[path, 0, 0], out[path, 0, 1] = low, high
        if left == 2:
            marginals[0, 0, 0, left] += -1
    stream[4], stream[5], stream[6], stream[7] = w_0, w_1, w_2, w_3
    return done
"""


def both(text: str, monkeypatch: pytest.MonkeyPatch, **changes: Any) -> list[list[Any]]:
    """What a kernel returns and leaves in its arrays: translated, and by numba."""
    monkeypatch.setenv("CERTBOUND_CACHE", "off")
    found = []
    for way in (translatable, lambda _: False):
        monkeypatch.setattr(cache, "_LOADED", {})
        monkeypatch.setattr(cache, "translatable", way)
        given = {
            name: np.ones((4,) * kind.ndim, dtype=str(kind.dtype)) for name, kind in zip(NAMES.split(", "), KERNEL.args)
            if name != "steps"
        }  # fmt: skip
        given |= {"stream": np.arange(1, 9, dtype=np.uint64), "steps": 40}
        given |= {name: np.copy(value) if np.ndim(value) else value for name, value in changes.items()}
        arguments = [given[name] for name in NAMES.split(", ")]
        returned = cache.load_kernel(text)(*arguments)
        found.append([returned, *(array.tobytes() for array in arguments if isinstance(array, np.ndarray))])
    return found


def test_every_operation_of_a_tape_has_the_same_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    texts = [row.kernel.format("a", "b") for row in OPERATIONS.values()]
    lines = [f"        out[path, {i}, 0] = {text}" for i, text in enumerate(texts)]
    head = ["    for path in range(starts.shape[0]):", "        a, b = starts[path, 0], starts[path, 1]"]
    starts = np.array([[a, b] for a in VALUES for b in VALUES])
    out = np.zeros((len(starts), len(texts), 1))
    new, old = both(HEAD + "\n".join([*head, *lines, "    return 3"]), monkeypatch, starts=starts, out=out)
    assert new[0] == 3
    assert new == old


def test_every_line_of_the_language_does_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    starts = np.array([[0.1, 0.2], [1.0, -1.0], [0.5, 2.0], [np.nan, 0.0]])
    out, p = np.zeros((4, 40, 2)), np.array([0.05, 0.3, -0.2, 3.0])
    new, old = both(HEAD + LANGUAGE, monkeypatch, starts=starts, out=out, p=p)
    assert 3 < new[0] < 120
    assert new == old


def test_kernels_are_written_line_by_line_unless_they_work_in_arrays() -> None:
    assert translatable(ast.parse((HEAD + LANGUAGE).replace("@CACHE@", "False")))
    for more in ("p[1:3]", "noise.min()", "noise.copy()", "[1.0]", "x < 1 < 2"):
        assert not translatable(ast.parse(f"x = {more}"))


def test_splitting_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """A kernel of the other type, with noise-free paths of its own."""
    system = cb.ContinuousSystem(lambda x: [x[1], -np.sin(x[0]) - x[1]], states=2, diffusion=[[0.0], [0.4]])
    problem = cb.Problem(
        system, initial=cb.Box([0, 0], [0.1, 0.1]), safe=[cb.Inside(cb.Ball([0, 0], 1.0))], horizon=1.0
    )
    monkeypatch.setenv("CERTBOUND_CACHE", "off")
    found = []
    for way in (translatable, lambda _: False):
        monkeypatch.setattr(cache, "_LOADED", {})
        monkeypatch.setattr(cache, "translatable", way)
        rare = simulate_rare_exits(problem, paths=256, particles=128, steps=20, rng=1)
        found.append((rare.exits, rare.path_steps, rare.probability))
    assert found[0][0] > 0
    assert found[0] == found[1]
