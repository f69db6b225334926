"""Whether steps of a scheme are short enough for a model, and the scheme that bears long ones.

Euler's step multiplies a mode of rate l = a + b i of the drift's Jacobian J by 1 + h l, where e^{h l} is right: it
takes the rate a for log|1 + h l|/h, about a + h (b^2 - a^2)/2. A swing of 197 1/s that is damped by 10 1/s grows at
h = 1 ms. A scheme that moves the state by Phi f multiplies by the eigenvalues of I + Phi J.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.problem.model import Tape, compile_numpy, compile_scalar, jacobian
from certbound.simulation.stepping import StepModel
from certbound.simulation.transition import bridge_shares, exact_transition

_TOLERANCE = 0.2
_PIECES = 40  # of the noise-free path on which Jacobians are looked at
_LOOKS = 5
_HALVINGS = 30
_FASTEST = 50.0  # e-foldings of a piece beyond which the path is not followed
_DEAD = 0.3  # a mode that falls by more within a step follows the others, and only has to fall so far in the scheme

_Matrices = Array  # (k, n, n)


def jacobians(model: StepModel, steps: int, start: Any) -> _Matrices:
    """J along the noise-free path, and beside it by twice the deviation that linear noise has there; finite ones only.

    ``start(rng, count)`` draws starts. The first is J at the first start.
    """
    n, horizon = model.dimension, steps * model.interval
    rng = np.random.default_rng(0)
    drift, slope = compile_scalar(model.drift), compile_scalar(jacobian(model.drift, tuple(range(1, n + 1))))
    law = None if model.law is None else compile_scalar(model.law)
    middle = [0.5 * (low + high) for low, high in zip(model.low, model.high)][: model.disturbance_count]

    def others(time: float, x: list[float]) -> list[float]:
        held = [] if law is None else law(time, *x)
        row = model.table[min(int(time / model.interval), len(model.table) - 1)].tolist() if len(model.table) else []
        return [*held, *row, *middle]

    def at(time: float, x: Array) -> Array:
        point = x.tolist()
        return np.array(slope(time, *point, *others(time, point)), dtype=float).reshape(n, n)

    with np.errstate(all="ignore"):
        x = start(rng, 2)
        first = at(0.0, x[0])
        found = [first, at(0.0, x[1])]
        if not np.all(np.isfinite(first)):
            return np.array([m for m in found if np.all(np.isfinite(m))]).reshape(-1, n, n)
        h = horizon / _PIECES
        if h * np.max(np.linalg.eigvals(first).real) > _FASTEST:
            return np.array(found[:1])
        noise = _diffusion(model, x[0])
        move, _, factor = exact_transition(np.hstack([first, np.eye(n)]), np.zeros(n), noise, h)
        point, cloud = x[0], np.zeros(n)
        for k in range(_PIECES):
            state = point.tolist()
            point = point + move[:, n:] @ np.array(drift(k * h, *state, *others(k * h, state)), dtype=float)
            cloud = move[:, :n] @ cloud + factor @ rng.standard_normal(factor.shape[1])
            if not np.all(np.isfinite(point)):
                break
            if (k + 1) % (_PIECES // _LOOKS) == 0:
                found += [at((k + 1) * h, point), at((k + 1) * h, point + 2.0 * cloud)]
    return np.array([m for m in found if np.all(np.isfinite(m))]).reshape(-1, n, n)


def step_error(matrices: _Matrices, step: float, horizon: float, base: Array | None = None) -> float:
    """The largest error of a mode's rate, over what is allowed: a fifth of it, or of one e-folding in the horizon.

    Of Euler's scheme; with ``base`` of the scheme that is exact where J is that, infinite where that has no numbers.

    Examples
    --------
    >>> swing = np.array([[[0.0, 1.0], [-38_900.0, -20.0]]])
    >>> step_error(swing, 1e-3, 1.0) > 5.0, step_error(swing, 5e-5, 1.0) < 1.0
    (True, True)
    >>> step_error(swing, 1e-3, 1.0, swing[0]) < 1e-9
    True
    """
    worst = 0.0
    move = None if base is None else _propagator(base, step)
    for matrix in matrices:
        rates = np.linalg.eigvals(matrix)
        with np.errstate(divide="ignore"):
            if move is None:
                grown, right = np.log(np.abs(1.0 + step * rates)), step * rates.real
            else:
                scheme = np.eye(len(matrix)) + move @ matrix
                if not np.all(np.isfinite(scheme)):
                    return float("inf")
                moved = np.abs(np.linalg.eigvals(scheme))
                rates = rates[np.argsort(rates.real)]
                grown, right = (np.maximum(x, np.log(_DEAD)) for x in (np.log(np.sort(moved)), step * rates.real))
        allowed = _TOLERANCE * step * np.maximum(np.abs(rates.real), 1.0 / horizon)
        worst = max(worst, float(np.max(np.abs(grown - right) / allowed)))
    return worst


def steps_needed(matrices: _Matrices, steps: int, horizon: float, base: Array | None = None) -> int:
    """The least of steps, 2 steps, 4 steps, ... that are fine enough."""
    for _ in range(_HALVINGS):
        if step_error(matrices, horizon / steps, horizon, base) <= 1.0:
            break
        steps *= 2
    return steps


def exponential(model: StepModel, base: Array, diffusion: Array) -> StepModel:
    """The model with steps that are exact where the drift is linear with Jacobian ``base``.

    x+ = x + Phi f(x) + N(0, S), Phi = int_0^h e^{s J} ds, S = int_0^h e^{s J} g g' e^{s J'} ds (exponential Euler).
    """
    n = model.dimension
    move, _, factor = exact_transition(np.hstack([base, np.eye(n)]), np.zeros(n), diffusion, model.step)
    spread = bridge_shares(base, diffusion, model.step)[:, None] * diffusion * np.sqrt(model.step)
    return replace(model, flow=move[:, n:], noise=factor, spread=spread, scheme="exponential")


def _propagator(base: Array, step: float) -> Array:
    """int_0^h e^{s J} ds."""
    from scipy.linalg import expm

    n = len(base)
    block = np.zeros((2 * n, 2 * n))
    block[:n, :n], block[:n, n:] = base, np.eye(n)
    return np.asarray(expm(block * step)[:n, n:])


def _diffusion(model: StepModel, x: Array) -> Array:
    if isinstance(model.noise, Tape):
        noise: Array = compile_numpy(model.noise)(0.0, *x)
        return noise if np.all(np.isfinite(noise)) else np.zeros(noise.shape)
    return np.asarray(model.noise / np.sqrt(model.step), dtype=float)
