"""Random problems in the plane with targets and with windows: both bounds beside simulated paths, on purpose.

    python -m tests.values.random_goals [targets | windows] [first] [last] [seconds]
"""

from __future__ import annotations

import sys
import time
from typing import Any

import numpy as np

import certbound as cb
from certbound.problem.goals import until
from certbound.values.continuous import ExitBounds, bound_exits
from tests.values.random_systems import GRANTED, drift

Random = np.random.Generator
KINDS = ("targets", "windows")


def _system(rng: Random, n: int = 2, step: float = 0.0) -> cb.ContinuousSystem | cb.DiscreteSystem:
    """With a ``step`` in discrete time: what Euler's method makes of it."""
    gain: Any = np.diag(rng.uniform(0.3, 0.7, n))
    gain[0, n - 1] += rng.choice([0.0, 0.2, -0.2]) if n > 1 else 0.0
    terms = (0, 1, 2, 5, 6) if n > 1 else (1, 2, 5)
    f = drift(rng, n, terms=terms, clock=bool(rng.random() < 0.2), pushed=False, pull=rng.uniform(0.0, 1.0))
    if not step:
        return cb.ContinuousSystem(f, states=n, diffusion=gain)
    noise = cb.Gaussian(covariance=step * gain @ gain.T)
    moved = lambda t, x: [x[k] + step * v for k, v in enumerate(f(step * t, x))]  # noqa: E731
    return cb.DiscreteSystem(moved, states=n, noise=noise)


def targets(rng: Random, n: int = 2, step: float = 0.0) -> cb.Problem:
    """A box, a ball or a half-space to be reached from a point or a small box; with a ``step`` in discrete time."""
    low, high = -rng.uniform(0.8, 1.3, n), rng.uniform(0.8, 1.3, n)
    center, kind = rng.uniform(-0.3, 0.3, n), rng.integers(4)
    sides = rng.uniform(0.2, 0.45, n)
    region: Any = cb.Box(center - sides, center + sides)
    if kind == 0:
        region = cb.Ball(center, float(sides[0]))
    if kind == 1:
        region = cb.HalfSpace([float(rng.choice([-1.0, 1.0])), 0.0][:n], -float(rng.uniform(0.2, 0.5)))
    place = rng.choice([-1, 1], n) * rng.uniform(0.45, 0.65, n)
    start = cb.Box(place, place + rng.choice([0.0, 0.08], n))
    horizon = float(rng.choice([0.7, 2.0, 4.0]))
    horizon = round(horizon / step) if step else horizon
    safe = [cb.Inside(cb.Box(low, high))]
    return cb.Problem(_system(rng, n, step), initial=start, safe=safe, reach=region, horizon=horizon)


def windows(rng: Random) -> cb.Problem:
    """A box, and one or two narrower ones over a part of the horizon, or at one instant."""
    horizon = float(rng.choice([0.7, 1.5, 3.0]))
    safe = [cb.Inside(cb.Box(-rng.uniform(0.9, 1.3, 2), rng.uniform(0.9, 1.3, 2)))]
    for _ in range(rng.integers(1, 3)):
        first, last = np.sort(rng.choice([0.0, 0.25, 0.4, 0.6, 0.8, 1.0], 2)) * horizon
        if last > 0:
            sides = rng.uniform(0.4, 0.8, (2, 2))
            pick = [0, 1] if rng.random() < 0.6 else [int(rng.integers(2))]
            safe.append(cb.Inside(cb.Box(-sides[0, pick], sides[1, pick], coordinates=pick), (first, last)))
    place = rng.uniform(-0.2, 0.2, 2)
    start = cb.Box(place, place + rng.choice([0.0, 0.1], 2))
    return cb.Problem(_system(rng), initial=start, safe=safe, horizon=horizon)


def bounds(problem: cb.Problem, seconds: float) -> ExitBounds:
    """Both bounds."""
    if problem.reach is None:
        return bound_exits(problem, seconds=seconds)
    return bound_exits(until(problem, float(problem.horizon)), target=problem.reach.region, seconds=seconds)


def check(kind: str, seed: int, seconds: float, paths: int = 100_000) -> str:
    """One line about one problem; a defect where a simulation contradicts a bound."""
    problem = {"targets": targets, "windows": windows}[kind](np.random.default_rng(seed))
    begin = time.process_time()
    found = bounds(problem, seconds)
    spent = time.process_time() - begin
    upper, lower = 10**found.upper, 0.0 if found.lower is None else 10**found.lower
    counts = cb.simulate_exits(problem, paths=paths, rng=seed, confidence=0.9999, halve=False)
    bad = upper < counts.lower - GRANTED * counts.probability
    if problem.initial.is_point:
        bad |= lower > counts.upper + GRANTED * counts.probability
    what = f"{'DEFECT' if bad else 'fine'} {kind} {seed}"
    return f"{what}: {lower:.4g} <= {counts.probability:.4g} <= {upper:.4g} in {spent:.1f} s"


def main() -> None:
    """Print one line a problem."""
    kind, first, last, seconds = (*sys.argv[1:], *("targets", "0", "15", "4")[len(sys.argv) - 1 :])
    for seed in range(int(first), int(last)):
        sys.stdout.write(check(kind, seed, float(seconds)) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
