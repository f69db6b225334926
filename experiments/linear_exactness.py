"""Linear systems with Gaussian noise: how near the certified probability comes to the true one, and how fast.

The noise of every problem is scaled until the certified probability of leaving the safe set lies near the levels below,
where simulation can tell; the simulation starts at every corner of the initial set, and the worst corner counts. The
ratio is certified over simulated; its spread is that of the simulation (Clopper-Pearson limits).
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import certbound as cb
from certbound.simulation.stepping import Scenario
from experiments.harness import Arrays, Claims, main

__all__ = ["PROBLEMS", "compute", "level_of", "simulated", "tuned"]

FOLDER = Path(__file__).resolve().parent / "benchmarks"
LEVELS = (1e-2, 1e-3)  # in full; the first one otherwise
BISECTIONS = 7
LARGEST = {"two_tanks": 4.0, "room_3d": 9.0}  # noise beyond which a path passes a box more often than it enters it


def _file(name: str, **fixed: float) -> Callable[[float], cb.Problem]:
    """A bundled benchmark with its noise level set to a number."""
    return lambda sigma: cb.load(FOLDER / f"{name}.toml", sigma=sigma, **fixed)


def _oscillator(sigma: float) -> cb.Problem:
    """A damped oscillator with noise on its velocity; the position is smooth, the velocity rough."""
    system = cb.linear_system([[0, 1], [-1, -1]], diffusion=[[0.0], [sigma]])
    safe = [cb.Inside(cb.Box([-1, -1.3], [1, 1.3]))]
    return cb.Problem(system, initial=[0.3, 0.0], safe=safe, horizon=5.0, delta=1e-3, name="oscillator")


def _chain(sigma: float) -> cb.Problem:
    """Two masses, springs and dampers with Euler steps of .1, noise on the velocities."""
    step = 0.1
    matrix = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [-20, 10, -4, 2], [10, -10, 2, -2]], dtype=float)
    system = cb.linear_system(
        np.eye(4) + step * matrix, noise=cb.Gaussian(std=sigma), noise_matrix=[[0, 0], [0, 0], [step, 0], [0, step]]
    )
    safe = [cb.Inside(cb.HalfSpace([1, 0, 0, 0], 0.4)), cb.Inside(cb.HalfSpace([-1, 1, 0, 0], 0.3))]
    return cb.Problem(system, initial=np.zeros(4), safe=safe, horizon=50, delta=1e-3, name="linear chain")


PROBLEMS: dict[str, Callable[[float], cb.Problem]] = {
    "ou": lambda sigma: cb.load("ou", sigma=sigma),
    "oscillator": _oscillator,
    "room_1d": _file("room_1d"),
    "two_tanks": _file("two_tanks"),
    "room_3d": _file("room_3d"),
    "contraction_14d": _file("contraction_14d"),
    "linear chain": _chain,
}


def level_of(problem: cb.Problem) -> float:
    """log10 of the certified probability by linear response."""
    return float(cb.verify_safety(problem, method="linear").log10_delta)


def tuned(
    build: Callable[[float], cb.Problem], level: float, largest: float = 20.0
) -> tuple[cb.Problem, float]:
    """The problem with its noise scaled until the certified probability is near ``level``, and its log10."""
    low, high = -4.0, float(np.log(largest))
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        problem = build(float(np.exp(middle))).replace(delta=level)
        low, high = (middle, high) if level_of(problem) <= np.log10(level) else (low, middle)
    problem = build(float(np.exp(low))).replace(delta=level)
    return problem, level_of(problem)


def simulated(problem: cb.Problem, paths: int) -> tuple[float, float, float]:
    """Probability of leaving from the worst corner of the initial set, with its limits."""
    start = problem.initial
    corners = list(itertools.product(*(sorted({a, b}) for a, b in zip(start.low, start.high))))
    found = []
    for number, corner in enumerate(corners):
        counts = cb.simulate_exits(
            problem, paths=paths // len(corners), rng=np.random.default_rng(number), scenario=Scenario(initial=corner)
        )
        found.append((counts.probability, counts.lower, counts.upper))
    return max(found)


def compute(full: bool) -> tuple[Arrays, Claims]:
    """Ratios and seconds of every problem.

    The obstacles of two_tanks and room_3d are boxes smaller than the noise that it takes to reach them: no noise brings
    room_3d there with a probability of more than 5e-5, of which even 10^6 paths say little.
    """
    paths = 1_000_000 if full else 100_000
    rows: Claims = {}
    for name, build in PROBLEMS.items():
        for level in LEVELS if full else LEVELS[:1]:
            problem, certified = tuned(build, level, LARGEST.get(name, 20.0))
            seconds = []
            for _ in range(3):
                begin = time.process_time()
                level_of(problem)
                seconds.append(time.process_time() - begin)
            probability, lower, upper = simulated(problem, paths)
            row = {
                "certified": 10**certified, "simulated": probability, "ratio": 10**certified / max(probability, 1e-12),
                "ratio_limits": [10**certified / upper, 10**certified / max(lower, 1e-12)],
                "target": 1.1 if problem.system.time == "discrete" else 1.5,
            }  # fmt: skip
            rows[f"{name} at {level:g}"] = row
            print(
                f"{name:16} {problem.system.time:10} certified {row['certified']:.3e}  simulated {probability:.3e}  "
                f"ratio {row['ratio']:.3f} [{row['ratio_limits'][0]:.3f}, {row['ratio_limits'][1]:.3f}]  "
                f"{1e3 * min(seconds):.0f} ms of one core",
                flush=True,
            )
    ratios = np.array([row["ratio"] for row in rows.values()])
    return {"ratio": ratios}, {"table": rows, "worst": float(ratios.max())}


if __name__ == "__main__":
    main("linear_exactness", compute)
