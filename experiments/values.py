"""Value functions beside the truth: how tight and how fast they are, and how that grows with grid and dimension.

    python -m experiments.values [--quick] [--seconds S] [--bounds] [--growth | --engines] [name ...]

prints a table in Markdown: the certified lower and upper bound of every problem, the truth with an interval, both
ratios, the processor time of the engine, and the most that the ratios may be. The truth of a line is a fine monotone
solution of the backward equation, extrapolated; of a plane with noise in both states the same by finite volumes; of
everything else a simulation with 99 % limits, by splitting where failing is rare; ``--bounds`` leaves the truth out.
``--growth`` prints time, memory and ratio over the size of the grid and the dimension, with the power law that fits
them; ``--engines`` what each engine proves of a few problems by itself. Run on purpose: minutes.
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.sparse import diags, eye, kron
from scipy.sparse.linalg import splu

import certbound as cb
from certbound.problem.model import compile_numpy
from certbound.values.discrete import bound_failure
from certbound.values.enclosing import squared_diffusion
from experiments import values_continuous, values_discrete
from experiments.values_continuous import line_problems, plane_problems

__all__ = ["CASES", "Case", "compute", "engines", "growth", "plane_truth", "space_growth", "truth_of"]

Ends = tuple[float, float]
QUICK = ("double well 0.5", "linear 0.4", "Van der Pol 0.3", "logistic map, std .06", "pendulum, std .15")
PATHS = 200_000
ABOUT = {
    "Van der Pol 0.1": 1.57e-17, "Van der Pol 0.2": 1.14e-4, "Van der Pol 0.3": 0.0343, "Lotka-Volterra 0.1": 7.3e-5,
    "Lotka-Volterra 0.2": 0.0934, "pendulum, std .06": 2.2e-7, "three rooms, 100 steps": 6.7e-4,
}  # fmt: skip
RARE = 1e-3


@dataclass(frozen=True, kw_only=True)
class Case:
    """A problem, where its truth comes from ("line", "plane" or "paths") and the ratios that are aimed at.

    ``about`` is asked as delta: near the truth, so that no side ends early as delta is met or refuted.
    """

    name: str
    problem: Callable[[], cb.Problem]
    truth: str
    upper: float
    lower: float | None
    about: float | None = None


def duffing(sigma: float) -> cb.Problem:
    """x' = v, v' = x - x^3 - v/2, noise on the speed alone."""
    system = cb.ContinuousSystem(
        lambda x: [x[1], x[0] - x[0] ** 3 - 0.5 * x[1]], states=["x", "v"], diffusion=[[0.0], [sigma]]
    )
    safe = [cb.Inside(cb.Box([0, -2], [2, 2]))]
    return cb.Problem(system, initial=cb.Box([0.9, -0.1], [1.1, 0.1]), safe=safe, horizon=5)


def swing(sigma: float) -> cb.Problem:
    """A pendulum with a noisy torque."""
    system = cb.ContinuousSystem(
        lambda x: [x[1], -9.81 * np.sin(x[0]) - 0.5 * x[1]], states=["angle", "speed"], diffusion=[[0.0], [sigma]]
    )
    safe = [cb.Inside(cb.Box([-1.2, -5], [1.2, 5]))]
    return cb.Problem(system, initial=cb.Box([-0.1, -0.1], [0.1, 0.1]), safe=safe, horizon=5)


def oscillator() -> cb.Problem:
    """A hardening spring with a noisy speed that must stay below 2.25."""
    system = cb.ContinuousSystem(
        lambda x: [x[1], -x[0] - x[1] - 0.5 * x[0] ** 3], states=["x1", "x2"], diffusion=[[0.0], [0.5]]
    )
    safe = [cb.Outside(cb.HalfSpace([0, -1], -2.25)), cb.Inside(cb.Box([-3, -3], [3, 3]))]
    return cb.Problem(system, initial=cb.Box([-1, -1], [1, 1]), safe=safe, horizon=5)


def around_ball() -> cb.Problem:
    """An Ornstein-Uhlenbeck process in the plane around a ball off the grid's lines."""
    system = cb.ContinuousSystem(lambda x: -x, states=2, diffusion=0.4 * np.eye(2))
    safe = [cb.Inside(cb.Box([-2, -2], [2, 2])), cb.Outside(cb.Ball([0.93, 0.71], 0.5))]
    return cb.Problem(system, initial=[-0.3, -0.2], safe=safe, horizon=2)


def in_ellipse() -> cb.Problem:
    """A linear drift within an ellipse, from a ball."""
    system = cb.ContinuousSystem(lambda x: [-x[0] + 0.5 * x[1], -x[1]], states=2, diffusion=0.35 * np.eye(2))
    safe = [cb.Inside(cb.Ellipsoid([0, 0], [[1.2, 0.4], [0.4, 0.7]]))]
    return cb.Problem(system, initial=cb.Ball([0.1, 0], 0.1), safe=safe, horizon=1.5)


def half_disc() -> cb.Problem:
    """A cubic oscillator with a noisy speed and a box around a half-disc (Jarmill, prob_unsafe): noise in one state."""
    system = cb.ContinuousSystem(
        lambda x: [x[1], -(x[0] + x[1] + 0.5 * x[0] ** 3)], states=["x1", "x2"], diffusion=[[0.0], [0.1]]
    )
    return cb.Problem(system, initial=[0.85, -0.75], safe=[cb.Outside(cb.Box([-1, -1.25], [0, -0.75]))], horizon=5)


def lorenz() -> cb.Problem:
    """Three states with noise on each."""
    system = cb.ContinuousSystem(
        lambda x: [2 * (x[1] - x[0]), x[0] * (0.5 - x[2]) - x[1], x[0] * x[1] - x[2]], states=3,
        diffusion=0.35 * np.eye(3),
    )  # fmt: skip
    safe = [cb.Inside(cb.Box([-1.5] * 3, [1.5] * 3))]
    return cb.Problem(system, initial=cb.Box([-0.2] * 3, [0.2] * 3), safe=safe, horizon=2)


def unicycle() -> cb.Problem:
    """A vehicle of speed 1 with noise on its heading alone."""
    system = cb.ContinuousSystem(
        lambda x: [np.cos(x[2]), np.sin(x[2]), 0 * x[2]], states=3, diffusion=[[0.0], [0.0], [1.0]]
    )
    safe = [cb.Inside(cb.Box([-1, -1], [3, 1], coordinates=[0, 1]))]
    return cb.Problem(system, initial=cb.Box([-0.05] * 3, [0.05] * 3), safe=safe, horizon=2)


def cube() -> cb.Problem:
    """Brownian motion in a cube, from its middle: three independent lines."""
    system = cb.ContinuousSystem(lambda x: [0 * x[0], 0 * x[1], 0 * x[2]], states=3, diffusion=0.35 * np.eye(3))
    safe = [cb.Inside(cb.Box([-1] * 3, [1] * 3))]
    return cb.Problem(system, initial=[0, 0, 0], safe=safe, horizon=1)


def _listed(problems: Iterator[tuple[str, cb.Problem]], truth: str, aims: dict[str, Ends]) -> Iterator[Case]:
    for name, problem in problems:
        upper, lower = next((pair for key, pair in aims.items() if name.startswith(key)), (1.05, 1.1))
        about = ABOUT.get(name)
        yield Case(name=name, problem=lambda p=problem: p, truth=truth, upper=upper, lower=lower, about=about)


CASES: tuple[Case, ...] = (
    *_listed(line_problems(), "line", {}),
    *_listed(plane_problems(), "plane", {"Van der Pol": (1.3, 1.5), "Lotka": (1.5, 1.5)}),
    *(Case(name=f"Duffing {s}", problem=lambda s=s: duffing(s), truth="paths", upper=1.25, lower=1.5)
      for s in (0.15, 0.25, 0.4)),
    Case(name="pendulum, torque 1.0", problem=lambda: swing(1.0), truth="paths", upper=1.3, lower=1.5),
    Case(name="cubic oscillator .5", problem=oscillator, truth="paths", upper=1.5, lower=1.5),
    Case(name="around a ball", problem=around_ball, truth="paths", upper=1.2, lower=1.5),
    Case(name="in an ellipse", problem=in_ellipse, truth="paths", upper=1.3, lower=None),
    Case(name="half-disc in its box", problem=half_disc, truth="paths", upper=1.3, lower=1.5),
    Case(name="Lorenz-like", problem=lorenz, truth="paths", upper=5.0, lower=None),
    Case(name="unicycle", problem=unicycle, truth="paths", upper=2.0, lower=None),
    Case(name="cube", problem=cube, truth="paths", upper=1.5, lower=None),
    *(Case(name=name, problem=make, truth="paths", upper=1.1, lower=1.1, about=ABOUT.get(name))
      for name, make in values_discrete.PROBLEMS.items()),
)  # fmt: skip


# ---- the truth -----------------------------------------------------------------------------------------------


def truth_of(case: Case, problem: cb.Problem) -> tuple[float, float, float]:
    """(value, low, high) of the probability from the worst start; by simulation from corners and middle only."""
    if case.truth == "line":
        fine, coarse = values_continuous.truth(problem), values_continuous.truth(problem, 1000, 1000)
        return fine, min(fine, coarse), max(fine, coarse)
    if case.truth == "plane":
        value, low, high = plane_truth(problem, 160)
        return (value, low, high) if high < 1.2 * low else _worst_of_paths(problem)  # the grid is too coarse for it
    return _worst_of_paths(problem)


def _worst_of_paths(problem: cb.Problem) -> tuple[float, float, float]:
    around = problem.initial.hull()
    points = {tuple(point) for point in itertools.product(*zip(around.lo, around.hi))} | {tuple(around.mid)}
    best = (0.0, 0.0, 0.0)
    for point in sorted(points):
        one = problem.replace(initial=list(point))
        found = cb.simulate_exits(one, paths=PATHS, rng=np.random.default_rng(1))
        if found.probability < RARE:
            from certbound.simulation.estimates import simulate_rare_exits

            found = simulate_rare_exits(one, paths=PATHS, rng=np.random.default_rng(1))
        best = max(best, (found.probability, found.lower, found.upper))
    return best


def plane_truth(problem: cb.Problem, cells: int) -> tuple[float, float, float]:
    """Finite volumes on a grid, extrapolated; the interval is what half the grid gives, as a measure of the error."""
    coarse, fine = _plane(problem, cells // 2), _plane(problem, cells)
    better = fine + (fine - coarse) / 3
    spread = abs(fine - coarse)
    return better, better - spread, better + spread


def _plane(problem: cb.Problem, cells: int) -> float:
    """u_t + f.grad u + (a_11 u_xx + a_22 u_yy)/2 = 0 with u = 1 on the faces, from the worst start.

    Fitted rates along each axis, and an L-stable step of order 2 whose length doubles: one factorisation a length.
    """
    region = problem.safe[0].region
    axes = [np.linspace(low, high, cells + 1) for low, high in zip(region.low, region.high)]
    x = [axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")]
    drift = compile_numpy(problem.closed_loop)(0.0, *x)
    square = compile_numpy(squared_diffusion(problem.system.diffusion, problem.system.states))(0.0, *x)
    square = np.broadcast_to(square, (len(x[0]), 2, 2))
    inside = np.ones((cells + 1, cells + 1), dtype=bool)
    inside[[0, -1]] = inside[:, [0, -1]] = False
    free = diags(inside.ravel().astype(float))
    total = None
    for axis in (0, 1):
        h = axes[axis][1] - axes[axis][0]
        f, a = drift[:, axis], square[:, axis, axis]
        q = 2 * f * h / a
        small = np.abs(q) < 1e-9
        down = a / (2 * h * h) * np.where(small, 1.0, q / np.expm1(np.where(small, 1.0, q)))
        up = down + f / h
        shift = diags([np.ones(cells)], [1], shape=(cells + 1, cells + 1))
        one = eye(cells + 1)
        ahead = kron(shift, one) if axis == 0 else kron(one, shift)
        part = diags(up) @ ahead + diags(down) @ ahead.T - diags(up + down)
        total = part if total is None else total + part
    operator = (free @ total).tocsc()
    u, gamma = (~inside).astype(float).ravel(), 1 - 0.5**0.5
    lengths = problem.horizon * 2.0 ** -np.arange(11, -1, -1.0)
    for step in (lengths - np.concatenate([[0.0], lengths[:-1]])) / 24:
        solve = splu((eye(len(u)) - gamma * step * operator).tocsc()).solve
        for _ in range(24):
            u = np.maximum(solve(u + (1 / gamma - 1) * (solve(u) - u)), 0.0)
    chosen = np.ones(len(u), dtype=bool)
    for axis, low, high in zip(x, problem.initial.low, problem.initial.high):
        chosen &= (axis >= low - 1e-9) & (axis <= high + 1e-9)
    return float(u[chosen].max())


# ---- tables --------------------------------------------------------------------------------------------------

HEAD = "| problem | lower | upper | truth | interval | upper/truth | truth/lower | aim | CPU s |"


def compute(names: list[str], *, seconds: float | None = None, bounds: bool = False) -> Iterator[str]:
    """The table, line by line; of what an engine refuses, its words."""
    yield HEAD
    yield "| --- " * 9 + "|"
    for case in CASES:
        if names and not any(part in case.name for part in names):
            continue
        yield _row(case, seconds, bounds=bounds)


def _row(case: Case, seconds: float | None, *, bounds: bool) -> str:
    problem = case.problem()
    problem = problem if case.about is None else problem.replace(delta=case.about)
    begin = time.process_time()
    upper, lower, words = _bounds(problem, seconds)
    spent = time.process_time() - begin
    if words:
        return f"| {case.name} | - | - | - | - | - | - | {case.upper:g} | {words} |"
    truth, low, high = (math.nan, math.nan, math.nan) if bounds else truth_of(case, problem)
    above, below = f"{upper / truth:.3f}" if low > 0 else "-", f"{truth / lower:.3f}" if lower and low > 0 else "-"
    aim = f"{case.upper:g}" + ("" if case.lower is None else f", {case.lower:g}")
    return (
        f"| {case.name} | {lower:.4g} | {upper:.4g} | {truth:.4g} | {low:.3g} ... {high:.3g} | {above} "
        f"| {below} | {aim} | {spent:.1f} |"
    )


def _bounds(problem: cb.Problem, seconds: float | None) -> tuple[float, float, str]:
    """(upper, lower, why not); within ``seconds`` or as the engine spends its time by itself."""
    if seconds is None:
        verdict = cb.verify_safety(problem, method="values")
        answer = verdict.answers.get("values")
        if answer is None or not answer.applicable:
            return 1.0, 0.0, verdict.reason
        return 10.0**answer.log10_delta, 0.0 if answer.log10_lower is None else 10.0**answer.log10_lower, ""
    from certbound.values.continuous import bound_exits

    try:
        if problem.system.time == "discrete":
            steps = bound_failure(problem, seconds=seconds, ratio=1.02)
            return steps.upper, steps.lower, ""
        found = bound_exits(problem, seconds=seconds)
    except cb.InfeasibleError as error:
        return 1.0, 0.0, str(error)
    return 10.0**found.upper, 0.0 if found.lower is None else 10.0**found.lower, ""


def engines() -> Iterator[str]:
    """What each engine proves of a few problems by itself, as log10 of its bound, and the processor time it takes."""
    from certbound.safety.portfolio import ENGINES

    yield "| problem | " + " | ".join(ENGINES) + " |"
    yield "| --- " * (len(ENGINES) + 1) + "|"
    chosen = ("double well 0.35", "Van der Pol 0.3", "Duffing 0.25", "logistic map, std .04", "pendulum, std .1")
    listed = {case.name: case.problem for case in CASES if case.name in (*chosen, "three rooms, 100 steps")}
    bundled = {name: lambda n=name: cb.load(n) for name in ("ou", "unicycle", "chain_rest")}
    for name, make in (bundled | listed).items():
        cells = []
        for method in ENGINES:
            begin = time.process_time()
            answer = cb.verify_safety(make(), method=method).answers[method]
            spent = time.process_time() - begin
            found = f"{answer.log10_delta:.2f}" if answer.applicable and answer.log10_delta < 0 else "-"
            cells.append(f"{found} ({spent:.1f} s)")
        yield f"| {name} | " + " | ".join(cells) + " |"


GAPS = {1: (0.03, 3e-4, 3e-5, 3e-6), 2: (0.1, 0.02, 2e-3, 5e-4), 3: (0.3, 0.03, 0.01, 5e-3)}


def growth(quick: bool) -> Iterator[str]:
    """x+ = .9 x with noise .3 on each of n states in [-1, 1]^n, ten steps: what smaller and smaller gaps cost."""
    yield "| states | cells | CPU s | MB | upper/lower - 1 |"
    yield "| --- " * 5 + "|"
    for n, gaps in GAPS.items():
        found: dict[int, tuple[float, float, float]] = {}
        system = cb.DiscreteSystem(lambda x: 0.9 * x, states=n, noise=cb.Gaussian(std=0.3))
        safe = [cb.Inside(cb.Box([-1.0] * n, [1.0] * n))]
        problem = cb.Problem(system, initial=[0.0] * n, safe=safe, horizon=10)
        for gap in gaps[:2] if quick else gaps:
            begin = time.process_time()
            bounds = bound_failure(problem, ratio=1 + gap, seconds=120.0)
            seconds = time.process_time() - begin
            cells = math.prod(bounds.cells)
            if cells in found:
                continue
            memory = _memory(lambda p=problem, g=gap: bound_failure(p, ratio=1 + g, seconds=120.0))
            found[cells] = (seconds, memory, bounds.upper / bounds.lower - 1)
            yield f"| {n} | {cells} | {seconds:.2f} | {memory:.0f} | {found[cells][2]:.2g} |"
        if len(found) > 1:
            logs = np.log(np.array([(cells, *row) for cells, row in found.items()]))
            laws = [float(np.polyfit(logs[:, 0], logs[:, k], 1)[0]) for k in (1, 2, 3)]
            yield f"| {n} | cells^p | p = {laws[0]:.2f} | p = {laws[1]:.2f} | p = {laws[2]:.2f} |"


def space_growth(quick: bool) -> Iterator[str]:
    """The cube: what seconds buy in three states and continuous time, where the truth is known in closed form."""
    odd = 2 * np.arange(60) + 1.0
    stays = 4 / np.pi * np.sum((-1.0) ** np.arange(60) / odd * np.exp(-((0.35 * np.pi * odd) ** 2) / 8))
    truth, rows = 1 - float(stays) ** 3, []
    yield "| seconds granted | grids | CPU s | MB | upper/truth |"
    yield "| --- " * 5 + "|"
    for seconds in (2.0, 8.0) if quick else (2.0, 8.0, 32.0, 128.0):
        begin = time.process_time()
        found = values_continuous.bound_exits(cube(), seconds=seconds, lower=False)
        spent, ratio = time.process_time() - begin, 10.0**found.upper / truth
        memory = _memory(lambda s=seconds: values_continuous.bound_exits(cube(), seconds=s, lower=False))
        rows.append((spent, memory, ratio - 1))
        yield f"| {seconds:g} | {found.words.rpartition('cells: ')[2]} | {spent:.1f} | {memory:.0f} | {ratio:.3f} |"
    logs = np.log(np.array(rows))
    laws = [float(np.polyfit(logs[:, 0], logs[:, k], 1)[0]) for k in (1, 2)]
    yield f"| | CPU s^p | | p = {laws[0]:.2f} | ratio - 1: p = {laws[1]:.2f} |"


def _memory(task: Callable[[], object]) -> float:
    """The peak of what Python and NumPy allocate, in megabytes; measured apart, since measuring takes time."""
    tracemalloc.start()
    task()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak / 1e6


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m experiments.values")
    parser.add_argument("names", nargs="*", help="parts of names of problems (default: all)")
    parser.add_argument("--quick", action="store_true", help="five problems, and the growth on two grids each")
    parser.add_argument("--seconds", type=float, help="of the engine for each problem (default: its own limit)")
    parser.add_argument("--bounds", action="store_true", help="bounds and processor times only, without the truth")
    parser.add_argument("--growth", action="store_true", help="only how it grows")
    parser.add_argument("--engines", action="store_true", help="only the engines side by side")
    options = parser.parse_args()
    if options.engines:
        for line in engines():
            print(line, flush=True)
        return
    if not options.growth:
        names = options.names or (list(QUICK) if options.quick else [])
        for line in compute(names, seconds=options.seconds, bounds=options.bounds):
            print(line, flush=True)
    if options.growth or (options.quick and not options.names):
        for line in itertools.chain(growth(options.quick), space_growth(options.quick)):
            print(line, flush=True)


if __name__ == "__main__":
    main()
