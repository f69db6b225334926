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
