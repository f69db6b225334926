"""Linear models with Gaussian noise by their exact law: both bounds beside simulation, and seconds of one core.

Two areas of a load-frequency control over 20 to 1000 s, random stable systems of 5 to 30 states (limits with and
without noise of their own, rates up to a hundred apart), a thermal network with rates from 1e-4 to 1e4, and a beam of
60 modes with a damping of 1e-3. Simulations move by exact transition matrices, with the crossing probability of a
Brownian bridge between two samples where noise drives a limit's row itself; elsewhere what happens between samples is
missed.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm, solve_continuous_lyapunov

import certbound as cb
from certbound.reach.affine import affine_answer, affine_failing
from experiments.harness import Arrays, Claims, main

__all__ = ["areas", "beam", "compute", "random_model", "simulated", "thermal"]

SYSTEMS, MORE = 20, 60  # random systems, and in full
HORIZONS = (20.0, 40.0, 120.0, 1000.0)


@dataclass(frozen=True, eq=False)
class Model:
    """dX = A X dt + G dW from 0; fails where some \\|row X\\| exceeds its level."""

    slope: np.ndarray
    noise: np.ndarray
    rows: np.ndarray
    levels: np.ndarray
    horizon: float

    def problem(self) -> cb.Problem:
        """The same for certbound."""
        n = len(self.slope)
        system = cb.linear_system(self.slope, diffusion=self.noise)
        safe = [
            cb.Inside(cb.HalfSpace(sign * row, float(level)))
            for row, level in zip(self.rows, self.levels) for sign in (1.0, -1.0)
        ]  # fmt: skip
        return cb.Problem(system, initial=np.zeros(n), safe=safe, horizon=self.horizon, delta=0.05)


def areas(horizon: float) -> Model:
    """Two areas with integral control, loads as Ornstein-Uhlenbeck processes: f, m, p of each, tie line, i, l."""
    f, m, p, i, load = ((0, 3), (1, 4), (2, 5), (7, 8), (9, 10))
    slope, noise = np.zeros((11, 11)), np.zeros((11, 2))
    for k, sign in enumerate((-1.0, 1.0)):
        slope[f[k], [p[k], load[k], 6, f[k]]] = [6.0, -6.0, 6.0 * sign, -0.05]
        slope[m[k], [m[k], f[k], i[k]]] = [-5.0, -5.0 * (1 / 2.4 + 0.1), -0.05]
        slope[p[k], [p[k], m[k]]] = [-2.0, 2.0]
        slope[i[k], f[k]], slope[load[k], load[k]] = 1.0, -1 / 30
        noise[load[k], k] = 0.04 * np.sqrt(2 / 30)
    slope[6, list(f)] = [0.1, -0.1]
    return Model(slope, noise, np.eye(11)[list(f)], np.full(2, 0.2), horizon)


def random_model(seed: int) -> Model:
    """A stable system of 5 to 30 states, one to three limits at 2.8 to 5 standard deviations."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(5, 31))
    slope = rng.standard_normal((n, n)) / np.sqrt(n)
    slope -= (np.linalg.eigvals(slope).real.max() + rng.uniform(0.05, 1)) * np.eye(n)
    slope = np.exp(rng.uniform(-0.5, 0.5, n) * np.log(rng.choice([1, 10, 100])))[:, None] * slope
    slope -= max(np.linalg.eigvals(slope).real.max() + 0.02 + rng.uniform(0, 0.3), 0.0) * np.eye(n)
    noise = np.zeros((n, int(rng.integers(1, n // 2 + 1))))
    for column in range(noise.shape[1]):
        noise[rng.integers(n), column] = rng.uniform(0.2, 1)
    chosen = rng.choice(n, size=int(rng.integers(1, 4)), replace=False)
    spread = np.sqrt(np.diag(solve_continuous_lyapunov(slope, -noise @ noise.T))[chosen])
    levels = spread * rng.uniform(2.8, 5) * rng.uniform(1, 1.1, len(chosen))
    return Model(slope, noise, np.eye(n)[chosen], levels, float(10 ** rng.uniform(0.5, 2.5)))


def thermal(horizon: float = 1e4) -> Model:
    """Twelve masses in a row with rates from 1e-4 to 1e4, a noisy sink at the slow end and a limit at the third."""
    rates = 10.0 ** np.linspace(-4, 4, 12)
    slope = np.diag(-2 * rates) + np.diag(rates[1:], -1) + np.diag(0.3 * rates[:-1], 1)
    noise = np.zeros((12, 1))
    noise[0] = 0.02
    spread = solve_continuous_lyapunov(slope, -noise @ noise.T)
    return Model(slope, noise, np.eye(12)[[2]], 4.0 * np.sqrt(spread[[2], [2]]), horizon)


def beam(horizon: float = 10.0, modes: int = 60) -> Model:
    """The tip of a cantilever whose modes, damped by 1e-3, are driven by white noise at the tip."""
    places = (np.arange(modes) + 0.5) * np.pi
    speeds = 2 * np.pi * (places / places[0]) ** 2
    slope, noise = np.zeros((2 * modes, 2 * modes)), np.zeros((2 * modes, 1))
    signs = (-1.0) ** np.arange(modes)
    for k, speed in enumerate(speeds):
        slope[2 * k, 2 * k + 1], slope[2 * k + 1, 2 * k], slope[2 * k + 1, 2 * k + 1] = 1, -(speed**2), -2e-3 * speed
        noise[2 * k + 1] = 2 * signs[k]
    row = np.zeros(2 * modes)
    row[::2] = 2 * signs
    step = horizon / 256
    flow, spread = _moved(slope, noise, step)
    whole = np.zeros_like(spread)
    for _ in range(256):
        whole = flow @ whole @ flow.T + spread
    return Model(slope, noise, row[None], 4.0 * np.sqrt([row @ whole @ row]), horizon)


def _moved(slope: np.ndarray, noise: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Transition matrix and covariance of a step, by doubling."""
    halvings = max(0, int(np.ceil(np.log2(np.abs(slope).sum(axis=1).max() * step))) + 1)
    n, gram = len(slope), noise @ noise.T
    block = expm(np.block([[-slope, gram], [np.zeros((n, n)), slope.T]]) * step / 2**halvings)
    flow = block[n:, n:].T
    spread = flow @ block[:n, n:]
    for _ in range(halvings):
        spread = spread + flow @ spread @ flow.T
        flow = flow @ flow
    return flow, (spread + spread.T) / 2


def simulated(model: Model, steps: int, paths: int, seed: int = 0) -> float:
    """How often paths leave."""
    flow, spread = _moved(model.slope, model.noise, model.horizon / steps)
    values, vectors = np.linalg.eigh(spread)
    root = (vectors * np.sqrt(np.maximum(values, 0)))[:, values > 1e-15 * values.max()]
    rng = np.random.default_rng(seed)
    own = ((model.rows @ model.noise) ** 2).sum(axis=1) * model.horizon / steps
    x = np.zeros((paths, len(flow)))
    y = x @ model.rows.T
    for _ in range(steps):
        before = y
        x = x @ flow.T + rng.standard_normal((len(x), root.shape[1])) @ root.T
        y = x @ model.rows.T
        left = np.any(np.abs(y) > model.levels, axis=1)
        for sign in (1, -1) if np.any(own > 0) else ():
            gaps = np.maximum(model.levels - sign * before, 0) * np.maximum(model.levels - sign * y, 0)
            between = np.where(own > 0, np.exp(-2 * gaps / np.where(own > 0, own, 1.0)), 0.0)
            left |= np.any(rng.random(y.shape) < between, axis=1)
        x, y = x[~left], y[~left]
    return 1 - len(x) / paths


def _row(name: str, model: Model, paths: int, most_steps: int = 4000) -> dict[str, float]:
    problem = model.problem()
    begun = time.process_time()
    above = affine_answer(problem)
    between = time.process_time()
    below = affine_failing(problem)
    seconds = between - begun, time.process_time() - between
    assert above is not None
    upper, lower = 10**above.log10_delta, 0.0 if below is None else below.probability
    speed = float(np.abs(np.linalg.eigvals(model.slope)).max())
    steps = int(min(max(10 * model.horizon * speed, 200), most_steps))
    seen = simulated(model, steps, paths) if paths * upper > 20 else float("nan")
    print(f"{name:16} {len(model.slope):3} states  [{lower:.3g}, {upper:.3g}]  simulated {seen:.3g}  "
          f"{seconds[0]:.1f} s + {seconds[1]:.1f} s", flush=True)  # fmt: skip
    return {"upper": upper, "lower": lower, "simulated": seen if np.isfinite(seen) else -1.0}


def compute(full: bool) -> tuple[Arrays, Claims]:
    """Bounds and simulated frequencies of every model."""
    paths = 200_000 if full else 20_000
    rows: Claims = {}
    for horizon in HORIZONS:
        few = max(int(paths * min(1.0, 100 / horizon)), 4000)
        rows[f"areas {horizon:g} s"] = _row(f"areas {horizon:g} s", areas(horizon), few, int(20 * horizon))
    rows["thermal"] = _row("thermal", thermal(), paths)
    rows["beam"] = _row("beam", beam(modes=60 if full else 10), paths // 20)
    for seed in range(MORE if full else SYSTEMS):
        rows[f"random {seed}"] = _row(f"random {seed}", random_model(seed), paths)
    ratios = np.array([row["upper"] / row["simulated"] for row in rows.values() if row["simulated"] > 0])
    print(f"upper/simulated: median {np.median(ratios):.2f}, largest {ratios.max():.2f}", flush=True)
    return {"ratio": ratios}, {"table": rows, "median": float(np.median(ratios)), "worst": float(ratios.max())}


if __name__ == "__main__":
    main("affine_laws", compute)
