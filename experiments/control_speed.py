"""Times of the control room: receding-horizon steps, plans, runs of the closed loop, the convex path, the filter.

Milliseconds of wall time as the machine is when asked, and of processor time where others may be using it; the first
step, which builds and compiles the program, is left out and printed beside.

``python -m experiments.control_speed [--full]``
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

import certbound as cb
from certbound.problem.model import compile_numpy
from certbound.synthesis.tightening import initial_center
from experiments.harness import Arrays, Claims, main

HORIZON = 20
SAMPLE = 0.05
NOISE = 0.01


def timed(run: Callable[[], Any]) -> tuple[Any, float]:
    """What a call returns, and its milliseconds."""
    began = time.perf_counter()
    found = run()
    return found, 1e3 * (time.perf_counter() - began)


def spread(times: list[float]) -> dict[str, float]:
    """Median, 99 % quantile and maximum."""
    return {
        "median": float(np.median(times)), "99 %": float(np.quantile(times, 0.99)), "largest": float(np.max(times)),
    }  # fmt: skip


def receding(masses: int, rounds: int) -> Claims:
    """Steps of the predictive controller on the chain, N = 20."""
    chain = cb.load("chain", masses=masses)
    plan, planning = timed(lambda: cb.synthesize_plan(chain))
    controller = cb.PredictiveController(chain, horizon=HORIZON, plan=plan)
    _, first = timed(controller.step)
    times: list[float] = []
    busy: list[float] = []
    for _ in range(rounds):
        controller.reset()
        for k in range(chain.horizon):
            began = time.process_time()
            _, spent = timed(controller.step)
            times += [spent] if k else []
            busy += [1e3 * (time.process_time() - began)] if k else []
    verdict, proving = timed(controller.verify)
    return {"plan": planning, "first step": first, "verification": proving, "status": verdict.status, **spread(times),
            "processor, median": float(np.median(busy)), "processor, 99 %": float(np.quantile(busy, 0.99))}  # fmt: skip


def convex(masses: int) -> Claims:
    """Steps of the convex path on the chain, whose dynamics are linearised along the last prediction."""
    chain = cb.load("chain", masses=masses)
    planner, state = cb.ConvexPlanner(chain, horizon=HORIZON), initial_center(chain.initial)
    times: list[float] = []
    for k in range(30):
        found, spent = timed(lambda start=state: planner.solve(start))  # type: ignore[misc]
        state = planner.piece(state, found.inputs[0], 0.0)[0]
        times += [spent] if k else []
    return spread(times)


def runs() -> Claims:
    """3000 noisy runs of 50 steps with the plan: once with compilation, once without."""
    plan = cb.synthesize_plan(cb.load("chain"), method="linear")
    return {
        name: timed(lambda: cb.simulate_closed_loop(plan, runs=3000, rng=0))[1] for name in ("first", "again")
    }  # fmt: skip


def unicycle() -> cb.Problem:
    """A unicycle with speed and turning rate as inputs, among the three obstacles of Sec. VIII-A."""

    def move(x: Any, u: Any) -> list[Any]:
        return [x[0] + SAMPLE * u[0] * np.cos(x[2]), x[1] + SAMPLE * u[0] * np.sin(x[2]), x[2] + SAMPLE * u[1]]

    system = cb.DiscreteSystem(
        move, states=["px", "py", "th"], inputs=cb.Box([0, -2], [1, 2]), noise=cb.Gaussian(std=NOISE * SAMPLE**0.5),
    )  # fmt: skip
    obstacles = cb.load("unicycle").safe
    return cb.Problem(system, initial=[5, 5, -2 * np.pi / 3], safe=obstacles, horizon=100, delta=1e-3)


def filtered(rounds: int) -> Claims:
    """The safety filter around a controller that drives from its measured state at an obstacle's centre."""
    problem = unicycle()
    guard, building = timed(lambda: cb.SafetyFilter(problem, steady=True))
    step, target = compile_numpy(problem.system.dynamics), np.asarray(problem.safe[0].region.center)
    radius = float(problem.safe[0].region.radius)
    rng, times, changed, nearest, kept = np.random.default_rng(0), [], [], np.inf, True
    for _ in range(rounds):
        guard.reset()
        x = guard.state.copy()
        for k in range(problem.horizon):
            ahead = target - x[:2]
            turn = np.angle(np.exp(1j * (np.arctan2(ahead[1], ahead[0]) - x[2])))
            report, spent = timed(lambda turn=turn: guard.step([1.0, 2 * turn]))  # type: ignore[misc]
            x = step(k, *x, *report.input) + NOISE * SAMPLE**0.5 * rng.standard_normal(3)
            nearest = min(nearest, float(np.linalg.norm(x[:2] - target)))
            times.append(spent)
            changed += [spent] if report.changed > 1e-9 else []
        kept = kept and guard.guaranteed
    return {
        "building": building, **spread(times), "steps": len(times), "steps that changed": len(changed),
        "median of those": float(np.median(changed)), "guaranteed": kept, "nearest": nearest, "obstacle": radius,
    }  # fmt: skip


def compute(full: bool) -> tuple[Arrays, Claims]:
    """All times, in ms."""
    rounds = 10 if full else 3
    claims: Claims = {
        "receding horizon, 3 masses": receding(3, rounds),
        "receding horizon, 10 masses": receding(10, rounds),
        "convex, 3 masses": convex(3),
        "3000 runs of 50 steps": runs(),
        "safety filter, unicycle": filtered(rounds),
    }
    for name, value in claims.items():
        print(name)
        for key, number in value.items():
            print(f"{key:>30}  {number}")
    return {}, claims


if __name__ == "__main__":
    main("control_speed", compute)
