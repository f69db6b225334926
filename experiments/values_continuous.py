"""Exit probabilities by value functions in continuous time, beside a fine solution of the backward equation.

    python experiments/values_continuous.py [seconds] [name ...]

prints certified upper bound / truth and truth / certified lower bound with the wall and the processor time of each
problem. The truth in one state is the monotone scheme of the tests on a fine grid; in two states none is printed.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator

import numpy as np
from scipy.linalg import solve_banded

import certbound as cb
from certbound.values.continuous.exits import bound_exits

__all__ = ["compute", "line_problems", "plane_problems", "truth"]


def line_problems() -> Iterator[tuple[str, cb.Problem]]:
    """The list of one-state problems: double well, cubic, Ornstein-Uhlenbeck, geometric Brownian motion."""
    cases = {
        "double well": (lambda x: [x[0] - x[0] ** 3], (0.0, 2.5), 10.0, (0.9, 1.1), (0.25, 0.35, 0.5)),
        "cubic": (lambda x: [-(x[0] ** 3)], (-1.5, 1.5), 10.0, (0.0, 0.0), (0.3, 0.4, 0.6)),
        "linear": (lambda x: [-x[0]], (-1.0, 1.0), 1.0, (0.0, 0.0), (0.2, 0.3, 0.4)),
        "geometric": (lambda x: [-0.1 * x[0]], (0.3, 2.5), 1.0, (1.0, 1.0), (0.1, 0.2, 0.3)),
    }
    for name, (f, (low, high), horizon, start, sigmas) in cases.items():
        for sigma in sigmas:
            gain = (lambda x, s=sigma: np.array([[s * x[0]]])) if name == "geometric" else sigma
            system = cb.ContinuousSystem(f, states=1, diffusion=gain)
            yield f"{name} {sigma}", cb.Problem(
                system, initial=cb.Box([start[0]], [start[1]]), safe=[cb.Inside(cb.Box([low], [high]))], horizon=horizon
            )


def plane_problems() -> Iterator[tuple[str, cb.Problem]]:
    """Reversed Van der Pol and Lotka-Volterra with noise in both states."""
    for sigma in (0.1, 0.2, 0.3):
        system = cb.ContinuousSystem(
            lambda x: [-x[1], x[0] + (x[0] ** 2 - 1) * x[1]], states=2, diffusion=sigma * np.eye(2)
        )
        box, safe = cb.Box([-0.2, -0.2], [0.2, 0.2]), cb.Box([-1.2, -1.2], [1.2, 1.2])
        yield f"Van der Pol {sigma}", cb.Problem(system, initial=box, safe=[cb.Inside(safe)], horizon=5)
    for sigma in (0.1, 0.2):
        system = cb.ContinuousSystem(
            lambda x: [x[0] * (1 - x[1]), x[1] * (x[0] - 1)], states=2,
            diffusion=lambda x, s=sigma: np.array([[s * x[0], 0.0], [0.0, s * x[1]]]),
        )  # fmt: skip
        box, safe = cb.Box([0.95, 0.95], [1.05, 1.05]), cb.Box([0.3, 0.3], [2.5, 2.5])
        yield f"Lotka-Volterra {sigma}", cb.Problem(system, initial=box, safe=[cb.Inside(safe)], horizon=5)


def truth(problem: cb.Problem, cells: int = 2000, steps: int = 2000) -> float:
    """The exit probability of a one-state problem from its worst start, extrapolated from two grids."""
    coarse, fine = _solved(problem, cells // 2, steps // 2), _solved(problem, cells, steps)
    return fine + (fine - coarse) / 3


def _solved(problem: cb.Problem, cells: int, steps: int) -> float:
    from certbound.problem.model import compile_numpy
    from certbound.values.enclosing import squared_diffusion

    region = problem.safe[0].region
    x = np.linspace(region.low[0], region.high[0], cells + 1)
    h = x[1] - x[0]
    f = compile_numpy(problem.closed_loop)(0.0, x)[:, 0]
    a = np.broadcast_to(compile_numpy(squared_diffusion(problem.system.diffusion, ("x1",)))(0.0, x)[..., 0, 0], x.shape)
    q = 2 * f * h / a
    safe = np.where(np.abs(q) < 1e-9, 1.0, q)
    left = a / (2 * h * h) * np.where(np.abs(q) < 1e-9, 1.0, safe / np.expm1(safe))
    right, gamma = left + f / h, 1 - 0.5**0.5
    u = np.zeros(cells + 1)
    u[[0, -1]] = 1.0
    for step in np.diff(problem.horizon * np.concatenate([[0.0], np.geomspace(1e-6, 1.0, steps)])):
        bands = np.zeros((3, cells + 1))
        bands[1] = 1.0
        bands[1, 1:-1] += gamma * step * (left + right)[1:-1]
        bands[0, 2:], bands[2, :-2] = -gamma * step * right[1:-1], -gamma * step * left[1:-1]
        stage = solve_banded((1, 1), bands, u)
        u = np.maximum(solve_banded((1, 1), bands, u + (1 / gamma - 1) * (stage - u)), 0.0)
    ends = [float(problem.initial.low[0]), float(problem.initial.high[0])]
    return float(np.exp(np.interp(np.linspace(*ends, 41), x, np.log(np.maximum(u, 1e-300)))).max())


def compute(seconds: float, names: list[str]) -> list[str]:
    """One line a problem."""
    lines = []
    for name, problem in [*line_problems(), *plane_problems()]:
        if names and not any(part in name for part in names):
            continue
        begin = time.process_time()
        found = bound_exits(problem, seconds=seconds)
        spent = time.process_time() - begin
        text = f"{name:20s} upper {10**found.upper:.4g}"
        if problem.system.dimension == 1:
            exact = truth(problem)
            below = "none" if found.lower is None else f"{exact / 10**found.lower:.4f}"
            text += f"  truth {exact:.4g}  upper/truth {10**found.upper / exact:.4f}  truth/lower {below}"
        lines.append(f"{text}  {found.seconds:.1f} s, {spent:.1f} s of processor  ({found.words})")
        print(lines[-1], flush=True)
    return lines


if __name__ == "__main__":
    compute(float(sys.argv[1]) if len(sys.argv) > 1 else 3.0, sys.argv[2:])
