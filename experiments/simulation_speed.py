"""Path-steps per second of the kernels, beside the same loops in JAX and in vectorised NumPy, in one run.

Scalar Ornstein-Uhlenbeck process, Euler-Maruyama, running maximum of |X| (the kernels with their Brownian bridge,
which the others leave out): JAX compiles a scan in float32, with the fastest of its generators, batch sizes and
unrollings. Unicycle: NumPy steps all paths of a batch at once and looks for obstacles after every step.

The contestants take turns, so that whatever else the machine does hits all of them, and each keeps its best turn;
compilation is left out, and all may use every core. ``python -m experiments.simulation_speed [--full]``; JAX is left
out where the extra ``compare`` is not installed.
"""

from __future__ import annotations

import importlib.util
import os
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

import certbound as cb
from certbound.simulation.estimates import simulate_exits
from certbound.simulation.estimates.deviations import sup_deviation
from certbound.simulation.stepping import Scenario
from experiments.harness import Arrays, Claims, main

RATE, SIGMA, HORIZON, STEPS = -0.5, 0.1**0.5, 5.0, 1000
STEP = HORIZON / STEPS

Contestant = tuple[Callable[[], Any], float]  # what to run, and its path-steps


def race(contestants: Mapping[str, Contestant], turns: int) -> dict[str, float]:
    """Path-steps per second of each, in its best turn; a turn that is not counted comes first."""
    best = dict.fromkeys(contestants, 0.0)
    for turn in range(-1, turns):
        for name, (run, path_steps) in contestants.items():
            started = time.perf_counter()
            run()
            rate = path_steps / (time.perf_counter() - started)
            best[name] = max(best[name], rate if turn >= 0 else 0.0)
    return best


def ou_here(paths: int, scenario: Scenario) -> Contestant:
    """The kernel on the scalar process."""
    system = cb.ContinuousSystem(lambda x: RATE * x, states=1, diffusion=[[SIGMA]])
    domain = cb.Box([-99.0], [99.0])
    problem = cb.Problem(system, initial=[0.0], safe=[], domain=domain, horizon=HORIZON)
    return (
        lambda: sup_deviation(problem, paths=paths, rng=1, steps=STEPS, scenario=scenario),
        paths * STEPS,
    )


def ou_numpy(paths: int, batch: int = 8192) -> Contestant:
    """The same loop in NumPy, one thread."""
    shock, factor = SIGMA * STEP**0.5, 1.0 + RATE * STEP
    rng = np.random.Generator(np.random.SFC64(1))
    rounds = max(paths // batch, 1)

    def run() -> None:
        for _ in range(rounds):
            x, top, z = np.zeros(batch), np.zeros(batch), np.empty(batch)
            for _ in range(STEPS):
                rng.standard_normal(out=z)
                x = factor * x + shock * z
                np.maximum(top, np.abs(x), out=top)

    return run, rounds * batch * STEPS


def ou_jax(paths: int, generator: str, batch: int, unroll: int) -> Contestant:
    """The same loop in JAX."""
    import jax
    import jax.numpy as jnp

    shock, factor = SIGMA * STEP**0.5, 1.0 + RATE * STEP

    def advance(carry: Any, key: Any) -> Any:
        x, top = carry
        x = factor * x + shock * jax.random.normal(key, (batch,), dtype=jnp.float32)
        return (x, jnp.maximum(top, jnp.abs(x))), None

    def loop(key: Any) -> Any:
        start = (jnp.zeros(batch, jnp.float32), jnp.zeros(batch, jnp.float32))
        return jax.lax.scan(advance, start, jax.random.split(key, STEPS), unroll=unroll)[0][1]

    compiled, key = jax.jit(loop), jax.random.key(1, impl=generator)
    rounds = max(paths // batch, 1)

    def run() -> None:
        for _ in range(rounds):
            compiled(key).block_until_ready()

    return run, rounds * batch * STEPS


def fastest_jax(paths: int) -> tuple[str, int, int]:
    """Generator, batch size and unrolling that are fastest on a short run."""
    choices = [
        (generator, batch, unroll)
        for generator in ("threefry2x32", "rbg", "unsafe_rbg")
        for batch in (2048, 16384, 65536)
        for unroll in (1, 8)
    ]
    contestants = {str(choice): ou_jax(paths, *choice) for choice in choices}
    rates = race(contestants, 2)
    return max(choices, key=lambda choice: rates[str(choice)])


def unicycle_here(paths: int) -> Contestant:
    """The kernel on the bundled unicycle: exits, with bridge."""
    problem = cb.load("unicycle")
    return lambda: simulate_exits(problem, paths=paths, rng=1, steps=STEPS), paths * STEPS


def unicycle_numpy(paths: int, batch: int) -> Contestant:
    """The same in NumPy, one thread, without a bridge."""
    problem = cb.load("unicycle")
    values = problem.parameters
    step = float(problem.horizon) / STEPS
    obstacles = [(c.region.center, c.region.radius) for c in problem.safe]
    rng = np.random.Generator(np.random.SFC64(1))
    rounds = max(paths // batch, 1)

    def run() -> None:
        for _ in range(rounds):
            start = problem.initial.sample(rng, batch)
            px, py, th = (start[:, i].copy() for i in range(3))
            d = rng.uniform(-values["disturbance"], values["disturbance"], batch)
            safe = np.ones(batch, dtype=bool)
            for _ in range(STEPS):
                ux, uy = 0.5 - px, 0.0 - py
                cos, sin = np.cos(th), np.sin(th)
                dot, cross = ux * cos + uy * sin, uy * cos - ux * sin
                turn = values["k"] * np.arctan2(cross, dot)
                turn += values["gamma"] * cross * dot / (ux**2 + uy**2)
                speed = values["gamma"] * dot
                z = values["sigma"] * step**0.5 * rng.standard_normal((3, batch))
                px = px + step * speed * cos + z[0]
                py = py + step * speed * sin + z[1]
                th = th + step * (turn + d) + z[2]
                for center, radius in obstacles:
                    safe &= (px - center[0]) ** 2 + (py - center[1]) ** 2 > radius**2

    return run, rounds * batch * STEPS


def compute(full: bool) -> tuple[Arrays, Claims]:
    """All rates, and the ratios that matter."""
    paths, turns = (200_000, 8) if full else (65_536, 4)
    scalar = {
        "here": ou_here(paths, Scenario(scheme="euler")),
        "here, no bridge": ou_here(paths, Scenario(scheme="euler", bridge=False)),
        "numpy": ou_numpy(paths // 8),
    }
    claims: Claims = {}
    if importlib.util.find_spec("jax") is not None:
        os.environ.setdefault("JAX_PLATFORMS", "cpu")
        choice = fastest_jax(paths // 4)
        claims["jax_choice"] = list(choice)
        scalar["jax"] = ou_jax(paths, *choice)
    rates = race(scalar, turns)
    claims["ou"] = rates
    claims["ou_over_jax"] = rates["here"] / rates["jax"] if "jax" in rates else None
    steering = {"here": unicycle_here(paths // 4)}
    steering |= {f"numpy, batch {batch}": unicycle_numpy(paths // 32, batch) for batch in (1024, 4096)}
    rates = race(steering, turns)
    claims["unicycle"] = rates
    claims["unicycle_over_numpy"] = rates["here"] / max(rate for name, rate in rates.items() if name != "here")
    for name, value in claims.items():
        print(f"{name:>20}  {value}")
    return {}, claims


if __name__ == "__main__":
    main("simulation_speed", compute)
