"""Whether steps of a scheme are short enough for a model, and the scheme that bears long ones.

Euler's step multiplies a mode of rate l = a + b i of the drift's Jacobian by 1 + h l, where e^{h l} is right: it
takes the rate a for log|1 + h l|/h, about a + h (b^2 - a^2)/2. A swing of 197 1/s that is damped by 10 1/s grows at
h = 1 ms.

The exponential midpoint rule splits the drift into J x and a rest N. In a pair of steps of length h,

    c = E x + A N(x) + w_1,      y = E x + P N(c) - B (N(c) - N(x)) + w_1,
    d = E y + P N(c) + w_2,      z = d + C (N(d) - N(c)),

E = e^{h J}, P = int_0^h e^{s J} ds and w_1, w_2 ~ N(0, int_0^h e^{s J} g g' e^{s J'} ds): exact where N is constant, of
weak order 2 where g is (Hochbruck and Ostermann, Exponential integrators, 2010). On modes that die out within a step A
is P, and B and C are those of an N that grows evenly, so that paths end on slow manifolds. Elsewhere A is h, and B and
C are 0: where N is a force, a function of positions that acts on velocities, N(c) is then N(E x + w_1), the rule is
symmetric in time, and adds no damping and no energy to a swing, however light.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.problem.model import Tape, compile_numpy, compile_scalar, jacobian
from certbound.simulation.stepping import Exponential, StepModel
from certbound.simulation.transition import bridge_spread, exact_transition

_TOLERANCE = 0.2
_PIECES = 40  # of the noise-free path on which Jacobians are looked at
_LOOKS = 5
_HALVINGS = 30
_FASTEST = 50.0  # e-foldings of a piece beyond which the path is not followed
_OBLIQUE = 1e6  # norm of a projection beyond which modes are not told apart
_DEAD = 0.3  # a mode that falls by more within a step follows the others, and only has to fall so far in the scheme

_Matrices = Array  # (k, n, n)


def jacobians(
    model: StepModel, steps: int, start: Any, stays: Callable[[Array, float], bool] = lambda state, time: True
) -> _Matrices:
    """J along the noise-free path, and beside it by twice the deviation that linear noise has there; finite ones only.

    ``start(rng, count)`` draws starts, and the path ends where ``stays(state, time)`` is false. The first is J at the
    first start.
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
        move, _, factor = exact_transition(first, np.zeros(n), noise, h)
        point, cloud, scheme = x[0], np.zeros(n), exponential_step(first, 0.5 * h)

        def rest(time: float, state: Array) -> Array:
            values = state.tolist()
            return np.array(drift(time, *values, *others(time, values)), dtype=float) - first @ state

        for k in range(_PIECES):
            lead = scheme.move @ point + scheme.lead @ rest(k * h, point)
            renewed = rest((k + 0.5) * h, lead)
            taken = scheme.response @ renewed
            point = scheme.move @ point + taken - scheme.first @ (renewed - rest(k * h, point))
            point = scheme.move @ point + taken
            point = point + scheme.second @ (rest((k + 1) * h, point) - renewed)
            cloud = move @ cloud + factor @ rng.standard_normal(factor.shape[1])
            if not (np.all(np.isfinite(point)) and stays(point, (k + 1) * h)):
                break
            if (k + 1) % (_PIECES // _LOOKS) == 0:
                found += [at((k + 1) * h, point), at((k + 1) * h, point + 2.0 * cloud)]
    return np.array([m for m in found if np.all(np.isfinite(m))]).reshape(-1, n, n)


def step_error(matrices: _Matrices, step: float, horizon: float, base: Array | None = None) -> float:
    """The largest error of a mode's rate, over what is allowed: a fifth of it, or of one e-folding in the horizon.

    Of Euler's scheme; with ``base`` of the exponential one that is exact where J is that, infinite where it has no
    numbers.

    Examples
    --------
    >>> swing = np.array([[[0.0, 1.0], [-38_900.0, -20.0]]])
    >>> step_error(swing, 1e-3, 1.0) > 5.0, step_error(swing, 5e-5, 1.0) < 1.0
    (True, True)
    >>> step_error(swing, 1e-3, 1.0, swing[0]) < 1e-9
    True
    """
    worst, scheme = 0.0, None if base is None else exponential_step(base, step)
    if scheme is not None and not all(np.all(np.isfinite(m)) for m in (scheme.move, scheme.response, scheme.lead)):
        return float("inf")
    for matrix in matrices:
        rates = np.linalg.eigvals(matrix)
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
            if scheme is None:
                span, grown, right = step, np.log(np.abs(1.0 + step * rates)), step * rates.real
            else:
                span, pair = 2.0 * step, _pair(scheme, matrix)
                if not np.all(np.isfinite(pair)):
                    return float("inf")
                moved = np.sort(np.abs(np.linalg.eigvals(pair)))
                rates = rates[np.argsort(rates.real)]
                grown, right = (np.maximum(x, np.log(_DEAD)) for x in (np.log(moved), span * rates.real))
        allowed = _TOLERANCE * span * np.maximum(np.abs(rates.real), 1.0 / horizon)
        worst = max(worst, float(np.max(np.abs(grown - right) / allowed)))
    return worst


def _pair(scheme: Exponential, matrix: Array) -> Array:
    """The matrix of a pair of steps of the exponential scheme where the drift is ``matrix`` x."""
    rest = matrix - scheme.base
    taken = rest @ (scheme.move + scheme.lead @ rest)
    middle = scheme.move + scheme.response @ taken - scheme.first @ (taken - rest)
    end = scheme.move @ middle + scheme.response @ taken
    return end + scheme.second @ (rest @ end - taken)


def linear_part(matrices: _Matrices, step: float, horizon: float) -> Array:
    """The J of the exponential scheme: the first, or the mean of all where the error is half as large with it."""
    first: Array = matrices[0]
    mean = np.asarray(np.mean(matrices, axis=0))
    errors = [step_error(matrices, step, horizon, base) for base in (first, mean)]
    return mean if 2.0 * errors[1] < errors[0] else first


def steps_needed(matrices: _Matrices, steps: int, horizon: float, base: Array | None = None) -> int:
    """The least of steps, 2 steps, 4 steps, ... that are fine enough."""
    for _ in range(_HALVINGS):
        if step_error(matrices, horizon / steps, horizon, base) <= 1.0:
            break
        steps *= 2
    return steps


def exponential_step(base: Array, step: float) -> Exponential:
    """The matrices of the exponential midpoint rule that is exact where the drift is linear with Jacobian ``base``."""
    identity = np.eye(len(base))
    with np.errstate(all="ignore"):
        move, response, growing = _propagator(base, step)
        fast = _fast_modes(base, step) if np.all(np.isfinite(growing)) else identity
        lead, first = step * identity + (response - step * identity) @ fast, (response - growing) @ fast
        return Exponential(base=base, move=move, response=response, lead=lead, first=first, second=growing @ fast)


def exponential(model: StepModel, base: Array) -> StepModel:
    """The model with steps of the exponential midpoint rule; noise that depends on the state acts in their middle."""
    scheme = exponential_step(base, model.step)
    if isinstance(model.noise, Tape):
        return replace(model, exponential=scheme, scheme="exponential")
    diffusion = model.noise / np.sqrt(model.step)
    _, _, factor = exact_transition(base, np.zeros(model.dimension), diffusion, model.step)
    rough = bridge_spread(base, diffusion, model.step)
    spread = rough * np.any(diffusion != 0.0, axis=1)[:, None]  # what follows noise does so by another slope elsewhere
    return replace(
        model, exponential=scheme, noise=factor, spread=spread, rough=rough, carry=scheme.move, scheme="exponential"
    )


def _fast_modes(base: Array, step: float) -> Array:
    """The projection on the modes that die out within a step, along the others; all where these are not apart."""
    from scipy.linalg import schur, solve_sylvester

    n = len(base)
    sorted_schur: Any = schur
    form, turn, count = sorted_schur(base, output="complex", sort=lambda rate: rate.real * step < -1.0)
    if count in (0, n):
        return np.asarray(np.eye(n) * (count > 0))
    coupling = solve_sylvester(form[:count, :count], -form[count:, count:], -form[:count, count:])
    if not np.linalg.norm(coupling) < _OBLIQUE:
        return np.eye(n)
    inner = np.zeros((n, n), dtype=complex)
    inner[:count, :count], inner[:count, count:] = np.eye(count), -coupling
    return np.asarray((turn @ inner @ turn.conj().T).real)


def _propagator(base: Array, step: float) -> tuple[Array, Array, Array]:
    """e^{h J}, int_0^h e^{s J} ds and int_0^h e^{(h - s) J} s/h ds."""
    from scipy.linalg import expm

    n = len(base)
    block = np.zeros((3 * n, 3 * n))
    block[:n, :n], block[:n, n : 2 * n], block[n : 2 * n, 2 * n :] = base * step, np.eye(n) * step, np.eye(n)
    whole = np.asarray(expm(block))
    return whole[:n, :n], whole[:n, n : 2 * n], whole[:n, 2 * n :]


def _diffusion(model: StepModel, x: Array) -> Array:
    if isinstance(model.noise, Tape):
        noise: Array = compile_numpy(model.noise)(0.0, *x)
        return noise if np.all(np.isfinite(noise)) else np.zeros(noise.shape)
    return np.asarray(model.noise / np.sqrt(model.step), dtype=float)
