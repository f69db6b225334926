"""Linear models with additive noise, and their certificates by the exact law."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from flint import ctx

import certbound as cb
from certbound.checker.affine import check_affine
from certbound.checker.report import Budget
from certbound.checker.statement import Model, read_model
from certbound.safety.certificate import problem_data
from certbound.safety.certificates import law_proof

OPEN = float("inf")


def linear_problem(
    slope: Any, diffusion: Any, bounds: Sequence[float], *, horizon: float, initial: Any = None, drift: Any = None,
    gain: Any = None, delta: float = 0.1, safe: Any = None,
) -> cb.Problem:  # fmt: skip
    """dX = (A X + c + E d) dt + G dW with |x_i| at most the bounds (infinite: no limit), from 0 by default."""
    a, n = np.asarray(slope, dtype=float), len(slope)
    c = np.zeros(n) if drift is None else np.asarray(drift, dtype=float)
    e = None if gain is None else np.asarray(gain, dtype=float)

    def move(x: Any, d: Any = None) -> Any:
        flow = [sum((a[i, j] * x[j] for j in range(n)), 0 * x[0]) + c[i] for i in range(n)]
        return flow if e is None else [f + sum(e[i, j] * d[j] for j in range(e.shape[1])) for i, f in enumerate(flow)]

    given = {} if e is None else {"disturbance": cb.Box([-1.0] * e.shape[1], [1.0] * e.shape[1])}
    dynamics = (lambda x: move(x)) if e is None else move
    system = cb.ContinuousSystem(dynamics, states=n, diffusion=np.asarray(diffusion, dtype=float), **given)
    limits = [cb.Inside(cb.Box([-b for b in bounds], list(bounds)))] if safe is None else safe
    start = [0.0] * n if initial is None else initial
    return cb.Problem(system, initial=start, safe=limits, horizon=horizon, delta=delta)


def oscillator(**changes: Any) -> cb.Problem:
    """A damped spring that noise pushes; its place is limited."""
    given: dict[str, Any] = {"bounds": [1.5, OPEN], "horizon": 30.0} | changes
    return linear_problem([[0, 1], [-1, -0.2]], [[0], [0.2]], **given)


def ornstein_uhlenbeck(**changes: Any) -> cb.Problem:
    """dX = -X dt + 0.3 dW within [-1, 1]."""
    return linear_problem([[-1.0]], [[0.3]], **({"bounds": [1.0], "horizon": 10.0} | changes))


def correlated(**changes: Any) -> cb.Problem:
    """Two states that correlated noise moves, both with limits."""
    given: dict[str, Any] = {"bounds": [1.2, 1.2], "horizon": 20.0} | changes
    return linear_problem([[-1, 0.5], [0, -2]], [[0.3, 0.1], [0.1, 0.4]], **given)


def read(problem: cb.Problem) -> Model:
    """The problem as the checker reads it."""
    with ctx.workprec(128):
        return read_model(json.loads(json.dumps(problem_data(problem))), Budget(60.0))


def proved(problem: cb.Problem, proof: Any = None) -> float:
    """The checker's bound of P(fail), from the writer's proof or another one."""
    given = json.loads(json.dumps(law_proof(problem)[0] if proof is None else proof))
    with ctx.workprec(128):
        return float(check_affine(read(problem), given, Budget(60.0)).upper())


def two_areas(horizon: float, delta: float) -> cb.Problem:
    """Two power areas of eleven states: frequencies within 0.2 Hz, under loads that are Ornstein-Uhlenbeck processes.

    Governors (0.2 s) and turbines (0.5 s) answer the frequencies of areas of 20 s, with a tie line between them.
    """

    def move(x: Any) -> list[Any]:
        f1, m1, p1, f2, m2, p2, tie, i1, i2, l1, l2 = x
        u1, u2 = -0.1 * f1 - 0.01 * i1, -0.1 * f2 - 0.01 * i2
        return [
            6.0 * (p1 - l1 - tie) - f1 / 20, (-m1 - f1 / 2.4 + u1) / 0.2, (m1 - p1) / 0.5,
            6.0 * (p2 - l2 + tie) - f2 / 20, (-m2 - f2 / 2.4 + u2) / 0.2, (m2 - p2) / 0.5,
            0.1 * (f1 - f2), f1, f2, -l1 / 30, -l2 / 30,
        ]  # fmt: skip

    noise = np.zeros((11, 2))
    noise[9, 0] = noise[10, 1] = 0.04 * np.sqrt(2 / 30)
    high = [OPEN] * 11
    high[0] = high[3] = 0.2
    safe = [cb.Inside(cb.Box([-x for x in high], high))]
    system = cb.ContinuousSystem(move, states=11, diffusion=noise)
    return cb.Problem(system, initial=[0.0] * 11, safe=safe, horizon=horizon, delta=delta)
