"""Random problems in the plane, in space and beyond: upper bounds beside simulated paths, on purpose.

    python -m tests.values.random_systems [plane | velocity | steps | quadratic | maps | space] [first] [last]

Paths of Euler's method without bridges miss exits, so that their frequency is at most the truth (up to the weak error
of the step, for which one per cent is granted): an upper bound below its lower limit is a defect. Where f grows with
time, bends, has kinks or disturbances, and where g depends on the state, that is still so.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

import certbound as cb
from certbound.arrays import Array
from certbound.errors import EnclosureError, InfeasibleError
from certbound.problem.model import compile_numpy
from certbound.quadratic import bound_quadratic
from certbound.safety.starts import bound_safe_starts
from certbound.values.continuous import bound_exits
from certbound.values.discrete import bound_failure
from certbound.values.semilagrangian import bound_exits_by_steps
from tests.values.random_problems import limits

Random = np.random.Generator
GRANTED = 1e-2
KINDS = ("plane", "velocity", "steps", "quadratic", "maps", "space")
_TERMS: tuple[Callable[[Any, Any], Any], ...] = (
    lambda x, y: x * y,
    lambda x, y: np.sin(2 * x),
    lambda x, y: abs(x),
    lambda x, y: np.minimum(x, 0.3 * y),
    lambda x, y: np.maximum(x, 0.1),
    lambda x, y: x**3,
    lambda x, y: np.tanh(3 * x) * y,
    lambda x, y: np.exp(0.5 * x),
)
_SMOOTH = (0, 1, 5, 6, 7)


def drift(rng: Random, n: int, *, terms: tuple[int, ...], clock: bool, pushed: bool, pull: float) -> Callable[..., Any]:
    """A linear part that pulls inward, one bent term a row, perhaps a clock and a disturbance on the first row."""
    a = rng.normal(size=(n, n)) * 0.6 / np.sqrt(n) - pull * np.eye(n)
    c, picks = rng.normal(size=n) * 0.4, rng.integers(0, n, (n, 2))
    kinds, sway = rng.choice(terms, n), rng.normal(size=n) * 0.5 * clock

    def f(t: Any, x: Any, d: Any = None) -> list[Any]:
        rows = []
        for i in range(n):
            row = sum(a[i, j] * x[j] for j in range(n)) + c[i] * _TERMS[kinds[i]](x[picks[i, 0]], x[picks[i, 1]])
            row = row + sway[i] * np.cos(3 * t) if clock else row
            rows.append(row + d[0] if d is not None and i == n - 1 else row)
        return rows

    return (lambda t, x, d: f(t, x, d)) if pushed else (lambda t, x: f(t, x))


def _system(rng: Random, n: int, gain: Any, terms: tuple[int, ...], *, plain: bool = False) -> cb.ContinuousSystem:
    clock, pushed = not plain and rng.random() < 0.3, not plain and rng.random() < 0.3
    f = drift(rng, n, terms=terms, clock=clock, pushed=pushed, pull=rng.uniform(0.0, 1.0))
    more = {"disturbance": cb.Box([-0.1], [0.15])} if pushed else {}
    return cb.ContinuousSystem(f, states=n, diffusion=gain, **more)


def _box_problem(rng: Random, system: Any, horizon: float, *, wide: float = 0.15) -> cb.Problem:
    n = system.dimension
    low, high = -rng.uniform(0.7, 1.3, n), rng.uniform(0.7, 1.3, n)
    place, width = rng.uniform(-0.2, 0.2, n), rng.choice([0.0, wide], n)
    safe = [cb.Inside(cb.Box(low, high))]
    return cb.Problem(system, initial=cb.Box(place, place + width), safe=safe, horizon=horizon)


def _tilted(gain: Array, tilt: Array) -> Callable[[Any], Any]:
    """A gain that grows along the first state."""
    return lambda x: [[gain[i, j] * (1 + tilt[i] * x[0]) for j in range(gain.shape[1])] for i in range(len(gain))]


def plane(rng: Random) -> cb.Problem:
    """Two states, noise of full rank: correlated, or dependent on the state."""
    gain: Any = np.diag(rng.uniform(0.25, 0.6, 2))
    gain[0, 1] = rng.choice([0.0, 0.2, -0.3])
    if rng.random() < 0.4:
        gain = _tilted(gain, rng.uniform(-0.4, 0.4, 2))
    return _box_problem(rng, _system(rng, 2, gain, tuple(range(8))), float(rng.choice([0.3, 1.0])))


def velocity(rng: Random) -> cb.Problem:
    """A position without noise and a velocity with; of either order."""
    s, swap = rng.uniform(0.3, 0.9), rng.random() < 0.3
    k, c, e = rng.uniform(-1, 3), rng.uniform(0, 1.5), rng.normal(size=3) * 0.5
    kind = int(rng.choice(_SMOOTH))

    def f(x: Any) -> list[Any]:
        p, q = (x[1], x[0]) if swap else (x[0], x[1])
        force = -k * p - c * q + e[0] * _TERMS[kind](p, q)
        way = q + e[1] * 0.3 * p + (e[2] * 0.3 * p * q if kind == 1 else 0.0)
        return [force, way] if swap else [way, force]

    system = cb.ContinuousSystem(f, states=2, diffusion=[[s], [0.0]] if swap else [[0.0], [s]])
    return _box_problem(rng, system, float(rng.choice([0.7, 2.0])), wide=0.1)


def space(rng: Random) -> cb.Problem:
    """Three states, noise of any rank: correlated, or dependent on the state."""
    gain: Any = np.diag(rng.uniform(0.3, 0.6, 3) * (1.0 if rng.random() < 0.8 else rng.permutation([0.0, 1.0, 1.0])))
    gain[0, 1:] = rng.choice([0.0, 0.2, -0.3]), rng.choice([0.0, 0.2])
    if rng.random() < 0.4:
        gain = _tilted(gain, rng.uniform(-0.4, 0.4, 3))
    return _box_problem(rng, _system(rng, 3, gain, tuple(range(8))), float(rng.choice([0.3, 1.0])))


def steps(rng: Random) -> cb.Problem:
    """Two or three states in discrete time: uniform noise, common factors, kinks, random starts."""
    n, kind = int(rng.choice([2, 3, 3])), int(rng.integers(4))
    gain = 0.45 if n == 3 else 0.8
    base = drift(rng, n, terms=tuple(range(7)), clock=bool(rng.random() < 0.3), pushed=False, pull=0.0)
    std = rng.uniform(0.2, 0.5, n)
    law: Any = cb.Gaussian(std=std)
    if kind == 1:
        law = cb.Uniform(halfwidth=1.5 * std)
    if kind == 2:
        e = rng.uniform(-0.8, 0.8, n) * std
        law = cb.Gaussian(covariance=np.diag(std**2) + np.outer(e, e))
    system = cb.DiscreteSystem(lambda t, x: [gain * v for v in base(t, x)], states=n, noise=law)
    problem = _box_problem(rng, system, int(rng.integers(1, 4 if n == 3 else 9)))
    if kind == 3:
        cov = np.diag(rng.uniform(0.05, 0.2, n) ** 2)
        start = cb.GaussianStart(np.zeros(n), cov)
        return cb.Problem(system, initial=start, safe=problem.safe, horizon=problem.horizon)
    return problem


def quadratic(rng: Random) -> cb.Problem:
    """Two to six states, some without noise of their own."""
    n = int(rng.integers(2, 7))
    gain: Any = rng.choice([0.12, 0.2, 0.35]) * rng.standard_normal((n, int(rng.integers(1, n + 1))))
    if rng.random() < 0.3:
        gain = _tilted(gain, rng.uniform(-0.4, 0.4, n))
    return _box_problem(rng, _system(rng, n, gain, _SMOOTH), 1.0)


def worst_frequency(problem: cb.Problem, paths: int, rng: Random, *, euler: int = 300) -> tuple[float, float]:
    """Limits of the largest probability among a corner of the starts, their middle and the disturbances' vertices."""
    box, start = problem.system.disturbance, problem.initial
    pushes = [()] if box is None else [tuple(box.low), tuple(box.high)]
    places = [None] if start.random else [start.low, start.high, (start.low + start.high) / 2]
    continuous = problem.system.time == "continuous"
    run = _flow if continuous else _chain
    share = paths // 4
    found = [(run(problem, place, push, share, rng, euler), i, j)
             for i, place in enumerate(places) for j, push in enumerate(pushes)]  # fmt: skip
    _, i, j = max(found)
    best = run(problem, places[i], pushes[j], paths, rng, euler)
    return limits(best, paths)


def _begun(problem: cb.Problem, place: Array | None, count: int, rng: Random) -> Array:
    return problem.initial.sample(rng, count) if place is None else np.tile(np.asarray(place, dtype=float), (count, 1))


def _held(problem: cb.Problem, x: Array, t: float) -> Array:
    active = [c for c in problem.constraints if c.during is None or c.during[0] <= t <= c.during[1]]
    return np.all([c.satisfied(x, t) for c in active], axis=0) if active else np.ones(len(x), dtype=bool)


def _chain(problem: cb.Problem, place: Any, push: Any, count: int, rng: Random, euler: int) -> int:
    step = compile_numpy(problem.closed_loop)
    x = _begun(problem, place, count, rng)
    safe = _held(problem, x, 0)
    for t in range(int(problem.horizon)):
        noise = problem.system.noise.sample(rng, count) @ problem.system.noise_matrix.T
        x = np.broadcast_to(step(float(t), *x.T, *push), x.shape) + noise
        safe &= _held(problem, x, t + 1)
    return int(np.sum(~safe))


def _flow(problem: cb.Problem, place: Any, push: Any, count: int, rng: Random, euler: int) -> int:
    f, gain = compile_numpy(problem.closed_loop), problem.system.diffusion
    moving = not isinstance(gain, np.ndarray)
    g = compile_numpy(gain) if moving else np.asarray(gain)
    h, failed = float(problem.horizon) / euler, 0
    x = _begun(problem, place, count, rng)
    for k in range(euler):
        kick = np.sqrt(h) * rng.standard_normal((len(x), (gain.shape if moving else g.shape)[1]))
        noise = kick @ g.T if not moving else np.einsum(
            "pij,pj->pi", np.broadcast_to(g(k * h, *x.T), (len(x), *gain.shape)), kick
        )
        x = x + h * np.broadcast_to(f((k + 0.5) * h, *x.T, *push), x.shape) + noise
        safe = _held(problem, x, (k + 1) * h)
        failed += int(np.sum(~safe))
        x = x[safe]
    return failed


def bounds(kind: str, problem: cb.Problem, seconds: float) -> tuple[float, float]:
    """(lower, upper) of the engine that the kind is about; 0 where it has no lower bound."""
    if kind in ("plane", "space"):
        return 0.0, float(10 ** bound_exits(problem, seconds=seconds).upper)
    if kind == "velocity":
        found = bound_exits_by_steps(problem, seconds=seconds)
        return 0.0 if found.lower is None else float(10**found.lower), float(10**found.upper)
    if kind == "steps":
        both = bound_failure(problem, seconds=seconds)
        return both.lower, both.upper
    return 0.0, float(10 ** bound_quadratic(problem, target=1e-6, seconds=seconds).upper)


def check(kind: str, seed: int, *, paths: int = 100_000, seconds: float = 3.0) -> tuple[str, float, float, float]:
    """("" or what is wrong, lower and upper limit of the simulation, certified upper bound)."""
    rng = np.random.default_rng([seed, 10 + KINDS.index(kind)])
    if kind == "maps":
        return _check_map(rng, paths, seconds)
    makers = {"plane": plane, "velocity": velocity, "steps": steps, "quadratic": quadratic, "space": space}
    problem = makers[kind](rng)
    problem = problem.replace(initial=problem.initial.middle) if kind == "velocity" else problem
    lower, upper = bounds(kind, problem, seconds)
    if upper >= 1 and not lower:
        return "", 0.0, 1.0, 1.0
    low, high = worst_frequency(problem, paths, rng)
    if problem.system.time == "continuous":
        low, high = low * (1 - GRANTED), high * (1 + 3 * GRANTED)  # between the steps of a path exits are missed
    known = problem.initial.random or problem.initial.is_point
    wrong = "upper bound below the truth" * (upper < low)
    wrong += f" lower {lower:.4g} above the truth" * (known and lower > high)
    return wrong, low, high, upper


def _check_map(rng: Random, paths: int, seconds: float) -> tuple[str, float, float, float]:
    """Starts at the rim of a map of safe starts, in turn; the worst of them."""
    from tests.values.random_problems import line_problem, step_problem

    pick = int(rng.integers(3))
    problem = line_problem(rng)[0] if pick == 0 else step_problem(rng) if pick == 1 else plane(rng)
    delta = float(10 ** rng.uniform(-2.5, -0.3))
    found = bound_safe_starts(problem, {}, delta)
    rows = found.to_columns()
    order = np.argsort(rows["log10_delta"])[::-1][:4]
    answer = ("", 0.0, 1.0, delta)
    for k in order:
        ends = [(rows[f"{name}_low"][k], rows[f"{name}_high"][k]) for name in problem.system.states]
        corner = [float(end[int(rng.integers(2))]) for end in ends]
        bound = min(10.0 ** float(found.bound([corner])[0]), delta)
        run = _flow if problem.system.time == "continuous" else _chain
        box = problem.system.disturbance
        pushes = [()] if box is None else [tuple(box.low), tuple(box.high)]
        fails = max(run(problem, corner, push, paths, rng, 300) for push in pushes)
        low, high = limits(fails, paths)
        low *= 1 - GRANTED if problem.system.time == "continuous" else 1.0
        wrong = f"start {corner} fails too often" * (low > bound)
        if wrong or low > answer[1]:
            answer = (wrong or answer[0], low, high, bound)
    return answer


def main(kind: str, first: int, last: int) -> int:
    """Run seeds and write a line each; the number of violations."""
    bad = 0
    for seed in range(first, last):
        begun = time.process_time()
        try:
            wrong, low, high, upper = check(kind, seed)
        except (InfeasibleError, EnclosureError) as error:
            sys.stdout.write(f"{kind} {seed}: {type(error).__name__}: {str(error)[:110]}\n")
            continue
        bad += bool(wrong)
        spent = time.process_time() - begun
        sys.stdout.write(f"{kind} {seed}: {upper:.4g}, simulated [{low:.4g}, {high:.4g}], {spent:.1f} s {wrong}\n")
        sys.stdout.flush()
    return bad


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3])) > 0)
