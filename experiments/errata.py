"""What docs/theory.md says of the paper's slips, computed: no figure, only claims for the check."""

from __future__ import annotations

import itertools
import math

import numpy as np

import certbound as cb
from certbound.problem.model import compile_numpy, jacobian
from certbound.tubes.kummer import KummerProfile
from certbound.tubes.question import Start
from certbound.tubes.schedule import make_schedule
from experiments.harness import Arrays, Claims, main
from experiments.linear import SIGMA, limit, paths, tube


def compute(full: bool) -> tuple[Arrays, Claims]:
    """One claim a slip that can be computed."""
    count = 2_000_000 if full else 200_000
    claims: Claims = {"paths": count}
    for name, gain, horizon in (("half", 0.5, 5), ("tenth", 0.1, 1)):
        claims[f"thm4_printed_{name}"] = left(gain, horizon, "thm4_as_printed", count)
        claims[f"thm4_corrected_{name}"] = left(gain, horizon, "thm4", count)
    claims["epsilon_2_printed"] = 2 / (1 / 16) ** 2
    claims["cosh_epsilon"] = cosh_epsilon()
    claims["lemma_3_bound"], claims["lemma_3_truth"] = lemma_3()
    claims["unicycle_rate"] = unicycle_rate(20_000 if full else 4_000)
    claims["chain_gain"] = chain_gain()
    claims["pointwise_minimum"] = pointwise_minimum(count // 10)
    claims["anticipating"] = anticipating(count // 100)
    claims["reflection"] = tube("thm2", 0.0, 2.0).maximum / limit(0.0, 2.0).maximum
    return {}, claims


def left(gain: float, horizon: int, method: str, count: int) -> float:
    """Share of paths of x+ = L x + w, w ~ N(0, 1), that leave a tube for delta = 0.01 with the best epsilon."""
    known = cb.Constants(gain=gain, sigma=1.0, dimension=1, isotropic=True)
    radius = cb.tune_tube(known, horizon=horizon, delta=0.01, method=method).radius(np.arange(horizon + 1.0))
    rng = np.random.default_rng(41)
    state, outside = np.zeros(count), np.zeros(count, dtype=bool)
    for step in range(1, horizon + 1):
        state = gain * state + rng.standard_normal(count)
        outside |= np.abs(state) > radius[step]
    return float(outside.mean())


def anticipating(count: int) -> float:
    """Share of paths of x+ = d x + w, |d| <= 0.99, that leave the tube for delta = 0.01 when d sees w."""
    horizon, gain = 2000, 0.99
    known = cb.Constants(gain=gain, sigma=1.0, dimension=1, isotropic=True)
    radius = cb.tune_tube(known, horizon=horizon, delta=0.01).radius(np.arange(horizon + 1.0))
    rng = np.random.default_rng(44)
    state, outside = np.zeros(count), np.zeros(count, dtype=bool)
    for step in range(1, horizon + 1):
        noise = rng.standard_normal(count)
        state = gain * np.sign(state * noise) * state + noise
        outside |= np.abs(state) > radius[step]
    return float(outside.mean())


def cosh_epsilon() -> float:
    """Distance of (2 log 2, 2) from the curve (eps1, eps2) of eq. (7), least over eps."""
    epsilon = np.linspace(1e-3, 1 - 1e-9, 400_001)
    first = -np.log1p(-(epsilon**2)) / epsilon**2
    return float(np.min(np.hypot(first - 2 * math.log(2), 2 / epsilon**2 - 2)))


def lemma_3() -> tuple[float, float]:
    """M = 0, 0, 1 with a = -1, b = 1: the bound on P(M_t > 1/2 for some t), and the truth."""
    values, a, b = [0.0, 0.0, 1.0], -1.0, 1.0
    assert all(following <= a * value + b for value, following in itertools.pairwise(values))
    phi = [a * a, a, 1.0]
    bound = (values[0] * phi[0] + b * phi[1] + b * phi[2]) / 0.5
    return bound, float(max(values) > 0.5)


def unicycle_rate(count: int) -> float:
    """Least Euclidean matrix measure of the unicycle's Jacobian over random states: never below 0 (E10)."""
    problem = cb.load("unicycle")
    names = problem.closed_loop.inputs
    columns = [names.index(state) for state in problem.system.states]
    derivative = compile_numpy(jacobian(problem.closed_loop, columns))
    rng = np.random.default_rng(42)
    px, py = rng.uniform(1, 6, (2, count))
    matrices = derivative(np.zeros(count), px, py, rng.uniform(-np.pi, np.pi, count), rng.uniform(-0.1, 0.1, count))
    return float(np.linalg.eigvalsh((matrices + np.swapaxes(matrices, -1, -2)) / 2)[..., -1].min())


def chain_gain() -> float:
    """Euclidean norm of the chain's Jacobian at rest: at least 1 for every feedback (E11)."""
    problem = cb.load("chain_rest")
    names = problem.closed_loop.inputs
    columns = [names.index(state) for state in problem.system.states]
    values = [0.0] * len(names)
    return float(np.linalg.norm(compile_numpy(jacobian(problem.closed_loop, columns))(*values), 2))


def pointwise_minimum(count: int) -> float:
    """Share of paths outside the pointwise minimum of many Kummer tubes for delta = 0.01 at c = -1, T = 5.

    Each of them is a tube; a proof that used a different one at each time would prove nothing.
    """
    rate, horizon, delta = -1.0, 5.0, 0.01
    times, states = paths(rate, horizon, count=count, points=500, seed=43)
    schedule = make_schedule(cb.Constants(rate=rate, sigma=SIGMA, dimension=1, isotropic=True), horizon)
    lowest = np.full(len(times), np.inf)
    for power in np.geomspace(1e-2, 30, 24):
        for start in np.geomspace(1e-4, 10, 24):
            profile = KummerProfile(schedule=schedule, a=power, v0=start, delta=delta, bessel=False, start=Start())
            lowest = np.minimum(lowest, profile.radius(times))
    return float((np.abs(states) > lowest).any(axis=1).mean())


if __name__ == "__main__":
    main("errata", compute)
