"""Path-steps per second of the kernels, beside the same loops in JAX and in vectorised NumPy, in one run.

Scalar Ornstein-Uhlenbeck process, Euler-Maruyama, running maximum of |X| (the kernels with their Brownian bridge,
which the other two leave out): JAX compiles a scan in float32, with the fastest of its generators, batch sizes and
unrollings. Unicycle: NumPy steps all paths of a batch at once, with the fastest of several batch sizes, and looks for
obstacles after every step. Every rate is the best of three runs, compilation left out; all use the machine's cores as
they choose to.

    python -m experiments.simulation_speed [--full]

JAX is left out where the extra ``compare`` is not installed.
"""

from __future__ import annotations

import importlib.util
import os
import time
from collections.abc import Callable
from typing import Any

import numpy as np

import certbound as cb
from certbound.simulation.deviations import sup_deviation
from certbound.simulation.montecarlo import simulate_exits
from certbound.simulation.stepping import Scenario
from experiments.harness import Arrays, Claims, main

RATE, SIGMA, HORIZON, STEPS = -0.5, 0.1**0.5, 5.0, 1000
REPEATS = 3


def best(run: Callable[[], Any], path_steps: float) -> float:
    """Path-steps per second of the fastest of three runs, after one that is not counted."""
    run()
    seconds = []
    for _ in range(REPEATS):
        started = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - started)
    return path_steps / min(seconds)


def ou_here(paths: int) -> dict[str, float]:
    """Rates of the kernels on the scalar process: by Euler's scheme with and without the bridge, and exactly."""
    system = cb.ContinuousSystem(lambda x: RATE * x, states=1, diffusion=[[SIGMA]])
    domain = cb.Box([-99.0], [99.0])
    problem = cb.Problem(system, initial=[0.0], safe=[], domain=domain, horizon=HORIZON)
    rates = {}
    for name, scenario in {
        "euler, bridge": Scenario(scheme="euler"),
        "euler, no bridge": Scenario(scheme="euler", bridge=False),
        "exact, bridge": Scenario(),
    }.items():

        def run(scenario: Scenario = scenario) -> Any:
            return sup_deviation(problem, paths=paths, rng=1, steps=STEPS, scenario=scenario)

        rates[name] = best(run, paths * STEPS)
    return rates


def ou_numpy(paths: int) -> float:
    """Rate of the same loop in NumPy, one thread, batches that stay in the cache."""
    step = HORIZON / STEPS
    shock, factor = SIGMA * step**0.5, 1.0 + RATE * step
    rates = []
    for batch in (1024, 8192):
        rng = np.random.Generator(np.random.SFC64(1))

        def run(batch: int = batch, rng: np.random.Generator = rng) -> None:
            for _ in range(max(paths // batch, 1)):
                x, top, z = np.zeros(batch), np.zeros(batch), np.empty(batch)
                for _ in range(STEPS):
                    rng.standard_normal(out=z)
                    x = factor * x + shock * z
                    np.maximum(top, np.abs(x), out=top)

        rates.append(best(run, max(paths // batch, 1) * batch * STEPS))
    return max(rates)


def ou_jax(paths: int) -> dict[str, float]:
    """Rates of the same loop in JAX (jit, scan, float32) by generator, best over batches and unrolling."""
    if importlib.util.find_spec("jax") is None:
        return {}
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    import jax
    import jax.numpy as jnp

    step = HORIZON / STEPS
    shock, factor = SIGMA * step**0.5, 1.0 + RATE * step
    rates: dict[str, float] = {}
    for generator in ("threefry2x32", "rbg", "unsafe_rbg"):
        for batch in (2048, 16384, 131072):
            for unroll in (1, 8):

                def loop(key: Any, batch: int = batch, unroll: int = unroll) -> Any:
                    def advance(carry: Any, subkey: Any) -> Any:
                        x, top = carry
                        x = factor * x + shock * jax.random.normal(subkey, (batch,), dtype=jnp.float32)
                        return (x, jnp.maximum(top, jnp.abs(x))), None

                    start = (jnp.zeros(batch, jnp.float32), jnp.zeros(batch, jnp.float32))
                    keys = jax.random.split(key, STEPS)
                    return jax.lax.scan(advance, start, keys, unroll=unroll)[0][1]

                compiled = jax.jit(loop)
                key = jax.random.key(1, impl=generator)
                rounds = max(paths // batch, 1)

                def run(compiled: Any = compiled, key: Any = key, rounds: int = rounds) -> None:
                    for _ in range(rounds):
                        compiled(key).block_until_ready()

                rate = best(run, rounds * batch * STEPS)
                rates[generator] = max(rate, rates.get(generator, 0.0))
    return rates


def unicycle_here(paths: int) -> float:
    """Rate of the kernels on the bundled unicycle, exits with bridge."""
    problem = cb.load("unicycle")
    return best(lambda: simulate_exits(problem, paths=paths, rng=1, steps=STEPS), paths * STEPS)


def unicycle_numpy(paths: int) -> float:
    """Rate of the same in NumPy, one thread, without a bridge."""
    problem = cb.load("unicycle")
    values = problem.parameters
    step = float(problem.horizon) / STEPS
    obstacles = [(c.region.center, c.region.radius) for c in problem.safe]
    rates = []
    for batch in (1024, 8192):
        rng = np.random.Generator(np.random.SFC64(1))
        rounds = max(paths // batch, 1)

        def run(batch: int = batch, rng: np.random.Generator = rng, rounds: int = rounds) -> None:
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

        rates.append(best(run, rounds * batch * STEPS))
    return max(rates)


def compute(full: bool) -> tuple[Arrays, Claims]:
    """All rates, and the two ratios that matter."""
    paths = 400_000 if full else 100_000
    here, jax = ou_here(paths), ou_jax(paths)
    claims: Claims = {
        "ou_here": here,
        "ou_numpy": ou_numpy(paths // 8),
        "ou_jax": jax,
        "unicycle_here": unicycle_here(paths // 4),
        "unicycle_numpy": unicycle_numpy(paths // 32),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
    }
    claims["unicycle_over_numpy"] = claims["unicycle_here"] / claims["unicycle_numpy"]
    claims["ou_over_jax"] = here["euler, bridge"] / max(jax.values()) if jax else None
    for name, value in claims.items():
        print(f"{name:>20}  {value}")
    return {}, claims


if __name__ == "__main__":
    main("simulation_speed", compute)
