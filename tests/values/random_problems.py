"""Random problems for value functions, and whether both bounds lie on the right sides of the truth.

    python -m tests.values.random_problems [line | plane | curved | steps] [first] [last]

One state in continuous time is compared with a fine monotone scheme (``line_truth``), everything else with simulated
paths: the vertices of the disturbances in turn, Brownian bridges within steps in continuous time, whose remaining bias
is that of Euler's steps with frozen coefficients, of the order of the step, for which half a per cent is granted. Among
curved limits there are no bridges: the simulated share is too small, and only upper bounds are compared with it.
"""

from __future__ import annotations

import itertools
import sys
import time
from typing import Any

import numpy as np
from scipy.stats import beta

import certbound as cb
from certbound.errors import InfeasibleError
from certbound.problem.model import compile_numpy
from certbound.values.continuous import bound_exits
from certbound.values.discrete import bound_failure
from tests.values.line_truth import bracket

Random = np.random.Generator
LEVEL = 1e-3
GRANTED = 5e-3


def line_problem(rng: Random) -> tuple[cb.Problem, float, float]:
    """One state in continuous time, and a line that paths do not leave."""
    a, b, c, d = rng.normal(size=4) * [0.3, 1.0, 0.5, 0.5]
    s, e = rng.uniform(0.25, 0.7), rng.uniform(-0.3, 0.3)
    kind, noisy = int(rng.integers(5)), int(rng.integers(4))

    def f(t: Any, x: Any, w: Any = None) -> list[Any]:
        base = [a - 0.7 * x[0], a + b * x[0], a - x[0] ** 3, c * np.sin(3 * x[0]) - 0.5 * x[0], -abs(x[0]) + a][kind]
        clock = d * np.cos(3 * t) if noisy % 2 else 0.0
        return [base + clock + (w[0] if w is not None else 0.0)]

    bent, swaying = lambda x: np.array([[s * (1 + e * np.tanh(x[0]))]]), lambda t: np.array([[s + 0.1 * np.sin(t)]])
    gains = [s, s, bent, swaying]
    options: dict[str, Any] = {"diffusion": gains[noisy]}
    if rng.random() < 0.3:
        w = rng.uniform(0.05, 0.3)
        options["disturbance"] = cb.Box([-w], [w])
        system = cb.ContinuousSystem(lambda t, x, d: f(t, x, d), states=1, **options)
    else:
        system = cb.ContinuousSystem(lambda t, x: f(t, x), states=1, **options)
    horizon = float(rng.choice([0.5, 1.0, 2.0]))
    safe = _limits(rng, horizon)
    place = rng.uniform(-0.15, 0.15)
    start: Any = cb.Box([place], [place + float(rng.choice([0.0, 0.1]))])
    if rng.random() < 0.2:
        start = cb.GaussianStart([place], [[rng.uniform(0.05, 0.2) ** 2]])
    return cb.Problem(system, initial=start, safe=safe, horizon=horizon), -4.0, 4.0


def _limits(rng: Random, horizon: float) -> list[Any]:
    low, high = -rng.uniform(0.6, 1.3), rng.uniform(0.6, 1.3)
    first, last = np.sort(rng.uniform(0.1, 0.9, 2)) * horizon
    sway, speed = rng.uniform(-0.2, 0.2), rng.uniform(0.5, 4.0)
    moving = lambda t: [sway * np.sin(speed * t)]  # noqa: E731
    rising = cb.Ball(lambda t: [low - 0.2 + 0.2 * t], 0.2)
    box = cb.Box([low], [high])
    choices = [
        [cb.Inside(box)],
        [cb.Inside(box, during=(0.0, last))],
        [cb.Inside(box, during=(first, horizon))],
        [cb.Inside(box, during=(first, last))],
        [cb.Inside(cb.Box([2 * low], [2 * high])), cb.Inside(box, during=(horizon, horizon))],
        [cb.Inside(cb.Box([2 * low], [2 * high])), cb.Inside(box, during=(first, first))],
        [cb.Inside(cb.Box([low], [high], center=moving))],
        [cb.Inside(cb.Box([low], [np.inf])), cb.Inside(cb.Box([-np.inf], [high], center=moving))],
        [cb.Inside(cb.HalfSpace([1.0], high))],
        [cb.Inside(cb.HalfSpace([-2.0], -2.0 * low))],
        [cb.Inside(cb.Box([-2.0], [2.0])), cb.Outside(cb.Box([high], [high + 0.3]))],
        [cb.Inside(cb.Box([-2.0], [2.0])), cb.Outside(rising, during=(0.0, last))],
    ]
    return choices[int(rng.integers(len(choices)))]


def plane_problem(rng: Random) -> cb.Problem:
    """Two states in continuous time, noise in both."""
    a = rng.normal(size=(2, 2)) * 0.8
    c, kind = rng.normal(size=2) * 0.4, int(rng.integers(3))

    def f(x: Any) -> list[Any]:
        more = [0.0 * x[0], x[0] * x[1], np.sin(2 * x[0])][kind]
        return [a[0, 0] * x[0] + a[0, 1] * x[1] + c[0] * more, a[1, 0] * x[0] + a[1, 1] * x[1] + c[1] * more]

    gain = np.diag(rng.uniform(0.3, 0.6, 2)) + np.array([[0.0, rng.choice([0.0, 0.1])], [0.0, 0.0]])
    system = cb.ContinuousSystem(f, states=2, diffusion=gain)
    low, high = -rng.uniform(0.7, 1.3, 2), rng.uniform(0.7, 1.3, 2)
    start = rng.uniform(-0.2, 0.2, 2)
    return cb.Problem(system, initial=start, safe=[cb.Inside(cb.Box(low, high))], horizon=float(rng.choice([0.5, 1.0])))


def curved_problem(rng: Random) -> cb.Problem:
    """Two states among obstacles, or within a disc, an ellipse, a triangle or a half-plane."""
    problem = plane_problem(rng)
    start, kind = problem.initial.middle, int(rng.integers(6))
    turn, far = rng.uniform(0, 2 * np.pi), rng.uniform(0.5, 0.8)
    place = start + far * np.array([np.cos(turn), np.sin(turn)])
    sides = np.array([[np.cos(turn + k), np.sin(turn + k)] for k in (0.0, 2.0, 4.0)])
    limits = [
        [cb.Inside(cb.Ball(start + rng.uniform(-0.2, 0.2, 2), rng.uniform(0.7, 1.1)))],
        [cb.Inside(cb.Ellipsoid(start, np.diag(rng.uniform(0.5, 1.2, 2)) + 0.2 * np.array([[0, 1], [1, 0]])))],
        [cb.Inside(cb.Polytope(sides, sides @ start + rng.uniform(0.5, 0.8, 3)))],
        [*problem.safe, cb.Inside(cb.HalfSpace(sides[0], float(sides[0] @ start) + far))],
        [cb.Inside(cb.Box([-2, -2], [2, 2])), cb.Outside(cb.Ball(place, rng.uniform(0.2, 0.35)))],
        [cb.Inside(cb.Box([-2, -2], [2, 2])), cb.Outside(cb.Box(place - 0.2, place + rng.uniform(0.1, 0.3, 2)))],
    ]
    initial = cb.Ball(start, 0.05) if rng.random() < 0.3 else start
    return problem.replace(initial=initial, safe=limits[kind])


def step_problem(rng: Random) -> cb.Problem:
    """One to three states in discrete time."""
    n = int(rng.choice([1, 1, 2, 2, 3]))
    a = rng.normal(size=(n, n))
    a *= rng.uniform(0.3, 1.05) / np.abs(np.linalg.eigvals(a)).max()
    c, kind = rng.normal(size=n) * 0.3, int(rng.integers(5))
    disturbed = n < 3 and rng.random() < 0.3

    def f(t: Any, x: Any, d: Any = None) -> list[Any]:
        y = [sum(a[i, j] * x[j] for j in range(n)) for i in range(n)]
        more = [0 * x, np.sin(2 * x), x**2, 0 * x + np.cos(0.7 * t), abs(x)][kind]
        return [y[i] + c[i] * more[n - 1 - i] + (d[0] if d is not None and i == 0 else 0.0) for i in range(n)]

    std = rng.uniform(0.15, 0.5, n)
    law: Any = cb.Gaussian(std=std) if rng.random() < 0.75 else cb.Uniform(halfwidth=1.5 * std)
    if n == 2 and rng.random() < 0.25:
        r = rng.uniform(-0.8, 0.8) * std[0] * std[1]
        law = cb.Gaussian(covariance=np.array([[std[0] ** 2, r], [r, std[1] ** 2]]))
    options: dict[str, Any] = {"states": n, "noise": law}
    if disturbed:
        system = cb.DiscreteSystem(lambda t, x, d: f(t, x, d), disturbance=cb.Box([-0.1], [0.15]), **options)
    else:
        system = cb.DiscreteSystem(lambda t, x: f(t, x), **options)
    low, high, horizon = -rng.uniform(0.7, 1.5, n), rng.uniform(0.7, 1.5, n), int(rng.integers(1, 5 if n == 3 else 9))
    boxes = [
        cb.Inside(cb.Box(low, high)),
        cb.Inside(cb.Box(low, high, center=lambda t: [0.1 * np.sin(t)] * n)),
        cb.Inside(cb.Box(low, high), during=(min(1, horizon - 1), max(horizon - 1, 1))),
    ]
    more: list[list[Any]] = [[], [], [cb.Outside(cb.Box([0.4] * n, [0.6] * n))]]
    if n == 2:
        more += [[cb.Outside(cb.Ball([0.6, 0.6], 0.3))], [cb.Inside(cb.HalfSpace([1, 1], 0.9))]]
        more += [[cb.Inside(cb.Ellipsoid([0, 0], [[1.5, 0.4], [0.4, 1.0]]))]]
    safe = [boxes[int(rng.integers(3))], *more[int(rng.integers(len(more)))]]
    start: Any = rng.uniform(-0.2, 0.2, n)
    if not getattr(law, "uniform", False) and rng.random() < 0.2:
        start = cb.GaussianStart(np.zeros(n), np.diag(rng.uniform(0.05, 0.2, n) ** 2))
    return cb.Problem(system, initial=start, safe=safe, horizon=horizon)


def limits(fails: int, paths: int) -> tuple[float, float]:
    """Clopper-Pearson limits at 99.9 %."""
    low = float(beta.ppf(LEVEL / 2, fails, paths - fails + 1)) if fails else 0.0
    return low, float(beta.ppf(1 - LEVEL / 2, fails + 1, paths - fails)) if fails < paths else 1.0


def simulated(problem: cb.Problem, paths: int, rng: Random, steps: int = 400) -> list[int]:
    """Failures under each constant vertex of the disturbances."""
    box = problem.system.disturbance
    corners = [()] if box is None else list(itertools.product(*zip(box.low, box.high)))
    run = _discrete if problem.system.time == "discrete" else _continuous
    chunk = 100_000
    return [
        sum(run(problem, corner, min(chunk, paths - k), rng, steps) for k in range(0, paths, chunk))
        for corner in corners
    ]


def _starts(problem: cb.Problem, count: int, rng: Random) -> np.ndarray:
    start = problem.initial
    return start.sample(rng, count) if start.random else np.tile(start.middle, (count, 1))


def _held(problem: cb.Problem, x: np.ndarray, t: float) -> np.ndarray:
    active = [c for c in problem.constraints if c.during is None or c.during[0] <= t <= c.during[1]]
    return np.all([c.satisfied(x, t) for c in active], axis=0) if active else np.ones(len(x), dtype=bool)


def _discrete(problem: cb.Problem, corner: tuple[float, ...], count: int, rng: Random, steps: int) -> int:
    step = compile_numpy(problem.closed_loop)
    x = _starts(problem, count, rng)
    safe = _held(problem, x, 0)
    for t in range(problem.horizon):
        noise = problem.system.noise.sample(rng, count) @ problem.system.noise_matrix.T
        x = np.broadcast_to(step(float(t), *x.T, *corner), x.shape) + noise
        safe &= _held(problem, x, t + 1)
    return int(np.sum(~safe))


def _continuous(problem: cb.Problem, corner: tuple[float, ...], count: int, rng: Random, steps: int) -> int:
    """Boxes over the whole horizon and constant noise: bridges between the steps, face by face."""
    f, gain = compile_numpy(problem.closed_loop), np.asarray(problem.system.diffusion)
    region, h = problem.constraints[0].region, float(problem.horizon) / steps
    size = np.diag(gain @ gain.T) * h
    x, safe = _starts(problem, count, rng), np.ones(count, dtype=bool)
    for k in range(steps):
        new = x + h * f(k * h, *x.T, *corner) + np.sqrt(h) * rng.standard_normal((count, gain.shape[1])) @ gain.T
        for bound, sign in ((region.high, 1), (region.low, -1)):
            before, after = sign * (bound - x), sign * (bound - new)
            crossed = (after < 0) | (rng.random(x.shape) < np.exp(-2 * np.maximum(before * after, 0.0) / size))
            safe &= ~np.any(crossed, axis=1)
        x = new
    return int(np.sum(~safe))


def _watched(problem: cb.Problem, count: int, rng: Random, steps: int) -> int:
    """Any limits, looked at at the ends of the steps only."""
    f, gain = compile_numpy(problem.closed_loop), np.asarray(problem.system.diffusion)
    h = float(problem.horizon) / steps
    x, safe = _starts(problem, count, rng), np.ones(count, dtype=bool)
    for k in range(steps):
        x = x + h * f(k * h, *x.T) + np.sqrt(h) * rng.standard_normal((count, gain.shape[1])) @ gain.T
        safe &= _held(problem, x, (k + 1) * h)
    return int(np.sum(~safe))


def check(
    kind: str, seed: int, *, paths: int = 1_000_000, seconds: float = 1.0, cells: int = 4800
) -> tuple[str, float, float, float, float]:
    """("" or what is wrong, lower bound, least and largest truth, upper bound)."""
    rng = np.random.default_rng([seed, {"line": 1, "plane": 2, "steps": 3, "curved": 4}[kind]])
    if kind == "line":
        problem, low, high = line_problem(rng)
        found = bound_exits(problem, seconds=seconds)
        lower, upper = 0.0 if found.lower is None else 10**found.lower, 10**found.upper
        truth = bracket(problem, low, high, cells)
        truth = truth[0] * (1 - GRANTED) - 1e-9, truth[1] * (1 + GRANTED) + 1e-9
    elif kind == "plane":
        problem = plane_problem(rng)
        bounds = bound_exits(problem, seconds=seconds)
        lower, upper = 0.0 if bounds.lower is None else 10**bounds.lower, 10**bounds.upper
        truth = limits(simulated(problem, paths, rng)[0], paths)
        truth = truth[0] * (1 - GRANTED), truth[1] * (1 + GRANTED)
    elif kind == "curved":
        problem, lower = curved_problem(rng), 0.0
        upper = 10 ** bound_exits(problem, seconds=seconds).upper
        fails = sum(_watched(problem, min(100_000, paths - k), rng, 400) for k in range(0, paths, 100_000))
        truth = limits(fails, paths)[0] * (1 - GRANTED), 1.0
    else:
        problem = step_problem(rng)
        both = bound_failure(problem, seconds=seconds)
        lower, upper = both.lower, both.upper
        worst = max(simulated(problem, paths, rng))
        # with disturbances a constant vertex is one policy: nothing is known about the truth from above
        truth = limits(worst, paths)
        truth = truth if problem.system.disturbance is None else (truth[0], 1.0)
    wrong = "upper bound below the truth" * (upper < truth[0]) + "lower bound above the truth" * (lower > truth[1])
    return wrong, lower, truth[0], truth[1], upper


def main(kind: str, first: int, last: int) -> int:
    """Run seeds and write a line each; the number of violations."""
    bad = 0
    for seed in range(first, last):
        begun = time.process_time()
        try:
            wrong, lower, least, most, upper = check(kind, seed)
        except InfeasibleError as error:
            sys.stdout.write(f"{kind} {seed}: {type(error).__name__}: {str(error)[:100]}\n")
            continue
        bad += bool(wrong)
        above, below = upper / most if most else np.inf, least / lower if lower else np.inf
        sys.stdout.write(f"{kind} {seed}: [{lower:.4g}, {upper:.4g}], truth [{least:.4g}, {most:.4g}], upper / truth ")
        sys.stdout.write(f"{above:.3f}, truth / lower {below:.3f}, {time.process_time() - begun:.1f} s {wrong}\n")
        sys.stdout.flush()
    return bad


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3])) > 0)
